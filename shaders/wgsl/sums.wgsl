// Sums over a workgroup through its memory.

var<workgroup> partial: array<u32, 256>;

// The sum of `value` over the threads before this one; all threads must come here.
fn exclusive(value: u32, thread: Thread) -> u32 {
    let local = place_of(thread);
    partial[local] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < 256u; reach *= 2u) {
        var before = 0u;
        if local >= reach {
            before = partial[local - reach];
        }
        workgroupBarrier();
        partial[local] = add(before, partial[local]);
        workgroupBarrier();
    }
    if local == 0u {
        return 0u;
    }
    return partial[local - 1u];
}

// The sum over all threads, after `exclusive`.
fn total(thread: Thread) -> u32 {
    return partial[255];
}
