//! KITTI raw: calibration, oxts, times and tracklets.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::kitti_raw;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(found) = kitti_raw::read_cameras(bytes) {
        assert!(found.cameras.values().all(|camera| camera.from_first.is_sane() && camera.width > 0));
    }
    if let Ok(pose) = kitti_raw::read_mounting(bytes) {
        assert!(pose.is_sane());
    }
    let _ = kitti_raw::read_times(bytes);
    if let Ok(found) = kitti_raw::read_tracklets(bytes) {
        assert!(found.iter().all(|of| of.size.min_element() > 0.0 && of.poses.iter().all(|pose| pose.is_sane())));
    }
    if let Ok(oxts) = kitti_raw::read_oxts(bytes) {
        assert!(kitti_raw::Mercator::new(&oxts.place).world_from_imu(&oxts).is_sane());
    }
});
