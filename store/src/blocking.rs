//! The store for code that is not async: rayon threads, trainers, tests.

use std::future::Future;
use std::ops::Range;

use bytes::Bytes;
use futures::executor::block_on;
use futures::future::try_join_all;
use scene::ArtefactId;

use crate::open::Network;
use crate::{Store, StoreError};

/// A [`Store`] whose calls return when the work is done. On a thread without an async runtime a folder is read and
/// written by that thread itself; on a thread of one, the runtime's pool for blocking work does it.
#[derive(Debug, Clone)]
pub struct BlockingStore {
    store: Store,
}

impl BlockingStore {
    pub(crate) fn new(store: Store) -> Self {
        Self { store }
    }

    /// The async store.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// See [`Store::put`].
    ///
    /// # Errors
    /// As there.
    pub fn put(&self, bytes: impl Into<Bytes>) -> Result<ArtefactId, StoreError> {
        let bytes = bytes.into();
        self.wait(|store| async move { store.put(bytes).await })
    }

    /// See [`Store::put`]: all of them side by side.
    ///
    /// # Errors
    /// The first of theirs.
    pub fn put_all(&self, all: Vec<Vec<u8>>) -> Result<Vec<ArtefactId>, StoreError> {
        self.wait(|store| async move { try_join_all(all.into_iter().map(|bytes| store.put(bytes.into()))).await })
    }

    /// See [`Store::get`].
    ///
    /// # Errors
    /// As there.
    pub fn get(&self, id: ArtefactId) -> Result<Bytes, StoreError> {
        self.wait(|store| async move { store.get(id).await })
    }

    /// See [`Store::get_or_discard`].
    ///
    /// # Errors
    /// As there.
    pub fn get_or_discard(&self, id: ArtefactId) -> Result<Option<Bytes>, StoreError> {
        self.wait(|store| async move { store.get_or_discard(id).await })
    }

    /// See [`Store::get_or_discard`]: all of them side by side.
    ///
    /// # Errors
    /// The first of theirs.
    pub fn get_all_or_discard(&self, ids: &[ArtefactId]) -> Result<Vec<Option<Bytes>>, StoreError> {
        let ids = ids.to_vec();
        self.wait(|store| async move { try_join_all(ids.into_iter().map(|id| store.get_or_discard(id))).await })
    }

    /// See [`Store::get_ranges`].
    ///
    /// # Errors
    /// As there.
    pub fn get_ranges(&self, id: ArtefactId, ranges: &[Range<u64>]) -> Result<Vec<Bytes>, StoreError> {
        let ranges = ranges.to_vec();
        self.wait(|store| async move { store.get_ranges(id, &ranges).await })
    }

    /// See [`Store::size`].
    ///
    /// # Errors
    /// As there.
    pub fn size(&self, id: ArtefactId) -> Result<Option<u64>, StoreError> {
        self.wait(|store| async move { store.size(id).await })
    }

    /// See [`Store::exists`].
    ///
    /// # Errors
    /// As there.
    pub fn exists(&self, id: ArtefactId) -> Result<bool, StoreError> {
        self.wait(|store| async move { store.exists(id).await })
    }

    /// See [`Store::put_name`].
    ///
    /// # Errors
    /// As there.
    pub fn put_name(&self, name: &str, bytes: impl Into<Bytes>) -> Result<(), StoreError> {
        let (name, bytes) = (name.to_owned(), bytes.into());
        self.wait(|store| async move { store.put_name(&name, bytes).await })
    }

    /// See [`Store::get_name`].
    ///
    /// # Errors
    /// As there.
    pub fn get_name(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        let name = name.to_owned();
        self.wait(|store| async move { store.get_name(&name).await })
    }

    /// What a network is needed for is done on the store's own runtime, as this thread may have none, or one that waits for us.
    fn wait<T, W>(&self, work: impl FnOnce(Store) -> W) -> T
    where
        T: Send + 'static,
        W: Future<Output = T> + Send + 'static,
    {
        let work = work(self.store.clone());
        match self.store.network.as_deref().and_then(Network::handle) {
            None => block_on(work),
            Some(network) => match block_on(network.spawn(work)) {
                Ok(done) => done,
                Err(error) => std::panic::resume_unwind(error.into_panic()),
            },
        }
    }
}
