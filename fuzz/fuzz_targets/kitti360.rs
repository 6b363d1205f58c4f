//! KITTI-360: calibration, poses, scans.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::kitti360;

fuzz_target!(|bytes: &[u8]| {
    let _ = kitti360::read_perspective(bytes);
    if let Ok(poses) = kitti360::read_cam_to_pose(bytes) {
        assert!(poses.values().all(|pose| pose.is_sane()));
    }
    let _ = kitti360::read_cam_to_velo(bytes);
    if let Ok(poses) = kitti360::read_poses(bytes) {
        assert!(poses.values().all(|pose| pose.is_sane()));
    }
    for step in [0, 1, 7] {
        let _ = kitti360::read_scan(bytes, step);
    }
});
