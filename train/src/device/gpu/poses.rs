//! Poses in training on the device: the displacements of the given cameras and the errors of their sensors, with their
//! Adam state.

use std::sync::Arc;

use glam::DMat3;
use render::gpu::{Displacements, Gpu, GpuError, GrowableBuffer, Kernel};
use shaders::train::{GivenPose, POSE, PoseConstants, SENSOR, Sensor, SensorCamera, SensorConstants};
use shaders::{MAX_VIEWS, WORKGROUP_SIZE};

use crate::device::step::ViewSample;
use crate::pose::sensors::{GivenSensor, GivenSensors, SensorTraining};
use crate::pose::{GivenPoses, PoseRates, PoseTraining, Rates, TRANSLATION_RATE};

/// Bytes of a camera's own displacement: six floats.
const OWN_BYTES: u64 = 24;
/// Bytes of a displacement as the renderer reads it: eight floats.
const BYTES: u64 = 32;

/// The buffers that `pose.wgsl` and `sensor.wgsl` describe, and their kernels.
pub(super) struct GpuPoses {
    pose_step: Kernel,
    sensor_step: Kernel,
    sum_displacements: Kernel,
    host: Arc<GivenPoses>,
    given: GrowableBuffer,
    cameras: GrowableBuffer,
    sensors: GrowableBuffer,
    own: GrowableBuffer,
    moments: GrowableBuffer,
    steps: GrowableBuffer,
    displacements: GrowableBuffer,
    /// Views of the cameras in training, ascending; `None` where poses are not trained.
    views: Option<Vec<u32>>,
}

impl GpuPoses {
    pub(super) fn new(gpu: &Gpu, host: &Arc<GivenPoses>) -> Result<Self, GpuError> {
        let mut given = GrowableBuffer::new(gpu, "given poses")?;
        given.reserve(gpu, (size_of::<GivenPose>() * host.poses.len()) as u64)?;
        gpu.upload(&given, 0, &given_rows(host))?;
        let mut cameras = GrowableBuffer::new(gpu, "cameras of sensors")?;
        cameras.reserve(gpu, (size_of::<SensorCamera>() * host.poses.len()) as u64)?;
        gpu.upload(&cameras, 0, &camera_rows(host))?;
        let mut sensors = GrowableBuffer::new(gpu, "sensors")?;
        sensors.reserve(gpu, size_of::<Sensor>() as u64)?;
        Ok(Self {
            pose_step: gpu.kernel(&POSE, "pose_step")?,
            sensor_step: gpu.kernel(&SENSOR, "sensor_step")?,
            sum_displacements: gpu.kernel(&SENSOR, "sum_displacements")?,
            host: Arc::clone(host),
            given,
            cameras,
            sensors,
            own: GrowableBuffer::new(gpu, "own displacements")?,
            moments: GrowableBuffer::new(gpu, "moments of displacements")?,
            steps: GrowableBuffer::new(gpu, "steps of displacements")?,
            displacements: GrowableBuffer::new(gpu, "displacements")?,
            views: None,
        })
    }

    /// Replaces the poses in training.
    pub(super) fn upload(&mut self, gpu: &Gpu, training: Option<&PoseTraining>) -> Result<(), GpuError> {
        self.views = training.map(|training| training.views.clone());
        let Some(PoseTraining { steps, values: [values, first, second], views, sensors, .. }) = training else {
            return Ok(());
        };
        let rows = views.len() as u64;
        self.own.reserve(gpu, OWN_BYTES * rows)?;
        self.moments.reserve(gpu, 2 * OWN_BYTES * rows)?;
        self.steps.reserve(gpu, 4 * rows)?;
        self.displacements.reserve(gpu, BYTES * rows)?;
        let moments: Vec<[[f32; 6]; 2]> = first.iter().zip(second).map(|(first, second)| [*first, *second]).collect();
        gpu.upload(&self.own, 0, values)?;
        gpu.upload(&self.moments, 0, &moments)?;
        gpu.upload(&self.steps, 0, steps)?;
        if let (Some(sensors), Some(given)) = (sensors, &self.host.sensors) {
            let rows = sensor_rows(sensors, given);
            self.sensors.reserve(gpu, (size_of::<Sensor>() * rows.len()) as u64)?;
            gpu.upload(&self.sensors, 0, &rows)?;
        }
        let mut encoder = gpu.encoder();
        let constants = gpu.uniform(&self.sensor_constants(&[], None));
        self.sum(gpu, &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default()), &constants);
        gpu.submit(encoder).map(drop)
    }

    /// The poses in training.
    pub(super) fn download(&self, gpu: &Gpu) -> Result<Option<PoseTraining>, GpuError> {
        let Some(views) = &self.views else { return Ok(None) };
        let rows = views.len();
        let moments: Vec<[[f32; 6]; 2]> = gpu.read(&self.moments, 0, rows)?;
        let (first, second) = moments.into_iter().map(|[first, second]| (first, second)).unzip();
        let values = [gpu.read(&self.own, 0, rows)?, first, second];
        let sensors = self.host.sensors.as_ref().map(|given| {
            let rows: Vec<Sensor> = gpu.read(&self.sensors, 0, given.sensors.len())?;
            let of = |part: fn(&Sensor) -> [f32; 8]| rows.iter().map(part).collect();
            let values = [of(|row| row.values), of(|row| row.first), of(|row| row.second)];
            Ok(SensorTraining { steps: rows.iter().map(|row| row.steps).collect(), values })
        });
        let (views, steps, sensors) = (views.clone(), gpu.read(&self.steps, 0, rows)?, sensors.transpose()?);
        // Paths of objects are refined on the CPU.
        Ok(Some(PoseTraining { views, steps, values, sensors, path: None }))
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

    /// Encodes a step of what is refined, from the gradients of each camera of the step.
    pub(super) fn encode(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        [gradients, optimiser]: [&wgpu::Buffer; 2],
        rows: &[Option<u32>],
        rates: &PoseRates,
    ) {
        if self.views.is_none() {
            return;
        }
        let pass = &mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        if let Some(rates) = &rates.views {
            let constants = gpu.uniform(&PoseConstants {
                rate: rates.rate,
                decay: rates.decay,
                spread: self.host.spread() as f32,
                cameras: self.count(),
                views: rows.len() as u32,
                is_anchored: self.host.is_anchored.into(),
                padding: [0; 2],
                row: numbers(rows),
            });
            let bindings = [
                (0, &constants),
                (1, optimiser),
                (2, gradients),
                (3, &*self.given),
                (4, &*self.own),
                (5, &*self.moments),
                (6, &*self.steps),
            ];
            self.pose_step.run(gpu, pass, &bindings, 1);
        }
        let constants = gpu.uniform(&self.sensor_constants(rows, rates.sensors.as_ref()));
        if rates.sensors.is_some() {
            let bindings = [(0, &constants), (1, optimiser), (2, gradients), (3, &*self.cameras), (4, &*self.sensors)];
            self.sensor_step.run(gpu, pass, &bindings, 1);
        }
        self.sum(gpu, pass, &constants);
    }

    /// Encodes the sums of the displacements of all cameras.
    fn sum(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, constants: &wgpu::Buffer) {
        if self.count() == 0 {
            return;
        }
        let bindings =
            [(0, constants), (3, &*self.cameras), (4, &*self.sensors), (5, &*self.own), (6, &*self.displacements)];
        self.sum_displacements.run(gpu, pass, &bindings, self.count().div_ceil(WORKGROUP_SIZE));
    }

    fn count(&self) -> u32 {
        self.views.as_ref().map_or(0, |views| views.len().min(self.host.poses.len()) as u32)
    }

    fn sensor_constants(&self, rows: &[Option<u32>], rates: Option<&Rates>) -> SensorConstants {
        SensorConstants {
            rate: rates.map_or(0.0, |rates| rates.rate),
            decay: rates.map_or(0.0, |rates| rates.decay),
            cameras: self.count(),
            views: rows.len() as u32,
            row: numbers(rows),
        }
    }
}

/// Rows counted from 1; 0 for none.
fn numbers(rows: &[Option<u32>]) -> [u32; MAX_VIEWS] {
    let mut numbers = [0; MAX_VIEWS];
    numbers.iter_mut().zip(rows).for_each(|(number, row)| *number = row.map_or(0, |row| row + 1));
    numbers
}

fn sensor_rows(training: &SensorTraining, given: &GivenSensors) -> Vec<Sensor> {
    let [values, first, second] = &training.values;
    let row = |(k, sensor): (usize, &GivenSensor)| Sensor {
        values: values[k],
        first: first[k],
        second: second[k],
        rates: sensor.rates,
        share: sensor.share,
        steps: training.steps[k],
        padding: [0; 2],
    };
    given.sensors.iter().enumerate().map(row).collect()
}

fn camera_rows(host: &GivenPoses) -> Vec<SensorCamera> {
    let none = SensorCamera { shift_per_second: [0.0; 3], sensor: 0, turn_per_second: [0.0; 3], padding: 0 };
    let Some(given) = &host.sensors else { return vec![none; host.poses.len()] };
    let row = |(sensor, &[x, y, z, a, b, c]): (&Option<u32>, &[f32; 6])| SensorCamera {
        shift_per_second: [x, y, z],
        sensor: sensor.map_or(0, |row| row + 1),
        turn_per_second: [a, b, c],
        ..none
    };
    given.of_camera.iter().zip(&given.per_second).map(row).collect()
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
