use std::collections::BTreeMap;

use city::sense::Motion;

use super::*;
use crate::ingest::{self, IngestOptions};
use crate::open::Source;

const CAMERAS: [(&str, &str); 4] =
    [("FRONT_LEFT", "front-left"), ("FRONT_RIGHT", "front-right"), ("SIDE_LEFT", "left"), ("SIDE_RIGHT", "right")];

/// A city with several drives, as a plain capture and as segments of Waymo by number.
fn drives() -> (tempfile::TempDir, Source, BTreeMap<String, Source>) {
    let settings = Settings { aerial: 0.0, lidar: true, waymo: true, spacing: Some(12.0), views: 120, ..small() };
    let (folder, _) = written(&settings, 2);
    let options = OpenOptions { lidar: true, ..OpenOptions::default() };
    let plain = open(folder.path(), &options).unwrap();
    let root = folder.path().join("waymo");
    let mut segments = BTreeMap::new();
    for entry in fs::read_dir(root.join("camera_image")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        let name = name.strip_suffix(".parquet").unwrap();
        segments.insert(name.strip_prefix("drive_").unwrap().to_owned(), open(&root.join(name), &options).unwrap());
    }
    (folder, plain, segments)
}

#[test]
fn drives_as_waymo_have_the_cameras_and_sweeps_of_the_capture() {
    let (folder, plain, segments) = drives();
    assert!(segments.len() > 1 && segments.values().all(|segment| segment.format == "waymo"), "{}", segments.len());
    let error = open(&folder.path().join("waymo"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("segments") && error.contains("waymo/drive_") && !error.contains('\n'), "{error}");

    let (mut views, mut masked, mut off, mut turned) = (0, 0, 0.0_f64, 0.0_f64);
    for (leg, segment) in &segments {
        for (camera, mount) in CAMERAS {
            let of = |source: &Source, prefix: &str| -> Vec<scene::Camera> {
                let views = source.capture.views.iter().filter(|view| view.name.starts_with(prefix));
                views.map(|view| view.camera).collect()
            };
            let ours = of(segment, &format!("{camera}/"));
            let theirs = of(&plain, &format!("street-{mount}-{leg}-"));
            assert!(ours.len() == theirs.len() && !ours.is_empty(), "{camera} of {leg}: {}", ours.len());
            for (ours, theirs) in ours.iter().zip(&theirs) {
                off = off.max(ours.centre().distance(theirs.centre()));
                let [a, b] = [ours, theirs].map(|camera| glam::DMat3::from_quat(camera.camera_from_world.rotation));
                turned = (a - b).to_cols_array().into_iter().fold(turned, |most, v| most.max(v.abs()));
                assert_eq!(ours.pinhole, theirs.pinhole);
                views += 1;
            }
        }
        masked += segment.capture.views.iter().filter(|view| view.masked).count();
    }
    assert!(3 * views == 2 * plain.capture.views.len(), "{views} of {}", plain.capture.views.len());
    assert!(off < 1e-6 && turned < 1e-6, "{off} m, {turned}");
    assert!(masked > 0 && masked < views, "{masked} of {views} show something that moves");
    let labels: usize = segments.values().flat_map(|segment| segment.labels.values()).sum();
    assert!(labels > 20 && segments.values().any(|segment| segment.labels.contains_key("vehicle")), "{labels}");

    let poses = scene::lidar::read_poses(&fs::read(folder.path().join("lidar/poses.jsonl")).unwrap()).unwrap();
    let (mut sweeps, mut compared, mut largest) = (0, 0, 0.0_f64);
    for (leg, segment) in &segments {
        let poses: Vec<_> = poses.iter().filter(|pose| pose.name.starts_with(&format!("street-{leg}-"))).collect();
        assert_eq!(poses.len(), segment.sweeps.len());
        for (sweep, pose) in segment.sweeps.iter().zip(poses) {
            assert!(sweep.world_from_sensor.translation.distance(pose.world_from_sensor.translation) < 1e-9);
            assert_eq!(sweep.views.len(), CAMERAS.len());
            let (ours, theirs) = (sweep.read().unwrap(), true_places(folder.path(), pose));
            assert!(ours.len() > 1000 && ours.len() == theirs.len(), "{} and {}", ours.len(), theirs.len());
            for (ours, theirs) in ours.iter().zip(&theirs) {
                largest = largest.max(ours.place.distance(*theirs));
                compared += 1;
            }
            sweeps += 1;
        }
    }
    assert_eq!(sweeps, plain.sweeps.len());
    assert!(largest < 1e-3, "{largest} m in {compared} points");
}

/// Where a sweep's points were measured, with the true time of each, in the order of a range image.
fn true_places(folder: &Path, pose: &scene::lidar::SweepPose) -> Vec<DVec3> {
    let bytes = fs::read(folder.join(format!("lidar/{}.bin", pose.name))).unwrap();
    let truth = fs::read(folder.join(format!("lidar/{}.npy", pose.name))).unwrap();
    let (shape, truth) = scene::npy::read_f32(&truth).unwrap();
    let turn = pose.turn().unwrap();
    let motion = Motion { velocity: turn.velocity, spin: turn.spin };
    let mut places = Vec::new();
    for (point, truth) in bytes.chunks_exact(16).zip(truth.chunks_exact(shape[1])) {
        let [x, y, z] = [0, 4, 8].map(|at| f64::from(f32::from_le_bytes(point[at..at + 4].try_into().unwrap())));
        let point = DVec3::new(x, y, z);
        let then = motion.extrapolate(&pose.world_from_sensor, f64::from(truth[5]));
        if (2.0..120.0).contains(&point.length()) {
            let elevation = (point.z / point.length()).asin().to_degrees();
            let beam = (elevation / (40.0 / 31.0)).round() as i64;
            places.push(((-beam, (-point.y.atan2(point.x) * 1e4) as i64), then.apply(point)));
        }
    }
    places.sort_by_key(|(pixel, _)| *pixel);
    places.into_iter().map(|(_, place)| place).collect()
}

#[test]
fn photos_in_a_table_are_ingested() {
    let (folder, _, segments) = drives();
    let (leg, segment) = segments.first_key_value().unwrap();
    let store = store::Store::open("memory://").unwrap().blocking();
    let options = IngestOptions { downscale: 1, threads: 2 };
    let ingested = ingest::ingest(segment, &store, &options, &|_, _| ()).unwrap();
    assert_eq!(ingested.decoded, segment.photos.len());
    // The first photo of a camera, as it was and after JPEG.
    let view = segment.capture.views.iter().position(|view| view.name.starts_with("SIDE_LEFT")).unwrap();
    let photo = &segment.photos[view];
    let mut table = crate::tables::open(&photo.path).unwrap();
    let bytes = table.bytes(scene::waymo::IMAGE, photo.row.unwrap(), 1 << 20).unwrap();
    let ours = image::load_from_memory(&bytes).unwrap().into_rgb8();
    let mut files: Vec<PathBuf> =
        fs::read_dir(folder.path().join("images")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let prefix = format!("street-left-{leg}-");
    let first = files.iter().find(|path| path.file_name().unwrap().to_str().unwrap().starts_with(&prefix)).unwrap();
    let theirs = image::open(first).unwrap().into_rgb8();
    assert_eq!(ours.dimensions(), theirs.dimensions());
    let off: u64 = ours.iter().zip(theirs.iter()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    assert!(off < 8 * ours.len() as u64, "{off} in {}", ours.len());
}
