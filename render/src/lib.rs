//! The differentiable splat renderer: colour, depth and transmittance of a view, and the gradient of every parameter.
//!
//! The stages have the same names in every backend: project, sort, bin, rasterize, rasterize_backward, reduce,
//! project_backward. [`cpu`] is a first-class backend (SIMD and rayon), not a mirror of another; `gpu` (feature `gpu`) is
//! wgpu; [`Stages`] are for comparing them.
//!
//! Conventions are gsplat's (DESIGN section 4): EWA projection with 0.3 px² added to the 2D covariance, pixel centres at
//! `+½`, `α = min(0.999, o·exp(-½ dᵀΣ'⁻¹d))`, skipped under 1/255, front to back until `T·(1-α) ≤ 1e-4`,
//! colour `max(SH + ½, 0)`, background blended with the remaining transmittance.
//!
//! Architecture invariant: no files, no network, no clock. Same input, same instruction set: same bits, whatever the
//! number of threads.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;

/// Nearest depth that is drawn, metres.
pub const NEAR_METRES: f32 = 0.01;
/// Added to the diagonal of the projected covariance, px².
pub const BLUR: f32 = 0.3;
/// Contributions below this are skipped.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Opacity is clamped here; the gradient above is zero.
pub const ALPHA_MAX: f32 = 0.999;
/// A pixel is finished before its transmittance falls to this.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;

/// How a view is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Opacity compensated for the blur (Mip-Splatting's 2D filter), so that a splat smaller than a pixel fades
    /// instead of growing. Off: the classic 3DGS rasterizer.
    pub antialiased: bool,
    /// SH degree in use, at most that of the splats.
    pub sh_degree: u8,
    /// Colour behind everything, sRGB 0..1.
    pub background: [f32; 3],
    /// Also produce depth and the share of the trainable splats; costs a tenth more.
    pub extras: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { antialiased: false, sh_degree: 3, background: [0.0; 3], extras: false }
    }
}

/// What a view looks like: planes of `width · height` floats, rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Red, green and blue planes one after the other: sRGB, background included.
    pub colour: Vec<f32>,
    /// Remaining transmittance: 1 - alpha.
    pub transmittance: Vec<f32>,
    /// Σ αTz, metres; empty without [`Options::extras`]. Divide by `1 - transmittance` for the mean depth.
    pub depth: Vec<f32>,
    /// Σ αT over the trainable splats only; empty without [`Options::extras`].
    pub own: Vec<f32>,
}

/// The gradient of a loss with respect to a [`Frame`]: same planes. Empty planes are zero.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Upstream {
    /// dL/d colour, three planes.
    pub colour: Vec<f32>,
    /// dL/d transmittance.
    pub transmittance: Vec<f32>,
    /// dL/d depth (Σ αTz).
    pub depth: Vec<f32>,
}

/// What the stages before `rasterize` came to, in the same form from every backend: for comparing them stage by stage.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stages {
    /// Indices of the splats that were drawn, nearest first; those of the context follow on those of the trainable ones.
    pub order: Vec<u32>,
    /// For each of them, in this order: mean x, y (pixels); a, b, c, log2 opacity with
    /// `α = 2^(log2 opacity - (a dx + b dy)² - (c dy)²)`; red, green, blue; depth (metres); half extents x, y (pixels).
    pub records: Vec<[f32; 12]>,
    /// `pairs[start[t] .. start[t + 1]]` belong to tile `t` of 16×16 pixels (row-major).
    pub start: Vec<u32>,
    /// Places in `order`, front to back within a tile.
    pub pairs: Vec<u32>,
}

/// Sums that a pair of splat and tile hands to its splat.
pub const MOMENTS: usize = 13;

/// What the stages between `rasterize` and `project_backward` came to, of trainable splats, in the same form from every backend.
/// A moment is a sum over the pixels of a tile from which the gradients of a splat's record follow linearly.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    /// Tile, splat and moments of each pair, by tile and then front to back.
    pub pairs: Vec<(u32, u32, [f32; MOMENTS])>,
    /// Splat and the sums over its pairs, of those that were drawn, by index.
    pub splats: Vec<(u32, [f32; MOMENTS])>,
}

/// The gradient of a loss with respect to the trainable splats, and what growth and pruning want to know.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// Columns as in [`scene::Splats`]; zero where a splat was not seen. Coefficients above the SH degree in use are
    /// left as they were.
    pub columns: Vec<Vec<f32>>,
    /// Bit `i % 16` of word `i / 16`: splat `i` was drawn.
    pub seen: Vec<u16>,
    /// Length of dL/d(mean in pixels), per splat.
    pub screen: Vec<f32>,
    /// As `screen`, summed over pixels without cancellation (AbsGS).
    pub screen_abs: Vec<f32>,
    /// Σ over pixels of αT: how much of the view the splat explains, in pixels.
    pub weight: Vec<f32>,
    /// dL/dξ for `camera_from_world ← exp(ξ)·camera_from_world`, ξ = (ρ metres, ω radians).
    pub pose: [f32; 6],
}

/// What each trainable splat means to a view, in pixels that count as much as their weight says. Zero where not seen.
#[derive(Debug, Clone, Default)]
pub struct Contributions {
    /// Σ αT.
    pub weight: Vec<f32>,
    /// Σ (dI/dg)² over channels too, with g the splat's projected value before opacity (Speedy-Splat, Hanson et al. 2025).
    pub squared: Vec<f32>,
    /// Σ δ² over channels too, with δ the exact change of the pixel if this splat alone were not there.
    pub energy: Vec<f32>,
}
