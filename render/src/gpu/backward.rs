//! The way back: from a frame's gradient to the splats'.

use super::*;

/// How the pairs of a splat with its tiles are added up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reduction {
    /// In the order of its tiles: the same bits every time.
    InOrder,
    /// By atomics, in whatever order the tiles are done: other bits every time. What the order is measured against; nothing goes on
    /// from it.
    ByAtomics,
}

impl GpuRenderer {
    /// Gradients of the trainable splats of the last [`forward`](Self::forward), summed over its views, whose splats must be passed again
    /// unchanged, from what lies in [`upstream`](Self::upstream). The pose has none here.
    ///
    /// # Errors
    /// Without a forward pass before, or with another number of splats; and as `forward`.
    pub fn backward(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        splats: &GpuSplats,
        planes: UpstreamPlanes,
    ) -> Result<(), GpuError> {
        let Some(Drawn { set, .. }) = self.drawn.filter(|drawn| drawn.set.count as usize == splats.len()) else {
            return Err(GpuError::Failed("backward needs the splats that forward drew".into()));
        };
        self.add_up_pairs(encoder, planes, Reduction::InOrder)?;
        let gpu = &*self.gpu;
        let (status, visible) = (&*self.status, &*self.of_splats.visible);
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
            (6, status),
            (7, visible),
            (8, &*self.sums),
            (9, out_a),
            (10, out_b),
            (11, out_c),
            (12, out_d),
            (13, &*self.statistics),
        ];
        self.kernels.project_backward.run_indirect(gpu, pass, &bindings, &self.args, args::SEEN);
        Ok(())
    }

    /// The stages of [`backward`](Self::backward) before `project_backward`: sums of each splat over the pixels of each of the last views.
    ///
    /// # Errors
    /// Without a forward pass before; and as `forward`.
    pub fn add_up_pairs(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        planes: UpstreamPlanes,
        how: Reduction,
    ) -> Result<(), GpuError> {
        let Some(Drawn { views, side, .. }) = self.drawn else {
            return Err(GpuError::Failed("there is nothing to go back from before the first forward pass".into()));
        };
        if planes.depth && views.extras == 0 {
            return Err(GpuError::Failed("a gradient of depth needs a forward pass with extras".into()));
        }
        let gpu = &*self.gpu;
        let by_atomics = match how {
            Reduction::InOrder => None,
            Reduction::ByAtomics => {
                encoder.clear_buffer(&self.sums, 0, None);
                Some(gpu.kernel(&shaders::RASTERIZE_BACKWARD_ATOMICS, "rasterize_backward")?)
            }
        };
        let (kernels, status, args, pairs) = (&self.kernels, &*self.status, &*self.args, &self.of_pairs);
        let OfSplats { records, tiles: tile_counts, first, visible, .. } = &self.of_splats;
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let planes = gpu.uniform(&shaders::Planes {
            transmittance: planes.transmittance.into(),
            depth: planes.depth.into(),
            padding: [0; 2],
        });
        let sums_go_to = if by_atomics.is_some() { &self.sums } else { &pairs.moments };
        let bindings = [
            (0, &self.views),
            (1, &*self.tile_ranges),
            (2, &*pairs.sides.values[side]),
            (3, &*pairs.splat),
            (4, records),
            (5, &*self.frame),
            (6, &*self.last),
            (7, &*self.upstream),
            (8, &planes),
            (9, &**sums_go_to),
        ];
        let kernel = by_atomics.as_ref().unwrap_or(&kernels.rasterize_backward);
        kernel.run(gpu, pass, &bindings, views.tiles);
        if how == Reduction::InOrder {
            let bindings: [(u32, &wgpu::Buffer); 6] =
                [(0, status), (1, visible), (2, first), (3, tile_counts), (4, &pairs.moments), (5, &self.sums)];
            kernels.reduce.run_indirect(gpu, pass, &bindings, args, args::SEEN_REDUCE);
        }
        Ok(())
    }

    /// What [`add_up_pairs`](Self::add_up_pairs) came to, by splat and then by view: the moments of `rasterize_backward.wgsl`, zeros where it was not
    /// seen.
    ///
    /// # Errors
    /// What went wrong until then, or without a forward pass.
    pub fn read_sums(&self, how: Reduction) -> Result<Vec<[f32; MOMENTS as usize]>, GpuError> {
        let own = self.drawn.map_or(0, |drawn| drawn.views.own as usize);
        match how {
            Reduction::ByAtomics => self.gpu.read(&self.sums, 0, own),
            Reduction::InOrder => {
                let seen = self.status()?.seen as usize;
                let places: Vec<u32> = self.gpu.read(&self.of_splats.visible, 0, seen)?;
                let sums: Vec<[f32; MOMENTS as usize]> = self.gpu.read(&self.sums, 0, seen)?;
                let mut by_splat = vec![[0.0; MOMENTS as usize]; own];
                places.iter().zip(sums).for_each(|(&i, sums)| by_splat[i as usize] = sums);
                Ok(by_splat)
            }
        }
    }
}
