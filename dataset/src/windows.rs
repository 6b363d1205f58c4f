//! Windows of views for whoever trains: read by ranges, decoded once, kept in a cache of bounded size.
//!
//! A training task looks at the same few windows hundreds of times, so what is kept is the finished window, and a hit
//! costs a lookup and no copy. Tiles are not kept: windows of one task rarely share them. What training expects to look at in a
//! few steps is fetched meanwhile, so that nobody waits for a store that is far away.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};

use scene::{Capture, CodecError, Pixels, Rect};
use store::{BlockingStore, StoreError};

use crate::mips::{Index, Layout};

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
    /// Windows that were read while somebody waited.
    pub misses: u64,
    /// Windows that were read because they were expected.
    pub expected: u64,
    /// Bytes read from the store.
    pub bytes_read: u64,
    /// The part of them that the windows' own pixels take, had each pixel of a tile the same.
    pub bytes_used: u64,
    /// Bytes in the cache now.
    pub cached_bytes: u64,
}

/// Where the tiles of mips lie, as far as readers of one capture have learnt: a window of such a mip takes one answer of the store
/// instead of two. For whoever reads a capture again and again.
#[derive(Debug, Default)]
pub struct Indexes(Mutex<Known>);

#[derive(Debug, Default)]
struct Known {
    /// By view and mip.
    indexes: HashMap<(u32, u8), Arc<Index>>,
    bytes: usize,
}

impl Indexes {
    /// What is learnt beyond so many bytes is not kept: the mips of some thousand photos.
    const LIMIT: usize = 32 << 20;

    fn known(&self) -> MutexGuard<'_, Known> {
        // A thread that panicked while it held the lock left at worst an index out.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn of(&self, mip: (u32, u8)) -> Option<Arc<Index>> {
        self.known().indexes.get(&mip).cloned()
    }

    fn learn(&self, mip: (u32, u8), index: &Arc<Index>) {
        let mut known = self.known();
        if known.bytes + index.size() <= Self::LIMIT && known.indexes.insert(mip, Arc::clone(index)).is_none() {
            known.bytes += index.size();
        }
    }
}

/// Threads that fetch what is expected: a window takes two answers of the store, one after the other.
const FETCHERS: usize = 4;
/// Expected windows that wait for them at most.
const QUEUE: usize = 16;

/// Reads windows of an ingested capture. Threads share one reader.
#[derive(Debug)]
pub struct WindowReader {
    shared: Arc<Shared>,
    /// To the threads that fetch what is expected, which end with the reader. There are none until something is.
    fetchers: OnceLock<SyncSender<Key>>,
}

impl WindowReader {
    /// A reader that keeps at most `cache_bytes` bytes of pixels.
    pub fn new(capture: Arc<Capture>, store: BlockingStore, cache_bytes: usize) -> Self {
        Self::sharing(Arc::default(), capture, store, cache_bytes)
    }

    /// The same, with what other readers of the capture have learnt of it.
    pub fn sharing(indexes: Arc<Indexes>, capture: Arc<Capture>, store: BlockingStore, cache_bytes: usize) -> Self {
        let cache = Mutex::new(Cache { limit: cache_bytes, ..Cache::default() });
        let (arrived, stats) = (Condvar::new(), Counters::default());
        Self { shared: Arc::new(Shared { capture, store, indexes, cache, arrived, stats }), fetchers: OnceLock::new() }
    }

    /// The capture.
    pub fn capture(&self) -> &Arc<Capture> {
        &self.shared.capture
    }

    /// The pixels of `rect`, in pixels of that mip, of a view of the capture.
    ///
    /// # Errors
    /// A view, mip or rectangle that is not there; a store that fails; damaged bytes.
    pub fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, WindowError> {
        let (key, shared) = ((view, mip, rect), &*self.shared);
        let mut cache = shared.cache();
        loop {
            if let Some(pixels) = cache.get(key) {
                shared.stats.hits.fetch_add(1, Ordering::Relaxed);
                return Ok(pixels);
            }
            if !cache.coming.contains(&key) {
                break;
            }
            cache = shared.arrived.wait(cache).unwrap_or_else(PoisonError::into_inner);
        }
        drop(cache);
        shared.stats.misses.fetch_add(1, Ordering::Relaxed);
        let pixels = shared.read(key)?;
        shared.cache().put(key, &pixels);
        Ok(pixels)
    }

    /// Begins to fetch a window that will be asked for soon, if it is not there, there is room for a queue of such, and the others
    /// have not too much to do.
    pub fn expect(&self, view: u32, mip: u8, rect: Rect) {
        let key = (view, mip, rect);
        let fetchers = self.fetchers.get_or_init(|| fetchers(&self.shared));
        let mut cache = self.shared.cache();
        let fits = rect.area().saturating_mul(4 * 2 * QUEUE as u64) <= cache.limit as u64;
        if !fits || cache.windows.contains_key(&key) || !cache.coming.insert(key) {
            return;
        }
        if fetchers.try_send(key).is_err() {
            cache.coming.remove(&key);
        }
    }

    /// What was done so far.
    pub fn stats(&self) -> WindowStats {
        let Counters { hits, misses, expected, bytes_read, bytes_used } = &self.shared.stats;
        let [hits, misses, expected, bytes_read, bytes_used] =
            [hits, misses, expected, bytes_read, bytes_used].map(|count| count.load(Ordering::Relaxed));
        let cached_bytes = self.shared.cache().bytes as u64;
        WindowStats { hits, misses, expected, bytes_read, bytes_used, cached_bytes }
    }
}

impl train::WindowSource for WindowReader {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        Self::window(self, view, mip, rect).map_err(|error| error.to_string())
    }

    fn expect(&self, view: u32, mip: u8, rect: Rect) {
        Self::expect(self, view, mip, rect);
    }
}

/// What a reader has in common with its fetchers.
#[derive(Debug)]
struct Shared {
    capture: Arc<Capture>,
    store: BlockingStore,
    indexes: Arc<Indexes>,
    cache: Mutex<Cache>,
    /// An expected window came, or failed.
    arrived: Condvar,
    stats: Counters,
}

#[derive(Debug, Default)]
struct Counters {
    hits: AtomicU64,
    misses: AtomicU64,
    expected: AtomicU64,
    bytes_read: AtomicU64,
    bytes_used: AtomicU64,
}

impl Shared {
    fn read(&self, (number, mip, rect): Key) -> Result<Arc<Pixels>, WindowError> {
        let view = match self.capture.views.get(number as usize) {
            Some(found) if usize::from(mip) < found.mips.len() => found,
            _ => return Err(WindowError::Absent { view: number, mip }),
        };
        let name = || view.name.clone();
        let id = view.mips[usize::from(mip)];
        let damaged = |error: CodecError| {
            let error = CodecError::new(format!("artefact {id}: {error}"));
            WindowError::Damaged { name: name(), mip, error }
        };
        let read = |ranges: &[Range<u64>]| {
            let parts = self.store.get_ranges(id, ranges);
            let parts = parts.map_err(|error| WindowError::Store { name: name(), mip, error })?;
            let bytes: usize = parts.iter().map(|part| part.len()).sum();
            self.stats.bytes_read.fetch_add(bytes as u64, Ordering::Relaxed);
            Ok(parts)
        };
        let camera = view.camera.mip(mip).pinhole;
        let layout = Layout { width: camera.width, height: camera.height, masked: view.masked };
        let index = match self.indexes.of((number, mip)) {
            Some(index) => index,
            None => {
                let head = read(std::slice::from_ref(&(0..layout.index_len() as u64)))?;
                let index = Arc::new(layout.index(&head[0]).map_err(damaged)?);
                self.indexes.learn((number, mip), &index);
                index
            }
        };
        let ranges = index.ranges(rect).ok_or_else(|| WindowError::Outside { name: name(), mip, rect })?;
        self.stats.bytes_used.fetch_add(index.bytes_of(rect), Ordering::Relaxed);
        index.window(rect, &read(&ranges)?).map(Arc::new).map_err(damaged)
    }

    fn cache(&self) -> MutexGuard<'_, Cache> {
        // A thread that panicked while it held the lock left at worst a window out of the cache.
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Starts the threads that fetch; where there can be none, nobody takes what is sent.
fn fetchers(shared: &Arc<Shared>) -> SyncSender<Key> {
    let (sender, receiver) = sync_channel(QUEUE);
    let receiver = Arc::new(Mutex::new(receiver));
    for _ in 0..FETCHERS {
        let (shared, receiver) = (Arc::clone(shared), Arc::clone(&receiver));
        // Whoever gets no thread does without.
        let _ = std::thread::Builder::new().name("windows".into()).spawn(move || fetch(&shared, &receiver));
    }
    sender
}

/// Fetches what is expected until the reader is gone.
fn fetch(shared: &Shared, expected: &Mutex<Receiver<Key>>) {
    /// Ends the waiting for a window, whatever came of it.
    struct Coming<'a>(&'a Shared, Key);
    impl Drop for Coming<'_> {
        fn drop(&mut self) {
            self.0.cache().coming.remove(&self.1);
            self.0.arrived.notify_all();
        }
    }
    let next = || expected.lock().unwrap_or_else(PoisonError::into_inner).recv();
    while let Ok(key) = next() {
        let _coming = Coming(shared, key);
        // What is wrong is said when the window is asked for.
        if let Ok(pixels) = shared.read(key) {
            shared.stats.expected.fetch_add(1, Ordering::Relaxed);
            shared.cache().put(key, &pixels);
        }
    }
}

type Key = (u32, u8, Rect);

/// Windows by key, the least recently used first to go.
#[derive(Debug, Default)]
struct Cache {
    windows: HashMap<Key, (u64, Arc<Pixels>)>,
    by_age: BTreeMap<u64, Key>,
    /// Those that are being fetched because they are expected.
    coming: HashSet<Key>,
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
