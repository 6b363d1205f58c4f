//! Locks of caches.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a cache, poisoned or not: after a panic it lacks at most an entry.
pub(super) fn lock<T>(cache: &Mutex<T>) -> MutexGuard<'_, T> {
    cache.lock().unwrap_or_else(PoisonError::into_inner)
}
