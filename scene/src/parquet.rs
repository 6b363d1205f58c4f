//! Reads and writes tables in Apache Parquet, as far as the Waymo Open Dataset needs it: flat columns and lists of numbers.
//!
//! ```text
//! "PAR1"
//! group of rows: for each column a chunk: [dictionary page] data pages     values, compressed page by page
//! ...
//! footer: columns, and where the chunks lie; its length; "PAR1"
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `footer` | columns, groups of rows, chunks |
//! | `pages` | headers of pages, and their bytes as a decompressed stream |
//! | `levels` | runs of small integers: which values are there, where lists begin, indices of a dictionary |
//! | `table` | columns as a whole, or single rows of them |
//! | `values` | the values of a page, plain or from a dictionary |
//! | `write` | the writer: plain, uncompressed pages |
//! | `snappy`, `thrift` | the formats below |
//!
//! Files are large: the photos of a drive are a column, and a page may hold hundreds of them. So a file is a [`Source`] that is
//! read in parts, and pages are streams. Every number of a file is untrusted: memory grows with the bytes that are there, up to
//! fixed limits, and never by what a header claims.
//!
//! Source: github.com/apache/parquet-format.

use std::io::{self, Cursor, Read};
use std::sync::Arc;

mod footer;
mod levels;
mod pages;
mod snappy;
mod table;
#[cfg(test)]
mod tests;
mod thrift;
mod values;
mod write;

pub use self::table::Table;
pub use self::write::{Cells, Writer};

const MAGIC: &[u8; 4] = b"PAR1";

/// A file whose parts are read apart.
pub trait Source {
    /// Its length, bytes.
    fn length(&self) -> u64;

    /// Its bytes from an offset on.
    ///
    /// # Errors
    /// The file cannot be read.
    fn reader(&self, offset: u64) -> io::Result<Box<dyn Read>>;
}

impl Source for Arc<[u8]> {
    fn length(&self) -> u64 {
        self.len() as u64
    }

    fn reader(&self, offset: u64) -> io::Result<Box<dyn Read>> {
        let mut cursor = Cursor::new(Self::clone(self));
        cursor.set_position(offset);
        Ok(Box::new(cursor))
    }
}
