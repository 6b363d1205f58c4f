// What training keeps on the device from step to step, and what a step's loss is made of.

struct OptimiserState {
    // Steps that are over, those left out included.
    steps_done: u32,
    // Steps of Adam.
    adam_steps: u32,
    // Steps left out, as their loss was not finite.
    steps_skipped: u32,
    // Of the epoch under way: views, and the sum of their mean absolute errors.
    epoch_views: u32,
    epoch_l1: f32,
    // Of the last step: the mean loss of its views, and whether it counts.
    loss: f32,
    is_step_valid: u32,
    padding: u32,
    // Of each of its views: what gradients of L1 and of SSIM are scaled by.
    gradient_scales: array<vec2<f32>, MAX_VIEWS>,
}

// A photo beside a frame.
struct Photo {
    width: u32,
    height: u32,
    // Width and height in tiles.
    tiles_x: u32,
    tiles_y: u32,
    // Tiles, pixels and bytes of the photos before this one.
    first_tile: u32,
    first_pixel: u32,
    first_byte: u32,
    // 1: the photo has a mask.
    masked: u32,
}

// The photos of a step.
struct Photos {
    count: u32,
    // Of all.
    tiles: u32,
    // Weight of 1 - SSIM.
    lambda: f32,
    // 1: a pixel counts by the share of it that the trainable splats explain.
    share_weighted: u32,
    photo: array<Photo, MAX_VIEWS>,
}

// Step sizes of one step and the pull of the regularisers, for one bank of columns.
struct AdamConstants {
    mean: f32,
    log_scale: f32,
    quat: f32,
    opacity: f32,
    sh_dc: f32,
    sh_rest: f32,
    beta2: f32,
    opacity_reg: f32,
    needle_reg: f32,
    log_scale_min: f32,
    log_scale_max: f32,
    // Columns of the bank that the SH degree uses.
    columns: u32,
    // Entries from a column to the next.
    stride: u32,
    // Views of the step.
    views: u32,
    padding: vec2<u32>,
}

// SSIM's window: exp(-d^2 / (2 1.5^2)) for d = 0, 1, .. 5, normalised so that the eleven taps sum to one.
const TAPS = array<f32, 6>(0.26601172, 0.21300554, 0.10936069, 0.036000773, 0.007598758, 0.00102838);
const RADIUS: u32 = 5u;
// Side of a tile with all that the photos of its pixels reach.
const HALO_SIDE: u32 = 26u;

// A byte of packed ones.
fn byte_of(word: u32, i: u32) -> u32 {
    return (word >> (8u * (i % 4u))) & 0xffu;
}
