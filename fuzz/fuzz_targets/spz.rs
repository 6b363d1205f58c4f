//! SPZ, raw and wrapped in gzip.
#![no_main]

use std::io::Write;

use flate2::{Compression, write::GzEncoder};
use libfuzzer_sys::fuzz_target;
use scene::spz::{self, Version};

fuzz_target!(|bytes: &[u8]| {
    let _ = spz::read(bytes);
    let mut zipped = GzEncoder::new(Vec::new(), Compression::none());
    zipped.write_all(bytes).expect("writing to memory succeeds");
    if let Ok((splats, antialiased)) = spz::read(&zipped.finish().expect("writing to memory succeeds")) {
        for version in [Version::V2, Version::V3] {
            // The writer refuses only -8,388 km, which fixed point holds on the negative side alone.
            let Ok(written) = spz::write(&splats, antialiased, version) else { continue };
            assert!(spz::read(&written).is_ok_and(|(again, _)| again.len() == splats.len()));
        }
    }
});
