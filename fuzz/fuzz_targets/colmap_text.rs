//! COLMAP's text files.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::colmap;

fuzz_target!(|bytes: &[u8]| {
    let _ = colmap::read_cameras_txt(bytes);
    if let Ok(images) = colmap::read_images_txt(bytes) {
        assert!(images.iter().all(|image| image.camera_from_world.is_sane()));
    }
    if let Ok(points) = colmap::read_points_txt(bytes) {
        (0..points.len()).for_each(|i| assert!(points.track(i).len() <= bytes.len()));
        assert!(points.positions.iter().all(|point| point.is_finite()));
    }
});
