//! Masks that no file names, found where tools leave them:
//!
//! ```text
//! masks/NAME.png           NAME with the photo's extension (COLMAP) or without; also mask/
//! images/NAME.mask.png     beside the photo, NAME with its extension or without
//! ```

use std::path::{Path, PathBuf};

use super::OpenOptions;
use super::files::Root;

/// The folders of masks that the capture has.
pub(super) fn folders(root: &Root) -> Vec<&'static str> {
    ["masks", "mask"].into_iter().filter(|folder| root.path(folder).is_dir()).collect()
}

/// The mask of a photo: `file` is its place in the capture, at times without the extension that its `path` has.
pub(super) fn find(root: &Root, folders: &[&str], file: &str, path: &Path, options: &OpenOptions) -> Option<PathBuf> {
    let extension = path.extension()?.to_str()?;
    let stem = file.strip_suffix(extension).and_then(|stem| stem.strip_suffix('.')).unwrap_or(file);
    let images = options.images.as_deref().unwrap_or("images").trim_end_matches('/');
    let inner = stem.strip_prefix(images).and_then(|rest| rest.strip_prefix('/')).unwrap_or(stem);
    let apart = folders.iter().flat_map(|folder| {
        [format!("{folder}/{inner}.{extension}.png"), format!("{folder}/{inner}.png"), format!("{folder}/{stem}.png")]
    });
    let beside = [format!("{stem}.{extension}.mask.png"), format!("{stem}.mask.png")];
    apart.chain(beside).find_map(|name| root.file(&name))
}
