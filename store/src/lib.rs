//! Artefacts: immutable objects named by the BLAKE3 hash of their bytes, and small named records that point at them.
//!
//! A store is a URL. Below it lie `artefacts/ab/<64 hex digits>` (`ab` are the first two, so that no folder grows
//! without end) and `names/<name>`. An artefact is written once and never changed, so writers need no lock and a
//! reader can prove what it read; a name is replaced as a whole.
//!
//! Architecture invariant: nothing here knows what the bytes mean.

mod blocking;
pub mod doctor;
mod error;
pub mod file;
mod names;
mod open;

use std::ffi::OsString;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode};
use scene::ArtefactId;

use names::is_missing;
use open::{Network, Surroundings};

pub use blocking::BlockingStore;
pub use error::StoreError;

/// The longest name of a record, in bytes.
pub const NAME_LIMIT: usize = 200;
/// A request to a server that fails in a way that may pass is tried so often again.
const RETRIES: usize = 10;
/// Ranges of an object that are no farther apart are read as one. Less than a request costs, and by default `object_store` would
/// read a whole megabyte more: most of a photo for a small window of it.
const MERGED_BYTES: u64 = 2048;

/// A place for artefacts and names. Clones are cheap and share the place.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    network: Option<Arc<Network>>,
    url: Arc<str>,
    read: Arc<AtomicU64>,
    written: Arc<AtomicU64>,
}

/// Bytes that went from and to a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Traffic {
    /// Bytes of artefacts, ranges and records that were read.
    pub read: u64,
    /// Bytes of artefacts and records that were written; an artefact that was there already is not.
    pub written: u64,
}

impl Store {
    /// Opens a store: the path of a folder, which is made if it is missing, `file:///path` likewise, `s3://bucket/prefix`, or
    /// `memory://`, which is empty, and gone with its last clone.
    ///
    /// S3 is reached as the environment says: `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, `AWS_REGION`,
    /// `AWS_ENDPOINT_URL` and the others of `object_store::aws::AmazonS3ConfigKey`. An endpoint without encryption beyond this
    /// machine needs `AWS_ALLOW_HTTP=true`. Nothing is asked of the server yet.
    ///
    /// # Errors
    /// A URL that is none, or of a kind that this program does not know; a folder that cannot be made or opened; variables
    /// that make no sense together.
    pub fn open(url: &str) -> Result<Self, StoreError> {
        let text = |(name, value): (OsString, OsString)| Some((name.into_string().ok()?, value.into_string().ok()?));
        let variables = std::env::vars_os().filter_map(text);
        Self::open_with(url, Surroundings { variables, retries: RETRIES })
    }

    /// A store in any other place; `url` is what errors and [`Store::url`] call it.
    pub fn over(objects: Arc<dyn ObjectStore>, url: &str) -> Self {
        Self { objects, network: None, url: url.into(), read: Arc::default(), written: Arc::default() }
    }

    fn open_with(
        url: &str,
        surroundings: Surroundings<impl Iterator<Item = (String, String)>>,
    ) -> Result<Self, StoreError> {
        let open::Place { objects, network } = open::open(url, surroundings)?;
        Ok(Self { network, ..Self::over(objects, url) })
    }

    /// The same place with a count of its own, from 0, that its clones share.
    pub fn metered(&self) -> Self {
        Self { read: Arc::default(), written: Arc::default(), ..self.clone() }
    }

    /// What this store and its clones moved since it was opened or made by [`Store::metered`].
    pub fn traffic(&self) -> Traffic {
        Traffic { read: self.read.load(Ordering::Relaxed), written: self.written.load(Ordering::Relaxed) }
    }

    /// The URL that the store was opened with.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Is it reached over a network, so that an answer takes its time, and what was read is worth keeping?
    pub fn is_far(&self) -> bool {
        self.network.is_some()
    }

    /// The same store for code that is not async.
    pub fn blocking(&self) -> BlockingStore {
        BlockingStore::new(self.clone())
    }

    /// Stores bytes under their hash. An artefact that is there already, at its full length, is left alone; otherwise
    /// it appears whole or not at all, and where it is not there it is created, never replaced.
    ///
    /// # Errors
    /// The store refuses the write: full, read-only, not reachable.
    pub async fn put(&self, bytes: Bytes) -> Result<ArtefactId, StoreError> {
        let id = ArtefactId::of(&bytes);
        let path = artefact_path(id);
        let mode = match self.objects.head(&path).await {
            Ok(found) if found.size == bytes.len() as u64 => return Ok(id),
            // One that was cut is mended.
            Ok(_) => PutMode::Overwrite,
            Err(_) => PutMode::Create,
        };
        match self.write(&path, bytes.clone(), mode).await {
            // Whoever was faster wrote the same bytes.
            Ok(()) | Err(object_store::Error::AlreadyExists { .. }) => return Ok(id),
            // A file system without links cannot create without replacing; what would be replaced is the same.
            Err(_) if self.network.is_none() => {}
            Err(error) => return Err(self.failed("write", &path, &error)),
        }
        let written = self.write(&path, bytes, PutMode::Overwrite).await;
        written.map(|()| id).map_err(|error| self.failed("write", &path, &error))
    }

    /// The bytes of an artefact, checked against its hash.
    ///
    /// # Errors
    /// Missing, damaged, or not readable.
    pub async fn get(&self, id: ArtefactId) -> Result<Bytes, StoreError> {
        let path = artefact_path(id);
        let bytes = self.read(&path).await.map_err(|error| self.artefact_failed(id, &path, &error))?;
        let found = ArtefactId::of(&bytes);
        if found == id { Ok(bytes) } else { Err(StoreError::Corrupt { id, store: self.url.to_string() }) }
    }

    /// The bytes of an artefact that can be made again, `None` where it is not there. One that is damaged, twice read, is deleted, so
    /// that it can be put again: [`Store::put`] leaves alone what has the right length.
    ///
    /// # Errors
    /// Not readable, or not to be deleted.
    pub async fn get_or_discard(&self, id: ArtefactId) -> Result<Option<Bytes>, StoreError> {
        let mut found = self.get(id).await;
        if matches!(found, Err(StoreError::Corrupt { .. })) {
            found = self.get(id).await;
        }
        match found {
            Ok(bytes) => Ok(Some(bytes)),
            Err(StoreError::Missing { .. }) => Ok(None),
            Err(StoreError::Corrupt { .. }) => self.remove(id).await.map(|()| None),
            Err(error) => Err(error),
        }
    }

    /// Ranges (none empty) of the bytes of an artefact, in the order asked for. A range says nothing of the hash of the whole: what
    /// is read by ranges carries its own checksums.
    ///
    /// # Errors
    /// Missing, a range beyond the end, or not readable.
    pub async fn get_ranges(&self, id: ArtefactId, ranges: &[Range<u64>]) -> Result<Vec<Bytes>, StoreError> {
        let path = artefact_path(id);
        let fetch = async |range| {
            let part = self.objects.get_range(&path, range).await?;
            self.read.fetch_add(part.len() as u64, Ordering::Relaxed);
            Ok(part)
        };
        let parts = object_store::coalesce_ranges(ranges, fetch, MERGED_BYTES).await;
        let parts = parts.map_err(|error: object_store::Error| self.artefact_failed(id, &path, &error))?;
        let whole = |(part, range): (&Bytes, &Range<u64>)| part.len() as u64 == range.end.saturating_sub(range.start);
        if parts.len() == ranges.len() && parts.iter().zip(ranges).all(whole) {
            Ok(parts)
        } else {
            Err(StoreError::Corrupt { id, store: self.url.to_string() })
        }
    }

    /// The length of an artefact in bytes, `None` if it is not there. Its bytes are not checked.
    ///
    /// # Errors
    /// The store cannot be asked.
    pub async fn size(&self, id: ArtefactId) -> Result<Option<u64>, StoreError> {
        let path = artefact_path(id);
        match self.objects.head(&path).await {
            Ok(found) => Ok(Some(found.size)),
            Err(error) if is_missing(&error) => Ok(None),
            Err(error) => Err(self.failed("look for", &path, &error)),
        }
    }

    /// True if the artefact is there. Its bytes are not checked.
    ///
    /// # Errors
    /// The store cannot be asked.
    pub async fn exists(&self, id: ArtefactId) -> Result<bool, StoreError> {
        Ok(self.size(id).await?.is_some())
    }

    /// Forgets an artefact; one that is not there is forgotten already. Whoever calls it knows that nothing refers to it.
    ///
    /// # Errors
    /// The store refuses it.
    pub async fn remove(&self, id: ArtefactId) -> Result<(), StoreError> {
        self.delete(&artefact_path(id)).await
    }

    /// What lies below the store's URL, for a database that keeps itself there, below a folder that is neither `artefacts`
    /// nor `names`. What it moves is not metered.
    pub fn objects(&self) -> Arc<dyn ObjectStore> {
        self.objects.clone()
    }

    async fn read(&self, path: &Path) -> object_store::Result<Bytes> {
        let bytes = self.objects.get(path).await?.bytes().await?;
        self.read.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes)
    }

    async fn write(&self, path: &Path, bytes: Bytes, mode: PutMode) -> object_store::Result<()> {
        let length = bytes.len() as u64;
        self.objects.put_opts(path, bytes.into(), mode.into()).await?;
        self.written.fetch_add(length, Ordering::Relaxed);
        Ok(())
    }

    fn artefact_failed(&self, id: ArtefactId, path: &Path, error: &object_store::Error) -> StoreError {
        if is_missing(error) {
            StoreError::Missing { id, store: self.url.to_string() }
        } else {
            self.failed("read", path, error)
        }
    }

    fn failed(&self, action: &'static str, path: &Path, error: &object_store::Error) -> StoreError {
        StoreError::Failed {
            action,
            path: path.to_string(),
            store: self.url.to_string(),
            reason: error::reason_of(error),
        }
    }
}

fn artefact_path(id: ArtefactId) -> Path {
    let hex = id.to_string();
    Path::from_iter(["artefacts", &hex[..2], &hex])
}

#[cfg(test)]
mod tests;
