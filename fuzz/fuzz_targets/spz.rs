//! SPZ, as it is and inside of gzip.
#![no_main]

use std::io::Write;

use flate2::{Compression, write::GzEncoder};
use libfuzzer_sys::fuzz_target;
use scene::spz::{self, Version};

fuzz_target!(|bytes: &[u8]| {
    let _ = spz::read(bytes);
    let mut zipped = GzEncoder::new(Vec::new(), Compression::none());
    zipped.write_all(bytes).expect("memory takes it");
    if let Ok((splats, antialiased)) = spz::read(&zipped.finish().expect("memory takes it")) {
        for version in [Version::V2, Version::V3] {
            // Only the one place 8,388 km out that the format has on one side alone is refused.
            let Ok(written) = spz::write(&splats, antialiased, version) else { continue };
            assert!(spz::read(&written).is_ok_and(|(again, _)| again.len() == splats.len()));
        }
    }
});
