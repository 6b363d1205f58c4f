// Stage `gather`: the tile counts of the visible entries in depth order, for the prefix sum.

@group(0) @binding(0) var<storage, read> status: Status;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

@compute @workgroup_size(256)
fn gather(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = thread_number(group, groups, local);
    if rank < status.visible {
        sums[rank] = tiles[order[rank]];
    }
    if rank == 0u {
        sums[status.visible] = 0u;
    }
}
