//! RAD, and what is read of it written again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::rad;

fuzz_target!(|bytes: &[u8]| {
    let Ok(read) = rad::read(bytes) else { return };
    assert!(read.nodes.iter().all(rad::Gaussian::is_finite));
    let leaves = read.leaves();
    // Merging takes a second for each few thousand.
    if (1..2000).contains(&leaves.len()) {
        let written = rad::write(&leaves, Default::default(), read.comment.as_deref());
        assert!(written.is_ok_and(|bytes| rad::read(&bytes).is_ok_and(|again| again.leaves().len() == leaves.len())));
    }
});
