// Stage `compact`: stream compaction of the visible entries, with their depths as sort keys.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read> is_visible: array<u32>;
@group(0) @binding(2) var<storage, read> sums: array<u32>;
@group(0) @binding(3) var<storage, read> records: array<Record>;
@group(0) @binding(4) var<storage, read_write> visible: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;

@compute @workgroup_size(256)
fn compact(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = thread_number(group, groups, local);
    if i >= views.entries || is_visible[i] == 0u {
        return;
    }
    visible[sums[i]] = i;
    // Positive floats sort as their bits.
    keys[sums[i]] = bitcast<u32>(records[i].colour_depth.w);
}
