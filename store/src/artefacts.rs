//! Artefacts: immutable objects named by the BLAKE3 hash of their bytes.

use std::ffi::OsString;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode};
use scene::ArtefactId;

use crate::error::{StoreError, object_store_reason};
use crate::open::{self, Environment, Location, Network};
use crate::paths::artefact_path;

/// Retries of a request that fails with a transient error.
const RETRIES: usize = 10;
/// Ranges of an object at most this many bytes apart are coalesced into one request: reading the gap costs less than a
/// request. The default of `object_store` is 1 MiB, most of a photo for a small window of it.
const COALESCE_BYTES: u64 = 2048;

/// An object store of artefacts and named records. Clones are cheap and refer to the same store.
#[derive(Debug, Clone)]
pub struct Store {
    pub(crate) objects: Arc<dyn ObjectStore>,
    pub(crate) network: Option<Arc<Network>>,
    url: Arc<str>,
    read: Arc<AtomicU64>,
    written: Arc<AtomicU64>,
}

/// Bytes transferred from and to a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Traffic {
    /// Bytes read of artefacts, ranges and records.
    pub read: u64,
    /// Bytes written of artefacts and records. A put of an existing artefact writes nothing.
    pub written: u64,
}

impl Store {
    /// Opens a store by its URL: the path of a folder, which is created if missing, `file:///path` likewise,
    /// `s3://bucket/prefix`, or `memory://`, which starts empty and is freed with its last clone.
    ///
    /// S3 is configured by the environment: `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, `AWS_REGION`,
    /// `AWS_ENDPOINT_URL` and the others of `object_store::aws::AmazonS3ConfigKey`. An unencrypted endpoint on another
    /// machine needs `AWS_ALLOW_HTTP=true`. No request is sent to the server yet.
    ///
    /// # Errors
    /// An invalid URL or an unsupported scheme; a folder that cannot be created or opened; inconsistent variables.
    pub fn open(url: &str) -> Result<Self, StoreError> {
        let text = |(name, value): (OsString, OsString)| Some((name.into_string().ok()?, value.into_string().ok()?));
        let variables = std::env::vars_os().filter_map(text);
        Self::open_with(url, Environment { variables, retries: RETRIES })
    }

    /// A store over any object store. Errors and [`Store::url`] give `url` as its name.
    pub fn over(objects: Arc<dyn ObjectStore>, url: &str) -> Self {
        Self { objects, network: None, url: url.into(), read: Arc::default(), written: Arc::default() }
    }

    pub(crate) fn open_with(
        url: &str,
        environment: Environment<impl Iterator<Item = (String, String)>>,
    ) -> Result<Self, StoreError> {
        let Location { objects, network } = open::open(url, environment)?;
        Ok(Self { network, ..Self::over(objects, url) })
    }

    /// The same store with its own traffic counters, starting at 0 and shared with its clones.
    pub fn metered(&self) -> Self {
        Self { read: Arc::default(), written: Arc::default(), ..self.clone() }
    }

    /// Bytes transferred by this store and its clones since it was opened or returned by [`Store::metered`].
    pub fn traffic(&self) -> Traffic {
        Traffic { read: self.read.load(Ordering::Relaxed), written: self.written.load(Ordering::Relaxed) }
    }

    /// The URL that the store was opened with.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Whether the store is accessed over a network, so that requests have latency and caching pays off.
    pub fn is_remote(&self) -> bool {
        self.network.is_some()
    }

    /// Stores bytes under their hash. An existing artefact of the full length is kept; a truncated one is overwritten. The
    /// artefact appears as a whole or not at all.
    ///
    /// # Errors
    /// The store refuses the write: full, read-only, unreachable.
    pub async fn put(&self, bytes: Bytes) -> Result<ArtefactId, StoreError> {
        let id = ArtefactId::of(&bytes);
        let path = artefact_path(id);
        let mode = match self.objects.head(&path).await {
            Ok(found) if found.size == bytes.len() as u64 => return Ok(id),
            Ok(_) => PutMode::Overwrite,
            Err(_) => PutMode::Create,
        };
        match self.write(&path, bytes.clone(), mode).await {
            // A concurrent writer wrote the same bytes.
            Ok(()) | Err(object_store::Error::AlreadyExists { .. }) => return Ok(id),
            // A file system without hard links cannot create exclusively. Overwriting is safe: the bytes are the same.
            Err(_) if self.network.is_none() => {}
            Err(error) => return Err(self.failed("write", &path, &error)),
        }
        let written = self.write(&path, bytes, PutMode::Overwrite).await;
        written.map(|()| id).map_err(|error| self.failed("write", &path, &error))
    }

    /// The bytes of an artefact, verified against its hash.
    ///
    /// # Errors
    /// Missing, damaged, or not readable.
    pub async fn get(&self, id: ArtefactId) -> Result<Bytes, StoreError> {
        let path = artefact_path(id);
        let bytes = self.read(&path).await.map_err(|error| self.artefact_failed(id, &path, &error))?;
        let found = ArtefactId::of(&bytes);
        if found == id { Ok(bytes) } else { Err(StoreError::Corrupt { id, store: self.url.to_string() }) }
    }

    /// The bytes of an artefact that can be recomputed, `None` if it is missing or damaged. An artefact that is damaged in
    /// two consecutive reads is deleted, because [`Store::put`] keeps any object of the right length.
    ///
    /// # Errors
    /// Not readable, or damaged and not deletable.
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

    /// Non-empty byte ranges of an artefact, in the order requested; neighbouring ranges are coalesced into one request.
    /// They are not verified against the hash of the artefact, so formats read by ranges carry their own checksums.
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
        let parts = object_store::coalesce_ranges(ranges, fetch, COALESCE_BYTES).await;
        let parts = parts.map_err(|error: object_store::Error| self.artefact_failed(id, &path, &error))?;
        let is_whole =
            |(part, range): (&Bytes, &Range<u64>)| part.len() as u64 == range.end.saturating_sub(range.start);
        if parts.len() == ranges.len() && parts.iter().zip(ranges).all(is_whole) {
            Ok(parts)
        } else {
            Err(StoreError::Corrupt { id, store: self.url.to_string() })
        }
    }

    /// The length of an artefact in bytes, `None` if it is missing. Its bytes are not verified.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub async fn size(&self, id: ArtefactId) -> Result<Option<u64>, StoreError> {
        let path = artefact_path(id);
        match self.objects.head(&path).await {
            Ok(found) => Ok(Some(found.size)),
            Err(error) if is_missing(&error) => Ok(None),
            Err(error) => Err(self.failed("look for", &path, &error)),
        }
    }

    /// Whether the store has the artefact. Its bytes are not verified.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub async fn exists(&self, id: ArtefactId) -> Result<bool, StoreError> {
        Ok(self.size(id).await?.is_some())
    }

    /// Deletes an artefact. Deleting a missing artefact succeeds. The caller guarantees that nothing refers to it.
    ///
    /// # Errors
    /// The store refuses it.
    pub async fn remove(&self, id: ArtefactId) -> Result<(), StoreError> {
        self.delete(&artefact_path(id)).await
    }

    /// The underlying object store, rooted at the store's URL, for a database that keeps its files there in a folder other
    /// than `artefacts` and `names`. Its traffic is not counted.
    pub fn objects(&self) -> Arc<dyn ObjectStore> {
        self.objects.clone()
    }

    pub(crate) async fn read(&self, path: &Path) -> object_store::Result<Bytes> {
        let bytes = self.objects.get(path).await?.bytes().await?;
        self.read.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes)
    }

    pub(crate) async fn write(&self, path: &Path, bytes: Bytes, mode: PutMode) -> object_store::Result<()> {
        let length = bytes.len() as u64;
        self.objects.put_opts(path, bytes.into(), mode.into()).await?;
        self.written.fetch_add(length, Ordering::Relaxed);
        Ok(())
    }

    pub(crate) async fn delete(&self, path: &Path) -> Result<(), StoreError> {
        match self.objects.delete(path).await {
            Err(error) if !is_missing(&error) => Err(self.failed("delete", path, &error)),
            _ => Ok(()),
        }
    }

    fn artefact_failed(&self, id: ArtefactId, path: &Path, error: &object_store::Error) -> StoreError {
        if is_missing(error) {
            StoreError::Missing { id, store: self.url.to_string() }
        } else {
            self.failed("read", path, error)
        }
    }

    pub(crate) fn failed(&self, action: &'static str, path: &Path, error: &object_store::Error) -> StoreError {
        StoreError::Failed {
            action,
            path: path.to_string(),
            store: self.url.to_string(),
            reason: object_store_reason(error),
        }
    }
}

/// Whether the object is missing. A missing bucket is another error.
pub(crate) fn is_missing(error: &object_store::Error) -> bool {
    matches!(error, object_store::Error::NotFound { .. }) && !error.to_string().contains("NoSuchBucket")
}
