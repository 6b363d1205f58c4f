//! Waymo: a table of any component, in Parquet.
#![no_main]

use std::sync::Arc;

use libfuzzer_sys::fuzz_target;
use scene::parquet::Table;
use scene::waymo;

fuzz_target!(|bytes: &[u8]| {
    let Ok(mut table) = Table::open(Arc::<[u8]>::from(bytes)) else { return };
    if let Ok(cameras) = waymo::read_cameras(&table) {
        assert!(cameras.values().all(|camera| camera.vehicle_from_camera.is_sane() && camera.width > 0));
    }
    if let Ok(photos) = waymo::read_photos(&table) {
        assert!(photos.iter().all(|photo| photo.world_from_vehicle.is_sane()));
        for photo in photos.iter().take(4) {
            let _ = table.bytes(waymo::IMAGE, photo.row, 1 << 20);
        }
    }
    if let Ok(poses) = waymo::read_vehicle_poses(&table) {
        assert!(poses.values().all(|pose| pose.is_sane()));
    }
    let _ = waymo::read_lasers(&table);
    // Columns of the seeds that pyarrow wrote.
    let _ = (table.texts("text"), table.lists("values"), table.bytes("photo", 4, 1 << 20));
    for (values, depth) in [(waymo::RANGES, 4), (waymo::PIXEL_POSES, 6)] {
        let Ok(turns) = waymo::read_turns(&table, values, depth) else { continue };
        let lengths: Vec<u32> = turns.iter().map(|turn| turn.length()).collect();
        for row in 0..turns.len().min(4) {
            if let Ok(list) = table.list(values, row as u64, &lengths) {
                assert_eq!(list.len(), lengths[row] as usize);
            }
        }
    }
    if let Ok(boxes) = waymo::read_boxes(&table) {
        assert!(boxes.iter().all(|found| found.vehicle_from_box.is_sane() && found.size.min_element() > 0.0));
    }
});
