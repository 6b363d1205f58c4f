//! Files beside a store, whole or not at all: what a full disk or a killed program leaves never has a file's own name.

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
    /// Of this file, for this reason.
    pub fn new(path: &Path, error: &(dyn Error + 'static)) -> Self {
        let mut reason = reason(error);
        // Where the reason says what to do, that is all there is to say.
        if !reason.contains(';') {
            reason += "; check the folder and the space on the disk";
        }
        Self { path: path.display().to_string(), reason }
    }
}

/// Writes a file: under another name first, so that it is there as a whole or as it was before. A link is followed, a
/// device or pipe written as it is.
///
/// # Errors
/// A place that refuses it.
pub fn save(path: &Path, bytes: &[u8]) -> Result<(), SaveError> {
    let mut saving = Saving::begin(path)?;
    saving.write(bytes)?;
    saving.finish()
}

/// A file that is written part by part, as by [`save`]: it has its name when [`finish`](Self::finish) returns, and nothing is left of
/// it where that is not reached.
#[derive(Debug)]
pub struct Saving {
    /// As it was named, for errors.
    shown: PathBuf,
    /// Where it goes.
    path: PathBuf,
    file: File,
    /// The name that it has until it is whole; none where it is a device or pipe.
    part: Option<PathBuf>,
}

impl Saving {
    /// Begins the file.
    ///
    /// # Errors
    /// A place that refuses it.
    pub fn begin(path: &Path) -> Result<Self, SaveError> {
        Self::open(path).map_err(|error| SaveError::new(path, &error))
    }

    /// Adds to its end.
    ///
    /// # Errors
    /// A disk that refuses it.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), SaveError> {
        self.file.write_all(bytes).map_err(|error| SaveError::new(&self.shown, &error))
    }

    /// Gives it its name.
    ///
    /// # Errors
    /// A folder that refuses it.
    pub fn finish(mut self) -> Result<(), SaveError> {
        let Some(part) = self.part.take() else { return Ok(()) };
        fs::rename(&part, &self.path).map_err(|error| {
            let _ = fs::remove_file(&part);
            SaveError::new(&self.shown, &error)
        })
    }

    fn open(shown: &Path) -> io::Result<Self> {
        let path = shown.canonicalize().unwrap_or_else(|_| shown.to_path_buf());
        let shown = shown.to_path_buf();
        let permissions = match OpenOptions::new().write(true).open(&path) {
            Ok(file) => match file.metadata()? {
                about if about.is_file() => Some(about.permissions()),
                _ => return Ok(Self { shown, path, file, part: None }),
            },
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            // Also a file that is protected from being written, which renaming would not ask about.
            Err(error) => return Err(error),
        };
        let part = part_beside(&path);
        let saving = Self { shown, path, file: File::create(&part)?, part: Some(part) };
        permissions.map_or(Ok(()), |permissions| saving.file.set_permissions(permissions))?;
        Ok(saving)
    }
}

impl Drop for Saving {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            let _ = fs::remove_file(part);
        }
    }
}

/// A hidden name in the same folder that nothing else writes.
fn part_beside(path: &Path) -> PathBuf {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    path.with_file_name(format!(".plat-{}-{count}.part", std::process::id()))
}

/// Adds to the end of a file; what it cannot take as a whole is taken back.
///
/// # Errors
/// A disk that refuses it.
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
    fn a_file_is_replaced_and_nothing_else_left() {
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
    fn what_is_not_finished_is_as_if_it_had_not_begun() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let begun = |parts: &[&str]| {
            let mut saving = Saving::begin(&path).unwrap();
            parts.iter().for_each(|part| saving.write(part.as_bytes()).unwrap());
            saving
        };
        drop(begun(&["lost"]));
        assert!(names(folder.path()).is_empty());
        begun(&["one ", "two ", ""]).finish().unwrap();
        drop(begun(&["lost"]));
        assert_eq!((names(folder.path()), &*fs::read_to_string(&path).unwrap()), (vec!["a".to_owned()], "one two "));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn links_devices_and_protection_stay() {
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
    fn what_does_not_fit_is_taken_back() {
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
