//! Folders and images of a synthetic capture.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use city::trace::Frame;
use image::{ColorType, ImageFormat};
use store::file::{SaveError, save};

/// Creates a folder and its parents.
pub(super) fn create_folder(folder: &Path) -> Result<(), SaveError> {
    fs::create_dir_all(folder).map_err(|e| SaveError::new(folder, &e))
}

/// Writes pixels of the frame's size as PNG.
pub(super) fn write_png(path: &Path, bytes: &[u8], frame: &Frame, kind: ColorType) -> Result<(), SaveError> {
    let mut png = Cursor::new(Vec::new());
    image::write_buffer_with_format(&mut png, bytes, frame.width, frame.height, kind, ImageFormat::Png)
        .map_err(|e| SaveError::new(path, &e))?;
    save(path, png.get_ref())
}
