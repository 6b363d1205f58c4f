// Which thread of its workgroup a thread is, and of its subgroup. All subgroups have the same size, a power of two from 8 to 128
// (`render` sees to that). Nothing says that neighbours by local index share a subgroup, so threads are numbered by their lanes.

struct Thread {
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
}

// 0 to 255, each once.
fn local_index(thread: Thread) -> u32 {
    return thread.subgroup * thread.size + thread.lane;
}
