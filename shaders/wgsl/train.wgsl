// Structs and constants of the training stages; see `train.rs` for the fields.

struct OptimiserState {
    // Finished steps, skipped ones included.
    steps_done: u32,
    // Updates of Adam.
    adam_steps: u32,
    // Steps skipped for a non-finite loss.
    steps_skipped: u32,
    // Views of the current epoch, and the sum of their mean absolute errors.
    epoch_views: u32,
    epoch_l1: f32,
    // Mean loss over the views of the last finished step.
    loss: f32,
    // 0: the current step is skipped, or its pairs overflowed.
    is_step_valid: u32,
    padding: u32,
    // Scale factors of the gradients of L1 and of SSIM, for each view of the step.
    gradient_scales: array<vec2<f32>, MAX_VIEWS>,
    // Scale factor of the gradient of the depth loss, for each view of the step.
    depth_scales: array<f32, MAX_VIEWS>,
}

// The target photo of one view.
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
    // Words of the first pixel weight and of the first target depth; 0: the photo has none.
    first_weight: u32,
    first_depth: u32,
    // Number of the exposure, from 1; 0: the render is shown as it is.
    exposure: u32,
    // Word of the first slope of the picture loss, three planes; 0: there are none.
    first_slope: u32,
}

// The target photos of a step.
struct Photos {
    count: u32,
    // Tiles of all photos.
    tiles: u32,
    // Weight of 1 - SSIM.
    lambda: f32,
    // 1: pixels are weighted by the share of their alpha that trainable splats contribute.
    share_weighted: u32,
    // 1: frames have the planes depth and trainable alpha.
    extras: u32,
    // Weight of the depth loss; 0 leaves it out.
    depth_weight: f32,
    // Sum of the views' picture losses, which the host computed, each times its weight.
    picture_loss: f32,
    padding: u32,
    photo: array<Photo, MAX_VIEWS>,
}

// Learning rates and regulariser weights of one step, for one bank of columns.
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
    // Elements from one column to the next.
    stride: u32,
    // Views of the step.
    views: u32,
    padding: vec2<u32>,
}

// Constants of a rearrangement of rows.
struct RearrangeConstants {
    // Rows after it.
    rows: u32,
    // Columns of the bank.
    columns: u32,
    // Elements from one column to the next.
    stride: u32,
    padding: u32,
}

// Constants of a step of the exposures.
struct ExposureConstants {
    // Number of exposures.
    rows: u32,
    // Learning rate.
    rate: f32,
    padding: vec2<u32>,
}

// A camera as given.
struct GivenPose {
    // Rows of the rotation from world to camera, each with a component of the offset from the mean camera, metres.
    rows: array<vec4<f32>, 3>,
    // Learning rate of translations in metres, relative to that of rotations.
    translation_rate: f32,
    padding: array<f32, 3>,
}

// Constants of a step of the poses.
struct PoseConstants {
    rate: f32,
    decay: f32,
    // Sum of the squared offsets, m^2.
    spread: f32,
    cameras: u32,
    // Views of the step.
    views: u32,
    // 1: the common motion of all cameras is removed.
    is_anchored: u32,
    padding: vec2<u32>,
    // Number of the displacement of each view, from 1; 0: it has none.
    row: array<vec4<u32>, 4>,
}

// The errors of a sensor, with their Adam state.
struct Sensor {
    // A motion of its cameras (metres, radians, in their axes), what ln(focal length) is greater by, seconds of its clock.
    values: array<f32, 8>,
    first: array<f32, 8>,
    second: array<f32, 8>,
    // Learning rates, of which that of a rotation is the share.
    rates: array<f32, 8>,
    // One over the number of its photos.
    share: f32,
    // Adam steps.
    steps: u32,
    padding: vec2<u32>,
}

// How the sensor of a camera displaces it.
struct SensorCamera {
    // Translation and rotation vector in a second of its clock.
    shift_per_second: vec3<f32>,
    // Number of the sensor, from 1; 0: none.
    sensor: u32,
    turn_per_second: vec3<f32>,
    padding: u32,
}

// Constants of a step of the sensors.
struct SensorConstants {
    rate: f32,
    decay: f32,
    cameras: u32,
    // Views of the step.
    views: u32,
    // Number of the camera of each view, from 1; 0: it has none.
    row: array<vec4<u32>, 4>,
}

// SSIM's 11-tap window: exp(-d^2 / (2 1.5^2)) for d = 0, 1, .. 5, normalised to a sum of one over the eleven taps.
const TAPS = array<f32, 6>(0.26601172, 0.21300554, 0.10936069, 0.036000773, 0.007598758, 0.00102838);
const RADIUS: u32 = 5u;
// Side of a tile with a halo of RADIUS pixels.
const HALO_SIDE: u32 = 26u;

// Byte i of an array of packed bytes, given its word.
fn byte_of(word: u32, i: u32) -> u32 {
    return (word >> (8u * (i % 4u))) & 0xffu;
}
