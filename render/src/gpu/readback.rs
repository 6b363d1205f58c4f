//! Frames, gradients and intermediate results, read back to the host.

use std::slice;

use scene::Camera;
use shaders::{MOMENTS, Views};

use super::error::GpuError;
use super::renderer::{GpuRenderer, LastForward};
use super::splats::{GpuPart, GpuSplats};
use crate::{BackwardIntermediates, ForwardIntermediates, Frame, Gradients, Options};

impl GpuRenderer {
    /// Draws one view and reads it back; grows the pair buffers as needed.
    ///
    /// # Errors
    /// As [`forward`](Self::forward), and any error of the submitted work.
    pub fn draw(
        &mut self,
        splats: &GpuSplats,
        parts: &[GpuPart],
        camera: &Camera,
        options: &Options,
    ) -> Result<Frame, GpuError> {
        loop {
            let mut encoder = self.gpu.encoder();
            self.forward(&mut encoder, splats, parts, slice::from_ref(camera), options)?;
            self.gpu.submit(encoder)?;
            if !self.grow_after_overflow()? {
                return self.read_frame(0);
            }
        }
    }

    /// Waits for all submitted work and reads the frame of view `view` of the last forward pass.
    ///
    /// # Errors
    /// Any error of the submitted work, or no such view.
    pub fn read_frame(&self, view: usize) -> Result<Frame, GpuError> {
        let has_view = |last: &LastForward| view < last.views.count as usize;
        let Some(LastForward { views, .. }) = self.last_forward.filter(has_view) else {
            return Err(GpuError::Failed(format!("the last forward pass has no view {view}")));
        };
        let view = views.view[view];
        let area = (view.pixels[0] * view.pixels[1]) as usize;
        let (planes, extra) = if views.extras != 0 { (6, area) } else { (4, 0) };
        let first = planes * view.first_pixel as usize;
        Ok(Frame {
            width: view.pixels[0] as usize,
            height: view.pixels[1] as usize,
            colour: self.gpu.read(&self.frame, first, 3 * area)?,
            transmittance: self.gpu.read(&self.frame, first + 3 * area, area)?,
            depth: self.gpu.read(&self.frame, first + 4 * area, extra)?,
            trainable_alpha: self.gpu.read(&self.frame, first + 5 * area, extra)?,
        })
    }

    /// The view of the last forward pass and the index of its sorted pair buffer. Intermediate results are compared for
    /// one view only.
    fn single_view(&self, what: &str) -> Result<(Views, usize), GpuError> {
        match self.last_forward {
            Some(LastForward { views, sorted, .. }) if views.count == 1 => Ok((views, sorted)),
            _ => Err(GpuError::Failed(format!("{what} can be read only after a forward pass of one view"))),
        }
    }

    /// Waits for all submitted work and reads the results of the stages before `rasterize`.
    ///
    /// # Errors
    /// Any error of the submitted work, or a last forward pass of several views.
    pub fn read_forward_intermediates(&self) -> Result<ForwardIntermediates, GpuError> {
        let (views, sorted) = self.single_view("projected splats and pairs")?;
        let (gpu, status) = (&*self.gpu, self.status()?);
        let (visible, pairs) = (status.visible as usize, status.pairs as usize);
        // 32 bits take an even number of passes, so the depth order is in buffer 0.
        let order: Vec<u32> = gpu.read(&self.entries.sort.values[0], 0, visible)?;
        let records: Vec<[f32; 12]> = gpu.read(&self.entries.records, 0, views.entries as usize)?;
        let mut rank = vec![0; views.entries as usize];
        order.iter().enumerate().for_each(|(n, &i)| rank[i as usize] = n as u32);
        let sorted_pairs: Vec<u32> = gpu.read(&self.pairs.sort.values[sorted], 0, pairs)?;
        let splats: Vec<u32> = gpu.read(&self.pairs.entry, 0, pairs)?;
        let ranges: Vec<[u32; 2]> = gpu.read(&self.tile_ranges, 0, views.tiles as usize)?;
        let mut start = vec![0];
        for [from, to] in ranges {
            start.push(start[start.len() - 1] + (to - from));
        }
        // WGSL's record: mean, a, b | c, log2 opacity, half extents | colour, depth.
        let record = |i: &u32| {
            let [x, y, a, b, c, opacity, half_x, half_y, red, green, blue, z] = records[*i as usize];
            [x, y, a, b, c, opacity, red, green, blue, z, half_x, half_y]
        };
        Ok(ForwardIntermediates {
            records: order.iter().map(record).collect(),
            pairs: sorted_pairs.iter().map(|&pair| rank[splats[pair as usize] as usize]).collect(),
            order,
            start,
        })
    }

    /// Waits for all submitted work and reads the moments of the last [`backward`](Self::backward).
    ///
    /// # Errors
    /// Any error of the submitted work, or a last forward pass of several views.
    pub fn read_backward_intermediates(&self) -> Result<BackwardIntermediates, GpuError> {
        const WORDS: usize = MOMENTS as usize;
        let (views, sorted) = self.single_view("moments")?;
        let (gpu, status) = (&*self.gpu, self.status()?);
        let (visible, pairs) = (status.visible_trainable as usize, status.pairs as usize);
        let pair_moments: Vec<[f32; WORDS]> = gpu.read(&self.pairs.moments, 0, pairs)?;
        let splat_moments: Vec<[f32; WORDS]> = gpu.read(&self.sums, 0, visible)?;
        let visible: Vec<u32> = gpu.read(&self.entries.visible, 0, visible)?;
        let sorted_pairs: Vec<u32> = gpu.read(&self.pairs.sort.values[sorted], 0, pairs)?;
        let splats: Vec<u32> = gpu.read(&self.pairs.entry, 0, pairs)?;
        let ranges: Vec<[u32; 2]> = gpu.read(&self.tile_ranges, 0, views.tiles as usize)?;
        let of_tile = |(tile, [from, to]): (usize, [u32; 2])| {
            let pairs = sorted_pairs[from as usize..to as usize].iter().map(|&pair| pair as usize);
            pairs.map(|pair| (tile as u32, splats[pair], pair_moments[pair])).collect::<Vec<_>>()
        };
        let all = ranges.into_iter().enumerate().flat_map(of_tile);
        Ok(BackwardIntermediates {
            pairs: all.filter(|(_, splat, _)| *splat < views.trainable_entries).collect(),
            splats: visible.into_iter().zip(splat_moments).collect(),
        })
    }

    /// Waits for all submitted work and reads the gradients in the CPU backend's form, summed over the views; zero
    /// where no view sees a splat. The gradients of the camera are zero;
    /// see [`pose_gradients`](Self::pose_gradients).
    ///
    /// # Errors
    /// Any error of the submitted work, or no forward pass before.
    pub fn read_gradients(&self, splats: &GpuSplats) -> Result<Gradients, GpuError> {
        let Some(LastForward { views, .. }) = self.last_forward else {
            return Err(GpuError::Failed("there are no gradients before the first forward pass".into()));
        };
        let (n, visible) = (splats.len(), self.status()?.visible_trainable as usize);
        let entries: Vec<u32> = self.gpu.read(&self.entries.visible, 0, visible)?;
        let statistics: Vec<[f32; 4]> = self.gpu.read(&self.statistics, 0, visible)?;
        let mut seen = vec![0u16; n.div_ceil(16)];
        let mut sums = [(); 3].map(|()| vec![0.0; n]);
        for (entry, statistics) in entries.iter().zip(statistics) {
            let i = (entry / views.count) as usize;
            seen[i / 16] |= 1 << (i % 16);
            sums.iter_mut().zip(statistics).for_each(|(sums, value)| sums[i] += value);
        }
        let mut columns = self.gradients.read(&self.gpu, n)?;
        for column in &mut columns {
            let unseen = column.iter_mut().enumerate().filter(|(i, _)| seen[i / 16] >> (i % 16) & 1 == 0);
            unseen.for_each(|(_, value)| *value = 0.0);
        }
        let [screen_gradient, screen_gradient_abs, weight] = sums;
        Ok(Gradients { columns, seen, screen_gradient, screen_gradient_abs, weight, pose: [0.0; 6], focal: 0.0 })
    }
}
