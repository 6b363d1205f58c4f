//! OpenSfM's `reconstruction.json`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::opensfm;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(sfm) = opensfm::read(bytes) {
        assert!(sfm.shots.iter().all(|shot| shot.camera_from_world.is_sane()));
        assert!(sfm.positions.len() == sfm.colours.len() && sfm.positions.iter().all(|point| point.is_finite()));
    }
});
