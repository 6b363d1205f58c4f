//! npy arrays.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::npy;

fuzz_target!(|bytes: &[u8]| {
    if let Ok((shape, data)) = npy::read_f32(bytes) {
        assert_eq!(shape.iter().product::<usize>(), data.len());
        assert!(npy::read_f32(&npy::write_f32(&shape, &data)).is_ok());
    }
});
