//! Reads windows of views by byte ranges and caches them decoded, in an LRU cache of bounded size.
//!
//! A training task reads the same few windows hundreds of times, so the cache holds decoded windows, and a hit costs a lookup
//! and no copy. Compressed tiles are cached only in a [`SharedTileCache`]: windows of one task rarely share tiles, windows of
//! different tasks do, which pays off for a remote store. The trainer announces windows a few steps ahead
//! ([`WindowReader::prefetch`]); background threads fetch them, which hides the latency of a remote store.

mod locks;
mod sparse_depth;
mod target_depth;
mod tile_cache;
mod zone_weights;

use std::collections::HashSet;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};

use bytes::Bytes;
use scene::{Capture, CodecError, Pixels, Rect, Zones};
use store::{BlockingStore, StoreError};

use self::locks::lock;
use self::target_depth::{DepthError, TargetDepth};
pub use self::tile_cache::SharedTileCache;
use crate::byte_lru::ByteLru;
use crate::mip_tiles::MipLayout;

/// A window that could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WindowError {
    /// No such view or mip: a bug of the caller, or a capture that was not ingested.
    #[error("view {view} mip {mip} is not in the ingested capture")]
    NoSuchMip {
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
        /// The artefact's id and its defect.
        error: CodecError,
    },
    /// The store failed.
    #[error("view {name} mip {mip}: {error}")]
    Store {
        /// The view's name.
        name: String,
        /// The mip.
        mip: u8,
        /// The store's error.
        error: StoreError,
    },
}

/// Counters of a reader since its creation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WindowStats {
    /// Windows found in the cache.
    pub hits: u64,
    /// Windows read by the calling thread.
    pub misses: u64,
    /// Windows read ahead by prefetch threads.
    pub prefetched: u64,
    /// Bytes read from the store.
    pub bytes_read: u64,
    /// The share of them that the windows use of their tiles, by area.
    pub bytes_used: u64,
    /// Current size of the cache, bytes.
    pub cached_bytes: u64,
}

/// Threads that prefetch. A window takes up to two sequential requests.
const PREFETCH_THREADS: usize = 4;
/// Windows queued for prefetching at most.
const PREFETCH_QUEUE: usize = 16;

/// Reads windows of an ingested capture. Threads share one reader. Dropping it discards queued prefetches and ends its threads.
#[derive(Debug)]
pub struct WindowReader {
    shared: Arc<Shared>,
    /// The queue of the prefetch threads, which start with the first prefetch.
    prefetch_queue: OnceLock<SyncSender<WindowKey>>,
}

impl WindowReader {
    /// A reader that caches at most `cache_bytes` bytes of decoded windows.
    pub fn new(capture: Arc<Capture>, store: BlockingStore, cache_bytes: usize) -> Self {
        Self::with_shared_tiles(Arc::new(SharedTileCache::new(0)), capture, store, cache_bytes)
    }

    /// A reader that shares tile indexes and compressed tiles with other readers of the capture.
    pub fn with_shared_tiles(
        tiles: Arc<SharedTileCache>,
        capture: Arc<Capture>,
        store: BlockingStore,
        cache_bytes: usize,
    ) -> Self {
        let cache = Mutex::new(WindowCache { windows: ByteLru::new(cache_bytes), pending: HashSet::new() });
        let (finished, counters, is_closed) = (Condvar::new(), Counters::default(), AtomicBool::new(false));
        let (depth, zones) = (None, None);
        let shared = Shared { capture, store, tiles, depth, zones, cache, finished, counters, is_closed };
        Self { shared: Arc::new(shared), prefetch_queue: OnceLock::new() }
    }

    /// A new reader like this one whose windows carry target depths: those measured by lidar or depth maps, and those of the
    /// sparse points whose track contains the view.
    #[must_use]
    pub fn with_depth(self) -> Self {
        let depth = Some(TargetDepth::new(&self.shared.capture));
        self.with(depth, self.shared.zones.clone())
    }

    /// A new reader like this one whose windows weigh pixels of zones more, `1 + weight` for one of usual size, and others 1.
    #[must_use]
    pub fn with_zones(self, zones: Arc<Zones>, weight: f32) -> Self {
        let depth = self.shared.depth.is_some().then(|| TargetDepth::new(&self.shared.capture));
        self.with(depth, Some((zones, weight)))
    }

    fn with(&self, depth: Option<TargetDepth>, zones: Option<(Arc<Zones>, f32)>) -> Self {
        let Shared { capture, store, tiles, cache, .. } = &*self.shared;
        let windows = ByteLru::new(lock(cache).windows.limit());
        let shared = Shared {
            capture: Arc::clone(capture),
            store: store.clone(),
            tiles: Arc::clone(tiles),
            depth,
            zones,
            cache: Mutex::new(WindowCache { windows, pending: HashSet::new() }),
            finished: Condvar::new(),
            counters: Counters::default(),
            is_closed: AtomicBool::new(false),
        };
        Self { shared: Arc::new(shared), prefetch_queue: OnceLock::new() }
    }

    /// Another reader of the same capture over `store`, with its own window cache and the same [`SharedTileCache`].
    pub fn with_store(&self, store: BlockingStore, cache_bytes: usize) -> Self {
        Self::with_shared_tiles(Arc::clone(&self.shared.tiles), Arc::clone(&self.shared.capture), store, cache_bytes)
    }

    /// The capture.
    pub fn capture(&self) -> &Arc<Capture> {
        &self.shared.capture
    }

    /// The pixels of `rect`, in pixels of that mip, of a view of the capture.
    ///
    /// # Errors
    /// No such view or mip, a rectangle outside of it, a failing store or damaged bytes.
    pub fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, WindowError> {
        let (key, shared) = ((view, mip, rect), &*self.shared);
        let mut cache = shared.cache();
        loop {
            if let Some(pixels) = cache.windows.get(&key) {
                shared.counters.hits.fetch_add(1, Ordering::Relaxed);
                return Ok(Arc::clone(pixels));
            }
            if !cache.pending.contains(&key) {
                break;
            }
            cache = shared.finished.wait(cache).unwrap_or_else(PoisonError::into_inner);
        }
        drop(cache);
        shared.counters.misses.fetch_add(1, Ordering::Relaxed);
        let pixels = shared.read(key)?;
        shared.insert(key, &pixels);
        Ok(pixels)
    }

    /// Queues a window to be fetched in the background. Does nothing if the window is cached or queued already, if the cache
    /// could not hold two queues of such windows, or if the queue is full.
    pub fn prefetch(&self, view: u32, mip: u8, rect: Rect) {
        let key = (view, mip, rect);
        let queue = self.prefetch_queue.get_or_init(|| start_prefetch_threads(&self.shared));
        let mut cache = self.shared.cache();
        // Colour and mask, and floats of depth and weight.
        let floats = u64::from(self.shared.depth.is_some()) + u64::from(self.shared.zones.is_some());
        let pixel_bytes = 4 + 4 * floats;
        let fits = rect.area().saturating_mul(pixel_bytes * 2 * PREFETCH_QUEUE as u64) <= cache.windows.limit() as u64;
        if !fits || cache.windows.contains(&key) || !cache.pending.insert(key) {
            return;
        }
        if queue.try_send(key).is_err() {
            cache.pending.remove(&key);
        }
    }

    /// The counters so far.
    pub fn stats(&self) -> WindowStats {
        let Counters { hits, misses, prefetched, bytes_read, bytes_used } = &self.shared.counters;
        let [hits, misses, prefetched, bytes_read, bytes_used] =
            [hits, misses, prefetched, bytes_read, bytes_used].map(|count| count.load(Ordering::Relaxed));
        let cached_bytes = self.shared.cache().windows.bytes() as u64;
        WindowStats { hits, misses, prefetched, bytes_read, bytes_used, cached_bytes }
    }
}

impl Drop for WindowReader {
    fn drop(&mut self) {
        self.shared.is_closed.store(true, Ordering::Release);
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

/// State shared by a reader and its prefetch threads.
#[derive(Debug)]
struct Shared {
    capture: Arc<Capture>,
    store: BlockingStore,
    tiles: Arc<SharedTileCache>,
    /// Where windows carry target depths.
    depth: Option<TargetDepth>,
    /// Where windows carry weights: the zones, and the additional weight of their pixels.
    zones: Option<(Arc<Zones>, f32)>,
    cache: Mutex<WindowCache>,
    /// Notified when a prefetch ends, with or without an error.
    finished: Condvar,
    counters: Counters,
    /// Set when the reader is dropped: prefetch threads discard the queue and end.
    is_closed: AtomicBool,
}

#[derive(Debug, Default)]
struct Counters {
    hits: AtomicU64,
    misses: AtomicU64,
    prefetched: AtomicU64,
    bytes_read: AtomicU64,
    bytes_used: AtomicU64,
}

impl Shared {
    fn read(&self, (number, mip, rect): WindowKey) -> Result<Arc<Pixels>, WindowError> {
        let view = match self.capture.views.get(number as usize) {
            Some(found) if usize::from(mip) < found.mips.len() => found,
            _ => return Err(WindowError::NoSuchMip { view: number, mip }),
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
            self.counters.bytes_read.fetch_add(bytes as u64, Ordering::Relaxed);
            Ok(parts)
        };
        let camera = view.camera.mip(mip).pinhole;
        let layout = MipLayout { width: camera.width, height: camera.height, masked: view.masked };
        let index = match self.tiles.index((number, mip)) {
            Some(index) => index,
            None => {
                let head = read(std::slice::from_ref(&(0..layout.index_len() as u64)))?;
                let index = Arc::new(layout.index(&head[0]).map_err(damaged)?);
                self.tiles.insert_index((number, mip), &index);
                index
            }
        };
        let ranges = index.ranges(rect).ok_or_else(|| WindowError::Outside { name: name(), mip, rect })?;
        self.counters.bytes_used.fetch_add(index.used_bytes(rect), Ordering::Relaxed);
        let mut tiles = self.tiles.tiles((number, mip), &ranges);
        let missing: Vec<usize> = (0..tiles.len()).filter(|&i| tiles[i].is_none()).collect();
        if !missing.is_empty() {
            let wanted: Vec<Range<u64>> = missing.iter().map(|&i| ranges[i].clone()).collect();
            missing.iter().zip(read(&wanted)?).for_each(|(&i, tile)| tiles[i] = Some(tile));
        }
        let tiles: Vec<Bytes> = tiles.into_iter().flatten().collect();
        let mut pixels = index.window(rect, &tiles).map_err(damaged)?;
        if let Some(depth) = &self.depth {
            let error = |error| match error {
                DepthError::Damaged(error) => WindowError::Damaged { name: name(), mip, error },
                DepthError::Store(error) => WindowError::Store { name: name(), mip, error },
            };
            pixels.depth = depth.plane(&self.capture, &self.store, number, mip, rect).map_err(error)?;
        }
        if let Some((zones, weight)) = &self.zones {
            let zones = zones.of(number as usize);
            zone_weights::weigh(&mut pixels, zones, *weight, &view.camera.pinhole, mip, rect);
        }
        self.tiles.insert_tiles((number, mip), missing.into_iter().map(|i| (ranges[i].start, tiles[i].clone())));
        Ok(Arc::new(pixels))
    }

    fn insert(&self, key: WindowKey, pixels: &Arc<Pixels>) {
        self.cache().windows.insert_if_absent(key, Arc::clone(pixels), memory_bytes(pixels));
    }

    fn cache(&self) -> MutexGuard<'_, WindowCache> {
        lock(&self.cache)
    }
}

/// Starts the prefetch threads and returns their queue. If no thread starts, the queue is disconnected and prefetches do
/// nothing.
fn start_prefetch_threads(shared: &Arc<Shared>) -> SyncSender<WindowKey> {
    let (sender, receiver) = sync_channel(PREFETCH_QUEUE);
    let receiver = Arc::new(Mutex::new(receiver));
    for _ in 0..PREFETCH_THREADS {
        let (shared, receiver) = (Arc::clone(shared), Arc::clone(&receiver));
        let _ = std::thread::Builder::new().name("windows".into()).spawn(move || run_prefetch(&shared, &receiver));
    }
    sender
}

/// Fetches queued windows until the reader is dropped.
fn run_prefetch(shared: &Shared, queue: &Mutex<Receiver<WindowKey>>) {
    /// Removes the window from the pending ones and wakes the threads that wait for it, also after an error or a panic.
    struct PendingGuard<'a>(&'a Shared, WindowKey);
    impl Drop for PendingGuard<'_> {
        fn drop(&mut self) {
            self.0.cache().pending.remove(&self.1);
            self.0.finished.notify_all();
        }
    }
    let next = || lock(queue).recv();
    while let Ok(key) = next() {
        let _pending = PendingGuard(shared, key);
        if shared.is_closed.load(Ordering::Acquire) {
            return;
        }
        // An error is dropped here: the window is read again when it is requested, which reports it.
        if let Ok(pixels) = shared.read(key) {
            shared.counters.prefetched.fetch_add(1, Ordering::Relaxed);
            shared.insert(key, &pixels);
        }
    }
}

/// View, mip and rectangle.
type WindowKey = (u32, u8, Rect);

#[derive(Debug)]
struct WindowCache {
    windows: ByteLru<WindowKey, Arc<Pixels>>,
    /// Windows that are queued or being fetched by prefetch threads.
    pending: HashSet<WindowKey>,
}

/// Size of a cached window with its approximate overhead, bytes.
fn memory_bytes(pixels: &Pixels) -> usize {
    let floats = [&pixels.weights, &pixels.depth].map(|plane| plane.as_ref().map_or(0, Vec::len));
    pixels.rgb.len() + pixels.mask.as_ref().map_or(0, Vec::len) + 4 * floats.iter().sum::<usize>() + 256
}

#[cfg(test)]
mod tests;
