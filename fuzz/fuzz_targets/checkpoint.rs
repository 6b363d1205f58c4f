//! Checkpoints, with valid lengths and checksum: a decoded checkpoint encodes and decodes to the same state.
#![no_main]

use libfuzzer_sys::fuzz_target;
use train::State;

/// The same as `train::checkpoint::CHECKPOINT`.
const CHECKPOINT: ([u8; 4], u32) = (*b"ckpt", 4);

fuzz_target!(|bytes: &[u8]| {
    let _ = State::from_frame(bytes);
    // A header takes about a dozen bytes, and several dozen with large numbers and epoch errors.
    for header in 0..bytes.len().min(96) {
        let frame = sealed(bytes, header);
        if let Ok(state) = State::from_frame(&frame) {
            let again = State::from_frame(&state.to_frame()).expect("an encoded checkpoint decodes");
            assert_eq!(again.step(), state.step());
        }
    }
});

/// A frame whose header is the first `header` bytes of `body` and whose bulk is the rest.
fn sealed(body: &[u8], header: usize) -> Vec<u8> {
    let (kind, version) = CHECKPOINT;
    let mut bytes = b"plat".to_vec();
    bytes.extend(kind);
    bytes.extend(version.to_le_bytes());
    bytes.extend((header as u32).to_le_bytes());
    bytes.extend(((body.len() - header) as u64).to_le_bytes());
    bytes.extend(&blake3::hash(body).as_bytes()[..16]);
    bytes.extend(body);
    bytes
}
