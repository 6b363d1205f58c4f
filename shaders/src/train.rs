//! The stages of training on the GPU: the loss, the step of Adam, and what growth goes by.

use bytemuck::{Pod, Zeroable};

use crate::{Stage, VIEW};

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
    /// Steps in `sum`.
    pub count: u32,
    /// Mean absolute errors of the epoch under way.
    pub sum: f32,
    /// Of the last step that is over.
    pub loss: f32,
    /// 1: the step under way counts.
    pub good: u32,
    /// What the gradient of L1 is scaled by.
    pub l1_scale: f32,
    /// What the gradient of SSIM is scaled by.
    pub ssim_scale: f32,
}

/// A photo beside a frame. Uniform.
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
    /// Weight of 1 - SSIM.
    pub lambda: f32,
    /// 1: the photo has a mask.
    pub masked: u32,
    /// 1: a pixel counts by the share of it that the trainable splats explain.
    pub by_share: u32,
    /// Not used.
    pub padding: u32,
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
    /// Pixels of the window.
    pub pixels: f32,
    /// Not used.
    pub padding: [u32; 2],
}
