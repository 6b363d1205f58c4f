//! The GPU backend: wgpu over Vulkan, Metal or DirectX 12; the stages are the WGSL of the crate `shaders`.
//!
//! Data flow of a view, or of several of one size or another side by side, one buffer a stage, no read-back between:
//! ```text
//! splats ─project→ records ─compact→ visible ─sort by depth→ order ─emit→ pairs ─sort by tile→ ranges ─rasterize→ frame
//! upstream ─rasterize_backward→ moments per pair ─reduce→ sums per splat ─project_backward→ gradients
//! ```
//! Views side by side are one dispatch a stage: what a splat is in a view is an entry, those of a splat are neighbours, and the tiles
//! of a view follow those of the one before. Their entries are sorted together, which leaves each tile the order that it would have
//! alone: each view is drawn to the bit as if there were no other.
//!
//! How many splats are visible and how many pairs they make only the device knows: stage `plan` writes the sizes of the
//! dispatches that follow. Pairs have room for so many; views with more set a flag that stays, and nothing is drawn or
//! trained until the host has seen it and made room ([`GpuRenderer::recover`]).
//!
//! No float is ever added atomically: the same adapter gives the same bits.

mod access;
mod backward;
mod device;
mod error;
mod kernel;
mod memory;
mod moments;
mod options;
mod sizes;
mod sort;
mod splats;
mod watch;

use std::sync::Arc;

use scene::Camera;
use shaders::{GROUP, MOMENTS, MOST_VIEWS, SCAN_BLOCK, Set, Status, TILE, View, Views, args, slot};

pub use backward::Reduction;
pub use device::Gpu;
pub use error::GpuError;
pub use kernel::Kernel;
pub use memory::{Buffer, Growing};
pub use options::{GpuOptions, Path};
pub use splats::{Columns, GpuSplats};
pub use watch::Dispatched;

use crate::{Frame, Gradients, Options};
use access::set_of;
use sizes::Sizes;
use sort::{Groups, Sides, Sorted, Sorter};

/// Pairs for which there is room at first.
const FIRST_PAIRS: usize = 1 << 18;

/// Which planes of the upstream gradient mean anything; those that do not are taken as zero. Colour always does.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct UpstreamPlanes {
    /// dL/d transmittance.
    pub transmittance: bool,
    /// dL/d depth.
    pub depth: bool,
}

/// A renderer with its buffers, which it keeps from view to view.
#[derive(Debug)]
pub struct GpuRenderer {
    gpu: Arc<Gpu>,
    kernels: Kernels,
    sorter: Sorter,
    views: wgpu::Buffer,
    status: Buffer,
    args: Buffer,
    of_splats: OfSplats,
    of_pairs: OfPairs,
    pair_capacity: usize,
    tile_ranges: Growing,
    last: Growing,
    frame: Growing,
    upstream: Growing,
    sums: Growing,
    gradients: Columns,
    statistics: Growing,
    drawn: Option<Drawn>,
}

/// What the last `forward` drew.
#[derive(Debug, Clone, Copy)]
struct Drawn {
    views: Views,
    set: Set,
    /// Side of the sorted pairs.
    side: usize,
}

/// Buffers with an entry for each splat, own and context, in each view.
#[derive(Debug)]
struct OfSplats {
    records: Growing,
    seen: Growing,
    sums: Growing,
    tiles: Growing,
    first: Growing,
    visible: Growing,
    sides: Sides,
}

/// Buffers with an entry for each pair.
#[derive(Debug)]
struct OfPairs {
    splat: Growing,
    sides: Sides,
    moments: Growing,
}

#[derive(Debug)]
struct Kernels {
    plan_start: Kernel,
    plan_visible: Kernel,
    plan_pairs: Kernel,
    project: Kernel,
    compact: Kernel,
    gather: Kernel,
    emit: Kernel,
    ranges: Kernel,
    rasterize: Kernel,
    rasterize_backward: Kernel,
    reduce: Kernel,
    project_backward: Kernel,
}

impl GpuRenderer {
    /// A renderer on this device.
    ///
    /// # Errors
    /// Where the driver refuses a stage or a buffer.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        let g = &*gpu;
        let kernels = Kernels {
            plan_start: g.kernel(&shaders::PLAN, "plan_start")?,
            plan_visible: g.kernel(&shaders::PLAN, "plan_visible")?,
            plan_pairs: g.kernel(&shaders::PLAN, "plan_pairs")?,
            project: g.kernel(&shaders::PROJECT, "project")?,
            compact: g.kernel(&shaders::COMPACT, "compact")?,
            gather: g.kernel(&shaders::GATHER, "gather")?,
            emit: g.kernel(&shaders::EMIT, "emit")?,
            ranges: g.kernel(&shaders::RANGES, "ranges")?,
            rasterize: g.kernel(&shaders::RASTERIZE, "rasterize")?,
            rasterize_backward: g.kernel(&shaders::RASTERIZE_BACKWARD, "rasterize_backward")?,
            reduce: g.kernel(&shaders::REDUCE, "reduce")?,
            project_backward: g.kernel(&shaders::PROJECT_BACKWARD, "project_backward")?,
        };
        let of_splats = OfSplats {
            records: Growing::new(g, "records")?,
            seen: Growing::new(g, "seen")?,
            sums: Growing::new(g, "sums")?,
            tiles: Growing::new(g, "tiles")?,
            first: Growing::new(g, "first pairs")?,
            visible: Growing::new(g, "visible")?,
            sides: Sides::new(g)?,
        };
        let of_pairs =
            OfPairs { splat: Growing::new(g, "pairs")?, sides: Sides::new(g)?, moments: Growing::new(g, "moments")? };
        Ok(Self {
            kernels,
            sorter: Sorter::new(g)?,
            views: g.constants("views", size_of::<Views>()),
            status: g.buffer("status", size_of::<Status>() as u64)?,
            args: g.buffer("args", 12 * args::COUNT)?,
            of_splats,
            of_pairs,
            pair_capacity: FIRST_PAIRS,
            tile_ranges: Growing::new(g, "ranges")?,
            last: Growing::new(g, "last pairs")?,
            frame: Growing::new(g, "frame")?,
            upstream: Growing::new(g, "upstream")?,
            sums: Growing::new(g, "splats' sums")?,
            gradients: Columns::new(g, "gradients", 0, 0)?,
            statistics: Growing::new(g, "statistics")?,
            drawn: None,
            gpu,
        })
    }

    /// As [`Gpu::name`].
    pub fn name(&self) -> String {
        self.gpu.name().to_string()
    }

    /// Draws the trainable splats and, with them, a frozen context, into [`frame`](Self::frame): as many views side by side as there are
    /// cameras, one to [`MOST_VIEWS`].
    ///
    /// # Errors
    /// Without a camera or with too many; where buffers do not fit. What fails later is told by whoever submits or waits.
    pub fn forward(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        splats: &GpuSplats,
        context: Option<&GpuSplats>,
        cameras: &[Camera],
        options: &Options,
    ) -> Result<(), GpuError> {
        let others = context.map_or(0, GpuSplats::len);
        let views = self.views_of(cameras, options, splats.len(), others)?;
        let sh_degree = options.sh_degree.min(splats.sh_degree());
        let set = set_of(splats, 0, sh_degree);
        self.drawn = None;
        self.fit(&views, splats)?;
        let gpu = &*self.gpu;
        gpu.write(encoder, &self.views, 0, &[views]);
        let tiles = views.tiles;
        encoder.clear_buffer(&self.tile_ranges, 0, Some(8 * u64::from(tiles)));

        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let (kernels, status, args) = (&self.kernels, &*self.status, &*self.args);
        let OfSplats { records, seen, sums, tiles: tile_counts, first, visible, sides } = &self.of_splats;
        let plan: [(u32, &wgpu::Buffer); 4] = [(0, &self.views), (1, status), (2, sums), (3, args)];
        kernels.plan_start.run(gpu, pass, &plan[..3], 1);
        // The context is finished: it is drawn in full, whatever degree the trainable splats have reached.
        let frozen = context.map(|context| (context, set_of(context, splats.len(), context.sh_degree())));
        for (splats, set) in [Some((splats, set)), frozen].into_iter().flatten() {
            let uniform = gpu.uniform(&set);
            let [a, b, c, d] = splats.columns().banks();
            let bindings = [
                (0, a),
                (1, b),
                (2, c),
                (3, d),
                (4, &self.views),
                (5, &uniform),
                (6, records),
                (7, seen),
                (8, sums),
                (9, tile_counts),
            ];
            if set.count > 0 {
                kernels.project.run(gpu, pass, &bindings, (set.count * views.count).div_ceil(GROUP));
            }
        }
        let groups = Groups::Direct((views.total + 1).div_ceil(SCAN_BLOCK));
        self.sorter.scan(gpu, pass, sums, status, slot::SPLAT_SLOTS, groups);
        kernels.plan_visible.run(gpu, pass, &plan, 1);
        let bindings = [(0, &self.views), (1, seen), (2, sums), (3, records), (4, visible), (5, &*sides.keys[0])];
        kernels.compact.run(gpu, pass, &bindings, views.total.div_ceil(GROUP));

        let side = self.sorter.sort(gpu, pass, sides, Some(visible), 32, (status, args), Sorted::Splats);
        let order = &*sides.values[side];
        let bindings = [(0, status), (1, order), (2, tile_counts), (3, sums)];
        kernels.gather.run_indirect(gpu, pass, &bindings, args, args::VISIBLE);
        let groups = Groups::Indirect(args, args::VISIBLE_SLOTS);
        self.sorter.scan(gpu, pass, sums, status, slot::VISIBLE_SLOTS, groups);
        kernels.plan_pairs.run(gpu, pass, &plan, 1);

        let pairs = &self.of_pairs;
        let bindings = [
            (0, &self.views),
            (1, status),
            (2, records),
            (3, order),
            (4, sums),
            (5, first),
            (6, &*pairs.splat),
            (7, &*pairs.sides.keys[0]),
            (8, &*pairs.sides.values[0]),
        ];
        kernels.emit.run_indirect(gpu, pass, &bindings, args, args::VISIBLE);
        let bits = 32 - tiles.saturating_sub(1).leading_zeros();
        let side = self.sorter.sort(gpu, pass, &pairs.sides, None, bits, (status, args), Sorted::Pairs);
        let bindings = [(0, status), (1, &*pairs.sides.keys[side]), (2, &*self.tile_ranges)];
        kernels.ranges.run_indirect(gpu, pass, &bindings, args, args::PAIRS);
        let bindings = [
            (0, &self.views),
            (1, &*self.tile_ranges),
            (2, &*pairs.sides.values[side]),
            (3, &*pairs.splat),
            (4, records),
            (5, &*self.frame),
            (6, &*self.last),
        ];
        kernels.rasterize.run(gpu, pass, &bindings, tiles);
        self.drawn = Some(Drawn { views, set, side });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device, with the portable stages where asked; `None`, and a line that says so, where there is none and `PLAT_GPU` does not
    /// require one.
    pub(super) fn gpu(portable: bool) -> Option<Arc<Gpu>> {
        let required = std::env::var("PLAT_GPU").is_ok_and(|value| value == "required");
        let options = GpuOptions {
            path: if portable { Path::Portable } else { Path::Fast },
            ..GpuOptions::from_env().expect("a sound environment")
        };
        match Gpu::open_with(&options) {
            Ok(gpu) => Some(gpu),
            Err(e) if required => panic!("PLAT_GPU=required, but {e}"),
            Err(_) => {
                println!("skipped: no adapter");
                None
            }
        }
    }

    #[test]
    fn constants_are_those_of_this_crate() {
        for (name, expected) in [
            ("NEAR_METRES", crate::NEAR_METRES),
            ("BLUR", crate::BLUR),
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
