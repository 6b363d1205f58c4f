//! The backward pass: from the gradient of a frame to the gradients of the splats.

use shaders::{MOMENTS, POSE_BLOCKS, args};

use super::error::GpuError;
use super::renderer::{GpuRenderer, LastForward, UpstreamPlanes};
use super::sizes::is_displaced;
use super::splats::GpuSplats;

/// How the moments of a splat's pairs are summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reduction {
    /// In the order of its tiles: bit-identical from run to run.
    Ordered,
    /// By atomic additions in any order: not reproducible. Only a baseline for measurements; no training uses it.
    Atomic,
}

impl GpuRenderer {
    /// Encodes a backward pass of the last [`forward`](Self::forward): gradients of the trainable splats, summed over
    /// its views, from the content of [`upstream`](Self::upstream). `splats` must be those of the forward pass,
    /// unchanged. After a forward pass with displacements also [`pose_gradients`](Self::pose_gradients).
    ///
    /// # Errors
    /// Without a forward pass before, or with another number of splats; and as `forward`.
    pub fn backward(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        splats: &GpuSplats,
        planes: UpstreamPlanes,
    ) -> Result<(), GpuError> {
        let same_splats = |last: &LastForward| last.set.count as usize == splats.len();
        let Some(LastForward { set, views, .. }) = self.last_forward.filter(same_splats) else {
            return Err(GpuError::Failed("backward needs the splats of the last forward pass".into()));
        };
        self.reduce_moments(encoder, planes, Reduction::Ordered)?;
        let gpu = &*self.gpu;
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let set = gpu.uniform(&set);
        let [a, b, c, d] = splats.columns().banks();
        let [out_a, out_b, out_c, out_d] = self.gradients.banks();
        let bindings = [
            (0, a),
            (1, b),
            (2, c),
            (3, d),
            (4, &self.views),
            (5, &set),
            (6, &*self.status),
            (7, &*self.entries.visible),
            (8, &*self.sums),
            (9, out_a),
            (10, out_b),
            (11, out_c),
            (12, out_d),
            (13, &*self.statistics),
        ];
        self.kernels.project_backward.run_indirect(gpu, pass, &bindings, &self.args, args::VISIBLE_TRAINABLE);
        if is_displaced(&views) {
            let (views_of, partials) = ((0, &self.views), (4, &*self.pose_partials));
            let entries = [(1, &*self.status), (2, &*self.entries.visible), (3, &*self.statistics)];
            let groups = views.count * POSE_BLOCKS;
            let reduce = &self.kernels.reduce_pose;
            reduce.run(gpu, pass, &[&[views_of, partials][..], &entries].concat(), groups);
            self.kernels.finish_pose.run(gpu, pass, &[views_of, partials, (5, &*self.pose_gradients)], 1);
        }
        Ok(())
    }

    /// Encodes the stages of [`backward`](Self::backward) before `project_backward`: the moments of each trainable
    /// splat in each view.
    ///
    /// # Errors
    /// Without a forward pass before; and as `forward`.
    pub fn reduce_moments(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        planes: UpstreamPlanes,
        reduction: Reduction,
    ) -> Result<(), GpuError> {
        let Some(LastForward { views, sorted, .. }) = self.last_forward else {
            return Err(GpuError::Failed("backward needs a forward pass before it".into()));
        };
        if planes.depth && views.extras == 0 {
            return Err(GpuError::Failed("a gradient of depth needs a forward pass with extras".into()));
        }
        let gpu = &*self.gpu;
        let atomic_kernel = match reduction {
            Reduction::Ordered => None,
            Reduction::Atomic => {
                encoder.clear_buffer(&self.sums, 0, None);
                Some(gpu.kernel(&shaders::RASTERIZE_BACKWARD_ATOMICS, "rasterize_backward")?)
            }
        };
        let (kernels, entries, pairs) = (&self.kernels, &self.entries, &self.pairs);
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let planes = gpu.uniform(&shaders::UpstreamPlanes {
            transmittance: planes.transmittance.into(),
            depth: planes.depth.into(),
            padding: [0; 2],
        });
        let output = if atomic_kernel.is_some() { &self.sums } else { &pairs.moments };
        let bindings = [
            (0, &self.views),
            (1, &*self.tile_ranges),
            (2, &*pairs.sort.values[sorted]),
            (3, &*pairs.entry),
            (4, &*entries.records),
            (5, &*self.frame),
            (6, &*self.last_pair),
            (7, &*self.upstream),
            (8, &planes),
            (9, &**output),
        ];
        let kernel = atomic_kernel.as_ref().unwrap_or(&kernels.rasterize_backward);
        kernel.run(gpu, pass, &bindings, views.tiles);
        if reduction == Reduction::Ordered {
            let bindings: [(u32, &wgpu::Buffer); 6] = [
                (0, &self.status),
                (1, &entries.visible),
                (2, &entries.first_pair),
                (3, &entries.tiles),
                (4, &pairs.moments),
                (5, &self.sums),
            ];
            kernels.reduce.run_indirect(gpu, pass, &bindings, &self.args, args::REDUCE);
        }
        Ok(())
    }

    /// Reads the result of [`reduce_moments`](Self::reduce_moments): the moments of each entry of a trainable splat, in
    /// the order of `rasterize_backward.wgsl`; zero where it is not visible.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn read_splat_moments(&self, reduction: Reduction) -> Result<Vec<[f32; MOMENTS as usize]>, GpuError> {
        let trainable = self.last_forward.map_or(0, |last| last.views.trainable_entries as usize);
        match reduction {
            Reduction::Atomic => self.gpu.read(&self.sums, 0, trainable),
            Reduction::Ordered => {
                let visible = self.status()?.visible_trainable as usize;
                let indices: Vec<u32> = self.gpu.read(&self.entries.visible, 0, visible)?;
                let sums: Vec<[f32; MOMENTS as usize]> = self.gpu.read(&self.sums, 0, visible)?;
                let mut by_entry = vec![[0.0; MOMENTS as usize]; trainable];
                indices.iter().zip(sums).for_each(|(&i, sums)| by_entry[i as usize] = sums);
                Ok(by_entry)
            }
        }
    }
}
