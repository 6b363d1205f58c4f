//! What a [`GpuRenderer`] shows of its buffers, what it reads back, and how it makes room.

use std::slice;

use bytemuck::Zeroable;

use super::*;
use crate::Stages;

impl GpuRenderer {
    /// Of each view planes of `width · height` floats one after the other: red, green, blue, transmittance and, with
    /// [`Options::extras`], depth and own; as in [`Frame`].
    pub fn frame(&self) -> &wgpu::Buffer {
        &self.frame
    }

    /// Where the gradient of a loss goes before [`backward`](Self::backward): of each view planes as in [`crate::Upstream`], three of
    /// colour, transmittance, depth, with room for all. It is there once `forward` was called.
    pub fn upstream(&self) -> &wgpu::Buffer {
        &self.upstream
    }

    /// Gradients in columns as the splats', with their stride. Only rows of splats that were seen mean anything.
    pub fn gradients(&self) -> &Columns {
        &self.gradients
    }

    /// Of each visible entry of trainable splats four floats: `screen`, `screen_abs` and `weight` of [`Gradients`] in its view, and the
    /// view's pixels.
    pub fn statistics(&self) -> &wgpu::Buffer {
        &self.statistics
    }

    /// The visible entries, ascending; the first [`Status::seen`] are those of trainable splats. Entry `i` of `n` views is splat `i / n`
    /// in view `i % n`.
    pub fn visible(&self) -> &wgpu::Buffer {
        &self.of_splats.visible
    }

    /// A word for each entry, own first, then context: 1 where it was drawn.
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

    /// Waits, and makes room if views had too many pairs. True: they and all that followed them were not drawn and must be
    /// done again.
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
            self.forward(&mut encoder, splats, context, slice::from_ref(camera), options)?;
            self.gpu.submit(encoder)?;
            if !self.recover()? {
                return self.read_frame(0);
            }
        }
    }

    /// The frame of one of the last views, once it is drawn.
    ///
    /// # Errors
    /// What went wrong until then, or without such a view.
    pub fn read_frame(&self, view: usize) -> Result<Frame, GpuError> {
        let drawn = self.drawn.filter(|drawn| view < drawn.views.count as usize);
        let Some(Drawn { views, .. }) = drawn else {
            return Err(GpuError::Failed("there is no frame of a view that was not drawn".into()));
        };
        let view = views.each[view];
        let area = (view.pixels[0] * view.pixels[1]) as usize;
        let (planes, extra) = if views.extras != 0 { (6, area) } else { (4, 0) };
        let first = planes * view.first_pixel as usize;
        Ok(Frame {
            width: view.pixels[0] as usize,
            height: view.pixels[1] as usize,
            colour: self.gpu.read(&self.frame, first, 3 * area)?,
            transmittance: self.gpu.read(&self.frame, first + 3 * area, area)?,
            depth: self.gpu.read(&self.frame, first + 4 * area, extra)?,
            own: self.gpu.read(&self.frame, first + 5 * area, extra)?,
        })
    }

    /// The last view, and the side of its sorted pairs, where there was one alone: stages are compared view by view.
    pub(super) fn only_view(&self, what: &str) -> Result<(Views, usize), GpuError> {
        match self.drawn {
            Some(Drawn { views, side, .. }) if views.count == 1 => Ok((views, side)),
            _ => Err(GpuError::Failed(format!("there are no {what} but of one view alone, after its forward pass"))),
        }
    }

    /// What the stages before `rasterize` came to in the last view, once it is drawn.
    ///
    /// # Errors
    /// What went wrong until then, or unless it was one view.
    pub fn read_stages(&self) -> Result<Stages, GpuError> {
        let (views, side) = self.only_view("stages")?;
        let (gpu, status) = (&*self.gpu, self.status()?);
        let (visible, pairs) = (status.visible as usize, status.pairs as usize);
        // An even number of passes: the order by depth lies where it began.
        let order: Vec<u32> = gpu.read(&self.of_splats.sides.values[0], 0, visible)?;
        let records: Vec<[f32; 12]> = gpu.read(&self.of_splats.records, 0, views.total as usize)?;
        let mut rank = vec![0; views.total as usize];
        order.iter().enumerate().for_each(|(n, &i)| rank[i as usize] = n as u32);
        let sorted: Vec<u32> = gpu.read(&self.of_pairs.sides.values[side], 0, pairs)?;
        let splats: Vec<u32> = gpu.read(&self.of_pairs.splat, 0, pairs)?;
        let ranges: Vec<[u32; 2]> = gpu.read(&self.tile_ranges, 0, views.tiles as usize)?;
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

    /// The last gradients as the CPU has them, summed over the views: zero where no view saw a splat. The pose's are always zero.
    ///
    /// # Errors
    /// What went wrong until then, or without a view.
    pub fn read_gradients(&self, splats: &GpuSplats) -> Result<Gradients, GpuError> {
        let Some(Drawn { views, .. }) = self.drawn else {
            return Err(GpuError::Failed("there are no gradients before the first forward pass".into()));
        };
        let (n, seen) = (splats.len(), self.status()?.seen as usize);
        let entries: Vec<u32> = self.gpu.read(&self.of_splats.visible, 0, seen)?;
        let statistics: Vec<[f32; 4]> = self.gpu.read(&self.statistics, 0, seen)?;
        let mut bits = vec![0u16; n.div_ceil(16)];
        let mut sums = [(); 3].map(|()| vec![0.0; n]);
        for (entry, statistics) in entries.iter().zip(statistics) {
            let i = (entry / views.count) as usize;
            bits[i / 16] |= 1 << (i % 16);
            sums.iter_mut().zip(statistics).for_each(|(sums, value)| sums[i] += value);
        }
        let mut columns = self.gradients.read(&self.gpu, n)?;
        for column in &mut columns {
            let unseen = column.iter_mut().enumerate().filter(|(i, _)| bits[i / 16] >> (i % 16) & 1 == 0);
            unseen.for_each(|(_, value)| *value = 0.0);
        }
        let [screen, screen_abs, weight] = sums;
        Ok(Gradients { columns, seen: bits, screen, screen_abs, weight, pose: [0.0; 6] })
    }

    /// Cameras side by side, over so many trainable splats and others.
    pub(super) fn views_of(
        &self,
        cameras: &[Camera],
        options: &Options,
        own: usize,
        others: usize,
    ) -> Result<Views, GpuError> {
        let count = cameras.len();
        if count == 0 || count > MOST_VIEWS {
            return Err(GpuError::Failed(format!("{count} views cannot be drawn side by side, 1 to {MOST_VIEWS} can")));
        }
        let entries = |splats: usize| {
            let bytes = 4 * count as u64 * splats as u64;
            let fits = u32::try_from(count * splats).ok().filter(|_| bytes <= self.gpu.room());
            fits.ok_or(GpuError::TooLarge { what: "visible".into(), bytes, most: self.gpu.room() })
        };
        let area = |camera: &Camera| u64::from(camera.pinhole.width) * u64::from(camera.pinhole.height);
        // Five planes of gradients; also, pixels and tiles are then numbers of 32 bits.
        let (bytes, most) = (20 * cameras.iter().map(area).sum::<u64>(), self.gpu.room());
        if bytes > most {
            return Err(GpuError::TooLarge { what: "upstream".into(), bytes, most });
        }
        let mut views = Views {
            background: [options.background[0], options.background[1], options.background[2], 0.0],
            count: count as u32,
            own: entries(own)?,
            total: entries(own + others)?,
            pair_capacity: self.pair_capacity as u32,
            antialiased: options.antialiased.into(),
            extras: options.extras.into(),
            ..Views::zeroed()
        };
        for (place, camera) in views.each.iter_mut().zip(cameras) {
            *place = View { first_tile: views.tiles, first_pixel: views.pixels, ..Self::view_of(camera) };
            views.tiles += place.tiles[0] * place.tiles[1];
            views.pixels += place.pixels[0] * place.pixels[1];
        }
        Ok(views)
    }

    fn view_of(camera: &Camera) -> View {
        let k = &camera.pinhole;
        let rows = camera.rotation().transpose().to_cols_array_2d();
        let translation = camera.camera_from_world.translation.to_array();
        let guard = |length: u32, focal: f64| 0.15 * f64::from(length) / focal;
        let (gx, gy) = (guard(k.width, k.fx), guard(k.height, k.fy));
        let centre = camera.centre().as_vec3();
        View {
            rows: std::array::from_fn(|r| {
                [rows[r][0] as f32, rows[r][1] as f32, rows[r][2] as f32, translation[r] as f32]
            }),
            centre: [centre.x, centre.y, centre.z, 0.0],
            focal: [k.fx as f32, k.fy as f32],
            principal: [k.cx as f32, k.cy as f32],
            cone_min: [(-k.cx / k.fx - gx) as f32, (-k.cy / k.fy - gy) as f32],
            cone_max: [
                ((f64::from(k.width) - k.cx) / k.fx + gx) as f32,
                ((f64::from(k.height) - k.cy) / k.fy + gy) as f32,
            ],
            pixels: [k.width, k.height],
            tiles: [k.width.div_ceil(TILE), k.height.div_ceil(TILE)],
            first_tile: 0,
            first_pixel: 0,
            padding: [0; 2],
        }
    }

    /// With room to spare where a binding has it, so that a job does not stop for a few pairs more.
    fn room_for(&self, pairs: usize) -> usize {
        let bound = (self.gpu.room() / (4 * u64::from(MOMENTS))) as usize;
        (pairs + pairs / 2).next_multiple_of(1 << 16).min(bound).max(pairs)
    }

    /// Makes room for views. Buffers only grow.
    pub(super) fn fit(&mut self, views: &Views, splats: &GpuSplats) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let (stride, sh_degree) = (splats.columns().stride(), splats.sh_degree());
        let sizes = Sizes::of(views);
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
