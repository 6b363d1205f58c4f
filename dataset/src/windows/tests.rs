use async_trait::async_trait;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, Result,
};
use scene::{Camera, Pinhole, Rigid, View};
use store::Store;

use super::*;
use crate::mip_tiles;
use crate::mips::tests::image;

/// An object store whose reads block until the gate is opened.
#[derive(Debug, Default)]
struct GatedStore {
    inner: Arc<InMemory>,
    gate: Mutex<Gate>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Gate {
    is_open: bool,
    /// Reads so far, blocked ones included.
    reads: usize,
}

impl GatedStore {
    fn wait_for_reads(&self, count: usize) {
        drop(self.changed.wait_while(self.gate.lock().unwrap(), |gate| gate.reads < count).unwrap());
    }

    fn open(&self) {
        self.gate.lock().unwrap().is_open = true;
        self.changed.notify_all();
    }

    fn reads(&self) -> usize {
        self.gate.lock().unwrap().reads
    }
}

impl std::fmt::Display for GatedStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("gated")
    }
}

#[async_trait]
impl ObjectStore for GatedStore {
    async fn get_opts(&self, at: &Path, options: GetOptions) -> Result<GetResult> {
        {
            // Blocks the prefetch thread itself, which polls this future.
            let mut gate = self.gate.lock().unwrap();
            gate.reads += 1;
            self.changed.notify_all();
            drop(self.changed.wait_while(gate, |gate| !gate.is_open).unwrap());
        }
        self.inner.get_opts(at, options).await
    }

    async fn put_opts(&self, at: &Path, bytes: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.inner.put_opts(at, bytes, options).await
    }

    async fn put_multipart_opts(&self, at: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(at, options).await
    }

    fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(at)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }
}

#[test]
fn a_dropped_reader_discards_queued_prefetches_and_ends_its_threads() {
    let gated = Arc::new(GatedStore::default());
    let pixels = image(100, 80, false);
    let store = Store::over(gated.clone(), "gated").metered();
    // Each window is of another view, whose index is not cached yet: a read takes two requests.
    let pinhole = Pinhole { width: 100, height: 80, fx: 80.0, fy: 80.0, cx: 50.0, cy: 40.0 };
    let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
    let bytes = mip_tiles::encode(&pixels).unwrap();
    let ungated = Store::over(gated.inner.clone(), "memory").blocking();
    let mips = vec![ungated.put(bytes.clone()).unwrap()];
    let views = (0..PREFETCH_THREADS + PREFETCH_QUEUE).map(|i| View {
        name: format!("{i}"),
        camera,
        mips: mips.clone(),
        masked: false,
    });
    let capture = Arc::new(Capture { views: views.collect(), ..Capture::default() });
    let reader = WindowReader::new(capture, store.blocking(), 10 << 20);
    let rect = camera.full();
    let prefetch = |views: std::ops::Range<usize>| views.for_each(|view| reader.prefetch(view as u32, 0, rect));
    prefetch(0..PREFETCH_THREADS);
    gated.wait_for_reads(PREFETCH_THREADS);
    prefetch(PREFETCH_THREADS..PREFETCH_THREADS + PREFETCH_QUEUE);
    let shared = Arc::clone(&reader.shared);
    assert_eq!(shared.cache().pending.len(), PREFETCH_THREADS + PREFETCH_QUEUE, "all are in flight or queued");

    drop(reader);
    gated.open();
    while Arc::strong_count(&shared) > 1 {
        std::thread::yield_now();
    }
    assert_eq!(shared.counters.prefetched.load(Ordering::Relaxed), PREFETCH_THREADS as u64);
    // An index and the coalesced tiles for each window that was in flight, which is the whole artefact.
    assert_eq!(gated.reads(), 2 * PREFETCH_THREADS);
    assert_eq!(store.traffic().read, (PREFETCH_THREADS * bytes.len()) as u64);
}
