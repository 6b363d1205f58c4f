// Who has which digit: each thread says so itself.

// Adds a thread's digit to the counts, if it has one.
fn count_digit(digit: u32, has_one: bool, thread: Thread) {
    if has_one {
        atomicAdd(&counts[digit], 1u);
    }
}

// Sets a thread's bit among the holders of its digit, if it has one. The order in which threads do so does not matter.
fn hold_digit(digit: u32, has_one: bool, thread: Thread) {
    let local = place_of(thread);
    if has_one {
        atomicOr(&holders[(local / 32u) * 256u + digit], 1u << (local % 32u));
    }
}
