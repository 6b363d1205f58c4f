// Exclusive prefix sum over a workgroup: within subgroups, then over subgroups, with one barrier.
// `subgroupExclusiveAdd` wraps around, so shuffles with a saturating addition replace it.

var<workgroup> subgroup_sums: array<u32, 32>;

// Sum of `value` over the threads before this one. Needs uniform control flow.
fn exclusive_scan(value: u32, thread: Thread) -> u32 {
    var sum = value;
    for (var distance = 1u; distance < thread.size; distance *= 2u) {
        let before = subgroupShuffleUp(sum, distance);
        sum = saturating_add(sum, select(0u, before, thread.lane >= distance));
    }
    if thread.lane == thread.size - 1u {
        subgroup_sums[thread.subgroup] = sum;
    }
    let before_lane = subgroupShuffleUp(sum, 1u);
    workgroupBarrier();
    var before = select(0u, before_lane, thread.lane > 0u);
    for (var s = 0u; s < thread.subgroup; s++) {
        before = saturating_add(before, subgroup_sums[s]);
    }
    return before;
}

// Sum over all threads; valid after `exclusive_scan`.
fn scan_total(thread: Thread) -> u32 {
    var sum = 0u;
    for (var s = 0u; s < 256u / thread.size; s++) {
        sum = saturating_add(sum, subgroup_sums[s]);
    }
    return sum;
}
