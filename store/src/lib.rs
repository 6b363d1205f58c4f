//! Artefacts: immutable objects named by the BLAKE3 hash of their bytes, and small named records that point at them.
//!
//! A store is a URL. Below it lie `artefacts/ab/<64 hex digits>` (`ab` are the first two, so that no folder grows
//! without end) and `names/<name>`. An artefact is written once and never changed, so writers need no lock and a
//! reader can prove what it read; a name is replaced as a whole.
//!
//! Architecture invariant: nothing here knows what the bytes mean.

mod blocking;
mod error;
pub mod file;

use std::error::Error;
use std::ops::Range;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use object_store::local::LocalFileSystem;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use scene::{ArtefactId, BadInput};

pub use blocking::BlockingStore;
pub use error::StoreError;

/// The longest name of a record, in bytes.
pub const NAME_LIMIT: usize = 200;

/// A place for artefacts and names. Clones are cheap and share the place.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
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
    /// Opens a store: the path of a folder, which is made if it is missing, `file:///path` likewise, or `memory://`,
    /// which is empty, and gone with its last clone.
    ///
    /// # Errors
    /// A URL that is none, or of a kind that this program does not know; a folder that cannot be made or opened.
    pub fn open(url: &str) -> Result<Self, StoreError> {
        const ADVICE: &str = "give the path of a folder, file:///path or memory://";
        let objects: Arc<dyn ObjectStore> = match url.split_once("://") {
            None if url.is_empty() => return Err(BadInput::new("the store", "has an empty URL", ADVICE).into()),
            None => Arc::new(folder(url, FilePath::new(url))?),
            Some(("memory", "")) => Arc::new(InMemory::new()),
            Some(("file", _)) => {
                let path = url::Url::parse(url).ok().and_then(|url| url.to_file_path().ok());
                let path = path.ok_or_else(|| BadInput::new(url, "is not the URL of a local folder", ADVICE))?;
                Arc::new(folder(url, &path)?)
            }
            Some((scheme, _)) => {
                let problem = format!("stores of the kind {scheme}:// are not supported by this version");
                return Err(BadInput::new(url, problem, ADVICE).into());
            }
        };
        Ok(Self { objects, url: url.into(), read: Arc::default(), written: Arc::default() })
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

    /// The same store for code that is not async.
    pub fn blocking(&self) -> BlockingStore {
        BlockingStore::new(self.clone())
    }

    /// Stores bytes under their hash. An artefact that is there already, at its full length, is left alone; otherwise
    /// it appears whole or not at all.
    ///
    /// # Errors
    /// The store refuses the write: full, read-only, not reachable.
    pub async fn put(&self, bytes: Bytes) -> Result<ArtefactId, StoreError> {
        let id = ArtefactId::of(&bytes);
        let path = artefact_path(id);
        if matches!(self.objects.head(&path).await, Ok(found) if found.size == bytes.len() as u64) {
            return Ok(id);
        }
        self.write(&path, bytes).await?;
        Ok(id)
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

    /// Ranges (none empty) of the bytes of an artefact, in the order asked for. A range says nothing of the hash of the whole: what
    /// is read by ranges carries its own checksums.
    ///
    /// # Errors
    /// Missing, a range beyond the end, or not readable.
    pub async fn get_ranges(&self, id: ArtefactId, ranges: &[Range<u64>]) -> Result<Vec<Bytes>, StoreError> {
        let path = artefact_path(id);
        let parts = self.objects.get_ranges(&path, ranges).await;
        let parts = parts.map_err(|error| self.artefact_failed(id, &path, &error))?;
        self.read.fetch_add(parts.iter().map(|part| part.len() as u64).sum(), Ordering::Relaxed);
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
            Err(object_store::Error::NotFound { .. }) => Ok(None),
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

    /// Stores a small record under a name, over whatever was there; readers see the old record or the new one.
    ///
    /// # Errors
    /// A name that is not made of ASCII letters, digits, `.`, `_`, `-` and `/`, or a store that refuses the write.
    pub async fn put_name(&self, name: &str, bytes: Bytes) -> Result<(), StoreError> {
        let path = name_path(name)?;
        self.write(&path, bytes).await
    }

    /// The record of this name, `None` if there is none.
    ///
    /// # Errors
    /// A name as [`Store::put_name`] refuses it, or a store that cannot be read.
    pub async fn get_name(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        let path = name_path(name)?;
        match self.read(&path).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed("read", &path, &error)),
        }
    }

    async fn read(&self, path: &Path) -> object_store::Result<Bytes> {
        let bytes = self.objects.get(path).await?.bytes().await?;
        self.read.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes)
    }

    async fn write(&self, path: &Path, bytes: Bytes) -> Result<(), StoreError> {
        let length = bytes.len() as u64;
        self.objects.put(path, bytes.into()).await.map_err(|error| self.failed("write", path, &error))?;
        self.written.fetch_add(length, Ordering::Relaxed);
        Ok(())
    }

    fn artefact_failed(&self, id: ArtefactId, path: &Path, error: &object_store::Error) -> StoreError {
        match error {
            object_store::Error::NotFound { .. } => StoreError::Missing { id, store: self.url.to_string() },
            other => self.failed("read", path, other),
        }
    }

    fn failed(&self, action: &'static str, path: &Path, error: &object_store::Error) -> StoreError {
        StoreError::Failed { action, path: path.to_string(), store: self.url.to_string(), reason: error::reason(error) }
    }
}

fn folder(url: &str, path: &FilePath) -> Result<LocalFileSystem, StoreError> {
    let closed = |error: &(dyn Error + 'static)| StoreError::Closed { store: url.into(), reason: error::reason(error) };
    std::fs::create_dir_all(path).map_err(|error| closed(&error))?;
    LocalFileSystem::new_with_prefix(path).map_err(|error| closed(&error))
}

fn artefact_path(id: ArtefactId) -> Path {
    let hex = id.to_string();
    Path::from_iter(["artefacts", &hex[..2], &hex])
}

/// `names/<name>`, where no name can leave the folder.
fn name_path(name: &str) -> Result<Path, StoreError> {
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

#[cfg(test)]
mod tests;
