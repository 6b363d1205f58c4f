//! Finds masks that the capture does not name, in the places where tools write them:
//!
//! ```text
//! masks/NAME.png           NAME with the photo's extension (COLMAP) or without; also mask/
//! images/NAME.mask.png     beside the photo, NAME with its extension or without
//! ```

use std::path::{Path, PathBuf};

use super::files::CaptureRoot;
use super::parsed::OpenOptions;

/// The mask folders of the capture.
pub(super) fn folders(root: &CaptureRoot) -> Vec<&'static str> {
    ["masks", "mask"].into_iter().filter(|folder| root.path(folder).is_dir()).collect()
}

/// The mask of a photo. `file` is its path relative to the capture, possibly without the extension that `path` has.
pub(super) fn find(
    root: &CaptureRoot,
    folders: &[&str],
    file: &str,
    path: &Path,
    options: &OpenOptions,
) -> Option<PathBuf> {
    let extension = path.extension()?.to_str()?;
    let stem = file.strip_suffix(extension).and_then(|stem| stem.strip_suffix('.')).unwrap_or(file);
    let images = options.images.as_deref().unwrap_or("images").trim_end_matches('/');
    let inner = stem.strip_prefix(images).and_then(|rest| rest.strip_prefix('/')).unwrap_or(stem);
    let in_folders = folders.iter().flat_map(|folder| {
        [format!("{folder}/{inner}.{extension}.png"), format!("{folder}/{inner}.png"), format!("{folder}/{stem}.png")]
    });
    let beside = [format!("{stem}.{extension}.mask.png"), format!("{stem}.mask.png")];
    in_folders.chain(beside).find_map(|name| root.file(&name))
}
