// Exclusive prefix sum over a workgroup through its memory (Hillis and Steele).

var<workgroup> partial: array<u32, 256>;

// Sum of `value` over the threads before this one. Needs uniform control flow.
fn exclusive_scan(value: u32, thread: Thread) -> u32 {
    let local = local_index(thread);
    partial[local] = value;
    workgroupBarrier();
    for (var distance = 1u; distance < 256u; distance *= 2u) {
        var before = 0u;
        if local >= distance {
            before = partial[local - distance];
        }
        workgroupBarrier();
        partial[local] = saturating_add(before, partial[local]);
        workgroupBarrier();
    }
    if local == 0u {
        return 0u;
    }
    return partial[local - 1u];
}

// Sum over all threads; valid after `exclusive_scan`.
fn scan_total(thread: Thread) -> u32 {
    return partial[255];
}
