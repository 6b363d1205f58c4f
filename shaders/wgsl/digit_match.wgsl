// Digit counts and bit masks of a workgroup by atomics, one per thread.

// Adds the digit of this thread to the counts, if it has a key.
fn count_digit(digit: u32, has_key: bool, thread: Thread) {
    if has_key {
        atomicAdd(&counts[digit], 1u);
    }
}

// Sets this thread's bit in the mask of its digit, if it has a key. The order of the threads does not matter.
fn mark_digit(digit: u32, has_key: bool, thread: Thread) {
    let local = local_index(thread);
    if has_key {
        atomicOr(&digit_masks[(local / 32u) * 256u + digit], 1u << (local % 32u));
    }
}
