//! Poses in training on the device: the displacements of the given cameras with their Adam state.

use std::sync::Arc;

use glam::DMat3;
use render::gpu::{Displacements, Gpu, GpuError, GrowableBuffer, Kernel};
use shaders::MAX_VIEWS;
use shaders::train::{GivenPose, POSE, PoseConstants};

use crate::device::step::ViewSample;
use crate::pose::{GivenPoses, PoseRates, PoseTraining, TRANSLATION_RATE};

/// Bytes of a displacement: six floats.
const BYTES: u64 = 24;

/// The buffers that `pose.wgsl` describes, and its kernel.
pub(super) struct GpuPoses {
    pose_step: Kernel,
    host: Arc<GivenPoses>,
    given: GrowableBuffer,
    displacements: GrowableBuffer,
    moments: GrowableBuffer,
    steps: GrowableBuffer,
    /// Views of the cameras in training, ascending; `None` where poses are not trained.
    views: Option<Vec<u32>>,
}

impl GpuPoses {
    pub(super) fn new(gpu: &Gpu, host: &Arc<GivenPoses>) -> Result<Self, GpuError> {
        let mut given = GrowableBuffer::new(gpu, "given poses")?;
        given.reserve(gpu, (size_of::<GivenPose>() * host.poses.len()) as u64)?;
        gpu.upload(&given, 0, &given_rows(host))?;
        Ok(Self {
            pose_step: gpu.kernel(&POSE, "pose_step")?,
            host: Arc::clone(host),
            given,
            displacements: GrowableBuffer::new(gpu, "displacements")?,
            moments: GrowableBuffer::new(gpu, "moments of displacements")?,
            steps: GrowableBuffer::new(gpu, "steps of displacements")?,
            views: None,
        })
    }

    /// Replaces the poses in training.
    pub(super) fn upload(&mut self, gpu: &Gpu, training: Option<&PoseTraining>) -> Result<(), GpuError> {
        self.views = training.map(|training| training.views.clone());
        let Some(PoseTraining { steps, values: [values, first, second], views }) = training else { return Ok(()) };
        let rows = views.len() as u64;
        self.displacements.reserve(gpu, BYTES * rows)?;
        self.moments.reserve(gpu, 2 * BYTES * rows)?;
        self.steps.reserve(gpu, 4 * rows)?;
        let moments: Vec<[[f32; 6]; 2]> = first.iter().zip(second).map(|(first, second)| [*first, *second]).collect();
        gpu.upload(&self.displacements, 0, values)?;
        gpu.upload(&self.moments, 0, &moments)?;
        gpu.upload(&self.steps, 0, steps)
    }

    /// The poses in training.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Option<PoseTraining>, GpuError> {
        let Some(views) = &self.views else { return Ok(None) };
        let rows = views.len();
        let moments: Vec<[[f32; 6]; 2]> = gpu.read(&self.moments, 0, rows)?;
        let (first, second) = moments.into_iter().map(|[first, second]| (first, second)).unzip();
        let values = [gpu.read(&self.displacements, 0, rows)?, first, second];
        Ok(Some(PoseTraining { views: views.clone(), steps: gpu.read(&self.steps, 0, rows)?, values }))
    }

    /// Row of the displacement of each sample; empty where poses are not trained.
    pub(super) fn rows(&self, samples: &[ViewSample]) -> Vec<Option<u32>> {
        let row = |views: &[u32], sample: &ViewSample| views.binary_search(&sample.view).ok().map(|row| row as u32);
        let Some(views) = &self.views else { return Vec::new() };
        samples.iter().map(|sample| row(views, sample)).collect()
    }

    /// The displacements of the cameras of a step.
    pub(super) fn displacements<'a>(&'a self, rows: &'a [Option<u32>]) -> Option<Displacements<'a>> {
        self.views.as_ref().map(|_| Displacements { rows: &self.displacements, of_camera: rows })
    }

    /// Encodes a step of these displacements from the gradient of each pose.
    pub(super) fn encode(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        [gradients, optimiser]: [&wgpu::Buffer; 2],
        rows: &[Option<u32>],
        rates: &PoseRates,
    ) {
        let Some(views) = &self.views else { return };
        let mut row = [0; MAX_VIEWS];
        row.iter_mut().zip(rows).for_each(|(number, row)| *number = row.map_or(0, |row| row + 1));
        let constants = gpu.uniform(&PoseConstants {
            rate: rates.rate,
            decay: rates.decay,
            spread: self.host.spread() as f32,
            cameras: views.len().min(self.host.poses.len()) as u32,
            views: rows.len() as u32,
            is_anchored: self.host.is_anchored.into(),
            padding: [0; 2],
            row,
        });
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let bindings = [
            (0, &constants),
            (1, optimiser),
            (2, gradients),
            (3, &*self.given),
            (4, &*self.displacements),
            (5, &*self.moments),
            (6, &*self.steps),
        ];
        self.pose_step.run(gpu, pass, &bindings, 1);
    }
}

fn given_rows(host: &GivenPoses) -> Vec<GivenPose> {
    let cameras = host.poses.iter().zip(&host.offsets).zip(&host.depths);
    let row = |((pose, offset), depth): ((&scene::Rigid, &glam::DVec3), &f32)| {
        let axes = DMat3::from_quat(pose.rotation).transpose().to_cols_array_2d();
        let offset = offset.to_array();
        let with_offset = |r: usize| {
            let [x, y, z] = axes[r];
            [x, y, z, offset[r]].map(|value| value as f32)
        };
        let rows = [with_offset(0), with_offset(1), with_offset(2)];
        GivenPose { rows, translation_rate: TRANSLATION_RATE * depth, padding: [0.0; 3] }
    };
    cameras.map(row).collect()
}
