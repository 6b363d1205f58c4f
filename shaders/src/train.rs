//! The stages of training on the GPU: the loss, the step of Adam, and what growth goes by.

use bytemuck::{Pod, Zeroable};

use crate::{MOST_VIEWS, Stage, VIEW};

/// What training keeps on the device, and the constants of its stages.
const BOOKS: &str = include_str!("../wgsl/books.wgsl");

/// `loss.wgsl`
pub const LOSS: Stage =
    Stage::new("loss", &[VIEW, BOOKS, include_str!("../wgsl/loss.wgsl")], &["loss_forward", "judge", "loss_backward"]);
/// `adam.wgsl`
pub const ADAM: Stage =
    Stage::new("adam", &[VIEW, BOOKS, include_str!("../wgsl/adam.wgsl")], &["adam_shape", "adam_colour"]);
/// `evidence.wgsl`
pub const EVIDENCE: Stage =
    Stage::new("evidence", &[VIEW, BOOKS, include_str!("../wgsl/evidence.wgsl")], &["evidence"]);
/// Every stage of training.
pub const STAGES: &[Stage] = &[LOSS, ADAM, EVIDENCE];

/// What training keeps on the device from step to step. A step that is left out, as its loss is not finite, is done and
/// skipped; one whose pairs had no room is not done.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Books {
    /// Steps that are over.
    pub done: u32,
    /// Steps of Adam.
    pub adam_steps: u32,
    /// Steps left out.
    pub skipped: u32,
    /// Views in `sum`.
    pub count: u32,
    /// Mean absolute errors of the epoch under way.
    pub sum: f32,
    /// Mean over the views of the last step that is over.
    pub loss: f32,
    /// 1: the step under way counts.
    pub good: u32,
    /// Not used.
    pub padding: u32,
    /// Of each view of a step: what the gradients of L1 and of SSIM are scaled by.
    pub scales: [[f32; 2]; MOST_VIEWS],
}

/// A photo beside a frame.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Window {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Width in tiles.
    pub tiles_x: u32,
    /// Height in tiles.
    pub tiles_y: u32,
    /// Tiles of the photos before this one.
    pub first_tile: u32,
    /// Pixels of the photos before this one.
    pub first_pixel: u32,
    /// Bytes of the photos before this one.
    pub first_byte: u32,
    /// 1: the photo has a mask.
    pub masked: u32,
}

/// The photos of a step. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Windows {
    /// How many there are.
    pub count: u32,
    /// Tiles of all.
    pub tiles: u32,
    /// Weight of 1 - SSIM.
    pub lambda: f32,
    /// 1: a pixel counts by the share of it that the trainable splats explain.
    pub by_share: u32,
    /// Each; those past `count` mean nothing.
    pub each: [Window; MOST_VIEWS],
}

/// Step sizes of one step and the pull of the regularisers, for one bank of columns. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Rates {
    /// Step of the mean in units of the splat's size.
    pub mean: f32,
    /// Step of ln(scale).
    pub log_scale: f32,
    /// Step of the quaternion.
    pub quat: f32,
    /// Step of the opacity's logit.
    pub opacity: f32,
    /// Step of the constant colour coefficient.
    pub sh_dc: f32,
    /// Step of the other coefficients.
    pub sh_rest: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Weight of the mean opacity of seen splats in the loss.
    pub opacity_pull: f32,
    /// Weight of the mean excess of needles among seen splats.
    pub needle_pull: f32,
    /// Bounds of ln(scale).
    pub log_scale_min: f32,
    /// See `log_scale_min`.
    pub log_scale_max: f32,
    /// Columns of the bank that the SH degree uses.
    pub columns: u32,
    /// Entries from a column to the next.
    pub stride: u32,
    /// Views of the step.
    pub views: u32,
    /// Not used.
    pub padding: [u32; 2],
}
