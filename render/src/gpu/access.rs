//! What a [`GpuRenderer`] shows of its buffers, what it reads back, and how it makes room.

use super::*;
use crate::Stages;

impl GpuRenderer {
    /// Planes of `width · height` floats one after the other: red, green, blue, transmittance and, with
    /// [`Options::extras`], depth and own; as in [`Frame`].
    pub fn frame(&self) -> &wgpu::Buffer {
        &self.frame
    }

    /// Where the gradient of a loss goes before [`backward`](Self::backward): planes as in [`crate::Upstream`], three of
    /// colour, transmittance, depth. There is room for all once `forward` was called.
    pub fn upstream(&self) -> &wgpu::Buffer {
        &self.upstream
    }

    /// Gradients in columns as the splats', with their stride. Only rows of splats that were seen mean anything.
    pub fn gradients(&self) -> &Columns {
        &self.gradients
    }

    /// Three columns of floats with the stride of the splats: `screen`, `screen_abs` and `weight` of [`Gradients`]. Only rows
    /// of splats that were seen mean anything.
    pub fn statistics(&self) -> &wgpu::Buffer {
        &self.statistics
    }

    /// Indices of the visible splats, ascending; the first [`Status::seen`] are the trainable ones.
    pub fn visible(&self) -> &wgpu::Buffer {
        &self.of_splats.visible
    }

    /// A word for each splat, own first, then context: 1 where it was drawn.
    pub fn seen(&self) -> &wgpu::Buffer {
        &self.of_splats.seen
    }

    /// Indirect dispatches, see [`shaders::args`].
    pub fn args(&self) -> &wgpu::Buffer {
        &self.args
    }

    /// A [`Status`].
    pub fn status_buffer(&self) -> &wgpu::Buffer {
        &self.status
    }

    /// The status, once everything submitted is done.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn status(&self) -> Result<Status, GpuError> {
        let status: Status = self.gpu.read(&self.status, 0, 1)?[0];
        if status.fault != 0 {
            return Err(GpuError::Failed("its stages disagree on which tiles a splat touches".into()));
        }
        Ok(status)
    }

    /// Waits, and makes room if a view had too many pairs. True: that view and all that followed it were not drawn and
    /// must be done again.
    ///
    /// # Errors
    /// What went wrong until then, or where there is no room.
    pub fn recover(&mut self) -> Result<bool, GpuError> {
        let status = self.status()?;
        if status.overflow == 0 {
            return Ok(false);
        }
        self.pair_capacity = self.room_for(status.most_pairs as usize);
        self.gpu.upload(&self.status, 0, &[Status::default()])?;
        Ok(true)
    }

    /// Draws a view and reads it back.
    ///
    /// # Errors
    /// What went wrong.
    pub fn draw(
        &mut self,
        splats: &GpuSplats,
        context: Option<&GpuSplats>,
        camera: &Camera,
        options: &Options,
    ) -> Result<Frame, GpuError> {
        loop {
            let mut encoder = self.gpu.encoder();
            self.forward(&mut encoder, splats, context, camera, options)?;
            self.gpu.submit(encoder)?;
            if !self.recover()? {
                return self.read_frame();
            }
        }
    }

    /// The last frame, once it is drawn.
    ///
    /// # Errors
    /// What went wrong until then, or without a frame.
    pub fn read_frame(&self) -> Result<Frame, GpuError> {
        let Some(Drawn { view, .. }) = self.drawn else {
            return Err(GpuError::Failed("there is no frame before the first forward pass".into()));
        };
        let area = (view.pixels[0] * view.pixels[1]) as usize;
        let extra = if view.extras != 0 { area } else { 0 };
        Ok(Frame {
            width: view.pixels[0] as usize,
            height: view.pixels[1] as usize,
            colour: self.gpu.read(&self.frame, 0, 3 * area)?,
            transmittance: self.gpu.read(&self.frame, 3 * area, area)?,
            depth: self.gpu.read(&self.frame, 4 * area, extra)?,
            own: self.gpu.read(&self.frame, 5 * area, extra)?,
        })
    }

    /// What the stages before `rasterize` came to in the last view, once it is drawn.
    ///
    /// # Errors
    /// What went wrong until then, or without a view.
    pub fn read_stages(&self) -> Result<Stages, GpuError> {
        let Some(Drawn { view, side, .. }) = self.drawn else {
            return Err(GpuError::Failed("there are no stages before the first forward pass".into()));
        };
        let (gpu, status) = (&*self.gpu, self.status()?);
        let (visible, pairs) = (status.visible as usize, status.pairs as usize);
        // An even number of passes: the order by depth lies where it began.
        let order: Vec<u32> = gpu.read(&self.of_splats.sides.values[0], 0, visible)?;
        let records: Vec<[f32; 12]> = gpu.read(&self.of_splats.records, 0, view.total as usize)?;
        let mut rank = vec![0; view.total as usize];
        order.iter().enumerate().for_each(|(n, &i)| rank[i as usize] = n as u32);
        let sorted: Vec<u32> = gpu.read(&self.of_pairs.sides.values[side], 0, pairs)?;
        let splats: Vec<u32> = gpu.read(&self.of_pairs.splat, 0, pairs)?;
        let ranges: Vec<[u32; 2]> = gpu.read(&self.tile_ranges, 0, (view.tiles[0] * view.tiles[1]) as usize)?;
        let mut start = vec![0];
        for [from, to] in ranges {
            start.push(start[start.len() - 1] + (to - from));
        }
        // mean, a, b | c, log2 opacity, half extents | colour, depth
        let record = |i: &u32| {
            let [x, y, a, b, c, opacity, half_x, half_y, red, green, blue, z] = records[*i as usize];
            [x, y, a, b, c, opacity, red, green, blue, z, half_x, half_y]
        };
        Ok(Stages {
            records: order.iter().map(record).collect(),
            pairs: sorted.iter().map(|&pair| rank[splats[pair as usize] as usize]).collect(),
            order,
            start,
        })
    }

    /// The last gradients as the CPU has them: zero where a splat was not seen. The pose's are always zero.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn read_gradients(&self, splats: &GpuSplats) -> Result<Gradients, GpuError> {
        let (n, stride) = (splats.len(), self.gradients.stride());
        let seen: Vec<u32> = self.gpu.read(&self.of_splats.seen, 0, n)?;
        let masked = |mut column: Vec<f32>| {
            column.iter_mut().zip(&seen).filter(|(_, seen)| **seen == 0).for_each(|(value, _)| *value = 0.0);
            column
        };
        let statistic = |k: usize| self.gpu.read(&self.statistics, k * stride, n).map(masked);
        let mut bits = vec![0u16; n.div_ceil(16)];
        for (i, &seen) in seen.iter().enumerate() {
            bits[i / 16] |= (seen as u16) << (i % 16);
        }
        Ok(Gradients {
            columns: self.gradients.read(&self.gpu, n)?.into_iter().map(masked).collect(),
            seen: bits,
            screen: statistic(0)?,
            screen_abs: statistic(1)?,
            weight: statistic(2)?,
            pose: [0.0; 6],
        })
    }

    pub(super) fn view_of(&self, camera: &Camera, options: &Options, own: usize, others: usize) -> View {
        let k = &camera.pinhole;
        let rows = camera.rotation().transpose().to_cols_array_2d();
        let translation = camera.camera_from_world.translation.to_array();
        let guard = |length: u32, focal: f64| 0.15 * f64::from(length) / focal;
        let (gx, gy) = (guard(k.width, k.fx), guard(k.height, k.fy));
        let centre = camera.centre().as_vec3();
        let background = options.background;
        View {
            rows: std::array::from_fn(|r| {
                [rows[r][0] as f32, rows[r][1] as f32, rows[r][2] as f32, translation[r] as f32]
            }),
            centre: [centre.x, centre.y, centre.z, 0.0],
            background: [background[0], background[1], background[2], 0.0],
            focal: [k.fx as f32, k.fy as f32],
            principal: [k.cx as f32, k.cy as f32],
            cone_min: [(-k.cx / k.fx - gx) as f32, (-k.cy / k.fy - gy) as f32],
            cone_max: [
                ((f64::from(k.width) - k.cx) / k.fx + gx) as f32,
                ((f64::from(k.height) - k.cy) / k.fy + gy) as f32,
            ],
            pixels: [k.width, k.height],
            tiles: [k.width.div_ceil(TILE), k.height.div_ceil(TILE)],
            own: own as u32,
            total: (own + others) as u32,
            pair_capacity: self.pair_capacity as u32,
            antialiased: options.antialiased.into(),
            extras: options.extras.into(),
            padding: 0,
            more_padding: [0; 2],
        }
    }

    /// With room to spare where a binding has it, so that a job does not stop for a few pairs more.
    fn room_for(&self, pairs: usize) -> usize {
        let bound = (self.gpu.room() / (4 * u64::from(MOMENTS))) as usize;
        (pairs + pairs / 2).next_multiple_of(1 << 16).min(bound).max(pairs)
    }

    /// Makes room for a view. Buffers only grow.
    pub(super) fn fit(&mut self, view: &View, splats: &GpuSplats) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let (stride, sh_degree) = (splats.columns().stride(), splats.sh_degree());
        let sizes = Sizes::of(view, stride);
        let of = &mut self.of_splats;
        of.records.fit(gpu, sizes.records)?;
        of.sums.fit(gpu, sizes.scanned)?;
        for buffer in [&mut of.seen, &mut of.tiles, &mut of.first, &mut of.visible] {
            buffer.fit(gpu, sizes.splat_words)?;
        }
        of.sides.fit(gpu, sizes.splat_words)?;
        let of = &mut self.of_pairs;
        of.splat.fit(gpu, sizes.pair_words)?;
        of.sides.fit(gpu, sizes.pair_words)?;
        of.moments.fit(gpu, sizes.moments)?;
        self.sorter.fit(gpu, sizes.histogram, sizes.block_sums)?;
        self.tile_ranges.fit(gpu, sizes.ranges)?;
        self.last.fit(gpu, sizes.last)?;
        self.frame.fit(gpu, sizes.frame)?;
        self.upstream.fit(gpu, sizes.upstream)?;
        self.sums.fit(gpu, sizes.sums)?;
        self.statistics.fit(gpu, sizes.statistics)?;
        if self.gradients.stride() != stride || self.gradients.sh_degree() != sh_degree {
            self.gradients = Columns::new(gpu, "gradients", 0, 0)?;
            self.gradients = Columns::new(gpu, "gradients", sh_degree, stride)?;
        }
        Ok(())
    }
}

pub(super) fn set_of(splats: &GpuSplats, first: usize, sh_degree: u8) -> Set {
    Set {
        first: first as u32,
        count: splats.len() as u32,
        stride: splats.columns().stride() as u32,
        sh_degree: sh_degree.into(),
    }
}
