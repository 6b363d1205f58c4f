//! The tables of a data set in nuScenes' layout, read one at a time.

use std::collections::BTreeMap;

use scene::{BadInput, CodecError};

use super::super::files::{self, CaptureRoot};

/// The tables of a version.
pub(super) struct Tables<'a> {
    pub(super) root: &'a CaptureRoot,
    pub(super) version: String,
}

impl Tables<'_> {
    /// A table, read by this codec.
    pub(super) fn read<T>(
        &self,
        table: &str,
        read: impl FnOnce(&[u8]) -> Result<T, CodecError>,
    ) -> Result<T, BadInput> {
        let name = format!("{}/{table}.json", self.version);
        let missing = || BadInput::new(format!("{}: {name}", self.root), "is not there", "download the tables again");
        let path = self.root.file(&name).ok_or_else(missing)?;
        read(&files::read(&path)?).map_err(|e| self.bad(table, e.to_string()))
    }

    /// The row that a table names.
    pub(super) fn row<'a, T>(
        &self,
        rows: &'a BTreeMap<String, T>,
        table: &str,
        named: &str,
        token: &str,
    ) -> Result<&'a T, BadInput> {
        let nowhere = || self.bad(table, format!("names a row '{token:.40}' that {named}.json lacks"));
        rows.get(token).ok_or_else(nowhere)
    }

    /// What is wrong with a table.
    pub(super) fn bad(&self, table: &str, problem: String) -> BadInput {
        let file = self.root.path(&format!("{}/{table}.json", self.version));
        BadInput::new(files::show(&file), problem, "correct the file or download the tables again")
    }
}
