//! Where cameras come from: captures, and files of cameras alone.

use std::path::Path;

use dataset::ingest::shrink;
use dataset::mips::SHORTEST_SIDE;
use dataset::open::{OpenOptions, Source};
use scene::{BadInput, Camera, Capture, Pinhole};

use crate::output::Output;

/// Opens a capture and says what of it was left out.
pub(crate) fn open(path: &Path, output: &Output) -> Result<Source, BadInput> {
    let source = dataset::open::open(path, &OpenOptions::default())?;
    const SHOWN: usize = 3;
    for (name, why) in source.left_out.iter().take(SHOWN) {
        output.note(format!("left out {name}: {why}"));
    }
    if source.left_out.len() > SHOWN {
        output.note(format!("left out {} more images", source.left_out.len() - SHOWN));
    }
    Ok(source)
}

/// What a person calls the capture: the name of its folder.
pub(crate) fn name_of(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The capture as ingest will leave it at one over `downscale` of its size, but for the photos.
///
/// # Errors
/// A factor that leaves too little of a photo.
pub(crate) fn shrunk(capture: &Capture, downscale: u32) -> Result<Capture, BadInput> {
    let mut capture = capture.clone();
    for view in &mut capture.views {
        let k = &mut view.camera.pinhole;
        *k = shrink(*k, downscale);
        if downscale > 1 && k.width.min(k.height) < SHORTEST_SIDE {
            let problem = format!("{downscale} leaves less than {SHORTEST_SIDE} pixels of {}", view.name);
            return Err(BadInput::new("--downscale", problem, "give a smaller factor"));
        }
    }
    Ok(capture)
}

/// The camera with its picture stretched to this size.
pub(crate) fn resized(camera: &Camera, width: u32, height: u32) -> Camera {
    let k = &camera.pinhole;
    let (x, y) = (f64::from(width) / f64::from(k.width), f64::from(height) / f64::from(k.height));
    let pinhole = Pinhole { width, height, fx: k.fx * x, fy: k.fy * y, cx: k.cx * x, cy: k.cy * y };
    Camera { pinhole, ..*camera }
}

/// The names and cameras of a capture, whose photos need not be there, or of a `transforms.json`.
pub(crate) fn read(path: &Path) -> Result<Vec<(String, Camera)>, BadInput> {
    let source = dataset::open::open(path, &OpenOptions { cameras_only: true, ..OpenOptions::default() })?;
    Ok(source.capture.views.into_iter().map(|view| (view.name, view.camera)).collect())
}
