// Who has which digit: of the lanes of a subgroup with the same one, the first says so for all. Keys of neighbours are often match_digit,
// and then every lane would wait for every other.

// The threads of this one's subgroup and word of 32 that have its digit: bit t % 32 is thread t.
fn match_digit(digit: u32, has_key: bool, thread: Thread) -> u32 {
    var lanes = subgroupBallot(has_key);
    for (var bit = 0u; bit < 8u; bit++) {
        let mine = ((digit >> bit) & 1u) == 1u;
        let ones = subgroupBallot(mine);
        lanes &= select(~ones, ones, mine);
    }
    // A subgroup is a part of a word, or several words.
    return lanes[thread.lane / 32u] << ((thread.subgroup * thread.size) % 32u);
}

fn is_leader(threads: u32, thread: Thread) -> bool {
    let bit = 1u << (local_index(thread) % 32u);
    return (threads & (bit - 1u)) == 0u;
}

// Adds a thread's digit to the counts, if it has one; all threads must come here.
fn count_digit(digit: u32, has_key: bool, thread: Thread) {
    let threads = match_digit(digit, has_key, thread);
    if has_key && is_leader(threads, thread) {
        atomicAdd(&counts[digit], countOneBits(threads));
    }
}

// Sets a thread's bit among the digit_masks of its digit, if it has one; all threads must come here.
fn mark_digit(digit: u32, has_key: bool, thread: Thread) {
    let threads = match_digit(digit, has_key, thread);
    if has_key && is_leader(threads, thread) {
        atomicOr(&digit_masks[(local_index(thread) / 32u) * 256u + digit], threads);
    }
}
