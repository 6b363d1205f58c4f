//! Files inside a capture, and nowhere else.

use std::fmt;
use std::fs::File;
use std::io::BufReader;
use std::path::{Component, Path, PathBuf};

use image::ImageError;
use scene::BadInput;

use crate::{mips, photo};

/// Pixels of the longest side of a photo: as many as a JPEG can have.
const LONGEST_SIDE: u32 = 65_535;
/// Extensions that are tried where a capture names images without one.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];

/// The folder of a capture.
pub(super) struct Root(PathBuf);

/// What became of the search for a file.
pub(super) enum Found {
    /// Canonical, inside the capture.
    File(PathBuf),
    /// Not there.
    Missing,
}

impl fmt::Display for Root {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.display().fmt(f)
    }
}

impl Root {
    /// The folder, or the folder of the file.
    pub(super) fn new(path: &Path) -> Result<Self, BadInput> {
        let cannot = |e| BadInput::new(show(path), format!("cannot be opened ({e})"), "give the folder of a capture");
        let path = path.canonicalize().map_err(cannot)?;
        match path.parent() {
            Some(folder) if path.is_file() => Ok(Self(folder.to_path_buf())),
            _ => Ok(Self(path)),
        }
    }

    /// Where a file of the capture would be; not checked.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// A file of the capture that may be there.
    pub(super) fn file(&self, name: &str) -> Option<PathBuf> {
        let path = self.0.join(name).canonicalize().ok()?;
        (path.is_file() && path.starts_with(&self.0)).then_some(path)
    }

    /// A file that the capture names, at times without its extension.
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

/// Width and height as the image's header says.
pub(super) fn image_size(path: &Path) -> Result<(u32, u32), BadInput> {
    let cannot = |e: &dyn fmt::Display| {
        let problem = format!("is not an image that can be read ({e})");
        BadInput::new(show(path), problem, "replace the file or take its image out of the capture")
    };
    let file = File::open(path).map_err(|e| cannot(&e))?;
    let (width, height) = photo::size(BufReader::new(file)).map_err(|e| match e {
        ImageError::Limits(_) => cannot(&"it claims more pixels than any photo has"),
        other => cannot(&other),
    })?;
    check_size(path, width, height)?;
    Ok((width, height))
}

/// Refuses sizes that no photo has: whoever walks along the border of one, or allocates for it, relies on this.
pub(super) fn check_size(path: &Path, width: u32, height: u32) -> Result<(), BadInput> {
    let area = u64::from(width) * u64::from(height);
    if area == 0 || area > mips::PIXEL_LIMIT || width.max(height) > LONGEST_SIDE {
        let most = mips::PIXEL_LIMIT;
        let problem = format!("claims {width}×{height} pixels: none, over {LONGEST_SIDE} a side or over {most} in all");
        return Err(BadInput::new(show(path), problem, "replace the file or take its image out of the capture"));
    }
    Ok(())
}

/// All bytes of a file.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, BadInput> {
    std::fs::read(path).map_err(|e| BadInput::new(show(path), format!("cannot be read ({e})"), "check the file"))
}

/// A path in a message.
pub(super) fn show(path: &Path) -> String {
    path.display().to_string()
}
