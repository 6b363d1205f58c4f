//! Exposures on the device: those in training with their Adam state, or the fixed ones of a step's views.

use bytemuck::cast_slice;
use render::gpu::{Gpu, GpuError, GrowableBuffer, Kernel};
use shaders::MAX_VIEWS;
use shaders::train::{EXPOSURE, ExposureConstants};

use crate::device::step::ViewSample;
use crate::exposure::ExposureTraining;

/// Bytes of an exposure: three rows of four floats.
const BYTES: u64 = 48;

/// The buffers that `exposure.wgsl` describes, and its kernels.
pub(super) struct GpuExposures {
    expose_backward: Kernel,
    exposure_step: Kernel,
    /// The trained exposures in the order of `views`, or the fixed ones of the samples of a step.
    values: GrowableBuffer,
    moments: GrowableBuffer,
    steps: GrowableBuffer,
    sums: GrowableBuffer,
    /// Views of the trained exposures, ascending; `None` where exposures are fixed or not used.
    views: Option<Vec<u32>>,
}

/// The buffers that the loss leaves to the exposures.
pub(super) struct LossBuffers<'a> {
    pub(super) photos: &'a wgpu::Buffer,
    pub(super) frame: &'a wgpu::Buffer,
    pub(super) upstream: &'a wgpu::Buffer,
    pub(super) optimiser: &'a wgpu::Buffer,
}

impl GpuExposures {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            expose_backward: gpu.kernel(&EXPOSURE, "expose_backward")?,
            exposure_step: gpu.kernel(&EXPOSURE, "exposure_step")?,
            values: GrowableBuffer::new(gpu, "exposures")?,
            moments: GrowableBuffer::new(gpu, "moments of exposures")?,
            steps: GrowableBuffer::new(gpu, "steps of exposures")?,
            sums: GrowableBuffer::new(gpu, "sums of exposures")?,
            views: None,
        })
    }

    /// Replaces the exposures in training.
    pub(super) fn upload(&mut self, gpu: &Gpu, training: Option<&ExposureTraining>) -> Result<(), GpuError> {
        let rows = training.map_or(0, |training| training.views.len());
        self.values.reserve(gpu, BYTES * rows.max(MAX_VIEWS) as u64)?;
        self.moments.reserve(gpu, 2 * BYTES * rows as u64)?;
        self.steps.reserve(gpu, 4 * rows as u64)?;
        self.views = training.map(|training| training.views.clone());
        let Some(ExposureTraining { steps, values: [values, first, second], .. }) = training else { return Ok(()) };
        let moments: Vec<[[f32; 12]; 2]> = first.iter().zip(second).map(|(first, second)| [*first, *second]).collect();
        gpu.upload(&self.values, 0, values)?;
        gpu.upload(&self.moments, 0, &moments)?;
        gpu.upload(&self.steps, 0, steps)
    }

    /// The exposures in training.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Option<ExposureTraining>, GpuError> {
        let Some(views) = &self.views else { return Ok(None) };
        let rows = views.len();
        let moments: Vec<[[f32; 12]; 2]> = gpu.read(&self.moments, 0, rows)?;
        let (first, second) = moments.into_iter().map(|[first, second]| (first, second)).unzip();
        let values = [gpu.read(&self.values, 0, rows)?, first, second];
        Ok(Some(ExposureTraining { views: views.clone(), steps: gpu.read(&self.steps, 0, rows)?, values }))
    }

    /// Number of the exposure of sample `n` of a step, from 1; 0 without one.
    pub(super) fn number(&self, n: usize, sample: &ViewSample) -> u32 {
        let row = match &self.views {
            Some(views) => views.binary_search(&sample.view).ok(),
            None => sample.exposure.map(|_| n),
        };
        row.map_or(0, |row| row as u32 + 1)
    }

    /// The exposures that [`number`](Self::number) counts: binding 8 of the loss.
    pub(super) fn values(&self) -> &wgpu::Buffer {
        &self.values
    }

    /// Makes room for a step over so many tiles and, where exposures are fixed, writes those of its samples.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        samples: &[ViewSample],
        tiles: u32,
    ) -> Result<(), GpuError> {
        if self.is_used(samples) {
            self.sums.reserve(gpu, BYTES * u64::from(tiles))?;
        }
        if self.views.is_none() {
            let fixed = samples.iter().zip(0..).filter_map(|(sample, n)| sample.exposure.map(|value| (n, value)));
            fixed.for_each(|(n, value)| gpu.write(encoder, &self.values, BYTES * n, cast_slice::<_, f32>(&value.0)));
        }
        Ok(())
    }

    /// Encodes the gradients of the render and of the exposures after the backward pass of the loss, and the step of
    /// the exposures in training.
    pub(super) fn encode(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        buffers: &LossBuffers,
        samples: &[ViewSample],
        tiles: u32,
        rate: f32,
    ) {
        if !self.is_used(samples) {
            return;
        }
        let LossBuffers { photos, frame, upstream, optimiser } = buffers;
        let (photos, values, sums) = ((0, *photos), (3, &*self.values), (4, &*self.sums));
        self.expose_backward.run(gpu, pass, &[photos, (1, *frame), (2, *upstream), values, sums], tiles);
        if let Some(views) = &self.views {
            let constants = gpu.uniform(&ExposureConstants { rows: views.len() as u32, rate, padding: [0; 2] });
            let adam = [(5, *optimiser), (6, &constants), (7, &*self.moments), (8, &*self.steps)];
            self.exposure_step.run(gpu, pass, &[&[photos, values, sums][..], &adam].concat(), 1);
        }
    }

    fn is_used(&self, samples: &[ViewSample]) -> bool {
        self.views.is_some() || samples.iter().any(|sample| sample.exposure.is_some())
    }
}
