// Shared by all stages: constants (equal to those of `render`, which a test compares), the views and the status. See
// `lib.rs` for the fields.

const WORKGROUP_SIZE: u32 = 256u;
const TILE: u32 = 16u;
const MOMENTS: u32 = 13u;
// Largest number of views in one dispatch.
const MAX_VIEWS: u32 = 16u;

const NEAR_METRES: f32 = 0.01;
const LOW_PASS: f32 = 0.3;
const ALPHA_MIN: f32 = 0.003921569;
const ALPHA_MAX: f32 = 0.999;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const SH_C0: f32 = 0.28209479;
const LOG2_E: f32 = 1.4426950;
const LN_2: f32 = 0.6931472;

// A camera and the offsets of its view in the shared buffers.
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
    // Number of the camera's displacement, from 1; 0: it is not displaced, and there is no gradient of its pose.
    displacement: u32,
    padding: u32,
}

// The views of a dispatch. Entry i of `count` views is splat i / count in view i % count, so the entries of a splat are
// adjacent.
struct Views {
    background: vec4<f32>,
    count: u32,
    // Tiles and pixels of all views.
    tiles: u32,
    pixels: u32,
    // Entries of the trainable splats; entries of these and of the context.
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

// A projected splat. a, b, c are the Cholesky factor of the conic, scaled for base 2:
// alpha = 2^(log2_opacity - (a dx + b dy)^2 - (c dy)^2). Evaluating the conic itself cancels along needles.
struct Record {
    // Mean in pixels; a, b.
    mean_ab: vec4<f32>,
    // c, log2 of the opacity, half extents of the ellipse at alpha = 1/255 in pixels.
    c_opacity_extent: vec4<f32>,
    // Colour, clamped below at 0; depth in metres.
    colour_depth: vec4<f32>,
}

// Number of a thread in a one- or two-dimensional dispatch.
fn thread_number(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
}

// Value of `Views::extras` for a plane of inverse depths.
const INVERSE_DEPTH = 2u;

// Number of planes of a frame.
fn frame_planes(extras: u32) -> u32 {
    return select(4u, 6u, extras != 0u);
}

// On bits, as compilers may assume that there is no NaN.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
