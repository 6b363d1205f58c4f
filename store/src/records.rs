//! Named records: small mutable objects, some of them numbered, that point at artefacts.

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::{ObjectStore, PutMode};

use crate::artefacts::{Store, is_missing};
use crate::error::StoreError;
use crate::paths::{self, MAX_RECORD_NAME_BYTES};

/// Listing a folder of more records than this is an error: plat does not write so many.
const MAX_LISTED: usize = 10_000_000;

impl Store {
    /// Stores a record, replacing any of this name. Readers see the old record or the new one, never a mixture.
    ///
    /// # Errors
    /// A name that is not made of ASCII letters, digits, `.`, `_`, `-` and `/`, or a store that refuses the write.
    pub async fn put_record(&self, name: &str, bytes: Bytes) -> Result<(), StoreError> {
        let path = record_path(name)?;
        self.write(&path, bytes, PutMode::Overwrite).await.map_err(|error| self.failed("write", &path, &error))
    }

    /// Creates a record unless there is one of this name, and returns whether it did. Of several concurrent calls exactly
    /// one creates it.
    ///
    /// # Errors
    /// As [`Store::put_record`]. After a network error it is unknown whether the record was created.
    pub async fn create_record(&self, name: &str, bytes: Bytes) -> Result<bool, StoreError> {
        let path = record_path(name)?;
        match self.write(&path, bytes, PutMode::Create).await {
            Ok(()) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(self.failed("create", &path, &error)),
        }
    }

    /// The record of this name, `None` if there is none.
    ///
    /// # Errors
    /// A name that [`Store::put_record`] refuses, or a store that cannot be read.
    pub async fn get_record(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        let path = record_path(name)?;
        match self.read(&path).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(error) if is_missing(&error) => Ok(None),
            Err(error) => Err(self.failed("read", &path, &error)),
        }
    }

    /// Deletes a record. Deleting a missing record succeeds.
    ///
    /// # Errors
    /// As [`Store::put_record`].
    pub async fn remove_record(&self, name: &str) -> Result<(), StoreError> {
        self.delete(&record_path(name)?).await
    }

    /// The names of all records below this folder, sorted; of all records if the folder is empty text.
    ///
    /// # Errors
    /// A folder that [`Store::put_record`] refuses as a name, or a store that cannot be read.
    pub async fn record_names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let path = if folder.is_empty() { paths::records_path() } else { record_path(folder)? };
        let mut found = self.objects.list(Some(&path));
        let mut names = Vec::new();
        while let Some(object) = found.try_next().await.map_err(|error| self.failed("list", &path, &error))? {
            names.extend(paths::record_name(&object.location).map(str::to_owned));
            if names.len() > MAX_LISTED {
                let (action, path, store) = ("list", path.to_string(), self.url().to_owned());
                let reason = format!("there are more than {MAX_LISTED} records");
                return Err(StoreError::Failed { action, path, store, reason });
            }
        }
        names.sort();
        Ok(names)
    }

    /// The record of the highest number in a folder of records named `<folder>/<number>.json`, and its number.
    ///
    /// # Errors
    /// As [`Store::record_names`].
    pub async fn newest_record(&self, folder: &str) -> Result<Option<(u64, Bytes)>, StoreError> {
        let names = self.record_names(folder).await?;
        let number = |name: &str| name.rsplit('/').next()?.strip_suffix(".json")?.parse::<u64>().ok();
        let newest = names.iter().filter_map(|name| Some((number(name)?, name))).max();
        let Some((number, name)) = newest else { return Ok(None) };
        Ok(self.get_record(name).await?.map(|bytes| (number, bytes)))
    }
}

fn record_path(name: &str) -> Result<Path, StoreError> {
    paths::record_path(name)
        .ok_or_else(|| StoreError::BadRecordName(name.chars().take(MAX_RECORD_NAME_BYTES).collect()))
}
