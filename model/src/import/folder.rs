//! Files that other files name.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};

use scene::{BadInput, CodecError};

/// A folder that no name leads out of.
pub(super) struct Folder {
    path: PathBuf,
    /// Files that were taken once.
    taken: BTreeSet<PathBuf>,
}

impl Folder {
    /// The folder of a file.
    pub(super) fn of(file: &Path) -> Self {
        let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
        Self { path: folder.unwrap_or(Path::new(".")).to_path_buf(), taken: BTreeSet::new() }
    }

    /// The path of a file in it, as another file names it.
    ///
    /// # Errors
    /// A name that leads elsewhere, by its parts, a scheme or a link, and one of no file.
    pub(super) fn path(&self, name: &str) -> Result<PathBuf, CodecError> {
        let wrong = |what: String| CodecError::new(format!("{name:?} {what}"));
        let mut parts = Path::new(name).components().filter(|part| *part != Component::CurDir).peekable();
        let is_elsewhere = name.contains("://") || parts.peek().is_none();
        if is_elsewhere || parts.any(|part| !matches!(part, Component::Normal(_))) {
            return Err(wrong("leads out of the folder".into()));
        }
        let path = self.path.join(name);
        let real = |path: &Path| path.canonicalize().map_err(|error| wrong(format!("cannot be read ({error})")));
        match real(&path)?.starts_with(real(&self.path)?) && path.is_file() {
            true => Ok(path),
            false => Err(wrong("is no file in the folder".into())),
        }
    }

    /// As [`Folder::path`], once for each file: else few names could ask for the same splats again and again.
    ///
    /// # Errors
    /// As [`Folder::path`], or a file that was taken before, by whatever name.
    pub(super) fn take(&mut self, name: &str) -> Result<PathBuf, CodecError> {
        let path = self.path(name)?;
        let is_new = path.canonicalize().is_ok_and(|real| self.taken.insert(real));
        if is_new { Ok(path) } else { Err(CodecError::new(format!("names {name:?} twice"))) }
    }

    /// The bytes of a file in it.
    ///
    /// # Errors
    /// As [`Folder::path`], or a file that cannot be read.
    pub(super) fn bytes(&self, name: &str) -> Result<Vec<u8>, CodecError> {
        fs::read(self.path(name)?).map_err(|error| CodecError::new(format!("{name:?} cannot be read ({error})")))
    }
}

/// The error of a file whose bytes do not decode.
pub(super) fn unreadable(path: &Path, error: &CodecError) -> BadInput {
    BadInput::new(path.display().to_string(), error.to_string(), "restore the file or export the model again")
}
