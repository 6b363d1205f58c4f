//! nuScenes: its tables.
#![no_main]

use std::collections::{BTreeMap, BTreeSet};

use libfuzzer_sys::fuzz_target;
use scene::nuscenes;

fuzz_target!(|bytes: &[u8]| {
    // The tokens of the seeds.
    let samples = BTreeMap::from([("s".to_string(), 7)]);
    let _ = nuscenes::read_names(bytes);
    let _ = nuscenes::read_samples(bytes, "one");
    let _ = nuscenes::read_modalities(bytes);
    let _ = nuscenes::read_instances(bytes);
    if let Ok(data) = nuscenes::read_data(bytes, &samples) {
        assert!(data.is_sorted_by_key(|datum| datum.microseconds));
    }
    if let Ok(poses) = nuscenes::read_ego_poses(bytes, &BTreeSet::from(["e"])) {
        assert!(poses.values().all(|pose| pose.is_sane()));
    }
    if let Ok(sensors) = nuscenes::read_calibrated_sensors(bytes) {
        assert!(sensors.values().all(|sensor| sensor.vehicle_from_sensor.is_sane()));
    }
    if let Ok(boxes) = nuscenes::read_annotations(bytes, &samples) {
        assert!(boxes.iter().all(|found| found.world_from_box.is_sane() && found.size.min_element() > 0.0));
    }
});
