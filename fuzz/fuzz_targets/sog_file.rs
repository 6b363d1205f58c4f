//! The files of a SOG without an archive, whose checksums a fuzzer cannot make: the input is `meta.json`, or each picture.
#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use scene::{CodecError, Splat, Splats, sog};

static FILES: LazyLock<Vec<sog::File>> = LazyLock::new(|| {
    let mut splats = Splats::new(1);
    for i in 0..40 {
        splats.push(&Splat::round([i as f32, 2.0, 3.0].into(), -1.0, [0.5; 3].into(), 0.9));
    }
    sog::write(&splats, true).expect("they are finite")
});

fuzz_target!(|bytes: &[u8]| {
    let is_json = bytes.first() == Some(&b'{');
    for damaged in FILES.iter().filter(|file| (file.name == sog::META) == is_json) {
        let file = |name: &str| match FILES.iter().find(|file| file.name == name) {
            Some(_) if name == damaged.name => Ok(bytes.to_vec()),
            Some(file) => Ok(file.bytes.clone()),
            None => Err(CodecError::new("no such file")),
        };
        let meta = file(sog::META).expect("it is there");
        if let Ok((splats, _)) = sog::read(&meta, file) {
            assert!((0..splats.len()).all(|i| splats.is_finite(i)));
        }
    }
});
