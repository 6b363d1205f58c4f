// Who has which digit: each thread says so itself.

// Adds a thread's digit to the counts, if it has one.
fn count_digit(digit: u32, has_key: bool, thread: Thread) {
    if has_key {
        atomicAdd(&counts[digit], 1u);
    }
}

// Sets a thread's bit among the digit_masks of its digit, if it has one. The order in which threads do so does not matter.
fn mark_digit(digit: u32, has_key: bool, thread: Thread) {
    let local = local_index(thread);
    if has_key {
        atomicOr(&digit_masks[(local / 32u) * 256u + digit], 1u << (local % 32u));
    }
}
