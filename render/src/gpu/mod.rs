//! The GPU backend: wgpu over Vulkan, Metal or DirectX 12, with the WGSL stages of the crate `shaders`.
//!
//! Data flow of a forward and a backward pass over one or more views; every arrow is a buffer that stays on the device:
//! ```text
//! splats ─project→ records ─compact→ visible ─sort by depth→ order ─emit→ pairs ─sort by tile→ ranges ─rasterize→ frame
//! upstream ─rasterize_backward→ moments per pair ─reduce→ moments per splat ─project_backward→ gradients
//! ```
//! A displacement of a camera is applied on the device, by `displace` before `project`; `reduce_pose` sums its gradient
//! after `project_backward`.
//!
//! Several views share each dispatch. An *entry* is one splat in one view; the entries of a splat are adjacent, and the
//! tiles of the views are numbered consecutively. All entries are sorted together, which keeps the order within each
//! tile, so every view is bit-identical to a pass over that view alone.
//!
//! Only the device knows how many splats are visible and how many (splat, tile) pairs they produce: stage `plan` writes
//! the arguments of the indirect dispatches. Pair buffers have a fixed capacity. A pass with more pairs sets a sticky
//! overflow flag, and nothing is drawn or trained until the host grows the buffers
//! ([`GpuRenderer::grow_after_overflow`]).
//!
//! Floats are never added atomically in the default path: the same adapter gives the same bits.

mod backward;
mod buffer;
mod device;
mod error;
mod forward;
mod kernel;
mod memory_cap;
mod options;
mod pipeline;
mod readback;
mod renderer;
mod sizes;
mod sort;
mod splats;
#[cfg(test)]
mod testing;
mod timestamp_recorder;
mod timestamps;
mod views;

pub use backward::Reduction;
pub use buffer::{Buffer, GrowableBuffer};
pub use device::Gpu;
pub use error::GpuError;
pub use kernel::Kernel;
pub use options::{GpuOptions, Path};
pub use renderer::{Displacements, GpuRenderer, UpstreamPlanes};
pub use splats::{Columns, GpuPart, GpuSplats};
pub use timestamps::TimedDispatch;

#[cfg(test)]
mod tests {
    #[test]
    fn wgsl_constants_match_rust() {
        for (name, expected) in [
            ("NEAR_METRES", crate::NEAR_METRES),
            ("LOW_PASS", crate::LOW_PASS),
            ("ALPHA_MIN", crate::ALPHA_MIN),
            ("ALPHA_MAX", crate::ALPHA_MAX),
            ("TRANSMITTANCE_MIN", crate::TRANSMITTANCE_MIN),
            ("SH_C0", scene::splats::SH_C0),
            ("LOG2_E", std::f32::consts::LOG2_E),
            ("LN_2", std::f32::consts::LN_2),
        ] {
            let start = format!("const {name}: f32 = ");
            let line = shaders::VIEW.lines().find_map(|line| line.strip_prefix(&start)).expect(name);
            assert_eq!(line.trim_end_matches(';').parse(), Ok(expected), "{name}");
        }
    }
}
