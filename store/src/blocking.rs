//! The store for code that is not async: rayon threads, trainers, tests.

use std::future::Future;
use std::ops::Range;

use bytes::Bytes;
use scene::ArtefactId;

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
        wait(self.store.put(bytes.into()))
    }

    /// See [`Store::get`].
    ///
    /// # Errors
    /// As there.
    pub fn get(&self, id: ArtefactId) -> Result<Bytes, StoreError> {
        wait(self.store.get(id))
    }

    /// See [`Store::get_ranges`].
    ///
    /// # Errors
    /// As there.
    pub fn get_ranges(&self, id: ArtefactId, ranges: &[Range<u64>]) -> Result<Vec<Bytes>, StoreError> {
        wait(self.store.get_ranges(id, ranges))
    }

    /// See [`Store::size`].
    ///
    /// # Errors
    /// As there.
    pub fn size(&self, id: ArtefactId) -> Result<Option<u64>, StoreError> {
        wait(self.store.size(id))
    }

    /// See [`Store::exists`].
    ///
    /// # Errors
    /// As there.
    pub fn exists(&self, id: ArtefactId) -> Result<bool, StoreError> {
        wait(self.store.exists(id))
    }

    /// See [`Store::put_name`].
    ///
    /// # Errors
    /// As there.
    pub fn put_name(&self, name: &str, bytes: impl Into<Bytes>) -> Result<(), StoreError> {
        wait(self.store.put_name(name, bytes.into()))
    }

    /// See [`Store::get_name`].
    ///
    /// # Errors
    /// As there.
    pub fn get_name(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        wait(self.store.get_name(name))
    }
}

fn wait<T>(work: impl Future<Output = T>) -> T {
    futures::executor::block_on(work)
}
