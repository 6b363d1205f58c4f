// Who has which digit: of the lanes of a subgroup with the same one, the first says so for all. Keys of neighbours are often alike,
// and then every lane would wait for every other.

// The threads of this one's subgroup and word of 32 that have its digit: bit t % 32 is thread t.
fn alike(digit: u32, has_one: bool, thread: Thread) -> u32 {
    var lanes = subgroupBallot(has_one);
    for (var bit = 0u; bit < 8u; bit++) {
        let mine = ((digit >> bit) & 1u) == 1u;
        let ones = subgroupBallot(mine);
        lanes &= select(~ones, ones, mine);
    }
    // A subgroup is a part of a word, or several words.
    return lanes[thread.lane / 32u] << ((thread.subgroup * thread.size) % 32u);
}

fn is_first(threads: u32, thread: Thread) -> bool {
    let bit = 1u << (place_of(thread) % 32u);
    return (threads & (bit - 1u)) == 0u;
}

// Adds a thread's digit to the counts, if it has one; all threads must come here.
fn count_digit(digit: u32, has_one: bool, thread: Thread) {
    let threads = alike(digit, has_one, thread);
    if has_one && is_first(threads, thread) {
        atomicAdd(&counts[digit], countOneBits(threads));
    }
}

// Sets a thread's bit among the holders of its digit, if it has one; all threads must come here.
fn hold_digit(digit: u32, has_one: bool, thread: Thread) {
    let threads = alike(digit, has_one, thread);
    if has_one && is_first(threads, thread) {
        atomicOr(&holders[(place_of(thread) / 32u) * 256u + digit], threads);
    }
}
