//! Data sets in the layout of nuScenes, whole and damaged.

use std::fs;

use glam::DVec2;
use serde_json::{Value, json};

use super::*;

const SECOND: i64 = 1_000_000;

fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

/// A car drives along x and looks ahead: two samples half a second apart, a photo between them, and a sweep each. A box comes
/// towards it, another one stands.
fn data_set() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let turned = [0.5, -0.5, 0.5, -0.5]; // x ahead, y left to z ahead, x right
    let still = [1.0, 0.0, 0.0, 0.0];
    let mut data = Vec::new();
    let mut poses = Vec::new();
    for (file, sensor, half_seconds, sample) in [
        ("samples/CAM_FRONT/a.png", "camera", 0.0, "s0"),
        ("sweeps/CAM_FRONT/b.png", "camera", 0.5, "s0"),
        ("samples/CAM_FRONT/c.png", "camera", 1.0, "s1"),
        ("samples/LIDAR_TOP/a.pcd.bin", "lidar", 0.0, "s0"),
        ("samples/LIDAR_TOP/c.pcd.bin", "lidar", 1.0, "s1"),
        ("samples/RADAR_FRONT/a.pcd", "radar", 0.0, "s0"),
    ] {
        let time = SECOND + (half_seconds * 0.5e6) as i64;
        data.push(json!({ "token": file, "sample_token": sample, "ego_pose_token": file, "calibrated_sensor_token": sensor,
            "filename": file, "timestamp": time, "is_key_frame": file.starts_with("samples"), "width": 48, "height": 32 }));
        poses.push(json!({ "token": file, "rotation": still, "translation": [4.0 * half_seconds, 0.0, 0.0] }));
        let path = root.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let points = [10.0f32, 1.0, 0.0, 50.0, 3.0, 20.0, -1.0, 0.5, 50.0, 4.0, f32::NAN, 0.0, 0.0, 0.0, 0.0];
        match sensor {
            "camera" => RgbImage::new(48, 32).save(path).unwrap(),
            _ => write(&path, points.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>()),
        }
    }
    let annotation = |token: &str, sample: &str, instance: &str, x: f64, y: f64| {
        json!({ "token": token, "sample_token": sample, "instance_token": instance, "attribute_tokens": ["p"],
            "rotation": still, "translation": [x, y, 1.0], "size": [2.0, 4.0, 1.5] })
    };
    let tables = [
        ("scene", json!([{ "token": "one", "name": "scene-0001" }])),
        (
            "sample",
            json!([
                { "token": "s0", "scene_token": "one", "timestamp": SECOND },
                { "token": "s1", "scene_token": "one", "timestamp": SECOND + SECOND / 2 },
            ]),
        ),
        ("sample_data", data.into()),
        ("ego_pose", poses.into()),
        (
            "calibrated_sensor",
            json!([
                { "token": "camera", "sensor_token": "cam", "rotation": turned, "translation": [1.0, 0.0, 1.5],
                    "camera_intrinsic": [[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]] },
                { "token": "lidar", "sensor_token": "top", "rotation": still, "translation": [0.0, 0.0, 2.0], "camera_intrinsic": [] },
                { "token": "radar", "sensor_token": "rad", "rotation": still, "translation": [0.0, 0.0, 2.0], "camera_intrinsic": [] },
            ]),
        ),
        (
            "sensor",
            json!([
                { "token": "cam", "channel": "CAM_FRONT", "modality": "camera" },
                { "token": "top", "channel": "LIDAR_TOP", "modality": "lidar" },
                { "token": "rad", "channel": "RADAR_FRONT", "modality": "radar" },
            ]),
        ),
        (
            "sample_annotation",
            json!([
                annotation("a0", "s0", "moves", 30.0, 0.0),
                annotation("a1", "s1", "moves", 20.0, 0.0),
                annotation("b0", "s0", "stands", 30.0, 4.0),
                annotation("b1", "s1", "stands", 30.1, 4.0),
            ]),
        ),
        (
            "instance",
            json!([{ "token": "moves", "category_token": "c" }, { "token": "stands", "category_token": "c" }]),
        ),
        ("category", json!([{ "token": "c", "name": "vehicle.car" }])),
        ("attribute", json!([{ "token": "p", "name": "vehicle.parked" }, { "token": "m", "name": "vehicle.moving" }])),
    ];
    for (name, rows) in tables {
        write(&root.join(format!("v1.0-mini/{name}.json")), rows.to_string());
    }
    folder
}

fn with_lidar(path: &Path) -> Result<Source, String> {
    open(path, &OpenOptions { lidar: true, ..OpenOptions::default() }).map_err(|error| error.to_string())
}

/// Changes a table.
fn change(root: &Path, table: &str, change: impl Fn(&mut Value)) {
    let path = root.join(format!("v1.0-mini/{table}.json"));
    let mut rows: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut rows);
    write(&path, rows.to_string());
}

#[test]
fn a_scene_has_its_photos_sweeps_and_annotated_boxes() {
    let folder = data_set();
    let source = with_lidar(folder.path()).unwrap();
    let views = &source.capture.views;
    assert_eq!((source.format, views.len(), source.sweeps.len()), ("nuscenes", 3, 2));
    assert_eq!(views[2].name, "sweeps/CAM_FRONT/b.png");
    assert_eq!(source.labels, BTreeMap::from([("vehicle.car".into(), 4)]));
    let camera = |i: usize| views[i].camera;
    assert!(camera(1).centre().distance(DVec3::new(5.0, 0.0, 1.5)) < 1e-9, "{}", camera(1).centre());
    assert!(camera(0).forward().distance(DVec3::X) < 1e-9);
    let (left, depth) = camera(0).project(DVec3::new(11.0, 1.0, 2.5));
    assert!((depth - 10.0).abs() < 1e-9 && left.distance(DVec2::new(20.0, 12.0)) < 1e-9, "{left}");
    // The sweep at the time of each sample belongs to its photo; the photo between them has none.
    assert_eq!((&source.sweeps[0].views[..], &source.sweeps[1].views[..]), (&[0][..], &[1][..]));
    let places: Vec<DVec3> = source.sweeps[1].read().unwrap().iter().map(|found| found.place).collect();
    assert_eq!(places, [DVec3::new(14.0, 1.0, 2.0), DVec3::new(24.0, -1.0, 2.5)]);
    // Only the box that moves is masked, between the samples where it is then.
    for (photo, expected) in source.photos.iter().zip([29.0, 15.0, 22.0]) {
        let [corners] = &photo.moving()[..] else { panic!("{:?}", photo.boxes) };
        let middle = corners.iter().sum::<DVec3>() / 8.0;
        assert!(middle.distance(DVec3::new(0.0, 0.5, expected)) < 1e-9, "{middle}");
        assert!((corners[1].z - corners[0].z).abs() - 4.0 < 1e-9 && (corners[0] - corners[4]).length() - 1.5 < 1e-9);
    }
    // It has a path, on the clock of the photos.
    let [object] = &source.capture.objects[..] else { panic!("{:?}", source.capture.objects) };
    for (view, expected) in views.iter().zip([29.0, 15.0, 22.0]) {
        let pose = object.pose(view.seconds.unwrap()).unwrap();
        let middle = view.camera.camera_from_world.after(&pose).translation;
        assert!(middle.distance(DVec3::new(0.0, 0.5, expected)) < 1e-6, "{middle}");
    }
    assert_eq!((object.class.as_str(), object.high - object.low), ("vehicle.car", DVec3::new(4.0, 2.0, 1.5)));
    source.capture.check().unwrap();
    // An attribute says that the other one moves; a box behind the camera is in no photo.
    change(folder.path(), "sample_annotation", |rows| {
        rows[2]["attribute_tokens"] = json!(["m"]);
        rows[1]["translation"] = json!([-20.0, 0.0, 1.0]);
    });
    let source = with_lidar(folder.path()).unwrap();
    assert_eq!(source.photos.iter().map(|photo| photo.moving().len()).collect::<Vec<_>>(), [2, 1, 2]);

    // Excerpts lack the data between key frames, or a key frame.
    fs::remove_dir_all(folder.path().join("sweeps")).unwrap();
    fs::remove_file(folder.path().join("samples/LIDAR_TOP/c.pcd.bin")).unwrap();
    let source = with_lidar(folder.path()).unwrap();
    assert_eq!((source.capture.views.len(), source.left_out.len(), source.sweeps.len()), (2, 0, 1));
    fs::remove_file(folder.path().join("samples/CAM_FRONT/c.png")).unwrap();
    let source = with_lidar(folder.path()).unwrap();
    assert_eq!((source.capture.views.len(), source.left_out.len()), (1, 1));
}

#[test]
fn one_of_several_scenes_is_named_after_the_folder() {
    let folder = data_set();
    let root = folder.path();
    assert_eq!(opened(&root.join("scene-0001")).unwrap().capture.views.len(), 3);
    refused(&root.join("scene-0002"), &["no scene scene-0002", "scene-0001"]);
    change(root, "scene", |rows| {
        let more = (2..9).map(|i| json!({ "token": i.to_string(), "name": format!("scene-000{i}") }));
        rows.as_array_mut().unwrap().extend(more);
    });
    refused(root, &["has 8 scenes", "scene-0001, scene-0002", "and 3 more", "/scene-0001"]);
    assert_eq!(opened(&root.join("scene-0001")).unwrap().capture.views.len(), 3);
    refused(&root.join("scene-0002"), &["sample_data.json", "no photo of the scene"]);
    change(root, "scene", |rows| *rows = json!([]));
    refused(root, &["has no scene"]);
}

#[test]
fn damaged_data_sets_are_refused_in_a_line() {
    let damaged = |words: &[&str], damage: &dyn Fn(&Path)| {
        let folder = data_set();
        damage(folder.path());
        let error = with_lidar(folder.path()).map(|source| source.capture.views.len()).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{words:?}: {error}");
    };
    // Tokens that lead nowhere.
    for (table, key, named) in [
        ("sample_data", "ego_pose_token", "ego_pose.json lacks"),
        ("sample_data", "calibrated_sensor_token", "calibrated_sensor.json lacks"),
        ("calibrated_sensor", "sensor_token", "sensor.json lacks"),
        ("sample_annotation", "instance_token", "instance.json lacks"),
        ("instance", "category_token", "category.json lacks"),
    ] {
        let file = format!("{table}.json");
        damaged(&[&file, "'nowhere'", named], &|root| change(root, table, |rows| rows[0][key] = json!("nowhere")));
    }
    let attribute = |rows: &mut Value| rows[0]["attribute_tokens"] = json!(["nowhere"]);
    damaged(&["sample_annotation.json", "attribute.json lacks"], &|root| change(root, "sample_annotation", attribute));
    // Timestamps that match no photo.
    let later = |rows: &mut Value| {
        for row in rows.as_array_mut().unwrap().iter_mut().filter(|row| row["calibrated_sensor_token"] == "lidar") {
            row["timestamp"] = json!(i64::MAX / 8);
        }
    };
    damaged(&["sample_data.json", "no sweep within 0.1 s"], &|root| change(root, "sample_data", later));
    let endless = |rows: &mut Value| rows[3]["timestamp"] = json!(i64::MIN);
    damaged(&["sample_data.json", "timestamp out of range"], &|root| change(root, "sample_data", endless));
    // Sweeps that are cut short, or of which nothing is finite.
    let sweep = |root: &Path, bytes: &[u8]| write(&root.join("samples/LIDAR_TOP/a.pcd.bin"), bytes);
    damaged(&["a.pcd.bin", "cut short"], &|root| sweep(root, &[0; 33]));
    damaged(&["a.pcd.bin", "none of which is finite"], &|root| sweep(root, &f32::NAN.to_le_bytes().repeat(10)));
    // Numbers, names and files.
    let bad = |table: &'static str, key: &'static str, value: Value| {
        move |root: &Path| change(root, table, |rows| rows[0][key] = value.clone())
    };
    damaged(&["ego_pose.json", "not a rotation"], &bad("ego_pose", "rotation", json!([2, 0, 0, 0])));
    damaged(&["ego_pose.json", "out of range"], &bad("ego_pose", "translation", json!([1e300, 0, 0])));
    damaged(&["calibrated_sensor.json", "pinhole"], &bad("calibrated_sensor", "camera_intrinsic", json!([[1, 2, 3]])));
    damaged(
        &["calibrated_sensor.json", "without intrinsics"],
        &bad("calibrated_sensor", "camera_intrinsic", json!([])),
    );
    damaged(&["sample_annotation.json", "without extent"], &bad("sample_annotation", "size", json!([0, 1, 1])));
    damaged(&["outside of the capture"], &bad("sample_data", "filename", json!("../../a.png")));
    damaged(&["another shape"], &bad("sample_data", "height", json!(48)));
    damaged(&["in the capture twice"], &bad("sample_data", "filename", json!("samples/CAM_FRONT/c.png")));
    damaged(&["sample.json", "is not there"], &|root| fs::remove_file(root.join("v1.0-mini/sample.json")).unwrap());
    damaged(&["sensor.json", "not such a table"], &|root| write(&root.join("v1.0-mini/sensor.json"), "[1e999]"));
}
