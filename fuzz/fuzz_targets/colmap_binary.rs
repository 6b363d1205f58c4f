//! COLMAP's binary files.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::colmap;

fuzz_target!(|bytes: &[u8]| {
    let _ = colmap::read_cameras_bin(bytes);
    if let Ok(images) = colmap::read_images_bin(bytes) {
        assert!(images.iter().all(|image| image.camera_from_world.is_sane()));
        assert!(colmap::read_keypoints_bin(bytes).is_ok());
    }
    if let Ok(points) = colmap::read_points_bin(bytes) {
        (0..points.len()).for_each(|i| assert!(points.track(i).len() <= bytes.len()));
        assert!(points.positions.iter().all(|point| point.is_finite()));
    }
});
