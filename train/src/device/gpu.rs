//! Computes training steps on a GPU. Splats, Adam moments and densification statistics live on the device, which runs
//! ahead of the host.
//!
//! ```text
//! photos ┐
//! splats ┴forward→ frames ─loss_forward→ sums ─finish_loss→ optimiser state
//!         ─loss_backward→ upstream ─expose_backward→ upstream ─backward→ gradients ─adam→ splats
//!                        └→ sums ─exposure_step→ exposures   └→ pose gradients ─pose_step→ displacements
//! ```
//! A step reads nothing back, but one with a picture loss, which the host computes from the frames before it submits the step:
//! its slopes are then a part of the photos. The device itself checks that the loss is finite and counts finished steps in its
//! optimiser state. When a step has more tile pairs than the pair buffer holds, that step and all after it change
//! nothing. The host finds this at the next synchronisation, enlarges the buffer and resubmits those steps. The result
//! therefore depends neither on the buffer's size nor on when the host synchronises.

use std::collections::VecDeque;
use std::iter;
use std::sync::Arc;

use bytemuck::Zeroable;
use render::cpu::Isa;
use render::gpu::{
    Buffer, Columns, Gpu, GpuError, GpuPart, GpuRenderer, GpuSplats, GrowableBuffer, Kernel, UpstreamPlanes,
};
use scene::{Camera, Splats, column};
use shaders::train::{
    ADAM, AdamConstants, DENSIFICATION_STATS, LOSS, NO_ROW, OptimiserState, Photo, Photos, REARRANGE,
    RearrangeConstants,
};
use shaders::{MAX_VIEWS, TILE, WORKGROUP_SIZE, args};

use self::exposures::{GpuExposures, LossBuffers};
use self::poses::GpuPoses;
use super::cpu::pixel_weights;
use super::step::{MAX_VIEWS_PER_STEP, StatePart, Step, TrainDevice, ViewSample};
use crate::checkpoint::State;
use crate::coarse_to_fine::Tally;
use crate::error::TrainError;
use crate::exposure::expose;
use crate::growth::DensificationStats;
use crate::optimiser::{self, Adam};
use crate::picture_loss::{PictureLoss, add_picture_loss};
use crate::pose::GivenPoses;

mod exposures;
mod poses;

/// Steps in flight on the device while the host reads the next photo.
const IN_FLIGHT: usize = 2;
/// Samples between two synchronisations. The host keeps their photos until then, in case it has to resubmit.
const SYNC_EVERY: usize = 32;
const _: () = assert!(MAX_VIEWS_PER_STEP as usize == MAX_VIEWS);

/// First column of each bank of [`Columns`], and the end.
const BANKS: [usize; 5] = [0, column::SH + 3, column::SH + 18, column::SH + 33, column::SH + 48];

/// The training state on a GPU.
pub(crate) struct GpuDevice<'a> {
    gpu: Arc<Gpu>,
    renderer: GpuRenderer,
    kernels: Kernels,
    lambda: f32,
    picture_loss: Option<&'a dyn PictureLoss>,
    splats: GpuSplats,
    context: Option<GpuSplats>,
    /// First and second moments, with the splats' stride.
    moments: [Columns; 2],
    /// Densification error of each splat.
    stats: GrowableBuffer,
    /// One [`OptimiserState`].
    optimiser: Buffer,
    /// Photos with their masks, one byte per value, then pixel weights, target depths and slopes of the picture loss, as floats.
    photo: GrowableBuffer,
    /// Derivatives of SSIM.
    partials: GrowableBuffer,
    /// Partial sums of the loss, per tile.
    sums: GrowableBuffer,
    exposures: GpuExposures,
    poses: GpuPoses,
    /// Submitted steps that are not known to be finished.
    pending: VecDeque<Submission>,
    /// Finished steps at the last synchronisation.
    done: u32,
    in_flight: VecDeque<wgpu::SubmissionIndex>,
}

/// What a step was submitted with.
#[derive(Clone)]
struct Submission {
    step: Step,
    pictures: Option<Pictures>,
}

/// The picture loss of a step, times its weight.
#[derive(Clone, Default)]
struct Pictures {
    /// Sum over the samples.
    loss: f64,
    /// Its derivative with respect to each sample's shown picture, three planes.
    slopes: Vec<Vec<f32>>,
}

struct Kernels {
    loss_forward: Kernel,
    finish_loss: Kernel,
    loss_backward: Kernel,
    stats: Kernel,
    adam_shape: Kernel,
    adam_colour: Kernel,
    rearrange: Kernel,
}

impl<'a> GpuDevice<'a> {
    /// Uploads a state. `lambda` is the weight of D-SSIM in the loss; `given` are the poses that displacements refer to.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        state: &State,
        lambda: f32,
        picture_loss: Option<&'a dyn PictureLoss>,
        context: Option<&Splats>,
        given: &Arc<GivenPoses>,
    ) -> Result<Self, TrainError> {
        let g = &**gpu;
        let kernels = Kernels {
            loss_forward: g.kernel(&LOSS, "loss_forward")?,
            finish_loss: g.kernel(&LOSS, "finish_loss")?,
            loss_backward: g.kernel(&LOSS, "loss_backward")?,
            stats: g.kernel(&DENSIFICATION_STATS, "densification_stats")?,
            adam_shape: g.kernel(&ADAM, "adam_shape")?,
            adam_colour: g.kernel(&ADAM, "adam_colour")?,
            rearrange: g.kernel(&REARRANGE, "rearrange")?,
        };
        let moments = || Columns::new(g, "moments", 0, 0);
        let mut device = Self {
            renderer: GpuRenderer::new(Arc::clone(gpu))?,
            kernels,
            lambda,
            picture_loss,
            splats: GpuSplats::upload(gpu, &state.splats, state.splats.len())?,
            context: context.map(|context| GpuSplats::upload(gpu, context, context.len())).transpose()?,
            moments: [moments()?, moments()?],
            stats: GrowableBuffer::new(g, "densification statistics")?,
            optimiser: g.buffer("optimiser state", size_of::<OptimiserState>() as u64)?,
            photo: GrowableBuffer::new(g, "photo")?,
            partials: GrowableBuffer::new(g, "derivatives of SSIM")?,
            sums: GrowableBuffer::new(g, "sums of tiles")?,
            exposures: GpuExposures::new(g)?,
            poses: GpuPoses::new(g, given)?,
            pending: VecDeque::new(),
            done: 0,
            in_flight: VecDeque::new(),
            gpu: Arc::clone(gpu),
        };
        device.upload_training_state(state)?;
        Ok(device)
    }

    /// Uploads everything but the splats.
    fn upload_training_state(&mut self, state: &State) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let (stride, sh_degree) = (self.splats.columns().stride(), self.splats.sh_degree());
        let (adam_steps, first, second) = state.adam.parts();
        for (moments, columns) in self.moments.iter_mut().zip([first, second]) {
            if moments.stride() != stride || moments.sh_degree() != sh_degree {
                // Free the old moments first: device memory may not hold both.
                *moments = Columns::new(gpu, "moments", 0, 0)?;
                *moments = Columns::new(gpu, "moments", sh_degree, stride)?;
            }
            moments.write(gpu, columns)?;
        }
        self.exposures.upload(gpu, state.exposures.as_ref())?;
        self.poses.upload(gpu, state.poses.as_ref())?;
        self.stats.reserve(gpu, 4 * stride as u64)?;
        // The host has statistics of all splats, or of none since the last refinement.
        let error = state.densification.error.iter().copied();
        let error: Vec<f32> = error.chain(iter::repeat(0.0)).take(stride).collect();
        gpu.upload(&self.stats, 0, &error)?;
        let Tally { sum, count } = state.coarse_to_fine.tally;
        let optimiser = OptimiserState {
            adam_steps: adam_steps as u32,
            steps_skipped: state.skipped,
            epoch_views: count,
            epoch_l1: sum as f32,
            loss: state.loss as f32,
            ..OptimiserState::default()
        };
        self.done = 0;
        gpu.upload(&self.optimiser, 0, &[optimiser])
    }

    /// Submits a step.
    fn submit(&mut self, Submission { step, pictures }: &Submission) -> Result<(), GpuError> {
        let gpu = Arc::clone(&self.gpu);
        let Step { samples, options, rates, depth_weight, exposure_rate, pose_rates, .. } = step;
        let (photos, bytes) = self.photos(samples, options.extras, *depth_weight, pictures.as_ref());
        let area: usize = samples.iter().map(|sample| sample.photo.area()).sum();
        let (of_photos, tiles) = (photos.tiles, 3 * photos.tiles);
        self.photo.reserve(&gpu, bytes.len() as u64)?;
        self.partials.reserve(&gpu, 4 * 9 * area as u64)?;
        self.sums.reserve(&gpu, 16 * u64::from(tiles))?;

        let mut encoder = gpu.encoder();
        gpu.write(&mut encoder, &self.photo, 0, &bytes);
        self.exposures.prepare(&gpu, &mut encoder, samples, of_photos)?;
        let rows = self.poses.rows(samples);
        self.forward(&mut encoder, step, &rows)?;
        let photos = gpu.uniform(&photos);
        {
            let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let Kernels { loss_forward, finish_loss, loss_backward, .. } = &self.kernels;
            let (frame, status) = (self.renderer.frame(), self.renderer.status_buffer());
            let exposures = (8, self.exposures.values());
            let bindings = [(0, &photos), (1, frame), (2, &*self.photo), (3, &*self.partials), exposures];
            loss_forward.run(&gpu, pass, &[&bindings[..], &[(4, &*self.sums)]].concat(), tiles);
            finish_loss.run(&gpu, pass, &[(0, &photos), (4, &self.sums), (5, &self.optimiser), (7, status)], 1);
            let upstream = self.renderer.upstream();
            loss_backward.run(&gpu, pass, &[&bindings[..], &[(5, &self.optimiser), (6, upstream)]].concat(), tiles);
            let buffers = LossBuffers { photos: &photos, frame, upstream, optimiser: &self.optimiser };
            self.exposures.encode(&gpu, pass, &buffers, samples, of_photos, *exposure_rate);
        }
        let planes = match *depth_weight > 0.0 {
            true => UpstreamPlanes { transmittance: true, depth: true },
            false => UpstreamPlanes::default(),
        };
        self.renderer.backward(&mut encoder, &self.splats, planes)?;
        if let Some(rates) = pose_rates {
            let buffers = [self.renderer.pose_gradients(), &self.optimiser];
            self.poses.encode(&gpu, &mut encoder, buffers, &rows, rates);
        }
        if let Some(rates) = rates {
            self.update_splats(&mut encoder, options.sh_degree, rates, samples.len());
        }
        self.in_flight.push_back(gpu.submit(encoder)?);
        match self.in_flight.len() > IN_FLIGHT {
            true => self.in_flight.pop_front().map_or(Ok(()), |index| gpu.wait_for(index)),
            false => Ok(()),
        }
    }

    /// Encodes the forward pass of a step; `rows` are those of its samples' poses.
    fn forward(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        Step { samples, options, .. }: &Step,
        rows: &[Option<u32>],
    ) -> Result<(), GpuError> {
        let cameras: Vec<Camera> = samples.iter().map(|sample| sample.camera).collect();
        let displacements = self.poses.displacements(rows);
        let context = self.context.as_ref().map(GpuPart::beside);
        self.renderer.forward_displaced(encoder, &self.splats, context.as_slice(), &cameras, options, displacements)
    }

    /// The picture loss of a step, of frames that are drawn for it alone. No submitted step is pending.
    fn pictures(&mut self, of: &dyn PictureLoss, step: &Step) -> Result<Pictures, TrainError> {
        let rows = self.poses.rows(&step.samples);
        loop {
            let mut encoder = self.gpu.encoder();
            self.forward(&mut encoder, step, &rows)?;
            self.gpu.submit(encoder)?;
            if !self.renderer.grow_after_overflow()? {
                break;
            }
        }
        let trained = self.exposures.download(&self.gpu)?;
        let (mut weights, mut exposed) = (Vec::new(), Vec::new());
        let mut pictures = Pictures::default();
        for (n, sample) in step.samples.iter().enumerate() {
            let frame = self.renderer.read_frame(n)?;
            pixel_weights(&frame, &sample.photo, self.context.is_some(), &mut weights);
            let exposure = trained.as_ref().map_or(sample.exposure, |trained| trained.of(sample.view));
            let shown = exposure.as_ref().map_or(&frame.colour, |exposure| {
                expose(exposure, &frame.colour, &mut exposed);
                &exposed
            });
            let mut slopes = vec![0.0; shown.len()];
            pictures.loss += add_picture_loss(of, step.picture_weight, sample, shown, &weights, &mut slopes)?;
            pictures.slopes.push(slopes);
        }
        Ok(pictures)
    }

    /// The layout of the photos in the photo buffer, and the bytes of all photos.
    fn photos(
        &self,
        samples: &[ViewSample],
        extras: bool,
        depth_weight: f32,
        pictures: Option<&Pictures>,
    ) -> (Photos, Vec<u8>) {
        let (mut bytes, mut first_pixel) = (Vec::new(), 0);
        let mut photos = Photos {
            count: samples.len() as u32,
            lambda: self.lambda,
            share_weighted: self.context.is_some().into(),
            extras: extras.into(),
            depth_weight,
            picture_loss: pictures.map_or(0.0, |pictures| pictures.loss as f32),
            ..Photos::zeroed()
        };
        for (n, (layout, sample)) in photos.photo.iter_mut().zip(samples).enumerate() {
            let photo = &sample.photo;
            let (width, height) = (photo.width, photo.height);
            *layout = Photo {
                width,
                height,
                tiles_x: width.div_ceil(TILE),
                tiles_y: height.div_ceil(TILE),
                first_tile: photos.tiles,
                first_pixel,
                first_byte: bytes.len() as u32,
                masked: photo.mask.is_some().into(),
                exposure: self.exposures.number(n, sample),
                ..Photo::zeroed()
            };
            photos.tiles += layout.tiles_x * layout.tiles_y;
            first_pixel += photo.area() as u32;
            bytes.extend_from_slice(&photo.rgb);
            bytes.extend_from_slice(photo.mask.as_deref().unwrap_or_default());
            bytes.resize(bytes.len().next_multiple_of(4), 0);
            let mut append = |planes: Option<&Vec<f32>>| match planes {
                Some(planes) => {
                    let first_word = (bytes.len() / 4) as u32;
                    bytes.extend_from_slice(bytemuck::cast_slice(planes));
                    first_word
                }
                None => 0,
            };
            layout.first_weight = append(photo.weights.as_ref());
            layout.first_depth = append(photo.depth.as_ref().filter(|_| depth_weight > 0.0));
            layout.first_slope = append(pictures.map(|pictures| &pictures.slopes[n]));
        }
        (photos, bytes)
    }

    /// Updates densification statistics and splats from the summed gradients of `views` views.
    fn update_splats(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        sh_degree: u8,
        rates: &optimiser::LearningRates,
        views: usize,
    ) {
        let Self { gpu, renderer, kernels, .. } = self;
        let used = column::SH + 3 * scene::splats::sh_coefficients(sh_degree.min(self.splats.sh_degree()));
        let rates = |columns: usize| {
            gpu.uniform(&AdamConstants {
                mean: rates.mean,
                log_scale: rates.log_scale,
                quat: rates.quat,
                opacity: rates.opacity,
                sh_dc: rates.sh_dc,
                sh_rest: rates.sh_rest,
                beta2: rates.beta2,
                // Each view's regulariser is a mean over its visible splats.
                opacity_reg: views as f32 * rates.opacity_reg,
                needle_reg: views as f32 * rates.needle_reg,
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
        let common = [(0, &first_rates), (1, status), (2, &self.optimiser), (3, visible)];
        let bindings = [(4, renderer.statistics()), (5, &*self.stats)];
        kernels.stats.run_indirect(gpu, pass, &[&common[..], &bindings].concat(), args, args::VISIBLE_TRAINABLE);
        let values = self.splats.columns().banks();
        let [first, second] = self.moments.each_ref().map(Columns::banks);
        let gradients = renderer.gradients().banks();
        let of_bank = |bank: usize| [(4, values[bank]), (5, first[bank]), (6, second[bank]), (7, gradients[bank])];
        kernels.adam_shape.run_indirect(gpu, pass, &[&common[..], &of_bank(0)].concat(), args, args::VISIBLE_TRAINABLE);
        for bank in 1..4 {
            let start = BANKS[bank];
            if used > start {
                let rates = rates(used.min(BANKS[bank + 1]) - start);
                let bindings = [&[(0, &rates)], &common[1..], &of_bank(bank)].concat();
                kernels.adam_colour.run_indirect(gpu, pass, &bindings, args, args::VISIBLE_TRAINABLE);
            }
        }
    }

    /// Copies Adam's state to the host.
    fn download_adam(&self, optimiser: &OptimiserState) -> Result<Adam, GpuError> {
        let [first, second] = self.moments.each_ref().map(|moments| moments.read(&self.gpu, self.splats.len()));
        Ok(Adam::from_parts(Isa::detect(), optimiser.adam_steps as i32, first?, second?))
    }

    /// Moves the rows of both moments as [`TrainDevice::rearrange`] says. The gradients' columns are free between steps:
    /// each moment is written there, and its old columns take their place.
    fn rearrange_moments(&mut self, rows: &[Option<u32>]) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let old_rows: Vec<u32> = rows.iter().map(|row| row.unwrap_or(NO_ROW)).collect();
        let row_buffer = gpu.buffer("old rows", 4 * rows.len().max(1) as u64)?;
        gpu.upload(&row_buffer, 0, &old_rows)?;
        for moments in &mut self.moments {
            let columns = column::SH + 3 * scene::splats::sh_coefficients(moments.sh_degree());
            let mut encoder = gpu.encoder();
            {
                let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                let (before, after) = (moments.banks(), self.renderer.gradients().banks());
                for bank in (0..4).filter(|&bank| columns > BANKS[bank]) {
                    let constants = gpu.uniform(&RearrangeConstants {
                        rows: rows.len() as u32,
                        columns: (columns.min(BANKS[bank + 1]) - BANKS[bank]) as u32,
                        stride: moments.stride() as u32,
                        padding: 0,
                    });
                    let bindings = [(0, &constants), (1, &*row_buffer), (2, before[bank]), (3, after[bank])];
                    let groups = (rows.len() as u32).div_ceil(WORKGROUP_SIZE);
                    self.kernels.rearrange.run(gpu, pass, &bindings, groups);
                }
            }
            gpu.submit(encoder)?;
            std::mem::swap(moments, self.renderer.gradients_mut());
        }
        Ok(())
    }

    /// Waits until all submitted steps are finished, resubmitting those that did not fit the pair buffer.
    fn synchronise(&mut self) -> Result<OptimiserState, GpuError> {
        loop {
            let grown = self.renderer.grow_after_overflow()?;
            self.in_flight.clear();
            let optimiser: OptimiserState = self.gpu.read(&self.optimiser, 0, 1)?[0];
            let finished = (optimiser.steps_done - self.done) as usize;
            self.pending.drain(..finished.min(self.pending.len()));
            self.done = optimiser.steps_done;
            if self.pending.is_empty() {
                return Ok(optimiser);
            }
            if !grown {
                return Err(GpuError::Failed("submitted steps were neither finished nor skipped".into()));
            }
            let again: Vec<Submission> = self.pending.iter().cloned().collect();
            again.iter().try_for_each(|submission| self.submit(submission))?;
        }
    }
}

impl TrainDevice for GpuDevice<'_> {
    fn step(&mut self, _: &mut State, step: Step) -> Result<(), TrainError> {
        let of_pictures = self.picture_loss.filter(|_| step.picture_weight > 0.0);
        let samples = self.pending.iter().map(|submission| submission.step.samples.len()).sum::<usize>();
        // A picture is drawn from splats that all steps before it have changed.
        if samples >= SYNC_EVERY || of_pictures.is_some() {
            self.synchronise()?;
        }
        let pictures = of_pictures.map(|of| self.pictures(of, &step)).transpose()?;
        let submission = Submission { step, pictures };
        self.submit(&submission)?;
        self.pending.push_back(submission);
        Ok(())
    }

    fn download(&mut self, state: &mut State, part: StatePart) -> Result<(), TrainError> {
        let optimiser = self.synchronise()?;
        state.skipped = optimiser.steps_skipped;
        state.loss = f64::from(optimiser.loss);
        state.coarse_to_fine.tally = Tally { sum: f64::from(optimiser.epoch_l1), count: optimiser.epoch_views };
        if part >= StatePart::Splats {
            // The device holds floats only. Rows change on the host alone, so its attributes still fit.
            state.splats = self.splats.download()?.with_attributes_of(&state.splats);
            state.exposures = self.exposures.download(&self.gpu)?;
            state.poses = self.poses.download(&self.gpu)?;
        }
        if part >= StatePart::Densification {
            state.densification = DensificationStats { error: self.gpu.read(&self.stats, 0, self.splats.len())? };
        }
        if part >= StatePart::All {
            state.adam = self.download_adam(&optimiser)?;
        }
        Ok(())
    }

    fn upload(&mut self, state: &State, part: StatePart) -> Result<(), TrainError> {
        self.synchronise()?;
        if part == StatePart::Tally {
            let Tally { sum, count } = state.coarse_to_fine.tally;
            let offset = std::mem::offset_of!(OptimiserState, epoch_views) as u64;
            self.gpu.upload(&self.optimiser, offset, &[count, (sum as f32).to_bits()])?;
        } else {
            self.splats.replace(&state.splats)?;
            self.upload_training_state(state)?;
        }
        Ok(())
    }

    fn rearrange(&mut self, state: &mut State, rows: &[Option<u32>]) -> Result<(), TrainError> {
        let optimiser = self.synchronise()?;
        let (moments, gradients) = (&self.moments[0], self.renderer.gradients());
        let has_room = state.splats.len() <= moments.stride()
            && (gradients.stride(), gradients.sh_degree()) == (moments.stride(), moments.sh_degree());
        if !has_room {
            // Columns must be allocated anew: by way of the host, where there is room for both.
            state.adam = self.download_adam(&optimiser)?;
            state.adam.rearrange(rows);
            return self.upload(state, StatePart::All);
        }
        self.splats.replace(&state.splats)?;
        self.rearrange_moments(rows)?;
        let stride = self.splats.columns().stride();
        let error = state.densification.error.iter().copied().chain(iter::repeat(0.0));
        self.gpu.upload(&self.stats, 0, &error.take(stride).collect::<Vec<f32>>())?;
        Ok(())
    }
}

impl From<GpuError> for TrainError {
    fn from(error: GpuError) -> Self {
        match error.is_out_of_memory() {
            true => Self::OutOfMemory(error.to_string()),
            false => Self::Device(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests;
