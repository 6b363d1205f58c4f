//! Checkpoints of a task, with lengths and checksum that fit the bytes: what is read is written as it was.
#![no_main]

use libfuzzer_sys::fuzz_target;
use train::State;

/// As `train::checkpoint::CHECKPOINT`.
const CHECKPOINT: ([u8; 4], u32) = (*b"ckpt", 2);

fuzz_target!(|bytes: &[u8]| {
    let _ = State::from_frame(bytes);
    // The header takes a dozen bytes or a few more, with large numbers and errors noted several dozen.
    for header in 0..bytes.len().min(96) {
        let frame = sealed(bytes, header);
        if let Ok(state) = State::from_frame(&frame) {
            let again = State::from_frame(&state.to_frame()).expect("what is written can be read");
            assert_eq!(again.step(), state.step());
        }
    }
});

/// A frame whose header is the first bytes of these, its bulk the others.
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
