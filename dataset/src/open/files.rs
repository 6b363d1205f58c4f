//! Access to the files of a capture, confined to its folder.

use std::fmt;
use std::fs::File;
use std::io::BufReader;
use std::path::{Component, Path, PathBuf};

use image::ImageError;
use scene::BadInput;

use crate::{mip_tiles, photo};

/// Longest side of a photo in pixels: the limit of JPEG.
const MAX_SIDE: u32 = 65_535;
/// Extensions tried for images named without one.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];

/// The canonical folder of a capture.
pub(super) struct CaptureRoot(PathBuf);

/// Result of the search for a file.
pub(super) enum Found {
    /// Canonical, inside the capture.
    File(PathBuf),
    /// No such file.
    Missing,
}

impl fmt::Display for CaptureRoot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.display().fmt(f)
    }
}

impl CaptureRoot {
    /// The folder `path`, or the folder of the file `path`.
    pub(super) fn new(path: &Path) -> Result<Self, BadInput> {
        let cannot = |e| BadInput::new(show(path), format!("cannot be opened ({e})"), "give the folder of a capture");
        let path = path.canonicalize().map_err(cannot)?;
        match path.parent() {
            Some(folder) if path.is_file() => Ok(Self(folder.to_path_buf())),
            _ => Ok(Self(path)),
        }
    }

    /// Joins a name to the folder. Neither existence nor confinement is checked.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// The canonical path of an optional file; `None` if it does not exist or lies outside.
    pub(super) fn file(&self, name: &str) -> Option<PathBuf> {
        let path = self.0.join(name).canonicalize().ok()?;
        (path.is_file() && path.starts_with(&self.0)).then_some(path)
    }

    /// The file of an image or another file named by the capture, possibly without its extension.
    ///
    /// # Errors
    /// The name leads out of the capture.
    pub(super) fn image(&self, name: &str) -> Result<Found, BadInput> {
        let outside = || {
            let problem = "lies outside of the capture";
            BadInput::new(format!("{self}: file {name}"), problem, "move it into the capture's folder")
        };
        let mut depth = 0;
        for component in Path::new(name).components() {
            depth += match component {
                Component::Normal(_) => 1,
                Component::CurDir => 0,
                Component::ParentDir if depth > 0 => -1,
                _ => return Err(outside()),
            };
        }
        let with_extension = EXTENSIONS.iter().map(|extension| format!("{name}.{extension}"));
        for name in std::iter::once(name.to_string()).chain(with_extension) {
            let Ok(path) = self.0.join(name).canonicalize() else { continue };
            if !path.starts_with(&self.0) {
                return Err(outside());
            }
            if path.is_file() {
                return Ok(Found::File(path));
            }
        }
        Ok(Found::Missing)
    }
}

/// Whether there are images in the folder or its `images`.
pub(super) fn has_photos(root: &CaptureRoot) -> bool {
    let is_image = |path: &Path| {
        let extension = path.extension().and_then(|end| end.to_str());
        extension.is_some_and(|end| EXTENSIONS.contains(&end))
    };
    let entries = ["", "images"].into_iter().filter_map(|folder| root.path(folder).read_dir().ok());
    entries.flatten().flatten().any(|entry| is_image(&entry.path()))
}

/// Width and height from the image's header.
pub(super) fn image_size(path: &Path) -> Result<(u32, u32), BadInput> {
    let cannot = |e: &dyn fmt::Display| {
        let problem = format!("is not an image that can be read ({e})");
        BadInput::new(show(path), problem, "replace the file or take its image out of the capture")
    };
    let file = File::open(path).map_err(|e| cannot(&e))?;
    let (width, height) = photo::size(BufReader::new(file)).map_err(|e| match e {
        ImageError::Limits(_) => cannot(&"its header claims more pixels than any photo has"),
        other => cannot(&other),
    })?;
    check_size(path, width, height)?;
    Ok((width, height))
}

/// Refuses sizes that no photo has. Allocations and loops over the border of an image depend on this limit.
pub(super) fn check_size(path: &Path, width: u32, height: u32) -> Result<(), BadInput> {
    let area = u64::from(width) * u64::from(height);
    if area == 0 || area > mip_tiles::MAX_PIXELS || width.max(height) > MAX_SIDE {
        let max = mip_tiles::MAX_PIXELS;
        let problem = format!("claims {width}×{height} pixels: none, over {MAX_SIDE} a side or over {max} in all");
        return Err(BadInput::new(show(path), problem, "replace the file or take its image out of the capture"));
    }
    Ok(())
}

/// Reads a whole file.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, BadInput> {
    std::fs::read(path).map_err(|e| BadInput::new(show(path), format!("cannot be read ({e})"), "check the file"))
}

/// A path for messages.
pub(super) fn show(path: &Path) -> String {
    path.display().to_string()
}

/// Names that an error lists.
const LISTED: usize = 5;

/// Names for a message: the first ones, and the number of the others.
pub(super) fn listed<S: AsRef<str>>(names: impl ExactSizeIterator<Item = S>) -> String {
    let more = names.len().saturating_sub(LISTED);
    let first: Vec<String> = names.take(LISTED).map(|name| name.as_ref().chars().take(40).collect()).collect();
    first.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() }
}

/// The name of a photo without `images/` and extension.
pub(super) fn stem(name: &str) -> &str {
    let name = name.strip_prefix("images/").unwrap_or(name);
    match name.rsplit_once('.') {
        Some((stem, extension)) if !extension.contains('/') => stem,
        _ => name,
    }
}
