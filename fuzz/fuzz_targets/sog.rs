//! SOG in one file, and what is read of it written again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::sog;

fuzz_target!(|bytes: &[u8]| {
    let Ok((splats, antialiased)) = sog::read_bundle(bytes) else { return };
    assert!((0..splats.len()).all(|i| splats.is_finite(i)));
    // Palettes take a second for each few thousand.
    if (1..2000).contains(&splats.len()) {
        let files = sog::write(&splats, antialiased).expect("finite splats are written");
        let again = sog::bundle(&files).expect("few splats are few bytes");
        assert!(sog::read_bundle(&again).is_ok_and(|(again, flag)| again.len() == splats.len() && flag == antialiased));
    }
});
