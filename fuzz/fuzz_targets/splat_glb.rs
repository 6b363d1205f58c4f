//! Splats in binary glTF, moved as a tileset would, and written again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::{Similarity, splat_glb};

fuzz_target!(|bytes: &[u8]| {
    let Ok(parts) = splat_glb::read(bytes) else { return };
    for splat_glb::Part { mut splats, antialiased, place } in parts {
        assert!((0..splats.len()).all(|i| splats.is_finite(i)));
        // The writer refuses no splats, and places beyond what SPZ's fixed point holds. A matrix that is not finite is no JSON.
        if splats.len() < 100_000
            && let Ok(written) = splat_glb::write(&splats, antialiased, place)
            && place.is_finite()
        {
            assert!(splat_glb::read(&written).is_ok_and(|again| again[0].splats.len() == splats.len()));
        }
        if let Some(moved) = Similarity::from_matrix(place) {
            moved.apply(&mut splats);
        }
    }
});
