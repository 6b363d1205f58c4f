//! Windows of views for whoever trains: read by ranges, decoded once, kept in a cache of bounded size.
//!
//! A training task looks at the same few windows hundreds of times, so what is kept is the finished window, and a hit
//! costs a lookup and no copy. Tiles are kept where asked for: windows of one task rarely share them, those of different tasks do,
//! and that is worth it where the store is far. What training expects to look at in a
//! few steps is fetched meanwhile, so that nobody waits for a store that is far away.

use std::collections::HashSet;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};

use bytes::Bytes;
use scene::{Capture, CodecError, Pixels, Rect};
use store::{BlockingStore, StoreError};

use crate::byte_lru::ByteLru;
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

/// What readers of one capture have in common, for whoever reads it again and again: where the tiles of its mips lie, so that a
/// window takes one answer of the store instead of two, and tiles as they were read, where that is asked for: blocks side by side look
/// at the same parts of the same photos.
#[derive(Debug)]
pub struct SharedTileCache {
    indexes: Mutex<ByteLru<Mip, Arc<Index>>>,
    /// By mip and place in its artefact.
    tiles: Mutex<ByteLru<(Mip, u64), Bytes>>,
}

/// A view, and which of its mips.
type Mip = (u32, u8);

impl SharedTileCache {
    /// The indexes of the mips of some thousand photos.
    const INDEX_BYTES: usize = 32 << 20;

    /// Keeps so many bytes of tiles: none is right where the store is as near as memory.
    pub fn keeping(tile_bytes: usize) -> Self {
        Self { indexes: Mutex::new(ByteLru::new(Self::INDEX_BYTES)), tiles: Mutex::new(ByteLru::new(tile_bytes)) }
    }

    fn index(&self, mip: Mip) -> Option<Arc<Index>> {
        locked(&self.indexes).get(&mip).cloned()
    }

    fn learn(&self, mip: Mip, index: &Arc<Index>) {
        locked(&self.indexes).put(mip, Arc::clone(index), index.size());
    }

    /// The tiles that begin in these places, as far as they are kept.
    fn tiles(&self, mip: Mip, ranges: &[Range<u64>]) -> Vec<Option<Bytes>> {
        let mut tiles = locked(&self.tiles);
        ranges.iter().map(|range| tiles.get(&(mip, range.start)).cloned()).collect()
    }

    /// Keeps tiles that were found to be whole.
    fn keep(&self, mip: Mip, read: impl Iterator<Item = (u64, Bytes)>) {
        let mut tiles = locked(&self.tiles);
        if tiles.limit() > 0 {
            for (start, tile) in read {
                // Not a part of whatever was read with it.
                let tile = Bytes::copy_from_slice(&tile);
                let bytes = tile.len() + TILE_BYTES;
                tiles.put((mip, start), tile, bytes);
            }
        }
    }
}

/// What it takes to find a tile, roughly.
const TILE_BYTES: usize = 96;

/// A thread that panicked while it held a lock left at worst something out of what is kept.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
        Self::sharing(Arc::new(SharedTileCache::new(0)), capture, store, cache_bytes)
    }

    /// The same, with what other readers of the capture have read of it.
    pub fn sharing(common: Arc<SharedTileCache>, capture: Arc<Capture>, store: BlockingStore, cache_bytes: usize) -> Self {
        let cache = Mutex::new(Cache { windows: ByteLru::new(cache_bytes), coming: HashSet::new() });
        let (arrived, stats) = (Condvar::new(), Counters::default());
        Self { shared: Arc::new(Shared { capture, store, common, cache, arrived, stats }), fetchers: OnceLock::new() }
    }

    /// Another reader of the same capture, over this store, that shares what was read of it.
    pub fn beside(&self, store: BlockingStore, cache_bytes: usize) -> Self {
        Self::sharing(Arc::clone(&self.shared.common), Arc::clone(&self.shared.capture), store, cache_bytes)
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
            if let Some(pixels) = cache.windows.get(&key) {
                shared.stats.hits.fetch_add(1, Ordering::Relaxed);
                return Ok(Arc::clone(pixels));
            }
            if !cache.coming.contains(&key) {
                break;
            }
            cache = shared.arrived.wait(cache).unwrap_or_else(PoisonError::into_inner);
        }
        drop(cache);
        shared.stats.misses.fetch_add(1, Ordering::Relaxed);
        let pixels = shared.read(key)?;
        shared.keep(key, &pixels);
        Ok(pixels)
    }

    /// Begins to fetch a window that will be asked for soon, if it is not there, there is room for a queue of such, and the others
    /// have not too much to do.
    pub fn prefetch(&self, view: u32, mip: u8, rect: Rect) {
        let key = (view, mip, rect);
        let fetchers = self.fetchers.get_or_init(|| fetchers(&self.shared));
        let mut cache = self.shared.cache();
        let fits = rect.area().saturating_mul(4 * 2 * QUEUE as u64) <= cache.windows.limit() as u64;
        if !fits || cache.windows.contains(&key) || !cache.coming.insert(key) {
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
        let cached_bytes = self.shared.cache().windows.bytes() as u64;
        WindowStats { hits, misses, expected, bytes_read, bytes_used, cached_bytes }
    }
}

impl train::WindowSource for WindowReader {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        Self::window(self, view, mip, rect).map_err(|error| error.to_string())
    }

    fn prefetch(&self, view: u32, mip: u8, rect: Rect) {
        Self::prefetch(self, view, mip, rect);
    }
}

/// What a reader has in common with its fetchers.
#[derive(Debug)]
struct Shared {
    capture: Arc<Capture>,
    store: BlockingStore,
    common: Arc<SharedTileCache>,
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
        let read = |ranges: &[Range<u64>]| -> Result<Vec<Bytes>, WindowError> {
            let parts = self.store.get_ranges(id, ranges);
            let parts = parts.map_err(|error| WindowError::Store { name: name(), mip, error })?;
            let bytes: usize = parts.iter().map(|part| part.len()).sum();
            self.stats.bytes_read.fetch_add(bytes as u64, Ordering::Relaxed);
            Ok(parts)
        };
        let camera = view.camera.mip(mip).pinhole;
        let layout = Layout { width: camera.width, height: camera.height, masked: view.masked };
        let index = match self.common.index((number, mip)) {
            Some(index) => index,
            None => {
                let head = read(std::slice::from_ref(&(0..layout.index_len() as u64)))?;
                let index = Arc::new(layout.index(&head[0]).map_err(damaged)?);
                self.common.learn((number, mip), &index);
                index
            }
        };
        let ranges = index.ranges(rect).ok_or_else(|| WindowError::Outside { name: name(), mip, rect })?;
        self.stats.bytes_used.fetch_add(index.bytes_of(rect), Ordering::Relaxed);
        let mut tiles = self.common.tiles((number, mip), &ranges);
        let missing: Vec<usize> = (0..tiles.len()).filter(|&i| tiles[i].is_none()).collect();
        if !missing.is_empty() {
            let wanted: Vec<Range<u64>> = missing.iter().map(|&i| ranges[i].clone()).collect();
            missing.iter().zip(read(&wanted)?).for_each(|(&i, tile)| tiles[i] = Some(tile));
        }
        let tiles: Vec<Bytes> = tiles.into_iter().flatten().collect();
        let pixels = index.window(rect, &tiles).map_err(damaged)?;
        self.common.keep((number, mip), missing.into_iter().map(|i| (ranges[i].start, tiles[i].clone())));
        Ok(Arc::new(pixels))
    }

    fn keep(&self, key: Key, pixels: &Arc<Pixels>) {
        self.cache().windows.put(key, Arc::clone(pixels), size(pixels));
    }

    fn cache(&self) -> MutexGuard<'_, Cache> {
        locked(&self.cache)
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
            shared.keep(key, &pixels);
        }
    }
}

type Key = (u32, u8, Rect);

#[derive(Debug)]
struct Cache {
    windows: ByteLru<Key, Arc<Pixels>>,
    /// Those that are being fetched because they are expected.
    coming: HashSet<Key>,
}

/// Pixels and, roughly, what the cache needs to find them.
fn size(pixels: &Pixels) -> usize {
    pixels.rgb.len() + pixels.mask.as_ref().map_or(0, Vec::len) + 256
}
