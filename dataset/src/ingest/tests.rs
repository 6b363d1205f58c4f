use std::path::Path;
use std::sync::Arc;

use image::{DynamicImage, GrayImage, ImageFormat, Luma};
use scene::{CameraModel, Rect, Rigid};
use store::Store;

use super::*;
use crate::photo::tests::{encoded, texture};
use crate::undistortion::ideal_pinhole;
use crate::windows::{SharedTileCache, WindowReader};

const WIDTH: u32 = 150;
const HEIGHT: u32 = 100;

fn model() -> CameraModel {
    CameraModel::Pinhole([120.0, 121.0, 74.5, 50.25])
}

/// A capture of PNG and JPEG photos of different brightness.
fn source(folder: &Path, count: u32) -> Source {
    let photo = |i: u32| {
        let format = if i.is_multiple_of(2) { ImageFormat::Png } else { ImageFormat::Jpeg };
        let name = format!("{i:03}.{}", format.extensions_str()[0]);
        let mut image = texture(WIDTH, HEIGHT);
        image.pixels_mut().for_each(|p| p.0[0] = p.0[0].wrapping_add(i as u8));
        std::fs::write(folder.join(&name), encoded(image, format)).unwrap();
        let photo = Photo {
            path: folder.join(&name),
            row: None,
            mask: None,
            depth: None,
            model: model(),
            width: WIDTH,
            height: HEIGHT,
            boxes: Vec::new(),
        };
        let camera_from_world = Rigid { translation: [f64::from(i), 0.0, 0.0].into(), ..Rigid::IDENTITY };
        let camera = Camera { pinhole: ideal_pinhole(&model(), WIDTH, HEIGHT).unwrap(), camera_from_world };
        (View { name, camera, mips: Vec::new(), masked: false, depth: None, seconds: None }, photo)
    };
    let (views, photos) = (0..count).map(photo).unzip();
    let capture = Capture { views, ..Capture::default() };
    Source {
        capture,
        photos,
        left_out: Vec::new(),
        format: "test",
        sweeps: Vec::new(),
        road: Vec::new(),
        seeds: Vec::new(),
        labels: Default::default(),
    }
}

fn options(threads: usize, downscale: u32) -> IngestOptions {
    IngestOptions { downscale, threads }
}

fn run(source: &Source, store: &BlockingStore, options: IngestOptions) -> Result<Ingested, IngestError> {
    ingest(source, store, &options, &|_, _| ())
}

fn memory() -> BlockingStore {
    Store::open("memory://").unwrap().blocking()
}

fn whole(camera: &Camera) -> Rect {
    camera.full()
}

#[test]
fn a_second_ingest_decodes_nothing_and_the_result_does_not_depend_on_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (source, store) = (source(folder.path(), 7), memory());
    let calls = Mutex::new(Vec::new());
    let first = ingest(&source, &store, &options(1, 1), &|done, of| calls.lock().unwrap().push((done, of))).unwrap();
    assert_eq!(calls.into_inner().unwrap(), (1..=7).map(|i| (i, 7)).collect::<Vec<_>>());
    assert_eq!(first.decoded, 7);
    assert_eq!(load_capture(&store, first.id).unwrap(), first.capture);
    let second = run(&source, &store, options(2, 1)).unwrap();
    assert_eq!((second.id, second.decoded), (first.id, 0));
    assert_eq!(run(&source, &memory(), options(2, 1)).unwrap().id, first.id);
    let smaller = run(&source, &store, options(2, 3)).unwrap();
    assert!(smaller.id != first.id && smaller.decoded == 7);
}

#[test]
fn an_interrupted_ingest_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let (mut source, store) = (source(folder.path(), 5), memory());
    let mut early = source.clone();
    early.photos.truncate(3);
    early.capture.views.truncate(3);
    assert_eq!(run(&early, &store, options(2, 1)).unwrap().decoded, 3);
    assert_eq!(run(&source, &store, options(2, 1)).unwrap().decoded, 2);
    source.capture.views[0].name = "another name.png".into();
    assert_eq!(
        run(&source, &store, options(2, 1)).unwrap().decoded,
        0,
        "ingest records are keyed by content, not by name"
    );
}

#[test]
fn a_lost_or_truncated_artefact_is_recomputed() {
    let folder = tempfile::tempdir().unwrap();
    let source = source(folder.path(), 3);
    let root = folder.path().join("store");
    let store = Store::open(root.to_str().unwrap()).unwrap().blocking();
    let first = run(&source, &store, options(1, 1)).unwrap();
    let path = |view: usize| {
        let id = first.capture.views[view].mips[0].to_string();
        root.join("artefacts").join(&id[..2]).join(&id)
    };
    let whole = std::fs::read(path(1)).unwrap();
    std::fs::remove_file(path(1)).unwrap();
    std::fs::write(path(2), "cut").unwrap();
    let second = run(&source, &store, options(1, 1)).unwrap();
    assert_eq!((second.id, second.decoded), (first.id, 2));
    assert_eq!(std::fs::read(path(1)).unwrap(), whole);
}

#[test]
fn truncated_and_other_files_are_one_line_errors() {
    let folder = tempfile::tempdir().unwrap();
    let source = source(folder.path(), 6);
    let whole = std::fs::read(&source.photos[3].path).unwrap();
    std::fs::write(&source.photos[5].path, "no image").unwrap();
    for bad in [&whole[..whole.len() / 2], &whole[..0], b"no image at all".as_slice()] {
        std::fs::write(&source.photos[3].path, bad).unwrap();
        for threads in [1, 3] {
            let error = run(&source, &memory(), options(threads, 1)).unwrap_err();
            assert!(matches!(error, IngestError::BadInput(_)));
            let line = error.to_string();
            assert!(line.contains("003.jpg") && line.lines().count() == 1, "{line}");
        }
    }
    std::fs::remove_file(&source.photos[3].path).unwrap();
    assert!(run(&source, &memory(), options(1, 1)).unwrap_err().to_string().contains("003.jpg"));
}

#[test]
fn sizes_are_checked_against_the_camera() {
    let folder = tempfile::tempdir().unwrap();
    let mut source = source(folder.path(), 1);
    for (width, height) in [(WIDTH + 1, HEIGHT), (0, HEIGHT), (u32::MAX, u32::MAX), (1 << 20, 1 << 20)] {
        (source.photos[0].width, source.photos[0].height) = (width, height);
        let line = run(&source, &memory(), options(1, 1)).unwrap_err().to_string();
        assert!(line.contains("000.png"), "{line}");
    }
    assert!(run(&source, &memory(), options(1, 0)).unwrap_err().to_string().starts_with("--downscale"));
    (source.photos[0].width, source.photos[0].height) = (WIDTH, HEIGHT);
    assert!(run(&source, &memory(), options(1, 50)).unwrap_err().to_string().starts_with("--downscale"));
}

#[test]
fn windows_are_crops_of_the_mips_and_the_cache_keeps_its_limit() {
    let folder = tempfile::tempdir().unwrap();
    let (source, store) = (source(folder.path(), 4), memory());
    let ingested = run(&source, &store, options(2, 1)).unwrap();
    let view = &ingested.capture.views[2];
    assert_eq!(view.mips.len(), 3);
    let capture = Arc::new(ingested.capture.clone());
    let photo = crate::photo::decode(&std::fs::read(&source.photos[2].path).unwrap(), WIDTH, HEIGHT).unwrap();
    let decoded =
        Pixels { width: WIDTH, height: HEIGHT, rgb: crate::photo::planes(&photo.rgb), mask: None, ..Pixels::default() };
    let limit = 40_000;
    let reader = WindowReader::new(Arc::clone(&capture), store.clone(), limit);
    assert!(*reader.window(2, 0, whole(&view.camera)).unwrap() == decoded);
    assert_eq!(reader.stats().cached_bytes, 0, "larger than the cache");
    for _ in 0..2 {
        for (i, mip) in (0..60).map(|i| (i, (i % 3) as u8)) {
            let all = reader.window(2, mip, whole(&view.camera.mip(mip))).unwrap();
            let rect = Rect { x: i % 7, y: i % 5, width: 20 + i % 10, height: 10 + i % 3 };
            let window = reader.window(2, mip, rect).unwrap();
            for (x, y) in (0..rect.height).flat_map(|y| (0..rect.width).map(move |x| (x, y))) {
                for c in 0..3 {
                    let from = c * all.area() + ((y + rect.y) * all.width + x + rect.x) as usize;
                    assert_eq!(window.rgb[c * window.area() + (y * rect.width + x) as usize], all.rgb[from]);
                }
            }
            assert!(reader.stats().cached_bytes <= limit as u64);
        }
    }
    let before = reader.stats();
    let rect = Rect { x: 1, y: 1, width: 30, height: 20 };
    let (first, second) = (reader.window(1, 0, rect).unwrap(), reader.window(1, 0, rect).unwrap());
    assert!(Arc::ptr_eq(&first, &second));
    let after = reader.stats();
    assert_eq!((after.hits - before.hits, after.misses - before.misses), (1, 1));
    assert!(after.bytes_read > before.bytes_read);
}

#[test]
fn shared_tiles_are_read_once_and_damaged_ones_not_cached() {
    let folder = tempfile::tempdir().unwrap();
    let store = memory();
    let mut capture = run(&source(folder.path(), 2), &store, options(1, 1)).unwrap().capture;
    let mut bytes = store.get(capture.views[0].mips[0]).unwrap().to_vec();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    // Ranges are not checked against the artefact's name, tiles against their own checksum.
    capture.views.push(View { mips: vec![store.put(bytes).unwrap()], ..capture.views[0].clone() });
    let capture = Arc::new(capture);
    let shared_tiles = Arc::new(SharedTileCache::new(1 << 20));
    let reader =
        || WindowReader::with_shared_tiles(Arc::clone(&shared_tiles), Arc::clone(&capture), store.clone(), 1 << 20);
    let whole = whole(&capture.views[0].camera);
    let [corner, right] = [Rect { width: 70, height: 70, ..whole }, Rect { x: 64, width: 80, height: 64, ..whole }];
    let first = reader();
    first.window(0, 0, corner).unwrap();
    let second = reader();
    assert_eq!(*second.window(0, 0, corner).unwrap(), *first.window(0, 0, corner).unwrap());
    assert_eq!(second.stats().bytes_read, 0);
    // The tile in both windows is not read again.
    let alone = WindowReader::new(Arc::clone(&capture), store.clone(), 0);
    assert_eq!(*second.window(0, 0, right).unwrap(), *alone.window(0, 0, right).unwrap());
    let [shared, alone] = [second, alone].map(|reader| reader.stats().bytes_read);
    assert!(0 < shared && shared < alone, "{shared} of {alone} bytes");
    for _ in 0..2 {
        let reader = reader();
        assert!(reader.window(2, 0, whole).is_err());
        assert!(reader.stats().bytes_read > 0, "damaged tiles are read again");
    }
}

#[test]
fn missing_and_damaged_windows_are_one_line_errors() {
    let folder = tempfile::tempdir().unwrap();
    let store = memory();
    let mut capture = run(&source(folder.path(), 1), &store, options(1, 1)).unwrap().capture;
    capture.views.push(View { mips: vec![ArtefactId::of(b"gone")], ..capture.views[0].clone() });
    capture.views.push(View { mips: vec![store.put("not a mip").unwrap()], ..capture.views[0].clone() });
    let reader = WindowReader::new(Arc::new(capture), store, 1 << 20);
    let rect = Rect { x: 0, y: 0, width: 10, height: 10 };
    for (view, mip, rect, words) in [
        (3, 0, rect, "view 3 mip 0 is not"),
        (0, 9, rect, "view 0 mip 9 is not"),
        (0, 0, Rect { x: 145, ..rect }, "is not inside mip 0 of view 000.png"),
        (0, 0, Rect { width: 0, ..rect }, "is not inside"),
        (1, 0, rect, "is not in the store"),
        (2, 0, rect, "view 000.png mip 0"),
    ] {
        let line = reader.window(view, mip, rect).unwrap_err().to_string();
        assert!(line.contains(words) && line.lines().count() == 1, "{line}");
    }
}

#[test]
fn prefetched_windows_equal_those_read_directly() {
    let folder = tempfile::tempdir().unwrap();
    let store = memory();
    let mut capture = run(&source(folder.path(), 3), &store, options(1, 1)).unwrap().capture;
    capture.views.push(View { mips: vec![ArtefactId::of(b"gone")], ..capture.views[0].clone() });
    let capture = Arc::new(capture);
    let rects: Vec<Rect> = (0..40).map(|i| Rect { x: i, y: i / 2, width: 30 + i, height: 20 + i }).collect();
    let plain = WindowReader::new(Arc::clone(&capture), store.clone(), 0);
    let reader = WindowReader::new(Arc::clone(&capture), store.clone(), 1 << 20);
    for (i, &rect) in rects.iter().enumerate() {
        let view = i as u32 % 3;
        reader.prefetch(view, 0, rect);
        // Duplicate and failing prefetches have no effect.
        reader.prefetch(view, 0, rect);
        reader.prefetch(3, 0, rect);
        reader.prefetch(99, 0, rect);
        assert_eq!(*reader.window(view, 0, rect).unwrap(), *plain.window(view, 0, rect).unwrap());
    }
    assert!(reader.window(3, 0, rects[0]).is_err() && reader.window(99, 0, rects[0]).is_err());
    let stats = reader.stats();
    // Windows that the queue had no room for are read by the caller.
    assert!(stats.prefetched > 0 && stats.prefetched + stats.misses >= 40, "{stats:?}");
    assert!(stats.bytes_used > 0 && stats.bytes_used < stats.bytes_read, "{stats:?}");
    // A cache without room fetches nothing.
    plain.prefetch(0, 0, rects[0]);
    assert_eq!(plain.stats().prefetched, 0);
}

#[test]
fn masks_and_downscaling_reach_the_mips() {
    let folder = tempfile::tempdir().unwrap();
    let (mut source, store) = (source(folder.path(), 2), memory());
    let mask = GrayImage::from_fn(WIDTH, HEIGHT, |x, _| Luma([if x < 30 { 0 } else { 255 }]));
    let path = folder.path().join("mask.png");
    std::fs::write(&path, encoded(DynamicImage::from(mask), ImageFormat::Png)).unwrap();
    source.photos[1].mask = Some(path.clone());
    let ingested = run(&source, &store, options(1, 3)).unwrap();
    let [plain, masked] = &ingested.capture.views[..] else { panic!("two views") };
    assert!(!plain.masked && masked.masked);
    let k = masked.camera.pinhole;
    assert_eq!((k.width, k.height), (50, 33));
    assert_eq!([k.fx, k.fy, k.cx, k.cy], [120.0 / 3.0, 121.0 / 3.0, 74.5 / 3.0, 50.25 / 3.0]);
    let camera = masked.camera;
    let reader = WindowReader::new(Arc::new(ingested.capture.clone()), store.clone(), 1 << 20);
    let window = reader.window(1, 1, whole(&camera.mip(1))).unwrap();
    let usable: Vec<u8> = (0..25).map(|x| if x < 5 { 0 } else { 255 }).collect();
    assert_eq!(window.mask.as_ref().unwrap()[..25], usable);
    // Another mask is ingested anew. A mask that is not an image is named in the error.
    std::fs::write(&path, encoded(GrayImage::from_pixel(WIDTH, HEIGHT, Luma([255])), ImageFormat::Png)).unwrap();
    let open = run(&source, &store, options(1, 3)).unwrap();
    assert!(open.decoded == 1 && !open.capture.views[1].masked);
    std::fs::write(&path, "no image").unwrap();
    assert!(run(&source, &store, options(1, 3)).unwrap_err().to_string().contains("mask.png"));
}

#[test]
fn a_real_capture_is_read_back_as_its_photos() {
    let shared = std::env::var("PLAT_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared").into());
    let capture = Path::new(&shared).join("data/fox/pinhole_270");
    if !capture.exists() {
        println!("skipped: ../shared/data not present");
        return;
    }
    let (source, store) = (crate::open::open(&capture, &Default::default()).unwrap(), memory());
    let ingested = run(&source, &store, options(2, 1)).unwrap();
    assert_eq!((ingested.capture.views.len(), ingested.decoded), (50, 50));
    let views = ingested.capture.views.clone();
    let reader = WindowReader::new(Arc::new(ingested.capture), store, 100 << 20);
    for (i, (view, photo)) in views.iter().zip(&source.photos).enumerate().step_by(9) {
        assert_eq!(view.mips.len(), 5);
        let decoded = image::open(&photo.path).unwrap().into_rgb8();
        let pixels = reader.window(i as u32, 0, whole(&view.camera)).unwrap();
        assert_eq!(crate::photo::planes(&decoded), pixels.rgb, "{}", view.name);
    }
}
