//! Segments of the Waymo Open Dataset, whole and damaged.

use std::f64::consts::{FRAC_PI_6, PI};
use std::fs;
use std::io::Cursor;

use glam::DVec2;
use scene::parquet::{Cells, Writer};

use super::*;
use crate::ingest::{self, IngestOptions};

const TIME: i64 = 1_550_083_467_346_370;
const SEGMENT: &str = "10017_6380";

type Columns = Vec<(&'static str, Cells)>;

/// The components of a segment.
struct Tables(BTreeMap<&'static str, Columns>);

impl Tables {
    /// A car that drives along x, 4 m a frame, looks ahead and to the left, and has a laser on its top and one in front. A box comes
    /// towards it, another one stands.
    fn new() -> Self {
        let frames = |rows: &[i64]| {
            let times = rows.iter().map(|frame| TIME + 100_000 * frame).collect();
            let names = vec![SEGMENT.to_owned(); rows.len()];
            vec![("key.segment_context_name", Cells::Text(names)), ("key.frame_timestamp_micros", Cells::Int64(times))]
        };
        let at = |x: f64, y: f64, z: f64, turn: f64| {
            let (s, c) = turn.sin_cos();
            vec![c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0]
        };
        let mut tables = BTreeMap::new();
        let mut cameras = vec![
            ("key.camera_name", Cells::Int8(vec![1, 4])),
            (
                "[CameraCalibrationComponent].extrinsic.transform",
                Cells::Doubles(vec![at(1.0, 0.0, 1.5, 0.0), at(0.0, 0.5, 1.5, PI / 2.0)]),
            ),
            ("[CameraCalibrationComponent].width", Cells::Int32(vec![48, 48])),
            ("[CameraCalibrationComponent].height", Cells::Int32(vec![32, 32])),
        ];
        for (name, value) in [
            ("[CameraCalibrationComponent].intrinsic.f_u", 40.0),
            ("[CameraCalibrationComponent].intrinsic.f_v", 40.0),
            ("[CameraCalibrationComponent].intrinsic.c_u", 24.0),
            ("[CameraCalibrationComponent].intrinsic.c_v", 16.0),
            ("[CameraCalibrationComponent].intrinsic.k1", 0.0),
            ("[CameraCalibrationComponent].intrinsic.k2", 0.0),
            ("[CameraCalibrationComponent].intrinsic.p1", 0.0),
            ("[CameraCalibrationComponent].intrinsic.p2", 0.0),
            ("[CameraCalibrationComponent].intrinsic.k3", 0.0),
        ] {
            cameras.push((name, Cells::Double(vec![value; 2])));
        }
        tables.insert("camera_calibration", cameras);
        let mut jpeg = Cursor::new(Vec::new());
        RgbImage::from_pixel(48, 32, image::Rgb([90, 60, 30])).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        let mut photos = frames(&[0, 0, 1, 1]);
        photos.extend([
            ("key.camera_name", Cells::Int8(vec![4, 1, 1, 4])),
            ("[CameraImageComponent].image", Cells::Bytes(vec![jpeg.into_inner(); 4])),
            (
                "[CameraImageComponent].pose.transform",
                Cells::Doubles([0.0, 0.0, 4.0, 4.0].map(|x| at(x, 0.0, 0.0, 0.0)).to_vec()),
            ),
            (
                "[CameraImageComponent].pose_timestamp",
                Cells::Double([0.0, 0.05, 0.1, 0.1].map(|delay| TIME as f64 * 1e-6 + delay).to_vec()),
            ),
        ]);
        tables.insert("camera_image", photos);
        let mut vehicles = frames(&[0, 1]);
        vehicles.push((
            "[VehiclePoseComponent].world_from_vehicle.transform",
            Cells::Doubles([0.0, 4.0].map(|x| at(x, 0.0, 0.0, 0.0)).to_vec()),
        ));
        tables.insert("vehicle_pose", vehicles);
        // The mounting's turn does not change where a column looks.
        tables.insert(
            "lidar_calibration",
            vec![
                ("key.laser_name", Cells::Int8(vec![1, 2])),
                (
                    "[LiDARCalibrationComponent].extrinsic.transform",
                    Cells::Doubles(vec![at(0.0, 0.0, 2.0, 0.5), at(2.0, 0.0, 1.0, 0.0)]),
                ),
                ("[LiDARCalibrationComponent].beam_inclination.min", Cells::Double(vec![0.0, -FRAC_PI_6])),
                ("[LiDARCalibrationComponent].beam_inclination.max", Cells::Double(vec![0.0, FRAC_PI_6])),
                ("[LiDARCalibrationComponent].beam_inclination.values", Cells::Doubles(vec![vec![0.0], vec![]])),
            ],
        );
        let mut lidar = frames(&[0, 0, 1]);
        let top = |range: f32| vec![range, 0.5, 0.0, -1.0, -1.0, 0.0, 0.0, -1.0];
        let front = [[-1.0f32, 0.0, 0.0, 0.0], [10.0, 0.2, 0.0, -1.0], [f32::NAN; 4], [0.0; 4]].concat();
        lidar.extend([
            ("key.laser_name", Cells::Int8(vec![2, 1, 1])),
            (RANGES, Cells::Floats(vec![front, top(5.0), top(6.0)])),
            (SHAPES, Cells::Int32s(vec![vec![2, 2, 4], vec![1, 2, 4], vec![1, 2, 4]])),
        ]);
        tables.insert("lidar", lidar);
        let mut poses = frames(&[0, 1]);
        let moved = |x: f32| [0.0, 0.0, 0.0, x, 0.0, 0.0].repeat(2);
        poses.extend([
            ("key.laser_name", Cells::Int8(vec![1, 1])),
            (POSES, Cells::Floats(vec![moved(1.0), moved(5.0)])),
            ("[LiDARPoseComponent].range_image_return1.shape", Cells::Int32s(vec![vec![1, 2, 6]; 2])),
        ]);
        tables.insert("lidar_pose", poses);
        let mut boxes = frames(&[0, 0, 1, 1]);
        boxes.extend([
            ("key.laser_object_id", Cells::Text(["a", "b", "b", "a"].map(String::from).to_vec())),
            ("[LiDARBoxComponent].box.center.x", Cells::Double(vec![30.0, 20.0, 16.1, 22.0])),
            ("[LiDARBoxComponent].box.center.y", Cells::Double(vec![0.0, 4.0, 4.0, 0.0])),
            ("[LiDARBoxComponent].box.center.z", Cells::Double(vec![1.0; 4])),
            ("[LiDARBoxComponent].box.size.x", Cells::Double(vec![4.0; 4])),
            ("[LiDARBoxComponent].box.size.y", Cells::Double(vec![2.0; 4])),
            ("[LiDARBoxComponent].box.size.z", Cells::Double(vec![1.5; 4])),
            ("[LiDARBoxComponent].box.heading", Cells::Double(vec![0.0; 4])),
            ("[LiDARBoxComponent].type", Cells::Int8(vec![1, 4, 4, 1])),
        ]);
        tables.insert("lidar_box", boxes);
        Self(tables)
    }

    /// Replaces a column.
    fn set(&mut self, component: &str, column: &str, cells: Cells) {
        let found = self.0.get_mut(component).unwrap().iter_mut().find(|(name, _)| *name == column);
        found.unwrap().1 = cells;
    }

    fn write(self, root: &Path) {
        for (component, columns) in self.0 {
            let mut writer = Writer::default();
            let mut bytes = writer.group(columns);
            bytes.extend(writer.finish());
            fs::create_dir_all(root.join(component)).unwrap();
            fs::write(root.join(format!("{component}/{SEGMENT}.parquet")), bytes).unwrap();
        }
    }
}

const RANGES: &str = "[LiDARComponent].range_image_return1.values";
const SHAPES: &str = "[LiDARComponent].range_image_return1.shape";
const POSES: &str = "[LiDARPoseComponent].range_image_return1.values";

fn with_lidar(path: &Path) -> Result<Source, String> {
    open(path, &OpenOptions { lidar: true, ..OpenOptions::default() }).map_err(|error| error.to_string())
}

#[test]
fn a_segment_has_its_photos_sweeps_and_annotated_boxes() {
    let folder = tempfile::tempdir().unwrap();
    Tables::new().write(&folder.path().join("training"));
    let source = with_lidar(folder.path()).unwrap();
    let views = &source.capture.views;
    assert_eq!((source.format, views.len(), source.sweeps.len(), source.left_out.len()), ("waymo", 4, 3, 0));
    let names: Vec<&str> = views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names[..2], ["FRONT/1550083467346370.jpg", "FRONT/1550083467446370.jpg"]);
    assert_eq!(source.photos.iter().map(|photo| photo.row).collect::<Vec<_>>(), [1, 2, 0, 3].map(Some));
    let camera = |i: usize| views[i].camera;
    assert!(camera(1).centre().distance(DVec3::new(5.0, 0.0, 1.5)) < 1e-9, "{}", camera(1).centre());
    assert!(camera(0).forward().distance(DVec3::X) < 1e-9 && camera(2).forward().distance(DVec3::Y) < 1e-9);
    let (left, depth) = camera(0).project(DVec3::new(11.0, 1.0, 2.5));
    assert!((depth - 10.0).abs() < 1e-9 && left.distance(DVec2::new(20.0, 12.0)) < 1e-9, "{left}");

    // The top laser's pixels have poses of their own, 1 m ahead of their frame; the front one's have none.
    assert_eq!(source.sweeps.iter().map(|sweep| &sweep.views[..]).collect::<Vec<_>>(), [&[0, 2][..], &[0, 2], &[1, 3]]);
    let (sine, cosine) = (PI / 12.0).sin_cos();
    let expected =
        [DVec3::new(2.0, -10.0 * cosine, 1.0 + 10.0 * sine), DVec3::new(1.0, 5.0, 2.0), DVec3::new(5.0, 6.0, 2.0)];
    for (sweep, expected) in source.sweeps.iter().zip(expected) {
        let [found] = &sweep.read().unwrap()[..] else { panic!("one return") };
        assert!(found.place.distance(expected) < 1e-5, "{} and {expected}", found.place);
    }
    assert!(source.sweeps[2].world_from_sensor.translation.distance(DVec3::new(4.0, 0.0, 2.0)) < 1e-9);

    // One box moves; in the first photo, taken 50 ms after its frame, it is half way.
    assert_eq!(source.labels, BTreeMap::from([("vehicle".into(), 2), ("cyclist".into(), 2)]));
    for (photo, expected) in source.photos.iter().zip([Some(27.0), Some(21.0), None, None]) {
        let middles: Vec<DVec3> = photo.moving().iter().map(|box_| box_.iter().sum::<DVec3>() / 8.0).collect();
        match (&middles[..], expected) {
            ([middle], Some(depth)) => assert!(middle.distance(DVec3::new(0.0, 0.5, depth)) < 1e-4, "{middle}"),
            (found, expected) => assert!(found.is_empty() && expected.is_none(), "{found:?}"),
        }
    }

    let [object] = &source.capture.objects[..] else { panic!("{:?}", source.capture.objects) };
    let pose = object.pose(views[0].seconds.unwrap()).unwrap();
    let middle = views[0].camera.camera_from_world.after(&pose).translation;
    assert!(middle.distance(DVec3::new(0.0, 0.5, 27.0)) < 1e-4, "{middle}");

    let store = store::Store::open("memory://").unwrap().blocking();
    let options = IngestOptions { downscale: 1, threads: 2 };
    let ingested = ingest::ingest(&source, &store, &options, &|_, _| ()).unwrap();
    assert_eq!(ingested.capture.views.len(), 4);
    // Without lidar, poses of pixels and boxes.
    for component in ["lidar", "lidar_pose", "lidar_calibration", "lidar_box", "vehicle_pose"] {
        fs::remove_dir_all(folder.path().join("training").join(component)).unwrap();
        if component != "lidar" {
            assert_eq!(with_lidar(folder.path()).unwrap().capture.views.len(), 4);
        }
    }
    // A lens with distortion, and masks named like views.
    let mut tables = Tables::new();
    tables.set("camera_calibration", "[CameraCalibrationComponent].intrinsic.k1", Cells::Double(vec![0.05, 0.0]));
    tables.write(folder.path());
    fs::create_dir_all(folder.path().join("masks/FRONT")).unwrap();
    GrayImage::new(48, 32).save(folder.path().join("masks/FRONT/1550083467446370.jpg.png")).unwrap();
    let source = with_lidar(folder.path()).unwrap();
    assert!(source.photos[0].model.is_distorted() && !source.photos[2].model.is_distorted());
    assert!(source.photos[1].mask.is_some() && source.photos[0].mask.is_none());
}

#[test]
fn one_of_several_segments_is_named_after_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    Tables::new().write(root);
    for component in ["camera_image", "camera_calibration"] {
        let file = |name: &str| root.join(format!("{component}/{name}.parquet"));
        fs::copy(file(SEGMENT), file("20_other")).unwrap();
    }
    refused(root, &["has 2 segments", "10017_6380, 20_other", "/10017_6380"]);
    assert_eq!(opened(&root.join("20_other")).unwrap().capture.views.len(), 4);
    assert_eq!(opened(&root.join("10017_6380.parquet")).unwrap().capture.views.len(), 4);
    refused(&root.join("30_none"), &["has no segment 30_none", "20_other"]);
}

#[test]
fn damaged_segments_are_refused_in_a_line() {
    let refused = |words: &[&str], root: &Path| {
        let error = with_lidar(root).map(|source| source.capture.views.len()).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{words:?}: {error}");
    };
    // Files.
    let file = |component: &str| format!("{component}/{SEGMENT}.parquet");
    let damaged = |words: &[&str], component: &str, damage: &dyn Fn(Vec<u8>) -> Vec<u8>| {
        let folder = tempfile::tempdir().unwrap();
        Tables::new().write(folder.path());
        let path = folder.path().join(file(component));
        fs::write(&path, damage(fs::read(&path).unwrap())).unwrap();
        refused(&[&[component], words].concat(), folder.path());
    };
    for component in ["camera_image", "camera_calibration", "vehicle_pose", "lidar", "lidar_pose", "lidar_box"] {
        damaged(&["cut short"], component, &|bytes| bytes[..bytes.len() - 9].to_vec());
        damaged(&["not a Parquet file"], component, &|_| b"PAR1".to_vec());
    }
    damaged(&["footer", "longer than the file"], "camera_image", &|mut bytes| {
        let at = bytes.len() - 8;
        bytes[at..at + 4].copy_from_slice(&0x00ff_ffffu32.to_le_bytes());
        bytes
    });
    // The header of a data page: two values become sixteen.
    damaged(&["key.frame", "claims more values"], "vehicle_pose", &|mut bytes| {
        let head = [0x2c, 0x15, 0x04, 0x15, 0x00];
        let at = bytes.windows(5).enumerate().filter(|(_, window)| *window == head).nth(1).unwrap().0;
        bytes[at + 2] = 0x20;
        bytes
    });
    // Contents.
    let changed = |words: &[&str], component: &str, column: &str, cells: Cells| {
        let folder = tempfile::tempdir().unwrap();
        let mut tables = Tables::new();
        tables.set(component, column, cells);
        tables.write(folder.path());
        refused(&[&[component], words].concat(), folder.path());
    };
    let nan = Cells::Doubles(vec![vec![f64::NAN; 16]; 4]);
    changed(&["row 0", "no rotation"], "camera_image", "[CameraImageComponent].pose.transform", nan);
    let far = |x: f64| vec![1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let pose = "[VehiclePoseComponent].world_from_vehicle.transform";
    changed(&["row 1", "out of range"], "vehicle_pose", pose, Cells::Doubles(vec![far(1.0), far(1e8)]));
    changed(&["row 1", "no rotation"], "vehicle_pose", pose, Cells::Doubles(vec![far(1.0), vec![1.0; 15]]));
    changed(&["camera 3", "lacks"], "camera_image", "key.camera_name", Cells::Int8(vec![1, 4, 1, 3]));
    changed(&["in row 1 a shape"], "lidar", SHAPES, Cells::Int32s(vec![vec![2, 2, 4], vec![1, 2, 3], vec![1, 2, 4]]));
    changed(
        &["in row 1 a shape"],
        "lidar",
        SHAPES,
        Cells::Int32s(vec![vec![2, 2, 4], vec![1 << 20; 3], vec![1, 2, 4]]),
    );
    let shape = "[LiDARPoseComponent].range_image_return1.shape";
    changed(
        &["row 1 poses of shape [2, 1, 6]"],
        "lidar_pose",
        shape,
        Cells::Int32s(vec![vec![1, 2, 6], vec![2, 1, 6]]),
    );
    let beams = Cells::Doubles(vec![vec![0.0; 3], vec![]]);
    let folder = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    tables.set("lidar_calibration", "[LiDARCalibrationComponent].beam_inclination.values", beams);
    tables.write(folder.path());
    refused(&["lidar/", "of 1 rows, and its laser has 3 beams"], folder.path());
    // A list that is shorter than its shape says is found when the sweep is read, and so is a pose of a pixel.
    let short = Cells::Floats(vec![vec![-1.0; 16], vec![-1.0; 8], vec![-1.0; 7]]);
    changed(&["row 2 a list of another length than 8"], "lidar", RANGES, short);
    let folder = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    tables.set("lidar_pose", POSES, Cells::Floats(vec![vec![f32::NAN; 12]; 2]));
    tables.write(folder.path());
    refused(&["lidar/", "pose that is not finite, of pixel 0"], folder.path());
    // Timestamps that match no pose, or no photo.
    let late = || Cells::Int64(vec![TIME + 900_000, TIME + 1_000_000]);
    let key = "key.frame_timestamp_micros";
    let three = Cells::Int64([900_000, 900_000, 1_000_000].map(|delay| TIME + delay).to_vec());
    changed(&["of the time 1550083468246370", "vehicle_pose has none"], "lidar", key, three.clone());
    changed(&["timestamp out of range"], "lidar", key, Cells::Int64(vec![i64::MIN; 3]));
    let folder = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    tables.0.remove("lidar_box");
    tables.set("vehicle_pose", key, late());
    tables.set("lidar", key, three);
    tables.write(folder.path());
    refused(&["lidar/", "no range image of a frame with a photo"], folder.path());
    // Boxes, lenses, and components that are missing.
    let size = "[LiDARBoxComponent].box.size.y";
    changed(&["row 3 a box without extent"], "lidar_box", size, Cells::Double(vec![1.0, 1.0, 1.0, 0.0]));
    let focal = "[CameraCalibrationComponent].intrinsic.f_v";
    changed(&["intrinsics", "camera 4"], "camera_calibration", focal, Cells::Double(vec![40.0, f64::NAN]));
    let width = "[CameraCalibrationComponent].width";
    changed(&["size out of range", "camera 1"], "camera_calibration", width, Cells::Int32(vec![0, 48]));
    let laser = "key.laser_name";
    changed(&["laser 5", "lacks"], "lidar", laser, Cells::Int8(vec![5, 1, 1]));
    for component in ["camera_calibration", "lidar_calibration"] {
        let folder = tempfile::tempdir().unwrap();
        Tables::new().write(folder.path());
        fs::remove_file(folder.path().join(file(component))).unwrap();
        refused(&[component, "is not there"], folder.path());
    }
    // A photo that is none is named by its row when it is ingested.
    let folder = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    tables.set("camera_image", "[CameraImageComponent].image", Cells::Bytes(vec![b"no photo".to_vec(); 4]));
    tables.write(folder.path());
    let source = opened(folder.path()).unwrap();
    let store = store::Store::open("memory://").unwrap().blocking();
    let options = IngestOptions { downscale: 1, threads: 1 };
    let error = ingest::ingest(&source, &store, &options, &|_, _| ()).unwrap_err().to_string();
    assert!(error.contains("(row 1)") && error.contains("is not a JPEG") && !error.contains('\n'), "{error}");
}
