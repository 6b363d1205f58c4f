//! Records: small objects with a name, some of them numbered.

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode};

use crate::{NAME_LIMIT, Store, StoreError};

/// The most records of one folder that are listed: a store with more is not one that plat wrote.
const LISTED_LIMIT: usize = 10_000_000;

impl Store {
    /// Stores a small record under a name, over whatever was there; readers see the old record or the new one.
    ///
    /// # Errors
    /// A name that is not made of ASCII letters, digits, `.`, `_`, `-` and `/`, or a store that refuses the write.
    pub async fn put_name(&self, name: &str, bytes: Bytes) -> Result<(), StoreError> {
        let path = name_path(name)?;
        self.write(&path, bytes, PutMode::Overwrite).await.map_err(|error| self.failed("write", &path, &error))
    }

    /// Stores a record under a name that has none, and says whether it did: of many that try at once, one does.
    ///
    /// # Errors
    /// As [`Store::put_name`]. After an error of the network it is not known whether the record is there.
    pub async fn create_name(&self, name: &str, bytes: Bytes) -> Result<bool, StoreError> {
        let path = name_path(name)?;
        match self.write(&path, bytes, PutMode::Create).await {
            Ok(()) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(self.failed("create", &path, &error)),
        }
    }

    /// The record of this name, `None` if there is none.
    ///
    /// # Errors
    /// A name as [`Store::put_name`] refuses it, or a store that cannot be read.
    pub async fn get_name(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        let path = name_path(name)?;
        match self.read(&path).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(error) if is_missing(&error) => Ok(None),
            Err(error) => Err(self.failed("read", &path, &error)),
        }
    }

    /// Forgets a record; one that is not there is forgotten already.
    ///
    /// # Errors
    /// As [`Store::put_name`].
    pub async fn remove_name(&self, name: &str) -> Result<(), StoreError> {
        self.delete(&name_path(name)?).await
    }

    /// The names of all records below this folder, of all there are where it is empty; sorted.
    ///
    /// # Errors
    /// A folder as [`Store::put_name`] refuses a name, or a store that cannot be read.
    pub async fn names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let path = if folder.is_empty() { Path::from("names") } else { name_path(folder)? };
        let mut found = self.objects.list(Some(&path));
        let mut names = Vec::new();
        while let Some(object) = found.try_next().await.map_err(|error| self.failed("list", &path, &error))? {
            names.extend(object.location.as_ref().strip_prefix("names/").map(str::to_owned));
            if names.len() > LISTED_LIMIT {
                let (action, path, store) = ("list", path.to_string(), self.url.to_string());
                let reason = format!("there are more than {LISTED_LIMIT} records");
                return Err(StoreError::Failed { action, path, store, reason });
            }
        }
        names.sort();
        Ok(names)
    }

    /// The record of the highest number in this folder, where records are named `<folder>/<number>.json`.
    ///
    /// # Errors
    /// As [`Store::names`].
    pub async fn newest(&self, folder: &str) -> Result<Option<(u64, Bytes)>, StoreError> {
        let names = self.names(folder).await?;
        let number = |name: &str| name.rsplit('/').next()?.strip_suffix(".json")?.parse::<u64>().ok();
        let newest = names.iter().filter_map(|name| Some((number(name)?, name))).max();
        let Some((number, name)) = newest else { return Ok(None) };
        Ok(self.get_name(name).await?.map(|bytes| (number, bytes)))
    }

    pub(crate) async fn delete(&self, path: &Path) -> Result<(), StoreError> {
        match self.objects.delete(path).await {
            Err(error) if !is_missing(&error) => Err(self.failed("delete", path, &error)),
            _ => Ok(()),
        }
    }
}

/// Whether there is no such object (and not: no such bucket).
pub(crate) fn is_missing(error: &object_store::Error) -> bool {
    matches!(error, object_store::Error::NotFound { .. }) && !error.to_string().contains("NoSuchBucket")
}

/// `names/<name>`, where no name can leave the folder.
pub(crate) fn name_path(name: &str) -> Result<Path, StoreError> {
    let plain = |part: &str| {
        !part.is_empty()
            && !part.starts_with('.')
            && part.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
    };
    if name.len() > NAME_LIMIT || !name.split('/').all(plain) {
        return Err(StoreError::BadName(name.chars().take(NAME_LIMIT).collect()));
    }
    Ok(Path::from_iter(std::iter::once("names").chain(name.split('/'))))
}
