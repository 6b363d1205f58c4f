//! Captures of cars with lidar: KITTI odometry and DGP.

use std::fs;
use std::path::Path;

use glam::DVec3;
use image::GrayImage;
use scene::MovingObject;

use super::*;

/// The sequence that `drive_kitti_odom_1` is an excerpt of, in KITTI's layout: its calibration and poses, empty photos, and a scan of
/// `drive_kitti_sfnd_lidar` at frame 10.
fn kitti_sequence(odometry: &Path, lidar: &Path) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    };
    let projections = fs::read_to_string(odometry.join("calib_P0_P1.txt")).unwrap();
    let named = projections.lines().enumerate().map(|(i, line)| format!("P{i}: {line}\n"));
    // The axes of a Velodyne: x ahead, y to the left, z up.
    let tr = "Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n".to_string();
    write("calib.txt", named.chain([tr]).collect::<String>().as_bytes());
    write("poses.txt", &fs::read(odometry.join("poses_cam_to_world_kitti.txt")).unwrap());
    write("velodyne/000010.bin", &fs::read(lidar.join("lidar_frontal/0000000010.bin")).unwrap());
    fs::create_dir(folder.path().join("image_0")).unwrap();
    for frame in 0..50 {
        GrayImage::new(1226, 370).save(folder.path().join(format!("image_0/{frame:06}.png"))).unwrap();
    }
    folder
}

#[test]
fn a_kitti_sequence_has_the_cameras_of_its_colmap_model() {
    let (Some(odometry), Some(lidar)) = (shared("drive_kitti_odom_1"), shared("drive_kitti_sfnd_lidar")) else {
        return;
    };
    let folder = kitti_sequence(&odometry, &lidar);
    let options = OpenOptions { lidar: true, ..OpenOptions::default() };
    let source = open(folder.path(), &options).unwrap();
    let expected = opened(&odometry).unwrap().capture.views;
    let views = &source.capture.views;
    assert_eq!((source.format, views.len(), source.sweeps.len()), ("kitti", 50, 1));
    for (view, expected) in views.iter().zip(&expected) {
        assert_eq!(view.name, format!("image_0/{}.png", expected.name.rsplit_once('.').unwrap().0));
        let (ours, theirs) = (&view.camera, &expected.camera);
        assert!(ours.centre().distance(theirs.centre()) < 1e-4, "{}", view.name);
        let turn = ours.camera_from_world.rotation.angle_between(theirs.camera_from_world.rotation);
        assert!(turn < 1e-4 && (ours.pinhole.fx - theirs.pinhole.fx).abs() < 0.01, "{}", view.name);
    }
    // The scan belongs to frame 10, and lies ahead of its camera.
    let sweep = &source.sweeps[0];
    assert_eq!(sweep.views, [10]);
    let returns = sweep.read().unwrap();
    let ahead = returns.iter().filter(|found| views[10].camera.project(found.place).1 > 0.0).count();
    assert!(returns.len() > 10_000 && ahead == returns.len(), "{ahead} of {}", returns.len());
    let points = &source.capture.points;
    assert!(points.len() > 1000 && source.seeds.len() == points.len(), "{}", points.len());

    let sequence = |name: &str| folder.path().join(name);
    fs::write(sequence("velodyne/000010.bin"), [0; 33]).unwrap();
    let error = open(folder.path(), &options).unwrap_err().to_string();
    assert!(error.contains("000010.bin") && !error.contains('\n'), "{error}");
    fs::remove_dir_all(sequence("velodyne")).unwrap();
    fs::write(sequence("calib.txt"), "P0: 1 0 0 0 0 1 0 0 0 0 1\n").unwrap();
    refused(folder.path(), &["calib.txt", "P0 has 11 numbers instead of twelve"]);
    fs::remove_file(sequence("poses.txt")).unwrap();
    refused(folder.path(), &["poses.txt", "is not there"]);
}

#[test]
fn a_dgp_scene_opens_with_its_lidar_and_boxes() {
    let Some(path) = shared("drive_dgp_scene_01") else { return };
    let source = open(&path, &OpenOptions { lidar: true, ..OpenOptions::default() }).unwrap();
    let capture = &source.capture;
    assert_eq!((source.format, capture.views.len(), source.sweeps.len()), ("dgp", 9, 3));
    assert!(source.labels.get("Car").is_some_and(|&cars| cars > 100), "{:?}", source.labels);
    assert!(capture.views.iter().any(|view| view.masked), "some cars move");
    // Three photos a second, on the clock of the objects' paths.
    let mut seconds: Vec<f64> = capture.views.iter().map(|view| view.seconds.unwrap()).collect();
    seconds.sort_by(f64::total_cmp);
    assert!(seconds.chunks(3).zip(0..).all(|(of, second)| of.iter().all(|at| (at - f64::from(second)).abs() < 1e-3)));
    let moved = |object: &MovingObject| {
        let places: Vec<DVec3> = object.path.iter().map(|pose| pose.world_from_object.translation).collect();
        places.iter().any(|place| place.distance(places[0]) > 0.4)
    };
    assert!(capture.objects.len() > 5 && capture.objects.iter().filter(|of| of.path.len() > 1).all(moved));
    capture.check().unwrap();
    // Every view sees a part of the sweep that was taken with it, at plausible depths.
    for sweep in &source.sweeps {
        let returns = sweep.read().unwrap();
        assert_eq!(sweep.views.len(), 3);
        for &view in &sweep.views {
            let places = (0..).zip(returns.iter().map(|found| found.place));
            let seen = crate::lidar::visible(&capture.views[view as usize].camera, places);
            let near = seen.iter().filter(|seen| seen.depth < 120.0).count();
            assert!(seen.len() > 500 && near as f64 > 0.9 * seen.len() as f64, "{} of {}", near, seen.len());
        }
    }
}
