// Stage `ranges`: first and last pair of each tile in the sorted list; one thread per pair. Tiles without pairs keep
// the zeros of a clear.

@group(0) @binding(0) var<storage, read> status: Status;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> tile_ranges: array<vec2<u32>>;

@compute @workgroup_size(256)
fn ranges(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let p = thread_number(group, groups, local);
    if p >= status.pairs {
        return;
    }
    let tile = keys[p];
    if p == 0u || keys[p - 1u] != tile {
        tile_ranges[tile].x = p;
    }
    if p + 1u == status.pairs || keys[p + 1u] != tile {
        tile_ranges[tile].y = p + 1u;
    }
}
