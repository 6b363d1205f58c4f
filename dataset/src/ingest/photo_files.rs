//! The bytes of photos, each a file or a row of a table.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use scene::BadInput;
use scene::parquet::Table;
use scene::waymo;

use crate::open::Photo;
use crate::tables::{self, TableFile};

/// Reads photos. It keeps the last table open, so that the next row is read on from there: the photos of a table are hundreds of
/// megabytes, of which only one photo is held.
#[derive(Default)]
pub(super) struct PhotoFiles {
    table: Option<(PathBuf, Table<TableFile>)>,
}

impl PhotoFiles {
    /// The bytes of a photo, `limit` at most.
    ///
    /// # Errors
    /// A file that cannot be read or is larger.
    pub(super) fn read(&mut self, photo: &Photo, limit: u64) -> Result<Vec<u8>, BadInput> {
        let Some(row) = photo.row else { return read(&photo.path, limit) };
        let table = match self.table.take().filter(|(path, _)| *path == photo.path) {
            Some((_, table)) => table,
            None => tables::open(&photo.path)?,
        };
        let (_, table) = self.table.insert((photo.path.clone(), table));
        table.bytes(waymo::IMAGE, row, limit).map_err(|e| tables::bad(&photo.path, &e))
    }
}

/// The bytes of a file, `limit` at most.
///
/// # Errors
/// It cannot be read or is larger.
pub(super) fn read(path: &Path, limit: u64) -> Result<Vec<u8>, BadInput> {
    let shown = || path.display().to_string();
    let failed = |e: std::io::Error| BadInput::new(shown(), format!("cannot be read ({e})"), "check the file");
    let file = File::open(path).map_err(failed)?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 > limit {
        let problem = format!("is larger than any photo of its camera can be ({} MB)", limit >> 20);
        return Err(BadInput::new(shown(), problem, "check the file and its camera's width and height"));
    }
    Ok(bytes)
}
