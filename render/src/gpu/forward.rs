//! The forward pass: project, sort, bin and rasterize, encoded without a readback.

use scene::Camera;
use shaders::{SCAN_BLOCK, SplatSet, Views, WORKGROUP_SIZE, args, status_word};

use super::error::GpuError;
use super::renderer::{Displacements, GpuRenderer, LastForward};
use super::sort::{Groups, SortInput};
use super::splats::{GpuPart, GpuSplats};
use super::views::{seen_from, views_of};
use crate::Options;

impl GpuRenderer {
    /// Encodes a forward pass of the trainable splats and frozen parts into [`frame`](Self::frame), with one view
    /// per camera.
    ///
    /// # Errors Unless there are 1 to [`MAX_VIEWS`](shaders::MAX_VIEWS) cameras, or if a buffer does not fit. Errors of
    /// the execution are returned by the call that submits or waits.
    pub fn forward(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        splats: &GpuSplats,
        parts: &[GpuPart],
        cameras: &[Camera],
        options: &Options,
    ) -> Result<(), GpuError> {
        self.forward_displaced(encoder, splats, parts, cameras, options, None)
    }

    /// As [`forward`](Self::forward), of cameras that are first moved in their own axes, on the device, where there are displacements. A backward pass
    /// then also computes [`pose_gradients`](Self::pose_gradients).
    ///
    /// # Errors
    /// As `forward`.
    pub fn forward_displaced(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        splats: &GpuSplats,
        parts: &[GpuPart],
        cameras: &[Camera],
        options: &Options,
        displacements: Option<Displacements>,
    ) -> Result<(), GpuError> {
        let counts = [splats.len(), parts.iter().map(|part| part.splats.len()).sum()];
        let mut views = views_of(cameras, options, counts, self.pair_capacity, self.gpu.max_binding_bytes())?;
        for (view, row) in views.view.iter_mut().zip(displacements.map_or(&[][..], |of| of.of_camera)) {
            view.displacement = row.map_or(0, |row| row + 1);
        }
        let set = set_of(splats, 0, options.sh_degree.min(splats.sh_degree()));
        self.last_forward = None;
        self.reserve(&views, splats)?;
        self.gpu.write(encoder, &self.views, 0, &[views]);
        encoder.clear_buffer(&self.tile_ranges, 0, Some(8 * u64::from(views.tiles)));

        let mut sets = vec![(splats, set, None)];
        let mut first = splats.len();
        for GpuPart { splats, cameras_from_part } in parts {
            let own = cameras_from_part.map(|poses| self.gpu.uniform(&seen_from(&views, cameras, poses)));
            // Frozen splats are drawn at their full SH degree, whatever degree training has reached.
            sets.push((splats, set_of(splats, first, splats.sh_degree()), own));
            first += splats.len();
        }
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        if let Some(Displacements { rows, .. }) = displacements {
            self.kernels.displace.run(&self.gpu, pass, &[(0, &self.views), (1, rows)], 1);
        }
        self.encode_project(pass, &views, &sets);
        let sorted = self.encode_sort_and_bin(pass, views.tiles);
        self.encode_rasterize(pass, views.tiles, sorted);
        self.last_forward = Some(LastForward { views, set, sorted });
        Ok(())
    }

    /// Projects all entries and compacts the visible ones.
    /// A set may have views of its own.
    fn encode_project(
        &self,
        pass: &mut wgpu::ComputePass,
        views: &Views,
        sets: &[(&GpuSplats, SplatSet, Option<wgpu::Buffer>)],
    ) {
        let (gpu, kernels, entries, status) = (&*self.gpu, &self.kernels, &self.entries, &*self.status);
        let plan = self.plan_bindings();
        kernels.plan_start.run(gpu, pass, &plan[..3], 1);
        for (splats, set, own_views) in sets {
            let uniform = gpu.uniform(set);
            let [a, b, c, d] = splats.columns().banks();
            let bindings = [
                (0, a),
                (1, b),
                (2, c),
                (3, d),
                (4, own_views.as_ref().unwrap_or(&self.views)),
                (5, &uniform),
                (6, &*entries.records),
                (7, &*entries.is_visible),
                (8, &*entries.sums),
                (9, &*entries.tiles),
            ];
            if set.count > 0 {
                kernels.project.run(gpu, pass, &bindings, (set.count * views.count).div_ceil(WORKGROUP_SIZE));
            }
        }
        let groups = Groups::Direct((views.entries + 1).div_ceil(SCAN_BLOCK));
        self.sorter.scan(gpu, pass, &entries.sums, status, status_word::ENTRY_SCAN, groups);
        kernels.plan_visible.run(gpu, pass, &plan, 1);
        let bindings = [
            (0, &self.views),
            (1, &*entries.is_visible),
            (2, &*entries.sums),
            (3, &*entries.records),
            (4, &*entries.visible),
            (5, &*entries.sort.keys[0]),
        ];
        kernels.compact.run(gpu, pass, &bindings, views.entries.div_ceil(WORKGROUP_SIZE));
    }

    /// Sorts the visible entries by depth, emits their pairs and sorts these by tile. Returns the index of the
    /// ping-pong buffer that holds the sorted pairs.
    fn encode_sort_and_bin(&self, pass: &mut wgpu::ComputePass, tiles: u32) -> usize {
        let (gpu, kernels, entries, pairs) = (&*self.gpu, &self.kernels, &self.entries, &self.pairs);
        let (status, args) = (&*self.status, &*self.args);
        let visible = Some(&*entries.visible);
        let sorted = self.sorter.sort(gpu, pass, &entries.sort, visible, 32, (status, args), SortInput::Entries);
        let order = &*entries.sort.values[sorted];
        let bindings = [(0, status), (1, order), (2, &*entries.tiles), (3, &*entries.sums)];
        kernels.gather.run_indirect(gpu, pass, &bindings, args, args::VISIBLE);
        let groups = Groups::Indirect(args, args::VISIBLE_SCAN);
        self.sorter.scan(gpu, pass, &entries.sums, status, status_word::VISIBLE_SCAN, groups);
        kernels.plan_pairs.run(gpu, pass, &self.plan_bindings(), 1);

        let bindings = [
            (0, &self.views),
            (1, status),
            (2, &*entries.records),
            (3, order),
            (4, &*entries.sums),
            (5, &*entries.first_pair),
            (6, &*pairs.entry),
            (7, &*pairs.sort.keys[0]),
            (8, &*pairs.sort.values[0]),
        ];
        kernels.emit.run_indirect(gpu, pass, &bindings, args, args::VISIBLE);
        let bits = 32 - tiles.saturating_sub(1).leading_zeros();
        let sorted = self.sorter.sort(gpu, pass, &pairs.sort, None, bits, (status, args), SortInput::Pairs);
        let bindings = [(0, status), (1, &*pairs.sort.keys[sorted]), (2, &*self.tile_ranges)];
        kernels.ranges.run_indirect(gpu, pass, &bindings, args, args::PAIRS);
        sorted
    }

    fn encode_rasterize(&self, pass: &mut wgpu::ComputePass, tiles: u32, sorted: usize) {
        let bindings = [
            (0, &self.views),
            (1, &*self.tile_ranges),
            (2, &*self.pairs.sort.values[sorted]),
            (3, &*self.pairs.entry),
            (4, &*self.entries.records),
            (5, &*self.frame),
            (6, &*self.last_pair),
        ];
        self.kernels.rasterize.run(&self.gpu, pass, &bindings, tiles);
    }

    fn plan_bindings(&self) -> [(u32, &wgpu::Buffer); 4] {
        [(0, &self.views), (1, &self.status), (2, &self.entries.sums), (3, &self.args)]
    }
}

fn set_of(splats: &GpuSplats, first: usize, sh_degree: u8) -> SplatSet {
    SplatSet {
        first: first as u32,
        count: splats.len() as u32,
        stride: splats.columns().stride() as u32,
        sh_degree: sh_degree.into(),
    }
}
