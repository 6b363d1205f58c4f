use async_trait::async_trait;
use futures::stream::BoxStream;
use glam::DVec3;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, Result,
};
use scene::{Camera, Pinhole, Rigid, SparsePoints, View};
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
        depth: None,
        seconds: None,
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

#[test]
fn windows_carry_the_depths_of_the_points_that_their_view_observed() {
    let store = Store::over(Arc::new(InMemory::new()), "memory").blocking();
    let mips = [image(100, 80, false), image(50, 40, false)];
    let mips: Vec<_> = mips.iter().map(|pixels| store.put(mip_tiles::encode(pixels).unwrap()).unwrap()).collect();
    let pinhole = Pinhole { width: 100, height: 80, fx: 80.0, fy: 80.0, cx: 50.0, cy: 40.0 };
    let camera = |x: f64| {
        let camera_from_world = Rigid { translation: DVec3::new(x, 0.0, 0.0), ..Rigid::IDENTITY };
        Camera { pinhole, camera_from_world }
    };
    let view = |x| View {
        name: format!("{x}"),
        camera: camera(x),
        mips: mips.clone(),
        masked: false,
        depth: None,
        seconds: None,
    };
    // Views 0 and 1 observed the first two points, which share a pixel in view 0; view 1 the third, which is also in
    // view 0; view 0 the last, which is behind it.
    let points = SparsePoints {
        positions: vec![
            DVec3::new(0.5, 0.25, 4.0),
            DVec3::new(0.25, 0.125, 2.0),
            DVec3::new(-1.0, 0.5, 4.0),
            DVec3::new(0.0, 0.0, -1.0),
        ],
        colours: vec![[0; 3]; 4],
        track_start: vec![0, 2, 4, 5, 6],
        seen_by: vec![0, 1, 1, 0, 1, 0],
        measured: 0,
    };
    let capture = Capture { views: vec![view(0.0), view(0.5)], points, ..Capture::default() };
    capture.check().unwrap();
    let capture = Arc::new(capture);
    let reader = WindowReader::new(Arc::clone(&capture), store.clone(), 10 << 20);
    let rect = Rect { x: 20, y: 10, width: 70, height: 60 };
    assert_eq!(reader.window(0, 0, rect).unwrap().depth, None);
    let reader = reader.with_depth();
    let targets = |view: u32, mip: u8, rect: Rect| -> Vec<(u32, u32, f32)> {
        let plane = reader.window(view, mip, rect).unwrap().depth.clone().unwrap_or_default();
        let at = |i: usize| (rect.x + i as u32 % rect.width, rect.y + i as u32 / rect.width);
        let found = plane.iter().enumerate().filter(|(_, depth)| **depth > 0.0);
        found.map(|(i, &depth)| (at(i).0, at(i).1, depth)).collect()
    };
    assert_eq!(targets(0, 0, rect), [(60, 45, 2.0)], "the nearest of two points, none of another view");
    let bytes = reader.stats().cached_bytes;
    assert_eq!(bytes, 70 * 60 * (3 + 4) + 256);
    for (mip, rect) in [(0, rect), (1, Rect { x: 5, y: 5, width: 40, height: 30 })] {
        let mut expected: Vec<(u32, u32, f32)> = (0..3)
            .map(|i| capture.views[1].camera.mip(mip).project(capture.points.positions[i]))
            .map(|(pixel, depth)| (pixel.x as u32, pixel.y as u32, depth as f32))
            .collect();
        expected.sort_by_key(|&(x, y, _)| (y, x));
        assert_eq!(targets(1, mip, rect), expected, "mip {mip}");
    }
    assert_eq!(targets(0, 0, Rect { x: 0, y: 0, width: 10, height: 10 }), [], "no point in the window");
}
