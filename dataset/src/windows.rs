//! Windows of views for whoever trains: read by ranges, decoded once, kept in a cache of bounded size.
//!
//! A training task looks at the same few windows hundreds of times, so what is kept is the finished window, and a hit
//! costs a lookup and no copy. Tiles are not kept: windows of one task rarely share them.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use scene::{Capture, CodecError, Pixels, Rect, View};
use store::{BlockingStore, StoreError};

use crate::mips::Layout;

/// A window that could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WindowError {
    /// No such view or mip in the capture: the caller's mistake, or a capture that was not ingested.
    #[error("view {view} mip {mip} is not in the ingested capture")]
    Absent {
        /// Index of the view.
        view: u32,
        /// The mip.
        mip: u8,
    },
    /// Empty, or not inside the mip.
    #[error("window {rect:?} is not inside mip {mip} of view {name}")]
    Outside {
        /// The view's name.
        name: String,
        /// The mip.
        mip: u8,
        /// The window.
        rect: Rect,
    },
    /// The artefact does not decode.
    #[error("view {name} mip {mip}: {error}; delete the artefact and ingest again")]
    Damaged {
        /// The view's name.
        name: String,
        /// The mip.
        mip: u8,
        /// What is wrong with it, and its id.
        error: CodecError,
    },
    /// The store failed.
    #[error("view {name} mip {mip}: {error}")]
    Store {
        /// The view's name.
        name: String,
        /// The mip.
        mip: u8,
        /// What it said.
        error: StoreError,
    },
}

/// What a reader did so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WindowStats {
    /// Windows that the cache had.
    pub hits: u64,
    /// Windows that were read.
    pub misses: u64,
    /// Bytes read from the store.
    pub bytes_read: u64,
    /// Bytes in the cache now.
    pub cached_bytes: u64,
}

/// Reads windows of an ingested capture. Threads share one reader.
#[derive(Debug)]
pub struct WindowReader {
    capture: Arc<Capture>,
    store: BlockingStore,
    cache: Mutex<Cache>,
    hits: AtomicU64,
    misses: AtomicU64,
    bytes_read: AtomicU64,
}

impl WindowReader {
    /// A reader that keeps at most `cache_bytes` bytes of pixels.
    pub fn new(capture: Arc<Capture>, store: BlockingStore, cache_bytes: usize) -> Self {
        let cache = Mutex::new(Cache { limit: cache_bytes, ..Cache::default() });
        let [hits, misses, bytes_read] = [(); 3].map(|()| AtomicU64::new(0));
        Self { capture, store, cache, hits, misses, bytes_read }
    }

    /// The capture.
    pub fn capture(&self) -> &Arc<Capture> {
        &self.capture
    }

    /// The pixels of `rect`, in pixels of that mip, of a view of the capture.
    ///
    /// # Errors
    /// A view, mip or rectangle that is not there; a store that fails; damaged bytes.
    pub fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, WindowError> {
        let key = (view, mip, rect);
        if let Some(pixels) = self.cache().get(key) {
            self.hits.fetch_add(1, Ordering::Relaxed);
            return Ok(pixels);
        }
        self.misses.fetch_add(1, Ordering::Relaxed);
        let found = self.capture.views.get(view as usize).ok_or(WindowError::Absent { view, mip })?;
        if usize::from(mip) >= found.mips.len() {
            return Err(WindowError::Absent { view, mip });
        }
        let pixels = Arc::new(self.read(found, mip, rect)?);
        self.cache().put(key, &pixels);
        Ok(pixels)
    }

    /// What was done so far.
    pub fn stats(&self) -> WindowStats {
        WindowStats {
            hits: self.hits.load(Ordering::Relaxed),
            misses: self.misses.load(Ordering::Relaxed),
            bytes_read: self.bytes_read.load(Ordering::Relaxed),
            cached_bytes: self.cache().bytes as u64,
        }
    }

    fn read(&self, view: &View, mip: u8, rect: Rect) -> Result<Pixels, WindowError> {
        let name = || view.name.clone();
        let id = view.mips[usize::from(mip)];
        let damaged = |error: CodecError| {
            let error = CodecError::new(format!("artefact {id}: {error}"));
            WindowError::Damaged { name: name(), mip, error }
        };
        let read = |ranges: &[std::ops::Range<u64>]| {
            let parts = self.store.get_ranges(id, ranges);
            let parts = parts.map_err(|error| WindowError::Store { name: name(), mip, error })?;
            let bytes: usize = parts.iter().map(|part| part.len()).sum();
            self.bytes_read.fetch_add(bytes as u64, Ordering::Relaxed);
            Ok(parts)
        };
        let camera = view.camera.mip(mip).pinhole;
        let layout = Layout { width: camera.width, height: camera.height, masked: view.masked };
        let head = read(std::slice::from_ref(&(0..layout.index_len() as u64)))?;
        let index = layout.index(&head[0]).map_err(damaged)?;
        let ranges = index.ranges(rect).ok_or_else(|| WindowError::Outside { name: name(), mip, rect })?;
        index.window(rect, &read(&ranges)?).map_err(damaged)
    }

    fn cache(&self) -> std::sync::MutexGuard<'_, Cache> {
        // A thread that panicked while it held the lock left at worst a window out of the cache.
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl train::WindowSource for WindowReader {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        Self::window(self, view, mip, rect).map_err(|error| error.to_string())
    }
}

type Key = (u32, u8, Rect);

/// Windows by key, the least recently used first to go.
#[derive(Debug, Default)]
struct Cache {
    windows: HashMap<Key, (u64, Arc<Pixels>)>,
    by_age: BTreeMap<u64, Key>,
    clock: u64,
    bytes: usize,
    limit: usize,
}

impl Cache {
    fn get(&mut self, key: Key) -> Option<Arc<Pixels>> {
        let (used, pixels) = self.windows.get_mut(&key)?;
        self.by_age.remove(used);
        self.clock += 1;
        *used = self.clock;
        self.by_age.insert(self.clock, key);
        Some(Arc::clone(pixels))
    }

    fn put(&mut self, key: Key, pixels: &Arc<Pixels>) {
        let bytes = size(pixels);
        if bytes > self.limit || self.windows.contains_key(&key) {
            return;
        }
        while self.bytes + bytes > self.limit {
            let Some((_, oldest)) = self.by_age.pop_first() else { break };
            if let Some((_, gone)) = self.windows.remove(&oldest) {
                self.bytes -= size(&gone);
            }
        }
        self.clock += 1;
        self.bytes += bytes;
        self.by_age.insert(self.clock, key);
        self.windows.insert(key, (self.clock, Arc::clone(pixels)));
    }
}

/// Pixels and, roughly, what the cache needs to find them.
fn size(pixels: &Pixels) -> usize {
    pixels.rgb.len() + pixels.mask.as_ref().map_or(0, Vec::len) + 256
}
