// Stage `densification_stats`: accumulates the screen-space gradients of the splats that the step's views see; one thread
// per splat.

@group(0) @binding(0) var<uniform> adam: AdamConstants;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> state: OptimiserState;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
// For each visible trainable entry: norm of the mean's gradient in pixels, the same with absolute values summed, sum of
// alpha T, pixels of the view. The last undoes the loss's mean over pixels.
@group(0) @binding(4) var<storage, read> statistics: array<vec4<f32>>;
// Sum of the absolute screen-space gradient.
@group(0) @binding(5) var<storage, read_write> accumulated: array<f32>;

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
        return; // the thread of the splat's first visible entry handles it
    }
    for (var entry = first; entry < status.visible_trainable && visible[entry] / adam.views == i; entry++) {
        accumulated[i] += statistics[entry].y * statistics[entry].w;
    }
}
