//! The GPU stages of training: loss, Adam, exposures, poses and densification statistics, with their layouts.

use bytemuck::{Pod, Zeroable};

use crate::{MAX_VIEWS, SUM, Stage, VIEW};

/// Structs and constants of the training stages.
const TRAIN: &str = include_str!("../wgsl/train.wgsl");
/// Constants of Adam, and powers.
const POWER: &str = include_str!("../wgsl/power.wgsl");

/// `loss.wgsl`
pub const LOSS: Stage = Stage::new(
    "loss",
    &[VIEW, TRAIN, SUM, include_str!("../wgsl/loss.wgsl")],
    &["loss_forward", "finish_loss", "loss_backward"],
);
/// `adam.wgsl`
pub const ADAM: Stage =
    Stage::new("adam", &[VIEW, TRAIN, POWER, include_str!("../wgsl/adam.wgsl")], &["adam_shape", "adam_colour"]);
/// `exposure.wgsl`
pub const EXPOSURE: Stage = Stage::new(
    "exposure",
    &[VIEW, TRAIN, SUM, POWER, include_str!("../wgsl/exposure.wgsl")],
    &["expose_backward", "exposure_step"],
);
/// `densification_stats.wgsl`
pub const DENSIFICATION_STATS: Stage = Stage::new(
    "densification_stats",
    &[VIEW, TRAIN, include_str!("../wgsl/densification_stats.wgsl")],
    &["densification_stats"],
);
/// `rearrange.wgsl`
pub const REARRANGE: Stage =
    Stage::new("rearrange", &[VIEW, TRAIN, include_str!("../wgsl/rearrange.wgsl")], &["rearrange"]);
/// `pose.wgsl`
pub const POSE: Stage =
    Stage::new("pose", &[VIEW, TRAIN, SUM, POWER, include_str!("../wgsl/pose.wgsl")], &["pose_step"]);
/// `sensor.wgsl`
pub const SENSOR: Stage = Stage::new(
    "sensor",
    &[VIEW, TRAIN, POWER, include_str!("../wgsl/sensor.wgsl")],
    &["sensor_step", "sum_displacements"],
);
/// Every stage of training.
pub const STAGES: &[Stage] = &[LOSS, ADAM, EXPOSURE, POSE, SENSOR, DENSIFICATION_STATS, REARRANGE];

/// Counters and losses that stay on the device between steps.
///
/// A step with a non-finite loss is skipped and counts as done. A step whose pairs overflowed the buffers is not done.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct OptimiserState {
    /// Finished steps, skipped ones included.
    pub steps_done: u32,
    /// Updates of Adam: the t of its bias correction.
    pub adam_steps: u32,
    /// Steps skipped for a non-finite loss.
    pub steps_skipped: u32,
    /// Views summed in `epoch_l1`.
    pub epoch_views: u32,
    /// Sum of the mean absolute errors of the current epoch's views.
    pub epoch_l1: f32,
    /// Mean loss over the views of the last finished step.
    pub loss: f32,
    /// 1: the current step updates the splats; 0: it is skipped, or its pairs overflowed.
    pub is_step_valid: u32,
    /// Padding.
    pub padding: u32,
    /// Scale factors of the gradients of L1 and of SSIM, for each view of the step.
    pub gradient_scales: [[f32; 2]; MAX_VIEWS],
    /// Scale factor of the gradient of the depth loss, for each view of the step.
    pub depth_scales: [f32; MAX_VIEWS],
}

/// The target photo of one view.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Photo {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Width in tiles.
    pub tiles_x: u32,
    /// Height in tiles.
    pub tiles_y: u32,
    /// Number of tiles of the photos before this one.
    pub first_tile: u32,
    /// Number of pixels of the photos before this one.
    pub first_pixel: u32,
    /// Number of bytes of the photos before this one.
    pub first_byte: u32,
    /// 1: the photo has a mask.
    pub masked: u32,
    /// Word of the first pixel weight; 0: the photo has none.
    pub first_weight: u32,
    /// Word of the first target depth; 0: the photo has none.
    pub first_depth: u32,
    /// Number of the exposure, from 1; 0: the render is shown as it is.
    pub exposure: u32,
    /// Word of the first slope of the picture loss, three planes; 0: there are none.
    pub first_slope: u32,
}

/// The target photos of a step. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Photos {
    /// Number of photos.
    pub count: u32,
    /// Tiles of all photos.
    pub tiles: u32,
    /// Weight of 1 - SSIM.
    pub lambda: f32,
    /// 1: pixels are weighted by the share of their alpha that trainable splats contribute.
    pub share_weighted: u32,
    /// 1: frames have the planes depth and trainable alpha.
    pub extras: u32,
    /// Weight of the depth loss; 0 leaves it out. Needs `extras`.
    pub depth_weight: f32,
    /// Sum of the views' picture losses, which the host computed, each times its weight.
    pub picture_loss: f32,
    /// Padding.
    pub padding: u32,
    /// The photos; only the first `count` are defined.
    pub photo: [Photo; MAX_VIEWS],
}

/// Old row of a row that continues none, see `rearrange.wgsl`.
pub const NO_ROW: u32 = u32::MAX;

/// Constants of a rearrangement of rows. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct RearrangeConstants {
    /// Number of rows after it.
    pub rows: u32,
    /// Number of columns of the bank.
    pub columns: u32,
    /// Elements from one column to the next.
    pub stride: u32,
    /// Padding.
    pub padding: u32,
}

/// Constants of a step of the exposures. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ExposureConstants {
    /// Number of exposures.
    pub rows: u32,
    /// Learning rate.
    pub rate: f32,
    /// Padding.
    pub padding: [u32; 2],
}

/// A camera as given, which its displacement refers to.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct GivenPose {
    /// Rows of the rotation from world to camera, each with a component of the camera's offset from the mean of all, in
    /// the world's axes, metres.
    pub rows: [[f32; 4]; 3],
    /// Learning rate of translations in metres, relative to that of rotations.
    pub translation_rate: f32,
    /// Padding.
    pub padding: [f32; 3],
}

/// Constants of a step of the poses. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct PoseConstants {
    /// Learning rate of rotations, radians.
    pub rate: f32,
    /// Share of the displacement of a view in the step that is taken back.
    pub decay: f32,
    /// Sum of the squared offsets of the cameras, m².
    pub spread: f32,
    /// Number of cameras.
    pub cameras: u32,
    /// Views of the step.
    pub views: u32,
    /// 1: the common motion of all cameras is removed.
    pub is_anchored: u32,
    /// Padding.
    pub padding: [u32; 2],
    /// Number of the displacement of each view of the step, from 1; 0: it has none.
    pub row: [u32; MAX_VIEWS],
}

/// The errors of a sensor, with their Adam state.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Sensor {
    /// A motion of its cameras in their axes (translation in metres, rotation vector in radians), what ln(focal length) is
    /// greater by, and seconds of its clock.
    pub values: [f32; 8],
    /// First moments.
    pub first: [f32; 8],
    /// Second moments.
    pub second: [f32; 8],
    /// Learning rates, of which that of a rotation is the share.
    pub rates: [f32; 8],
    /// One over the number of its photos.
    pub share: f32,
    /// Adam steps.
    pub steps: u32,
    /// Padding.
    pub padding: [u32; 2],
}

/// How the sensor of a camera displaces it.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SensorCamera {
    /// Translation in a second of the sensor's clock, metres, in the camera's axes.
    pub shift_per_second: [f32; 3],
    /// Number of the sensor, from 1; 0: none.
    pub sensor: u32,
    /// Rotation vector in a second of the sensor's clock, radians, in the camera's axes.
    pub turn_per_second: [f32; 3],
    /// Padding.
    pub padding: u32,
}

/// Constants of a step of the sensors. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SensorConstants {
    /// Learning rate of rotations, radians, times the number of photos.
    pub rate: f32,
    /// Share of the errors that is taken back, times the number of photos.
    pub decay: f32,
    /// Number of cameras.
    pub cameras: u32,
    /// Views of the step.
    pub views: u32,
    /// Number of the camera of each view of the step, from 1; 0: it has none.
    pub row: [u32; MAX_VIEWS],
}

/// Learning rates and regulariser weights of one step, for one bank of columns. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct AdamConstants {
    /// Learning rate of the mean, in units of the splat's size.
    pub mean: f32,
    /// Learning rate of ln(scale).
    pub log_scale: f32,
    /// Learning rate of the quaternion.
    pub quat: f32,
    /// Learning rate of the opacity logit.
    pub opacity: f32,
    /// Learning rate of the constant SH coefficient.
    pub sh_dc: f32,
    /// Learning rate of the other SH coefficients.
    pub sh_rest: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Weight of the mean opacity of visible splats in the loss.
    pub opacity_reg: f32,
    /// Weight of the needle penalty of visible splats in the loss.
    pub needle_reg: f32,
    /// Lower bound of ln(scale).
    pub log_scale_min: f32,
    /// Upper bound of ln(scale).
    pub log_scale_max: f32,
    /// Columns of the bank that the SH degree uses.
    pub columns: u32,
    /// Entries from one column to the next.
    pub stride: u32,
    /// Views of the step.
    pub views: u32,
    /// Padding.
    pub padding: [u32; 2],
}
