//! `tracks.json`: objects that move.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::objects;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(tracks) = objects::read(bytes) {
        for object in &tracks.objects {
            assert!(object.path.iter().all(|pose| pose.world_from_object.is_sane()));
            let first = object.path[0].seconds;
            assert!(object.pose(first).is_some_and(|pose| pose.is_sane()));
            assert!(object.splat_box().iter().all(|corner| corner.is_finite()));
        }
        assert!(objects::read(&objects::write(&tracks)).is_ok());
    }
});
