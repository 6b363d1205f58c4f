// Index of a thread in its workgroup by subgroup and lane. All subgroups have the same size, a power of two from 8 to
// 128 (checked by `render`). Threads adjacent in local index need not share a subgroup, hence this numbering.

struct Thread {
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
}

// A permutation of 0 to 255.
fn local_index(thread: Thread) -> u32 {
    return thread.subgroup * thread.size + thread.lane;
}
