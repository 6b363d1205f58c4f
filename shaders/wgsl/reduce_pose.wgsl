// Stage `reduce_pose`: sums the terms of the gradients of the pose and the focal length of the visible trainable entries of each view, in a fixed
// order: POSE_BLOCKS workgroups per view, then one for all.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> visible: array<u32>;
// After one vector per trainable entry, two per visible trainable entry: the seven terms.
@group(0) @binding(3) var<storage, read> statistics: array<vec4<f32>>;
// Two vectors per workgroup of a view.
@group(0) @binding(4) var<storage, read_write> partials: array<vec4<f32>>;
// Two vectors per view.
@group(0) @binding(5) var<storage, read_write> poses: array<vec4<f32>>;

const POSE_BLOCKS: u32 = 64u;

@compute @workgroup_size(256)
fn reduce_pose(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let n = group.y * groups.x + group.x;
    let v = n / POSE_BLOCKS;
    var low = vec4<f32>(0.0);
    var high = vec4<f32>(0.0);
    for (var k = n % POSE_BLOCKS * WORKGROUP_SIZE + local; k < status.visible_trainable; k += POSE_BLOCKS * WORKGROUP_SIZE) {
        if visible[k] % views.count == v && views.view[v].displacement != 0u {
            let at = views.trainable_entries + 2u * k;
            low += statistics[at];
            high += statistics[at + 1u];
        }
    }
    low = workgroup_sum(low, local);
    workgroupBarrier(); // protects `totals` until all threads have read the sum
    high = workgroup_sum(high, local);
    if local == 0u && v < views.count {
        partials[2u * n] = low;
        partials[2u * n + 1u] = high;
    }
}

@compute @workgroup_size(256)
fn finish_pose(@builtin(local_invocation_index) local: u32) {
    for (var k = 0u; k < 2u * views.count; k++) {
        var value = vec4<f32>(0.0);
        if local < POSE_BLOCKS {
            value = partials[2u * (k / 2u * POSE_BLOCKS + local) + k % 2u];
        }
        let total = workgroup_sum(value, local);
        if local == 0u {
            poses[k] = total;
        }
        workgroupBarrier(); // as above
    }
}
