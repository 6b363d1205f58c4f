// Stage `emit`: the pairs of entries and tiles, in depth order and then in tile order; one thread per visible entry.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read_write> status: Status;
@group(0) @binding(2) var<storage, read> records: array<Record>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
// Exclusive prefix sum of the tile counts in depth order.
@group(0) @binding(4) var<storage, read> sums: array<u32>;
@group(0) @binding(5) var<storage, read_write> first_pair: array<u32>;
@group(0) @binding(6) var<storage, read_write> pair_splat: array<u32>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> values: array<u32>;

@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = thread_number(group, groups, local);
    if rank >= status.visible || status.pairs == 0u {
        return;
    }
    let i = order[rank];
    var pair = sums[rank];
    let end = sums[rank + 1u];
    first_pair[i] = pair;
    let r = records[i];
    let tiles = views.view[i % views.count].tiles;
    let first_tile = views.view[i % views.count].first_tile;
    let box = tile_box(r, tiles);
    let e = ellipse(r);
    for (var y = box.first.y; y < box.end.y; y++) {
        for (var x = box.first.x; x < box.end.x; x++) {
            if overlaps(e, vec2<u32>(x, y)) {
                if pair < end {
                    pair_splat[pair] = i;
                    keys[pair] = first_tile + y * tiles.x + x;
                    values[pair] = pair;
                }
                pair++;
            }
        }
    }
    if pair != end {
        status.fault = 1u; // every thread writes the same value
    }
}
