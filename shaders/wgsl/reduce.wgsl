// Stage `reduce`: sums the moments of the pairs of each visible trainable entry, in the order of its tiles; sixteen
// threads per entry, one per moment.

@group(0) @binding(0) var<storage, read> status: Status;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> first_pair: array<u32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read> moments: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(256)
fn reduce(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let entry = thread_number(group, groups, local) / 16u;
    let moment = local % 16u;
    if entry >= status.visible_trainable || moment >= MOMENTS {
        return;
    }
    let i = visible[entry];
    let count = tiles[i];
    var total = 0.0;
    if count > 0u {
        let start = first_pair[i];
        for (var pair = start; pair < start + count; pair++) {
            total += moments[pair * MOMENTS + moment];
        }
    }
    sums[entry * MOMENTS + moment] = total;
}
