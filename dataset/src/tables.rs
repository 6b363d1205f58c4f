//! Tables in Parquet that are files.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use scene::parquet::{Source, Table};
use scene::{BadInput, CodecError};

/// A file that is opened anew for each part.
#[derive(Debug)]
pub(crate) struct TableFile {
    path: PathBuf,
    length: u64,
}

impl Source for TableFile {
    fn length(&self) -> u64 {
        self.length
    }

    fn reader(&self, offset: u64) -> io::Result<Box<dyn Read>> {
        let mut file = File::open(&self.path)?;
        file.seek(SeekFrom::Start(offset))?;
        Ok(Box::new(file))
    }
}

/// Opens a table.
///
/// # Errors
/// Not a table, or a file that cannot be read.
pub(crate) fn open(path: &Path) -> Result<Table<TableFile>, BadInput> {
    let length = path.metadata().map_err(|e| bad(path, &CodecError::new(format!("cannot be read ({e})"))))?.len();
    Table::open(TableFile { path: path.into(), length }).map_err(|e| bad(path, &e))
}

/// What is wrong with a table.
pub(crate) fn bad(path: &Path, error: &CodecError) -> BadInput {
    BadInput::new(path.display().to_string(), error.to_string(), "download the file again")
}
