//! Atomic writes of local files: a temporary file in the same folder, then a rename. After a full disk or a crash a file is
//! either as it was before or complete.

use std::error::Error;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::error::reason;

/// A file that could not be written, in one line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{path}: cannot be written: {reason}")]
pub struct SaveError {
    path: String,
    reason: String,
}

impl SaveError {
    /// The error of writing this file.
    pub fn new(path: &Path, error: &(dyn Error + 'static)) -> Self {
        let mut reason = reason(error);
        // Reasons with a semicolon contain advice already.
        if !reason.contains(';') {
            reason += "; check the folder and the space on the disk";
        }
        Self { path: path.display().to_string(), reason }
    }
}

/// Writes a file atomically. A symbolic link is followed; a device or pipe is written directly.
///
/// # Errors
/// The file cannot be created, written or renamed.
pub fn save(path: &Path, bytes: &[u8]) -> Result<(), SaveError> {
    let mut file = AtomicFile::create(path)?;
    file.write(bytes)?;
    file.commit()
}

/// A file that is written in parts, atomically as by [`save`]: it replaces the old file in [`commit`](Self::commit). Dropping it
/// uncommitted removes the temporary file.
#[derive(Debug)]
pub struct AtomicFile {
    /// The path as given by the caller, for errors.
    given_path: PathBuf,
    /// The path with links resolved.
    path: PathBuf,
    file: File,
    /// The temporary file; `None` for a device or pipe.
    temporary: Option<PathBuf>,
}

impl AtomicFile {
    /// Creates the temporary file.
    ///
    /// # Errors
    /// The file cannot be created or may not be replaced.
    pub fn create(path: &Path) -> Result<Self, SaveError> {
        Self::open(path).map_err(|error| SaveError::new(path, &error))
    }

    /// Appends bytes.
    ///
    /// # Errors
    /// The write fails.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), SaveError> {
        self.file.write_all(bytes).map_err(|error| SaveError::new(&self.given_path, &error))
    }

    /// Renames the temporary file to its final name.
    ///
    /// # Errors
    /// The rename fails; the temporary file is removed.
    pub fn commit(mut self) -> Result<(), SaveError> {
        let Some(temporary) = self.temporary.take() else { return Ok(()) };
        fs::rename(&temporary, &self.path).map_err(|error| {
            let _ = fs::remove_file(&temporary);
            SaveError::new(&self.given_path, &error)
        })
    }

    fn open(given_path: &Path) -> io::Result<Self> {
        let path = given_path.canonicalize().unwrap_or_else(|_| given_path.to_path_buf());
        let given_path = given_path.to_path_buf();
        let permissions = match OpenOptions::new().write(true).open(&path) {
            Ok(file) => match file.metadata()? {
                metadata if metadata.is_file() => Some(metadata.permissions()),
                _ => return Ok(Self { given_path, path, file, temporary: None }),
            },
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            // Includes a write-protected file, which a rename would replace all the same.
            Err(error) => return Err(error),
        };
        let temporary = temporary_path(&path);
        let atomic = Self { given_path, path, file: File::create(&temporary)?, temporary: Some(temporary) };
        permissions.map_or(Ok(()), |permissions| atomic.file.set_permissions(permissions))?;
        Ok(atomic)
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if let Some(temporary) = &self.temporary {
            let _ = fs::remove_file(temporary);
        }
    }
}

/// A hidden name in the same folder, unique to this process and call.
fn temporary_path(path: &Path) -> PathBuf {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    path.with_file_name(format!(".plat-{}-{count}.part", std::process::id()))
}

/// Appends to a file. A partial write is truncated again.
///
/// # Errors
/// The write fails.
pub fn append(file: &mut File, bytes: &[u8]) -> io::Result<()> {
    let length = file.metadata()?.len();
    file.write_all(bytes).inspect_err(|_| {
        let _ = file.set_len(length);
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_replaced_and_no_temporary_file_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        for bytes in ["first and long", "second", ""] {
            save(&path, bytes.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), bytes);
        }
        assert_eq!(names(folder.path()), ["a"]);
        let line = save(&folder.path().join("no/a"), b"x").unwrap_err().to_string();
        assert!(line.contains("no/a: cannot be written: ") && line.contains("; check the folder"), "{line}");
        let line = save(&path.join("a"), b"x").unwrap_err().to_string();
        assert!(line.contains("a/a: cannot be written: "), "{line}");
        assert!(save(folder.path(), b"x").is_err());
        assert_eq!(names(folder.path()), ["a"]);
    }

    #[test]
    fn an_uncommitted_file_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let written = |parts: &[&str]| {
            let mut file = AtomicFile::create(&path).unwrap();
            parts.iter().for_each(|part| file.write(part.as_bytes()).unwrap());
            file
        };
        drop(written(&["lost"]));
        assert!(names(folder.path()).is_empty());
        written(&["one ", "two ", ""]).commit().unwrap();
        drop(written(&["lost"]));
        assert_eq!((names(folder.path()), &*fs::read_to_string(&path).unwrap()), (vec!["a".to_owned()], "one two "));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn links_devices_and_permissions_are_kept() {
        use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};
        let folder = tempfile::tempdir().unwrap();
        let [file, link, full] = ["file", "link", "full"].map(|name| folder.path().join(name));
        fs::write(&file, "old").unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
        symlink(&file, &link).unwrap();
        save(&link, b"new").unwrap();
        assert!(link.is_symlink() && fs::read(&file).unwrap() == b"new");
        assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o640);
        symlink("/dev/full", &full).unwrap();
        let line = save(&full, b"new").unwrap_err().to_string();
        assert!(line.ends_with("full: cannot be written: the disk is full; free some space and run again"), "{line}");
        assert!(fs::metadata("/dev/full").unwrap().file_type().is_char_device());
        assert_eq!(names(folder.path()), ["file", "full", "link"]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_failed_append_is_truncated() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        let mut file = OpenOptions::new().create(true).append(true).open(&path).unwrap();
        append(&mut file, b"one\n").unwrap();
        append(&mut file, b"two\n").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"one\ntwo\n");
        let mut full = OpenOptions::new().write(true).open("/dev/full").unwrap();
        assert!(append(&mut full, b"x").is_err());
    }
}
