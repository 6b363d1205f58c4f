//! Depth maps in files become target depths: a generated city's true depths, as they are and as a model of single photos would
//! give them.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use city::CitySettings;
use dataset::depth_maps::{DepthKind, DepthMapOptions};
use dataset::depth_samples::DepthSamples;
use dataset::ingest::{IngestOptions, Ingested, ingest};
use dataset::open::{OpenOptions, open};
use dataset::synth::{self, Settings};
use scene::npy;
use store::{BlockingStore, Store};
use tempfile::TempDir;

const WIDTH: u32 = 160;
const HEIGHT: u32 = 100;

/// A city with its true depths in `depth/`, photos with masks of what moves.
fn city() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let city = CitySettings::default();
    let settings = Settings { city, views: 24, width: WIDTH, height: HEIGHT, truth: true, ..Settings::default() };
    synth::write(folder.path(), &settings, &|_, _, _| ()).unwrap();
    folder
}

fn memory() -> BlockingStore {
    Store::open("memory://").unwrap().blocking()
}

fn ingested(
    capture: &Path,
    store: &BlockingStore,
    depths: &DepthMapOptions,
    downscale: u32,
) -> Result<Ingested, String> {
    let options = OpenOptions { depths: Some(depths.clone()), ..OpenOptions::default() };
    let source = open(capture, &options).map_err(|error| error.to_string())?;
    let options = IngestOptions { downscale, threads: 2 };
    ingest(&source, store, &options, &|_, _| ()).map_err(|error| error.to_string())
}

fn maps_in(folder: &Path, kind: DepthKind) -> DepthMapOptions {
    DepthMapOptions { folder: Some(folder.to_path_buf()), kind, unit: None }
}

/// True depths by the name of the map.
fn truth(capture: &Path) -> BTreeMap<String, Vec<f32>> {
    let files = fs::read_dir(capture.join("depth")).unwrap().map(|entry| entry.unwrap().path());
    let read = |path: &Path| npy::read_f32(&fs::read(path).unwrap()).unwrap().1;
    files.map(|path| (path.file_stem().unwrap().to_str().unwrap().to_string(), read(&path))).collect()
}

/// Writes maps of these values.
fn write_maps(folder: &Path, maps: &BTreeMap<String, Vec<f32>>, value: impl Fn(usize, f32) -> f32) {
    fs::create_dir_all(folder).unwrap();
    for (number, (name, depths)) in maps.iter().enumerate() {
        let values: Vec<f32> = depths.iter().map(|&d| if d > 0.0 { value(number, d) } else { 0.0 }).collect();
        let bytes = npy::write_f32(&[HEIGHT as usize, WIDTH as usize], &values);
        fs::write(folder.join(format!("{name}.npy")), bytes).unwrap();
    }
}

/// The target depths of the views, by the name of the map.
fn targets(found: &Ingested, store: &BlockingStore) -> BTreeMap<String, DepthSamples> {
    let views = found.capture.views.iter().filter_map(|view| {
        let k = view.camera.pinhole;
        let samples = DepthSamples::decode(&store.get(view.depth?).unwrap(), k.width, k.height).unwrap();
        Some((view.name.rsplit_once('.').unwrap().0.to_string(), samples))
    });
    views.collect()
}

#[test]
fn metric_maps_are_the_targets_where_photos_are_used() {
    let folder = city();
    let (capture, truth, store) = (folder.path(), truth(folder.path()), memory());
    let options = maps_in(&capture.join("depth"), DepthKind::Metric);
    let found = ingested(capture, &store, &options, 1).unwrap();
    assert_eq!((found.depth_maps.maps, found.depth_maps.left_out.len()), (24, 0));
    let targets = targets(&found, &store);
    assert_eq!(targets.values().map(DepthSamples::len).sum::<usize>(), found.depth_samples);
    for (name, depths) in &truth {
        let mask = image::open(capture.join(format!("masks/{name}.png"))).unwrap().into_luma8();
        let used = (0..depths.len()).filter(|&i| depths[i] > 0.0 && mask.as_raw()[i] >= 128).count();
        assert_eq!(targets[name].len(), used, "{name}");
        for (x, y, depth) in targets[name].iter() {
            let expected = depths[(y * WIDTH + x) as usize];
            assert!((depth / expected - 1.0).abs() < 2e-4, "{name}: {depth} {expected} at {x}, {y}");
        }
    }
    // The same again, and other bytes than without maps or at half the size.
    assert_eq!(ingested(capture, &store, &options, 1).unwrap().id, found.id);
    let half = ingested(capture, &store, &options, 2).unwrap();
    assert!(half.id != found.id && half.depth_samples * 5 > found.depth_samples);
    let none = ingested(capture, &store, &DepthMapOptions::default(), 1).unwrap();
    assert!(none.id != found.id && none.depth_samples == 0 && none.capture.views.iter().all(|v| v.depth.is_none()));
}

#[test]
fn relative_maps_are_aligned_to_the_sparse_points_of_each_view() {
    let folder = city();
    let (capture, truth) = (folder.path(), truth(folder.path()));
    // Another scale and shift for each view.
    let scale = |number: usize| 0.3 + 0.1 * number as f32;
    let relative = |number: usize, d: f32| scale(number) * d + 2.0 - 0.1 * number as f32;
    let inverse = |number: usize, d: f32| scale(number) / d + 0.05 - 0.004 * number as f32;
    type Distort<'a> = &'a dyn Fn(usize, f32) -> f32;
    let kinds: [(DepthKind, Distort); 2] = [(DepthKind::Relative, &relative), (DepthKind::Inverse, &inverse)];
    for (kind, value) in kinds {
        let (maps, store) = (capture.join(format!("{kind:?}")), memory());
        write_maps(&maps, &truth, value);
        let found = ingested(capture, &store, &maps_in(&maps, kind), 1).unwrap();
        let mut errors: Vec<f32> = Vec::new();
        for (name, samples) in targets(&found, &store) {
            errors.extend(samples.iter().map(|(x, y, d)| (d / truth[&name][(y * WIDTH + x) as usize] - 1.0).abs()));
        }
        errors.sort_by(f32::total_cmp);
        let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
        let (maps, count) = (found.depth_maps.maps, errors.len());
        println!("{kind:?}: {maps} maps, {count} targets, off by {} in the median, 95 %: {}", at(0.5), at(0.95));
        println!("left out: {:?}", found.depth_maps.left_out);
        // Some street photos see too few of this small city's points.
        let left_out = &found.depth_maps.left_out;
        assert!(maps >= 12 && maps + left_out.len() == 24, "{left_out:?}");
        assert!(left_out.iter().all(|(_, reason)| reason.contains("of 20 needed")), "{left_out:?}");
        assert!(at(0.95) < 0.01, "{kind:?}: {}", at(0.95));
        // The other kind does not fit, and a falling map is refused.
        let falling = capture.join("falling");
        write_maps(&falling, &truth, |number, d| 1000.0 - value(number, d));
        let line = ingested(capture, &store, &maps_in(&falling, kind), 1).unwrap_err();
        assert!(line.contains("falling: has no depth map that can be aligned") && line.contains("fall"), "{line}");
    }
}

#[test]
fn maps_are_found_where_the_capture_has_them_and_may_be_missing() {
    let folder = city();
    let (capture, truth, store) = (folder.path(), truth(folder.path()), memory());
    let names: Vec<&String> = truth.keys().collect();
    // In the capture's own folder: half of the views.
    let half: BTreeMap<_, _> = truth.clone().into_iter().take(12).collect();
    write_maps(&capture.join("depths"), &half, |_, d| d);
    let own = ingested(capture, &store, &DepthMapOptions::default(), 1).unwrap();
    assert_eq!((own.depth_maps.maps, targets(&own, &store).len()), (12, 12));
    // Named by transforms.json: one map, in place of the one in the folder.
    let path = capture.join("transforms.json");
    let mut file = scene::transforms::read(&fs::read(&path).unwrap()).unwrap();
    file.frames[0].depth_file_path = Some(format!("depth/{}.npy", names[20]));
    file.frames[13].depth_file_path = Some("depth/missing.npy".into());
    fs::write(&path, scene::transforms::write(&file)).unwrap();
    let source = open(&path, &OpenOptions { depths: Some(DepthMapOptions::default()), ..Default::default() }).unwrap();
    let named = source.photos.iter().filter_map(|photo| photo.depth.as_ref());
    let other = named.filter(|file| file.path.ends_with(format!("depth/{}.npy", names[20]))).count();
    assert_eq!(
        (source.depth_maps(), other),
        (if names[..12].iter().any(|name| is_frame(&file, name)) { 12 } else { 13 }, 1)
    );
    file.frames[0].depth_file_path = Some("../outside.npy".into());
    fs::write(&path, scene::transforms::write(&file)).unwrap();
    let line = ingested(&path, &store, &DepthMapOptions::default(), 1).unwrap_err();
    assert!(line.contains("outside.npy: lies outside of the capture"), "{line}");

    let empty = capture.join("empty");
    fs::create_dir(&empty).unwrap();
    let line = ingested(capture, &store, &maps_in(&empty, DepthKind::Metric), 1).unwrap_err();
    assert!(line.contains("has no depth map of any photo") && line.contains(names[0].as_str()), "{line}");
    let line = ingested(capture, &store, &maps_in(&capture.join("nowhere"), DepthKind::Metric), 1).unwrap_err();
    assert!(line.contains("nowhere: is not a folder"), "{line}");
}

/// Whether the first frame of a file is the photo of this map.
fn is_frame(file: &scene::transforms::Transforms, name: &str) -> bool {
    file.frames[0].file_path.contains(name)
}

#[test]
fn damaged_maps_and_wrong_units_give_one_line() {
    let folder = city();
    let (capture, truth, store) = (folder.path(), truth(folder.path()), memory());
    let maps = capture.join("maps");
    write_maps(&maps, &truth, |_, d| 1000.0 * d);
    let options = maps_in(&maps, DepthKind::Metric);
    let line = ingested(capture, &store, &options, 1).unwrap_err();
    assert!(line.contains("times those of the sparse points") && line.contains("--depth-unit"), "{line}");
    let millimetres = DepthMapOptions { unit: Some(1e-3), ..options.clone() };
    assert_eq!(ingested(capture, &store, &millimetres, 1).unwrap().depth_maps.maps, 24);

    write_maps(&maps, &truth, |_, d| d);
    let (name, depths) = truth.first_key_value().unwrap();
    let path = maps.join(format!("{name}.npy"));
    let whole = fs::read(&path).unwrap();
    let mut with_nan = depths.clone();
    with_nan[5] = f32::NAN;
    let shape = [HEIGHT as usize, WIDTH as usize];
    for (bytes, word) in [
        (whole[..whole.len() - 7].to_vec(), "does not match"),
        (npy::write_f32(&shape, &with_nan), "the value NaN at column 5 of row 0"),
        (npy::write_f32(&[shape[1], shape[0]], depths), "not the same shape"),
    ] {
        fs::write(&path, bytes).unwrap();
        let line = ingested(capture, &store, &options, 1).unwrap_err();
        assert!(line.contains(word) && line.contains(name) && !line.contains(char::is_control), "{word}: {line}");
    }
}
