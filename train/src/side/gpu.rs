//! Steps on a GPU: splats, moments and evidence live there and run ahead of the host, which reads them when it has to decide.
//!
//! ```text
//! photos ┐
//! splats ┴forward→ frames ─loss_forward→ sums ─judge→ books ─loss_backward→ upstream ─backward→ gradients ─evidence, adam→ splats
//! ```
//! Nothing is read back for a step. Whether its loss is finite the device judges, and the books there say how many steps are
//! over: where a step's views had more pairs than there was room for, it and all that followed changed nothing, and the host, once it
//! sees that, makes room and begins them again. So a result depends neither on that room nor on when the host looks.

use std::collections::VecDeque;
use std::iter;
use std::sync::Arc;

use bytemuck::Zeroable;
use render::cpu::Isa;
use render::gpu::{Buffer, Columns, Gpu, GpuError, GpuRenderer, GpuSplats, Growing, Kernel, UpstreamPlanes};
use scene::{Camera, Splats, column};
use shaders::train::{ADAM, Books, EVIDENCE, LOSS, Rates, Window, Windows};
use shaders::{MOST_VIEWS, TILE, args};

use super::{Look, MOST_VIEWS_PER_STEP, Part, Side, Step};
use crate::growth::Evidence;
use crate::need::Tally;
use crate::optimiser::Adam;
use crate::{State, TrainError};

/// Steps that the device may be behind: the next photo is read meanwhile.
const IN_FLIGHT: usize = 2;
/// Photos between two looks at the books: they are kept until then, in case their steps must be done again.
const LOOK_EVERY: usize = 32;
const _: () = assert!(MOST_VIEWS_PER_STEP as usize == MOST_VIEWS);

/// First column of each bank of [`Columns`], and the end.
const BANKS: [usize; 5] = [0, column::SH + 3, column::SH + 18, column::SH + 33, column::SH + 48];

/// A training on a GPU.
pub(crate) struct GpuSide {
    gpu: Arc<Gpu>,
    renderer: GpuRenderer,
    kernels: Kernels,
    lambda: f32,
    splats: GpuSplats,
    context: Option<GpuSplats>,
    /// First and second moments, with the splats' stride.
    moments: [Columns; 2],
    /// Of each splat error and weight, with the splats' stride; and views.
    evidence: Growing,
    views: Growing,
    books: Buffer,
    /// Photos, each with its mask, a byte a value.
    photo: Growing,
    /// SSIM's derivatives.
    partials: Growing,
    /// Sums of tiles.
    sums: Growing,
    /// Steps begun that are not known to be over.
    begun: VecDeque<Step>,
    /// Steps that were over when the host last looked, as the books count.
    done: u32,
    in_flight: VecDeque<wgpu::SubmissionIndex>,
}

struct Kernels {
    loss_forward: Kernel,
    judge: Kernel,
    loss_backward: Kernel,
    evidence: Kernel,
    adam_shape: Kernel,
    adam_colour: Kernel,
}

impl GpuSide {
    /// Takes over a state, with the weight λ of 1 - SSIM in the loss.
    pub(crate) fn new(gpu: &Arc<Gpu>, now: &State, lambda: f32, context: Option<&Splats>) -> Result<Self, TrainError> {
        let g = &**gpu;
        let kernels = Kernels {
            loss_forward: g.kernel(&LOSS, "loss_forward")?,
            judge: g.kernel(&LOSS, "judge")?,
            loss_backward: g.kernel(&LOSS, "loss_backward")?,
            evidence: g.kernel(&EVIDENCE, "evidence")?,
            adam_shape: g.kernel(&ADAM, "adam_shape")?,
            adam_colour: g.kernel(&ADAM, "adam_colour")?,
        };
        let moments = || Columns::new(g, "moments", 0, 0);
        let mut side = Self {
            renderer: GpuRenderer::new(Arc::clone(gpu))?,
            kernels,
            lambda,
            splats: GpuSplats::upload(gpu, &now.splats, now.splats.len())?,
            context: context.map(|context| GpuSplats::upload(gpu, context, context.len())).transpose()?,
            moments: [moments()?, moments()?],
            evidence: Growing::new(g, "evidence")?,
            views: Growing::new(g, "views of splats")?,
            books: g.buffer("books", size_of::<Books>() as u64)?,
            photo: Growing::new(g, "photo")?,
            partials: Growing::new(g, "derivatives of SSIM")?,
            sums: Growing::new(g, "sums of tiles")?,
            begun: VecDeque::new(),
            done: 0,
            in_flight: VecDeque::new(),
            gpu: Arc::clone(gpu),
        };
        side.take_over(now)?;
        Ok(side)
    }

    /// Everything but the splats, which are there already.
    fn take_over(&mut self, now: &State) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let (stride, sh_degree) = (self.splats.columns().stride(), self.splats.sh_degree());
        let (adam_steps, first, second) = now.adam.parts();
        for (moments, columns) in self.moments.iter_mut().zip([first, second]) {
            if moments.stride() != stride || moments.sh_degree() != sh_degree {
                // The old ones first: both at once may be more than there is.
                *moments = Columns::new(gpu, "moments", 0, 0)?;
                *moments = Columns::new(gpu, "moments", sh_degree, stride)?;
            }
            moments.write(gpu, columns)?;
        }
        self.evidence.fit(gpu, 8 * stride as u64)?;
        self.views.fit(gpu, 4 * stride as u64)?;
        let n = now.splats.len();
        let Evidence { error, weight, views } = &now.evidence;
        // There is evidence of all splats, or of none since the last refinement.
        let padded =
            |values: &[f32]| -> Vec<f32> { values.iter().copied().chain(iter::repeat(0.0)).take(stride).collect() };
        gpu.upload(&self.evidence, 0, &padded(error))?;
        gpu.upload(&self.evidence, 4 * stride as u64, &padded(weight))?;
        let views: Vec<u32> = views.iter().copied().chain(iter::repeat(0)).take(n).collect();
        gpu.upload(&self.views, 0, &views)?;
        let Tally { sum, count } = now.need.tally;
        let books = Books {
            adam_steps: adam_steps as u32,
            skipped: now.skipped,
            count,
            sum: sum as f32,
            loss: now.loss as f32,
            ..Books::default()
        };
        self.done = 0;
        gpu.upload(&self.books, 0, &[books])
    }

    /// Hands a step to the device.
    fn submit(&mut self, step: &Step) -> Result<(), GpuError> {
        let gpu = Arc::clone(&self.gpu);
        let Step { looks, options, rates, .. } = step;
        let (windows, bytes) = self.windows(looks, options.extras);
        let area: usize = looks.iter().map(|look| look.photo.area()).sum();
        let tiles = 3 * windows.tiles;
        self.photo.fit(&gpu, bytes.len() as u64)?;
        self.partials.fit(&gpu, 4 * 9 * area as u64)?;
        self.sums.fit(&gpu, 16 * u64::from(tiles))?;

        let mut encoder = gpu.encoder();
        gpu.write(&mut encoder, &self.photo, 0, &bytes);
        let cameras: Vec<Camera> = looks.iter().map(|look| look.camera).collect();
        self.renderer.forward(&mut encoder, &self.splats, self.context.as_ref(), &cameras, options)?;
        let windows = gpu.uniform(&windows);
        {
            let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let Kernels { loss_forward, judge, loss_backward, .. } = &self.kernels;
            let (frame, status) = (self.renderer.frame(), self.renderer.status_buffer());
            let bindings = [(0, &windows), (1, frame), (2, &*self.photo), (3, &*self.partials), (4, &*self.sums)];
            loss_forward.run(&gpu, pass, &bindings, tiles);
            judge.run(&gpu, pass, &[(0, &windows), (4, &self.sums), (5, &self.books), (7, status)], 1);
            let upstream = self.renderer.upstream();
            let bindings = [bindings[0], bindings[1], bindings[2], bindings[3], (5, &self.books), (6, upstream)];
            loss_backward.run(&gpu, pass, &bindings, tiles);
        }
        self.renderer.backward(&mut encoder, &self.splats, UpstreamPlanes::default())?;
        self.move_splats(&mut encoder, options.sh_degree, rates, looks.len());
        self.in_flight.push_back(gpu.submit(encoder)?);
        match self.in_flight.len() > IN_FLIGHT {
            true => self.in_flight.pop_front().map_or(Ok(()), |index| gpu.wait_for(index)),
            false => Ok(()),
        }
    }

    /// Where each photo lies beside its frame, and the bytes of all.
    fn windows(&self, looks: &[Look], by_share: bool) -> (Windows, Vec<u8>) {
        let (mut bytes, mut first_pixel) = (Vec::new(), 0);
        let mut windows =
            Windows { count: looks.len() as u32, lambda: self.lambda, by_share: by_share.into(), ..Windows::zeroed() };
        for (window, Look { photo, .. }) in windows.each.iter_mut().zip(looks) {
            let (width, height) = (photo.width, photo.height);
            *window = Window {
                width,
                height,
                tiles_x: width.div_ceil(TILE),
                tiles_y: height.div_ceil(TILE),
                first_tile: windows.tiles,
                first_pixel,
                first_byte: bytes.len() as u32,
                masked: photo.mask.is_some().into(),
            };
            windows.tiles += window.tiles_x * window.tiles_y;
            first_pixel += photo.area() as u32;
            bytes.extend_from_slice(&photo.rgb);
            bytes.extend_from_slice(photo.mask.as_deref().unwrap_or_default());
            bytes.resize(bytes.len().next_multiple_of(4), 0);
        }
        (windows, bytes)
    }

    /// Evidence, and a step of Adam, from the gradients of so many views.
    fn move_splats(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        sh_degree: u8,
        rates: &crate::optimiser::Rates,
        views: usize,
    ) {
        let Self { gpu, renderer, kernels, .. } = self;
        let used = column::SH + 3 * scene::splats::sh_coefficients(sh_degree.min(self.splats.sh_degree()));
        let rates = |columns: usize| {
            gpu.uniform(&Rates {
                mean: rates.mean,
                log_scale: rates.log_scale,
                quat: rates.quat,
                opacity: rates.opacity,
                sh_dc: rates.sh_dc,
                sh_rest: rates.sh_rest,
                beta2: rates.beta2,
                // Each view's loss holds the means over the splats that it sees.
                opacity_pull: views as f32 * rates.opacity_pull,
                needle_pull: views as f32 * rates.needle_pull,
                log_scale_min: rates.log_scale_bounds[0],
                log_scale_max: rates.log_scale_bounds[1],
                columns: columns as u32,
                stride: self.splats.columns().stride() as u32,
                views: views as u32,
                padding: [0; 2],
            })
        };
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let (status, visible, args) = (renderer.status_buffer(), renderer.visible(), renderer.args());
        let first_rates = rates(0);
        let common = [(0, &first_rates), (1, status), (2, &self.books), (3, visible)];
        let bindings = [(4, renderer.statistics()), (5, &*self.evidence), (6, &*self.views)];
        kernels.evidence.run_indirect(gpu, pass, &[&common[..], &bindings].concat(), args, args::SEEN);
        let values = self.splats.columns().banks();
        let [first, second] = self.moments.each_ref().map(Columns::banks);
        let gradients = renderer.gradients().banks();
        let of_bank = |bank: usize| [(4, values[bank]), (5, first[bank]), (6, second[bank]), (7, gradients[bank])];
        kernels.adam_shape.run_indirect(gpu, pass, &[&common[..], &of_bank(0)].concat(), args, args::SEEN);
        for bank in 1..4 {
            let before = BANKS[bank];
            if used > before {
                let rates = rates(used.min(BANKS[bank + 1]) - before);
                let bindings = [&[(0, &rates)], &common[1..], &of_bank(bank)].concat();
                kernels.adam_colour.run_indirect(gpu, pass, &bindings, args, args::SEEN);
            }
        }
    }

    /// Waits until all steps begun are over.
    fn settle(&mut self) -> Result<Books, GpuError> {
        loop {
            let recovered = self.renderer.recover()?;
            self.in_flight.clear();
            let books: Books = self.gpu.read(&self.books, 0, 1)?[0];
            let over = (books.done - self.done) as usize;
            self.begun.drain(..over.min(self.begun.len()));
            self.done = books.done;
            if self.begun.is_empty() {
                return Ok(books);
            }
            if !recovered {
                return Err(GpuError::Failed("steps were handed to it that it neither did nor left out".into()));
            }
            let again: Vec<Step> = self.begun.iter().cloned().collect();
            again.iter().try_for_each(|step| self.submit(step))?;
        }
    }
}

impl Side for GpuSide {
    fn step(&mut self, _: &mut State, step: Step) -> Result<(), TrainError> {
        if self.begun.iter().map(|step| step.looks.len()).sum::<usize>() >= LOOK_EVERY {
            self.settle()?;
        }
        self.submit(&step)?;
        self.begun.push_back(step);
        Ok(())
    }

    fn fetch(&mut self, now: &mut State, part: Part) -> Result<(), TrainError> {
        let books = self.settle()?;
        now.skipped = books.skipped;
        now.loss = f64::from(books.loss);
        now.need.tally = Tally { sum: f64::from(books.sum), count: books.count };
        if part >= Part::Splats {
            now.splats = self.splats.download()?;
        }
        if part >= Part::All {
            let (gpu, n, stride) = (&*self.gpu, self.splats.len(), self.splats.columns().stride());
            let [first, second] = &self.moments;
            let (first, second) = (first.read(gpu, n)?, second.read(gpu, n)?);
            now.adam = Adam::from_parts(Isa::detect(), books.adam_steps as i32, first, second);
            now.evidence = Evidence {
                error: gpu.read(&self.evidence, 0, n)?,
                weight: gpu.read(&self.evidence, stride, n)?,
                views: gpu.read(&self.views, 0, n)?,
            };
        }
        Ok(())
    }

    fn give(&mut self, now: &State, part: Part) -> Result<(), TrainError> {
        self.settle()?;
        if part == Part::Tally {
            let Tally { sum, count } = now.need.tally;
            let offset = std::mem::offset_of!(Books, count) as u64;
            self.gpu.upload(&self.books, offset, &[count, (sum as f32).to_bits()])?;
        } else {
            self.splats.replace(&now.splats)?;
            self.take_over(now)?;
        }
        Ok(())
    }
}

impl From<GpuError> for TrainError {
    fn from(error: GpuError) -> Self {
        match error.is_memory() {
            true => Self::OutOfMemory(error.to_string()),
            false => Self::Device(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests;
