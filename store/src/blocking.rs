//! A blocking wrapper of [`Store`] for code that is not async: rayon threads, trainers, tests.

use std::future::Future;
use std::ops::Range;

use bytes::Bytes;
use futures::executor::block_on;
use futures::future::try_join_all;
use scene::ArtefactId;

use crate::artefacts::Store;
use crate::error::StoreError;
use crate::open::Network;

/// A [`Store`] whose calls block until they are done. Local folders are read and written by the calling thread, or, if it
/// belongs to an async runtime, by that runtime's blocking pool.
#[derive(Debug, Clone)]
pub struct BlockingStore {
    store: Store,
}

impl Store {
    /// The same store for code that is not async.
    pub fn blocking(&self) -> BlockingStore {
        BlockingStore { store: self.clone() }
    }
}

impl BlockingStore {
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
        self.run(|store| async move { store.put(bytes).await })
    }

    /// See [`Store::put`]: concurrent puts of several artefacts.
    ///
    /// # Errors
    /// The first error.
    pub fn put_all(&self, all: Vec<Vec<u8>>) -> Result<Vec<ArtefactId>, StoreError> {
        self.run(|store| async move { try_join_all(all.into_iter().map(|bytes| store.put(bytes.into()))).await })
    }

    /// See [`Store::get`].
    ///
    /// # Errors
    /// As there.
    pub fn get(&self, id: ArtefactId) -> Result<Bytes, StoreError> {
        self.run(|store| async move { store.get(id).await })
    }

    /// See [`Store::get_or_discard`].
    ///
    /// # Errors
    /// As there.
    pub fn get_or_discard(&self, id: ArtefactId) -> Result<Option<Bytes>, StoreError> {
        self.run(|store| async move { store.get_or_discard(id).await })
    }

    /// See [`Store::get_or_discard`]: concurrent reads of several artefacts.
    ///
    /// # Errors
    /// The first error.
    pub fn get_all_or_discard(&self, ids: &[ArtefactId]) -> Result<Vec<Option<Bytes>>, StoreError> {
        let ids = ids.to_vec();
        self.run(|store| async move { try_join_all(ids.into_iter().map(|id| store.get_or_discard(id))).await })
    }

    /// See [`Store::get_ranges`].
    ///
    /// # Errors
    /// As there.
    pub fn get_ranges(&self, id: ArtefactId, ranges: &[Range<u64>]) -> Result<Vec<Bytes>, StoreError> {
        let ranges = ranges.to_vec();
        self.run(|store| async move { store.get_ranges(id, &ranges).await })
    }

    /// See [`Store::size`].
    ///
    /// # Errors
    /// As there.
    pub fn size(&self, id: ArtefactId) -> Result<Option<u64>, StoreError> {
        self.run(|store| async move { store.size(id).await })
    }

    /// See [`Store::exists`].
    ///
    /// # Errors
    /// As there.
    pub fn exists(&self, id: ArtefactId) -> Result<bool, StoreError> {
        self.run(|store| async move { store.exists(id).await })
    }

    /// See [`Store::put_record`].
    ///
    /// # Errors
    /// As there.
    pub fn put_record(&self, name: &str, bytes: impl Into<Bytes>) -> Result<(), StoreError> {
        let (name, bytes) = (name.to_owned(), bytes.into());
        self.run(|store| async move { store.put_record(&name, bytes).await })
    }

    /// See [`Store::get_record`].
    ///
    /// # Errors
    /// As there.
    pub fn get_record(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        let name = name.to_owned();
        self.run(|store| async move { store.get_record(&name).await })
    }

    /// Network requests run on the store's own runtime: the calling thread may have no runtime, or one that it blocks.
    fn run<T, W>(&self, work: impl FnOnce(Store) -> W) -> T
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
