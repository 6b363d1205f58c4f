//! Finds the depth maps of photos:
//!
//! ```text
//! depths/NAME.npy          or NAME.png, NAME being that of the photo without extension
//! ```
//!
//! A frame's `depth_file_path` in `transforms.json` comes before them, and a folder given by the user before both. Photos without
//! a map are no error.

use scene::BadInput;

use super::files::{self, CaptureRoot, Found};
use super::parsed::PosedImage;
use crate::depth_maps::{DepthFile, DepthMapOptions};

/// The capture's own folder.
const FOLDER: &str = "depths";

/// Where the depth maps of a capture are.
pub(super) struct Maps<'a> {
    options: &'a DepthMapOptions,
    /// The user's folder.
    given: Option<CaptureRoot>,
    /// Whether the capture has a folder of its own.
    has_own: bool,
}

impl<'a> Maps<'a> {
    /// # Errors
    /// A folder given by the user that is none.
    pub(super) fn new(root: &CaptureRoot, options: &'a DepthMapOptions) -> Result<Self, BadInput> {
        let given = match &options.folder {
            Some(folder) if folder.is_dir() => Some(CaptureRoot::new(folder)?),
            Some(folder) => {
                let advice = "give the folder of depth maps";
                return Err(BadInput::new(files::show(folder), "is not a folder", advice));
            }
            None => None,
        };
        Ok(Self { options, given, has_own: root.path(FOLDER).is_dir() })
    }

    /// The map of a photo.
    ///
    /// # Errors
    /// The capture names a file outside of it.
    pub(super) fn find(&self, root: &CaptureRoot, image: &PosedImage) -> Result<Option<DepthFile>, BadInput> {
        let named = match &image.depth {
            Some(name) if self.given.is_none() => match root.image(name)? {
                Found::File(path) => Some(path),
                Found::Missing => None,
            },
            _ => None,
        };
        let in_folder = || {
            let stem = files::stem(&image.name);
            ["npy", "png"].iter().find_map(|extension| match &self.given {
                Some(folder) => folder.file(&format!("{stem}.{extension}")),
                None if self.has_own => root.file(&format!("{FOLDER}/{stem}.{extension}")),
                None => None,
            })
        };
        Ok(named.or_else(in_folder).map(|path| DepthFile::new(path, self.options)))
    }

    /// Refuses a folder of the user's in which no photo has a map.
    pub(super) fn check(&self, found: usize, images: &[PosedImage]) -> Result<(), BadInput> {
        let (Some(folder), Some(first)) = (self.options.folder.as_ref().filter(|_| found == 0), images.first()) else {
            return Ok(());
        };
        let problem = "has no depth map of any photo of the capture";
        let advice = format!("name them like the photos, such as {}.npy or .png", files::stem(&first.name));
        Err(BadInput::new(files::show(folder), problem, advice))
    }
}
