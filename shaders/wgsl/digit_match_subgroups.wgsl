// Digit counts and bit masks of a workgroup, one atomic per distinct digit of a subgroup: lanes with equal digits elect
// a leader. Keys of neighbours are often equal, and then one atomic per lane would serialise the subgroup.

// Mask of the threads with the same digit, among this thread's subgroup and word of 32 threads: bit t % 32 is thread t.
fn match_digit(digit: u32, has_key: bool, thread: Thread) -> u32 {
    var lanes = subgroupBallot(has_key);
    for (var bit = 0u; bit < 8u; bit++) {
        let mine = ((digit >> bit) & 1u) == 1u;
        let ones = subgroupBallot(mine);
        lanes &= select(~ones, ones, mine);
    }
    // A subgroup is a part of a word or several words.
    return lanes[thread.lane / 32u] << ((thread.subgroup * thread.size) % 32u);
}

fn is_leader(threads: u32, thread: Thread) -> bool {
    let bit = 1u << (local_index(thread) % 32u);
    return (threads & (bit - 1u)) == 0u;
}

// Adds the digit of this thread to the counts, if it has a key. Needs uniform control flow.
fn count_digit(digit: u32, has_key: bool, thread: Thread) {
    let threads = match_digit(digit, has_key, thread);
    if has_key && is_leader(threads, thread) {
        atomicAdd(&counts[digit], countOneBits(threads));
    }
}

// Sets this thread's bit in the mask of its digit, if it has a key. Needs uniform control flow.
fn mark_digit(digit: u32, has_key: bool, thread: Thread) {
    let threads = match_digit(digit, has_key, thread);
    if has_key && is_leader(threads, thread) {
        atomicOr(&digit_masks[(local_index(thread) / 32u) * 256u + digit], threads);
    }
}
