// Stage `densification_stats`: what the views of a step say of the splats that they have seen, for the next refinement; a thread a splat.

@group(0) @binding(0) var<uniform> adam: AdamConstants;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> state: OptimiserState;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
// Of each entry: length of the mean's gradient in pixels, the same summed without cancellation, sum of alpha T, pixels of the view,
// which undo the loss's mean.
@group(0) @binding(4) var<storage, read> statistics: array<vec4<f32>>;
// Columns: sum of that gradient without cancellation, largest sum of alpha T.
@group(0) @binding(5) var<storage, read_write> accumulated: array<f32>;
@group(0) @binding(6) var<storage, read_write> views: array<u32>;

@compute @workgroup_size(256)
fn densification_stats(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let first = thread_number(group, groups, local);
    if first >= status.visible_trainable || state.is_step_valid == 0u {
        return;
    }
    let i = visible[first] / adam.views;
    if first > 0u && visible[first - 1u] / adam.views == i {
        return; // another thread's
    }
    let n = adam.stride;
    for (var entry = first; entry < status.visible_trainable && visible[entry] / adam.views == i; entry++) {
        accumulated[i] += statistics[entry].y * statistics[entry].w;
        accumulated[n + i] = max(accumulated[n + i], statistics[entry].z);
        views[i]++;
    }
}
