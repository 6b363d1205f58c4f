//! PLY: splats, packed splats and point clouds.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::ply;

fuzz_target!(|bytes: &[u8]| {
    ply::comments(bytes);
    if let Ok(splats) = ply::read(bytes) {
        assert!(ply::read(&ply::write(&splats, &[])).is_ok_and(|again| again.len() == splats.len()));
    }
    if let Ok((points, colours)) = ply::read_points(bytes) {
        assert!(points.len() == colours.len() && points.iter().all(|point| point.is_finite()));
    }
});
