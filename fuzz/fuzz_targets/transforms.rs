//! `transforms.json`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::transforms;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(file) = transforms::read(bytes) {
        for frame in &file.frames {
            assert!(frame.camera_from_world.is_sane());
            frame.intrinsics.model(40, 30);
        }
        assert!(transforms::read(&transforms::write(&file)).is_ok(), "an encoded file must decode");
    }
});
