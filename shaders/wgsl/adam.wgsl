// Stage `adam`: a step of the splats that the step's views have seen; a thread a splat, a dispatch a bank of columns. A splat outside
// of them keeps its parameters and its moments: its gradient is not zero, it is unknown.

@group(0) @binding(0) var<uniform> rates: Rates;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> books: Books;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
// A bank of the splats' columns, of both moments and of the gradient.
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read_write> first: array<f32>;
@group(0) @binding(6) var<storage, read_write> second: array<f32>;
@group(0) @binding(7) var<storage, read> gradients: array<f32>;

const BETA1: f32 = 0.9;
const EPSILON: f32 = 1e-15;
const LARGEST: f32 = 3.4028234e38;
const LN_10: f32 = 2.3025851;
// No splat's index.
const NOBODY: u32 = 0xffffffffu;

// By multiplication alone, so that it depends on nothing but its arguments.
fn power(base: f32, exponent: u32) -> f32 {
    var result = 1.0;
    var square = base;
    for (var n = exponent; n > 0u; n >>= 1u) {
        if (n & 1u) == 1u {
            result *= square;
        }
        square *= square;
    }
    return result;
}

// 1 / (1 - beta^t) of both moments.
fn corrections() -> vec2<f32> {
    let t = books.adam_steps;
    return vec2<f32>(1.0 / (1.0 - power(BETA1, t)), 1.0 / (1.0 - power(rates.beta2, t)));
}

// Column k of the bank.
fn move_column(k: u32, i: u32, correction: vec2<f32>, rate: f32, pull: f32, lowest: f32, highest: f32) {
    let at = k * rates.stride + i;
    let value = values[at];
    let gradient = gradients[at] + pull;
    let m = fma(BETA1, first[at], (1.0 - BETA1) * gradient);
    let v = fma(rates.beta2, second[at], (1.0 - rates.beta2) * gradient * gradient);
    let next = value - rate * correction.x * m / (sqrt(v * correction.y) + EPSILON);
    // A gradient that is not finite moves nothing.
    if is_finite(gradient) && is_finite(next) {
        values[at] = clamp(next, lowest, highest);
        first[at] = m;
        second[at] = v;
    }
}

fn splat_of(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    let place = linear(group, groups, local);
    if place >= status.seen || books.good == 0u {
        return NOBODY;
    }
    let i = visible[place] / rates.views;
    // What other views saw of the same splat lies beside it: the first of them is its thread.
    if place > 0u && visible[place - 1u] / rates.views == i {
        return NOBODY;
    }
    return i;
}

// The first bank: mean, ln(scale), quaternion, opacity, constant colour.
@compute @workgroup_size(256)
fn adam_shape(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = splat_of(group, groups, local);
    if i == NOBODY {
        return;
    }
    let n = rates.stride;
    let c = corrections();
    let scales = vec3<f32>(values[3u * n + i], values[4u * n + i], values[5u * n + i]);
    let logit = values[10u * n + i];
    let size = exp2((scales.x + scales.y + scales.z) * (LOG2_E / 3.0));
    for (var k = 0u; k < 3u; k++) {
        move_column(k, i, c, size * rates.mean, 0.0, -LARGEST, LARGEST);
    }
    let longest = max(max(scales.x, scales.y), scales.z);
    let shortest = min(min(scales.x, scales.y), scales.z);
    let middle = scales.x + scales.y + scales.z - longest - shortest;
    let is_needle = LN_10 < longest - middle;
    for (var k = 0u; k < 3u; k++) {
        let pull = select(0.0, rates.needle_pull / f32(status.seen), is_needle && longest <= scales[k]);
        move_column(3u + k, i, c, rates.log_scale, pull, rates.log_scale_min, rates.log_scale_max);
    }
    for (var k = 6u; k < 10u; k++) {
        move_column(k, i, c, rates.quat, 0.0, -LARGEST, LARGEST);
    }
    let opacity = 1.0 / (1.0 + exp2(-LOG2_E * logit));
    let pull = opacity * (1.0 - opacity) * (rates.opacity_pull / f32(status.seen));
    move_column(10u, i, c, rates.opacity, pull, -15.0, 15.0);
    for (var k = 11u; k < 14u; k++) {
        move_column(k, i, c, rates.sh_dc, 0.0, -LARGEST, LARGEST);
    }
}

// The other banks: coefficients above the constant.
@compute @workgroup_size(256)
fn adam_colour(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = splat_of(group, groups, local);
    if i == NOBODY {
        return;
    }
    let c = corrections();
    for (var k = 0u; k < rates.columns; k++) {
        move_column(k, i, c, rates.sh_rest, 0.0, -LARGEST, LARGEST);
    }
}
