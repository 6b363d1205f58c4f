//! The differentiable 3D Gaussian splat renderer: colour, depth and transmittance of a view, and the gradient of every
//! parameter.
//!
//! [`cpu`] (SIMD and rayon) and `gpu` (feature `gpu`, wgpu) are independent backends with the same stages: project,
//! sort, bin, rasterize, rasterize_backward, reduce, project_backward. [`ForwardIntermediates`] and
//! [`BackwardIntermediates`] compare them stage by stage.
//!
//! Conventions are gsplat's (DESIGN section 4): EWA projection with 0.3 px² added to the 2D covariance, pixel centres
//! at `+½`, `α = min(0.999, o·exp(-½ dᵀΣ'⁻¹d))`, skipped under 1/255, front to back until `T·(1-α) ≤ 1e-4`, colour
//! `max(SH + ½, 0)`, background blended with the remaining transmittance.
//!
//! Architecture invariant: no files, no network, no clock. Results are bit-identical for the same input and instruction
//! set, whatever the number of threads.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod surface;

use scene::{Rigid, Splats};

/// Near plane, metres: nearer splats are culled.
pub const NEAR_METRES: f32 = 0.01;
/// EWA's low-pass filter, px²: added to the diagonal of the projected covariance (gsplat's `eps2d`).
pub const LOW_PASS: f32 = 0.3;
/// A splat is skipped at pixels where α is below this.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Upper clamp of α; the gradient of clamped values is zero.
pub const ALPHA_MAX: f32 = 0.999;
/// A pixel stops before its transmittance falls to this.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;

/// Frozen splats that are drawn with the trainable ones.
#[derive(Debug, Clone, Copy)]
pub struct Part<'a> {
    /// The splats.
    pub splats: &'a Splats,
    /// Takes their axes to the camera's, where theirs are not those of the trainable splats: the camera stands elsewhere for an object
    /// that moves.
    pub camera_from_part: Option<Rigid>,
}

impl<'a> Part<'a> {
    /// Splats in the axes of the trainable ones.
    pub fn beside(splats: &'a Splats) -> Self {
        Self { splats, camera_from_part: None }
    }
}

/// Rendering options.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Compensates opacity for the low-pass filter (Mip-Splatting's 2D filter, Yu et al. 2024), so that a splat smaller
    /// than a pixel fades instead of growing. Off: the classic 3DGS rasterizer.
    pub antialiased: bool,
    /// SH degree in use; clamped to that of the splats.
    pub sh_degree: u8,
    /// Background colour, sRGB 0..1.
    pub background: [f32; 3],
    /// Also render the planes `depth` and `trainable_alpha`; costs 10 % more.
    pub extras: bool,
    /// The plane `depth` is of inverse depths: Σ αT/z, 1/metres. A trace of sky behind a surface then has no weight,
    /// where it could double the mean depth.
    pub inverse_depth: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { antialiased: false, sh_degree: 3, background: [0.0; 3], extras: false, inverse_depth: false }
    }
}

/// A rendered view: planes of `width · height` floats, rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Red, green and blue planes, consecutive; sRGB, background included.
    pub colour: Vec<f32>,
    /// Remaining transmittance: 1 - alpha.
    pub transmittance: Vec<f32>,
    /// Σ αTz, metres, or Σ αT/z with [`Options::inverse_depth`]; empty without [`Options::extras`]. Divide by
    /// `1 - transmittance` for the mean.
    pub depth: Vec<f32>,
    /// Σ αT over the trainable splats, without the frozen parts; empty without [`Options::extras`].
    pub trainable_alpha: Vec<f32>,
}

/// The gradient of a loss with respect to a [`Frame`], in the same planes. An empty plane is zero.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Upstream {
    /// dL/d colour, three planes.
    pub colour: Vec<f32>,
    /// dL/d transmittance.
    pub transmittance: Vec<f32>,
    /// dL/d depth, the plane of [`Frame`].
    pub depth: Vec<f32>,
    /// dL/d trainable_alpha.
    pub trainable_alpha: Vec<f32>,
}

/// Results of the stages before `rasterize`, in a form that all backends share.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ForwardIntermediates {
    /// Indices of the visible splats, nearest first. Indices of frozen parts start after the trainable ones.
    pub order: Vec<u32>,
    /// The projected splats in this order: mean x, y (pixels); a, b, c, log2 opacity with
    /// `α = 2^(log2 opacity - (a dx + b dy)² - (c dy)²)`; red, green, blue; depth (metres, or its inverse); half extents x, y
    /// (pixels).
    pub records: Vec<[f32; 12]>,
    /// `pairs[start[t] .. start[t + 1]]` belong to tile `t` of 16×16 pixels (row-major).
    pub start: Vec<u32>,
    /// Indices into `order`, front to back within a tile.
    pub pairs: Vec<u32>,
}

/// Floats of the gradient moments of a (splat, tile) pair.
pub const MOMENTS: usize = 13;

/// Results of the stages `rasterize_backward` and `reduce` for trainable splats, in a form that all backends share.
///
/// A moment is a sum over pixels; the gradients of a projected splat are linear in its moments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BackwardIntermediates {
    /// Tile, splat and moments of each pair, by tile and then front to back.
    pub pairs: Vec<(u32, u32, [f32; MOMENTS])>,
    /// Index of each visible splat and the sums over its pairs, by index.
    pub splats: Vec<(u32, [f32; MOMENTS])>,
}

/// The gradient of a loss with respect to the trainable splats, and statistics for densification and pruning.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// Columns as in [`scene::Splats`]; zero where a splat is not visible. Columns of coefficients above the SH degree
    /// in use are not written.
    pub columns: Vec<Vec<f32>>,
    /// Bit `i % 16` of word `i / 16`: splat `i` is visible.
    pub seen: Vec<u16>,
    /// Norm of dL/d(mean in pixels), per splat (the densification criterion of 3DGS).
    pub screen_gradient: Vec<f32>,
    /// The same with absolute values summed over pixels (AbsGS, Ye et al. 2024).
    pub screen_gradient_abs: Vec<f32>,
    /// Σ αT over pixels, per splat.
    pub weight: Vec<f32>,
    /// dL/dξ for `camera_from_world ← exp(ξ)·camera_from_world`, ξ = (ρ metres, ω radians).
    pub pose: [f32; 6],
    /// dL/d ln(focal length), of both focal lengths together.
    pub focal: f32,
}

/// Contribution of each trainable splat to a view; sums over pixels, each times its weight. Zero where a splat is not
/// visible.
#[derive(Debug, Clone, Default)]
pub struct Contributions {
    /// Σ αT.
    pub weight: Vec<f32>,
    /// Σ (dI/dg)² over pixels and channels, with g the splat's Gaussian value before opacity (Speedy-Splat, Hanson et
    /// al. 2025).
    pub squared: Vec<f32>,
    /// Σ δ² over pixels and channels, with δ the exact change of the pixel if this splat alone is removed.
    pub energy: Vec<f32>,
}
