// Sums over a workgroup within its subgroups and then over these: one barrier. Not `subgroupExclusiveAdd`, which wraps around.

var<workgroup> of_subgroups: array<u32, 32>;

// The sum of `value` over the threads before this one; all threads must come here.
fn exclusive(value: u32, thread: Thread) -> u32 {
    var sum = value;
    for (var reach = 1u; reach < thread.size; reach *= 2u) {
        let before = subgroupShuffleUp(sum, reach);
        sum = add(sum, select(0u, before, thread.lane >= reach));
    }
    if thread.lane == thread.size - 1u {
        of_subgroups[thread.subgroup] = sum;
    }
    let before_lane = subgroupShuffleUp(sum, 1u);
    workgroupBarrier();
    var before = select(0u, before_lane, thread.lane > 0u);
    for (var s = 0u; s < thread.subgroup; s++) {
        before = add(before, of_subgroups[s]);
    }
    return before;
}

// The sum over all threads, after `exclusive`.
fn total(thread: Thread) -> u32 {
    var sum = 0u;
    for (var s = 0u; s < 256u / thread.size; s++) {
        sum = add(sum, of_subgroups[s]);
    }
    return sum;
}
