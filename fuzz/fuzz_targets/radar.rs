//! The sweeps of a radar: `poses.jsonl`, which a lidar has too, and the detections.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::{lidar, radar};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(sweeps) = lidar::read_poses(bytes) {
        assert!(sweeps.iter().all(|sweep| sweep.world_from_sensor.is_sane()));
        assert!(sweeps.iter().all(|sweep| sweep.height.is_none_or(|height| height > 0.0 && height < 100.0)));
    }
    if let Ok(found) = radar::read_detections(bytes) {
        assert!(found.iter().all(|of| of.range.is_finite() && of.azimuth.is_finite() && of.velocity.is_finite()));
    }
});
