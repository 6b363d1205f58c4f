//! Captures in the formats of other tools, written as those tools do.

use std::fs;
use std::path::Path;

use glam::{DMat3, DQuat, DVec2, DVec3};
use image::{GrayImage, RgbImage, RgbaImage};
use scene::transforms::{Frame, Intrinsics, Transforms};
use scene::{CameraModel, Rigid};

use super::*;

fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

/// OpenCV `camera_from_world` of a camera at `at` that looks at `to`, with z up.
fn looking(at: DVec3, to: DVec3) -> Rigid {
    let z = (to - at).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
    Rigid { rotation, translation: at }.inverse()
}

fn centred(points: &[DVec3], middle: DVec3, radius: f64) -> f64 {
    points.iter().filter(|p| p.distance(middle) < radius).count() as f64 / points.len() as f64
}

#[test]
fn captures_in_splits_are_merged_and_get_sampled_points() {
    // As the synthetic scenes of NeRF: three files, a field of view as lens, names without extension, no points.
    let folder = tempfile::tempdir().unwrap();
    let middle = DVec3::new(1.0, -2.0, 0.5);
    for (split, count) in [("train", 20), ("val", 4), ("test", 6)] {
        let mut text = r#"{"camera_angle_x": 0.6911112070083618, "frames": ["#.to_string();
        for i in 0..count {
            let turn = f64::from(i) + count as f64 * 0.1;
            let at = middle + 4.0 * DVec3::new(turn.cos(), turn.sin(), 0.6).normalize();
            let world_from_camera = looking(at, middle).inverse();
            let axes = DMat3::from_quat(world_from_camera.rotation);
            let (x, y, z) = (axes.x_axis, -axes.y_axis, -axes.z_axis);
            let row = |k: usize| format!("[{},{},{},{}]", x[k], y[k], z[k], at[k]);
            let rows = [row(0), row(1), row(2), "[0,0,0,1]".into()].join(",");
            let comma = if i == 0 { "" } else { "," };
            text += &format!(
                r#"{comma}{{"file_path": "./{split}/r_{i}", "rotation": 0.01, "transform_matrix": [{rows}]}}"#
            );
            fs::create_dir_all(folder.path().join(split)).unwrap();
            RgbaImage::new(40, 40).save(folder.path().join(format!("{split}/r_{i}.png"))).unwrap();
        }
        write(&folder.path().join(format!("transforms_{split}.json")), text + "]}");
    }
    let source = opened(folder.path()).unwrap();
    assert_eq!((source.format, source.capture.views.len()), ("transforms without points", 30));
    let focal = source.capture.views[0].camera.pinhole.fx;
    assert!((focal - 20.0 / (0.5f64 * 0.6911112070083618).tan()).abs() < 1e-9);
    let points = &source.capture.points.positions;
    // 4 m away the cameras see 2.9 m of height.
    assert!(points.len() > 5000 && centred(points, middle, 2.5) > 0.9, "{}", points.len());
    assert_eq!(points, &opened(folder.path()).unwrap().capture.points.positions);
    // A split opened by its file name; a frame in two splits counts once.
    let test = folder.path().join("transforms_test.json");
    assert_eq!(opened(&test).unwrap().capture.views.len(), 6);
    fs::copy(&test, folder.path().join("transforms_val.json")).unwrap();
    assert_eq!(opened(folder.path()).unwrap().capture.views.len(), 26);
    fs::remove_file(folder.path().join("transforms_train.json")).unwrap();
    refused(folder.path(), &["neither", "transforms.json"]);
}

#[test]
fn sampled_points_cover_the_city() {
    // Enough views that every place is seen from several sides.
    let folder = city_of(96);
    let true_points = opened(folder.path()).unwrap().capture.points.positions;
    for name in ["points3D.bin", "points3D.txt"] {
        let _ = fs::remove_file(folder.path().join("sparse/0").join(name));
    }
    let source = opened(folder.path()).unwrap();
    let points = &source.capture.points.positions;
    assert!(source.format == "colmap without points" && points.len() > 2000);
    // The city is 220 m wide. Nearly all true points have a sampled one nearby.
    let near = true_points.iter().filter(|p| points.iter().any(|q| p.distance(*q) < 8.0)).count();
    assert!(near as f64 > 0.9 * true_points.len() as f64, "{near} of {}", true_points.len());
}

#[test]
fn opensfm_and_opendronemap_are_opened() {
    let folder = tempfile::tempdir().unwrap();
    let shot =
        |name: &str, z: f64| format!(r#""{name}": {{"camera": "c", "rotation": [0,0,0], "translation": [0,0,{z}]}}"#);
    let text = format!(
        r#"[{{"cameras": {{"c": {{"projection_type": "brown", "width": 80, "height": 60, "focal_x": 0.9, "focal_y": 0.9,
            "c_x": 0.0, "c_y": 0.0, "k1": -0.05, "k2": 0, "k3": 0, "p1": 0, "p2": 0}}}},
            "shots": {{{}, {}, {}}}, "points": {{"1": {{"coordinates": [1, 0.5, 0], "color": [9, 8, 7]}}}},
            "reference_lla": {{"latitude": 46.0, "longitude": 7.0, "altitude": 500.0}}}},
          {{"cameras": {{}}, "shots": {{{}}}}}]"#,
        shot("a.jpg", 10.0),
        shot("b.jpg", 12.0),
        shot("missing.jpg", 5.0),
        shot("other.jpg", 5.0),
    );
    fs::create_dir(folder.path().join("images")).unwrap();
    for name in ["a.jpg", "b.jpg"] {
        RgbImage::new(80, 60).save(folder.path().join("images").join(name)).unwrap();
    }
    let alone = folder.path().join("reconstruction.json");
    let project = folder.path().join("opensfm/reconstruction.json");
    for place in [&alone, &project] {
        write(place, &text);
        let source = opened(folder.path()).unwrap();
        assert_eq!((source.format, source.capture.views.len()), ("opensfm", 2));
        assert_eq!(
            source.left_out.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(),
            ["missing.jpg", "other.jpg"]
        );
        assert_eq!(source.capture.geo_origin.unwrap().latitude_degrees, 46.0);
        let (pixel, depth) = source.capture.views[1].camera.project(DVec3::new(1.0, 0.5, 0.0));
        assert!(depth == 12.0 && (pixel - source.capture.views[1].camera.pinhole_centre()).x > 5.9, "{pixel}");
        assert_eq!(source.capture.points.colours, [[9, 8, 7]]);
        fs::remove_file(place).unwrap();
    }
    write(&alone, &text);
    assert_eq!(opened(&alone).unwrap().capture.views.len(), 2);
}

trait Centre {
    fn pinhole_centre(&self) -> DVec2;
}

impl Centre for scene::Camera {
    fn pinhole_centre(&self) -> DVec2 {
        DVec2::new(self.pinhole.cx, self.pinhole.cy)
    }
}

/// A drive of KITTI-360 in its layout: three frames, both cameras, two scans.
fn drive() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write(
        &at("calibration/perspective.txt"),
        "calib_time: x\nS_rect_00: 80 40\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: 50 0 40 0 0 50 20 0 0 0 1 0\n\
         S_rect_01: 80 40\nR_rect_01: 1 0 0 0 1 0 0 0 1\nP_rect_01: 50 0 40 -30 0 50 20 0 0 0 1 0\n",
    );
    // The vehicle's axes are forward, right, down; cameras stand 1 m ahead, the second 0.6 m to the right.
    write(
        &at("calibration/calib_cam_to_pose.txt"),
        "image_00: 0 0 1 1 1 0 0 0 0 1 0 0\nimage_01: 0 0 1 1 1 0 0 0.6 0 1 0 0\nimage_02: 0 0 1 1 1 0 0 0 0 1 0 0\n",
    );
    // The scanner's axes are forward, left, up; it is 0.5 m above the first camera.
    write(&at("calibration/calib_cam_to_velo.txt"), "0 0 1 0 -1 0 0 0 0 -1 0 -0.5\n");
    // The vehicle drives along the world's x axis: right is -y, down is -z.
    let pose = |frame: u32| format!("{frame} 1 0 0 {} 0 -1 0 7 0 0 -1 2\n", 10 * frame);
    write(&at("data_poses/drive_a/poses.txt"), pose(1) + &pose(2) + &pose(5));
    for camera in ["image_00", "image_01"] {
        let photos = at(&format!("data_2d_raw/drive_a/{camera}/data_rect"));
        fs::create_dir_all(&photos).unwrap();
        for frame in [1, 2] {
            RgbImage::new(80, 40).save(photos.join(format!("{frame:010}.png"))).unwrap();
        }
    }
    // A point 20 m ahead of the scanner, 2 m to the left and 1 m down, and one on the vehicle itself.
    let scan: Vec<u8> = [20.0f32, 2.0, -1.0, 0.5, 1.0, 0.0, 0.0, 0.5].iter().flat_map(|v| v.to_le_bytes()).collect();
    for frame in [1, 2, 5] {
        write(&at(&format!("data_3d_raw/drive_a/velodyne_points/data/{frame:010}.bin")), &scan);
    }
    folder
}

#[test]
fn kitti_360_is_opened_in_its_own_layout() {
    let folder = drive();
    let source = opened(folder.path()).unwrap();
    let names: Vec<_> = source.capture.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names.len(), 4);
    assert_eq!((source.format, names[0]), ("kitti360", "drive_a/image_00/0000000001.png"));
    assert_eq!(source.left_out.len(), 2);
    // Camera 00 of frame 1: vehicle at (10, 7, 2), 1 m ahead.
    let camera = |i: usize| source.capture.views[i].camera;
    assert!(camera(0).centre().distance(DVec3::new(11.0, 7.0, 2.0)) < 1e-9, "{}", camera(0).centre());
    assert!(camera(2).centre().distance(DVec3::new(11.0, 6.4, 2.0)) < 1e-9, "{}", camera(2).centre());
    assert!(camera(0).forward().distance(DVec3::X) < 1e-9);
    // Frames with photos have their scans: ahead of (11, 7, 2.5) and (21, 7, 2.5).
    let points = &source.capture.points.positions;
    assert_eq!(points.len(), 2);
    assert!(points[0].distance(DVec3::new(31.0, 9.0, 1.5)) < 1e-6, "{}", points[0]);
    let (pixel, depth) = camera(0).project(points[0]);
    assert!((depth - 20.0).abs() < 1e-6 && pixel.distance(DVec2::new(40.0 - 5.0, 20.0 + 1.25)) < 1e-6, "{pixel}");
    let scan = folder.path().join("data_3d_raw/drive_a/velodyne_points/data/0000000002.bin");
    write(&scan, [0; 17]);
    refused(folder.path(), &["0000000002.bin", "cut short"]);
    // Poses of camera 00 only, without scans and points.
    fs::remove_file(folder.path().join("data_poses/drive_a/poses.txt")).unwrap();
    let pose = |frame: u32| format!("{frame} 0 0 1 {} -1 0 0 7 0 -1 0 2 0 0 0 1\n", 10 * frame);
    write(&folder.path().join("data_poses/drive_a/cam0_to_world.txt"), pose(1) + &pose(2));
    let source = opened(folder.path()).unwrap();
    assert_eq!((source.format, source.capture.views.len()), ("kitti360 without points", 2));
    assert!(source.capture.views[0].camera.forward().distance(DVec3::X) < 1e-9);
    fs::remove_file(folder.path().join("data_poses/drive_a/cam0_to_world.txt")).unwrap();
    refused(folder.path(), &["no drive with poses"]);
}

#[test]
fn masks_are_found_by_every_convention() {
    for (mask, finds) in [
        ("masks/sub/a.png", true),
        ("masks/sub/a.jpg.png", true),
        ("mask/sub/a.png", true),
        ("mask/sub/a.jpg.png", true),
        ("masks/images/sub/a.png", true),
        ("images/sub/a.mask.png", true),
        ("images/sub/a.jpg.mask.png", true),
        ("masks/a.png", false),
        ("images/sub/b.mask.png", false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let model = CameraModel::Pinhole([40.0, 40.0, 24.0, 16.0]);
        let frame = |name: &str, x: f64| Frame {
            file_path: name.into(),
            mask_path: None,
            depth_file_path: None,
            intrinsics: Intrinsics::from_model(&model, None),
            camera_from_world: looking(DVec3::new(x, -5.0, 0.0), DVec3::ZERO),
        };
        let frames = vec![frame("images/sub/a.jpg", 0.0), frame("images/sub/c.jpg", 3.0)];
        write(
            &folder.path().join("transforms.json"),
            scene::transforms::write(&Transforms { frames, ply_file_path: None }),
        );
        fs::create_dir_all(folder.path().join("images/sub")).unwrap();
        for name in ["a", "c"] {
            RgbImage::new(48, 32).save(folder.path().join(format!("images/sub/{name}.jpg"))).unwrap();
        }
        let path = folder.path().join(mask);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        GrayImage::new(48, 32).save(&path).unwrap();
        let source = opened(folder.path()).unwrap();
        let masked: Vec<bool> = source.photos.iter().map(|photo| photo.mask.is_some()).collect();
        assert_eq!(masked, [finds, false], "{mask}");
    }
}

#[test]
fn fisheye_cameras_become_pinholes() {
    let folder = city();
    let path = folder.path().join("sparse/0/cameras.bin");
    let mut cameras = scene::colmap::read_cameras_bin(&fs::read(&path).unwrap()).unwrap();
    for camera in cameras.values_mut() {
        let [fx, fy, cx, cy] = camera.model.focal_and_centre();
        camera.model = CameraModel::OpenCvFisheye([fx, fy, cx, cy, 0.01, 0.0, 0.0, 0.0]);
    }
    let model = scene::colmap::Reconstruction { cameras, ..Default::default() };
    fs::write(&path, scene::colmap::write_cameras_bin(&model)).unwrap();
    let source = opened(folder.path()).unwrap();
    for (view, photo) in source.capture.views.iter().zip(&source.photos) {
        let k = view.camera.pinhole;
        assert!(photo.model.is_fisheye() && k.fx == photo.model.focal_and_centre()[0]);
        // The same field of view takes more pixels in a pinhole, so its image is wider.
        assert!(k.width > photo.width && k.height >= photo.height, "{k:?}");
    }
}
