// Stage `adam`: an Adam update of the splats that the step's views see; one thread per splat, one dispatch per bank of
// columns. Invisible splats keep their parameters and moments: a missing observation is not a zero gradient.

@group(0) @binding(0) var<uniform> adam: AdamConstants;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> state: OptimiserState;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
// One bank of the columns of splats, moments and gradients.
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read_write> first_moment: array<f32>;
@group(0) @binding(6) var<storage, read_write> second_moment: array<f32>;
@group(0) @binding(7) var<storage, read> gradients: array<f32>;

const F32_MAX: f32 = 3.4028234e38;
const LN_10: f32 = 2.3025851;
// Marks a thread without a splat.
const NO_SPLAT: u32 = 0xffffffffu;

// Bias corrections 1 / (1 - beta^t) of both moments.
fn corrections() -> vec2<f32> {
    let t = state.adam_steps;
    return vec2<f32>(1.0 / (1.0 - power(BETA1, t)), 1.0 / (1.0 - power(adam.beta2, t)));
}

// Updates column k of the bank.
fn update_column(k: u32, i: u32, correction: vec2<f32>, rate: f32, regulariser: f32, low: f32, high: f32) {
    let at = k * adam.stride + i;
    let value = values[at];
    let gradient = gradients[at] + regulariser;
    let m = fma(BETA1, first_moment[at], (1.0 - BETA1) * gradient);
    let v = fma(adam.beta2, second_moment[at], (1.0 - adam.beta2) * gradient * gradient);
    let next = value - rate * correction.x * m / (sqrt(v * correction.y) + EPSILON);
    // A non-finite gradient or value skips the update.
    if is_finite(gradient) && is_finite(next) {
        values[at] = clamp(next, low, high);
        first_moment[at] = m;
        second_moment[at] = v;
    }
}

fn splat_of_thread(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    let entry = thread_number(group, groups, local);
    if entry >= status.visible_trainable || state.is_step_valid == 0u {
        return NO_SPLAT;
    }
    let i = visible[entry] / adam.views;
    // The visible entries of a splat are adjacent; the first of them updates the splat.
    if entry > 0u && visible[entry - 1u] / adam.views == i {
        return NO_SPLAT;
    }
    return i;
}

// The first_moment bank: mean, ln(scale), quaternion, opacity, constant colour.
@compute @workgroup_size(256)
fn adam_shape(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = splat_of_thread(group, groups, local);
    if i == NO_SPLAT {
        return;
    }
    let n = adam.stride;
    let c = corrections();
    let scales = vec3<f32>(values[3u * n + i], values[4u * n + i], values[5u * n + i]);
    let logit = values[10u * n + i];
    let size = exp2((scales.x + scales.y + scales.z) * (LOG2_E / 3.0));
    for (var k = 0u; k < 3u; k++) {
        update_column(k, i, c, size * adam.mean, 0.0, -F32_MAX, F32_MAX);
    }
    let longest = max(max(scales.x, scales.y), scales.z);
    let shortest = min(min(scales.x, scales.y), scales.z);
    let middle = scales.x + scales.y + scales.z - longest - shortest;
    let is_needle = LN_10 < longest - middle;
    for (var k = 0u; k < 3u; k++) {
        let regulariser = select(0.0, adam.needle_reg / f32(status.visible_trainable), is_needle && longest <= scales[k]);
        update_column(3u + k, i, c, adam.log_scale, regulariser, adam.log_scale_min, adam.log_scale_max);
    }
    for (var k = 6u; k < 10u; k++) {
        update_column(k, i, c, adam.quat, 0.0, -F32_MAX, F32_MAX);
    }
    let opacity = 1.0 / (1.0 + exp2(-LOG2_E * logit));
    let regulariser = opacity * (1.0 - opacity) * (adam.opacity_reg / f32(status.visible_trainable));
    update_column(10u, i, c, adam.opacity, regulariser, -15.0, 15.0);
    for (var k = 11u; k < 14u; k++) {
        update_column(k, i, c, adam.sh_dc, 0.0, -F32_MAX, F32_MAX);
    }
}

// The other banks: coefficients above the constant.
@compute @workgroup_size(256)
fn adam_colour(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = splat_of_thread(group, groups, local);
    if i == NO_SPLAT {
        return;
    }
    let c = corrections();
    for (var k = 0u; k < adam.columns; k++) {
        update_column(k, i, c, adam.sh_rest, 0.0, -F32_MAX, F32_MAX);
    }
}
