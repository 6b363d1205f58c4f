// What all stages share: constants (those of `render`, which a test there compares), the views and their status.

const WORKGROUP_SIZE: u32 = 256u;
const TILE: u32 = 16u;
const MOMENTS: u32 = 13u;
// Views drawn side by side, at most.
const MAX_VIEWS: u32 = 16u;

const NEAR_METRES: f32 = 0.01;
const LOW_PASS: f32 = 0.3;
const ALPHA_MIN: f32 = 0.003921569;
const ALPHA_MAX: f32 = 0.999;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const SH_C0: f32 = 0.28209479;
const LOG2_E: f32 = 1.4426950;
const LN_2: f32 = 0.6931472;

// A camera and its window.
struct View {
    rows: array<vec4<f32>, 3>,
    centre: vec4<f32>,
    focal: vec2<f32>,
    principal: vec2<f32>,
    cone_min: vec2<f32>,
    cone_max: vec2<f32>,
    pixels: vec2<u32>,
    tiles: vec2<u32>,
    // Tiles and pixels of the views before this one.
    first_tile: u32,
    first_pixel: u32,
    padding: vec2<u32>,
}

// Views drawn side by side. What a splat is in a view is an entry: entry i of `count` views is splat i / count in view i % count,
// so that those of a splat are neighbours.
struct Views {
    background: vec4<f32>,
    count: u32,
    // Tiles and pixels of all.
    tiles: u32,
    pixels: u32,
    // Entries of the trainable splats; of these and the context.
    trainable_entries: u32,
    entries: u32,
    pair_capacity: u32,
    antialiased: u32,
    extras: u32,
    view: array<View, MAX_VIEWS>,
}

struct SplatSet {
    first: u32,
    count: u32,
    stride: u32,
    sh_degree: u32,
}

struct UpstreamPlanes {
    transmittance: u32,
    depth: u32,
    padding: vec2<u32>,
}

struct Status {
    overflow: u32,
    fault: u32,
    pairs: u32,
    max_pairs: u32,
    visible: u32,
    visible_trainable: u32,
    entry_scan_len: u32,
    visible_scan_len: u32,
    visible_histogram_len: u32,
    pair_histogram_len: u32,
}

// A splat in the view. The ellipse is the conic's Cholesky factor for exponents of two:
// alpha = 2^(log2_opacity - (a dx + b dy)^2 - (c dy)^2); the conic itself would cancel along needles.
struct Record {
    // Mean in pixels, a, b.
    mean_ab: vec4<f32>,
    // c, log2 of the opacity, half extents in pixels of the ellipse at alpha = 1/255.
    c_opacity_extent: vec4<f32>,
    // Colour, clamped from below at 0; depth in metres.
    colour_depth: vec4<f32>,
}

// The number of a thread in a dispatch of one or two dimensions of workgroups.
fn thread_number(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
}

// UpstreamPlanes of a frame.
fn frame_planes(extras: u32) -> u32 {
    return select(4u, 6u, extras != 0u);
}

// By bits: compilers may take comparisons for granted that only NaN fails.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
