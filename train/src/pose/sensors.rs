//! Refines what all photos of a sensor share: its mount, its focal length, and the time that its clock is off.
//!
//! A sensor has eight numbers: a rigid motion of its cameras in their own axes, a factor of the focal length, and seconds,
//! which move each camera along its path. Each photo of the sensor is a step of Adam on them. No common motion is removed, as
//! it is from cameras that move by themselves: a trajectory that stays as it was given fixes the model's frame, which hardly
//! any error of a sensor moves as a whole.

use glam::DVec3;
use scene::poses::SensorError;
use scene::sensors::{Motion, Taken};

use super::adam::{self, Rates, TRANSLATION_RATE, joined, median};

/// A rigid motion (metres, radians), what ln(focal length) is greater by, and the clock (seconds).
pub(crate) const NUMBERS: usize = 8;
/// The focal length.
const FOCAL: usize = 6;
/// The clock.
const CLOCK: usize = 7;
/// A sensor with fewer photos stays as it is given.
const MIN_PHOTOS: usize = 3;
/// Below this speed a clock cannot be told from a mount, metres per second.
const MIN_SPEED: f32 = 0.1;

/// What the numbers of sensors do to the cameras of a job.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GivenSensors {
    /// Row of the sensor of each camera; `None` if it has too few photos.
    pub(crate) of_camera: Vec<Option<u32>>,
    /// How a second of the clock displaces each camera; zeros where it is not known.
    pub(crate) per_second: Vec<[f32; 6]>,
    /// Each sensor.
    pub(crate) sensors: Vec<GivenSensor>,
}

/// A sensor that is refined.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct GivenSensor {
    /// Its number in the capture.
    pub(crate) number: u32,
    /// One over the number of its photos.
    pub(crate) share: f32,
    /// Learning rates of its numbers, of which that of a rotation is the share.
    pub(crate) rates: [f32; NUMBERS],
}

impl GivenSensors {
    /// Of cameras with these views, in the order of their rows, and the median depths of what they see, metres.
    pub(crate) fn of(views: &[u32], depths: &[f32], taken: &[Taken]) -> Self {
        let of_view = |view: &u32| taken.get(*view as usize);
        let mut numbers: Vec<u32> = views.iter().filter_map(|view| Some(of_view(view)?.sensor)).collect();
        numbers.sort_unstable();
        let photos = numbers.chunk_by(|a, b| a == b).filter(|photos| photos.len() >= MIN_PHOTOS);
        let sensors: Vec<GivenSensor> = photos
            .map(|photos| {
                let own = |view: &u32| of_view(view).filter(|taken| taken.sensor == photos[0]);
                let rows = views.iter().zip(depths).filter_map(|(view, depth)| Some((own(view)?, *depth)));
                let (mut depths, mut speeds): (Vec<f32>, Vec<Option<f32>>) = rows
                    .map(|(taken, depth)| (depth, taken.motion.map(|motion| motion.velocity.length() as f32)))
                    .unzip();
                let depth = median(&mut depths).unwrap_or(1.0);
                speeds.retain(Option::is_some);
                let mut speeds: Vec<f32> = speeds.into_iter().flatten().collect();
                let speed = median(&mut speeds).unwrap_or(0.0);
                let across = TRANSLATION_RATE * depth;
                let clock = if speed > MIN_SPEED { depth / speed } else { 0.0 };
                let rates = [across, across, across, 1.0, 1.0, 1.0, 1.0, clock];
                let share = 1.0 / photos.len() as f32;
                GivenSensor { number: photos[0], share, rates: rates.map(|rate| share * rate) }
            })
            .collect();
        let row = |view: &u32| {
            let number = of_view(view)?.sensor;
            Some(sensors.binary_search_by_key(&number, |sensor| sensor.number).ok()? as u32)
        };
        let per_second = |view: &u32| {
            let still = Motion { velocity: DVec3::ZERO, spin: DVec3::ZERO };
            let Motion { velocity, spin } = of_view(view).and_then(|taken| taken.motion).unwrap_or(still);
            joined([velocity, spin])
        };
        Self { of_camera: views.iter().map(row).collect(), per_second: views.iter().map(per_second).collect(), sensors }
    }
}

/// Numbers of sensors in training, with their Adam state.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SensorTraining {
    /// Adam steps of each sensor.
    pub(crate) steps: Vec<u32>,
    /// Numbers, first and second moments of each sensor.
    pub(crate) values: [Vec<[f32; NUMBERS]>; 3],
}

impl SensorTraining {
    /// Sensors as they are given.
    pub(crate) fn new(given: &GivenSensors) -> Self {
        let count = given.sensors.len();
        let zeros = || vec![[0.0; NUMBERS]; count];
        Self { steps: vec![0; count], values: [zeros(), zeros(), zeros()] }
    }

    /// The displacement of a camera by its sensor.
    pub(crate) fn displacement(&self, given: &GivenSensors, camera: usize) -> [f32; 7] {
        let sensor = given.of_camera.get(camera).copied().flatten();
        let Some(numbers) = sensor.and_then(|row| self.values[0].get(row as usize)) else { return [0.0; 7] };
        let per_second = &given.per_second[camera];
        std::array::from_fn(|k| per_second.get(k).map_or(0.0, |motion| numbers[CLOCK] * motion) + numbers[k])
    }

    /// One Adam step on the sensor of a camera, from the renderer's gradients of its pose and its focal length.
    pub(crate) fn step(&mut self, given: &GivenSensors, camera: usize, gradient: &[f32; 7], rates: &Rates) {
        let Some(row) = given.of_camera.get(camera).copied().flatten() else { return };
        let row = row as usize;
        let GivenSensor { share, rates: of_numbers, .. } = given.sensors[row];
        self.steps[row] = self.steps[row].saturating_add(1);
        let bias = adam::bias(self.steps[row]);
        let of_clock: f32 = given.per_second[camera].iter().zip(gradient).map(|(motion, slope)| motion * slope).sum();
        let [values, first, second] = &mut self.values;
        for k in 0..NUMBERS {
            // A motion of the camera has the gradient of its pose with the sign turned; a focal length has its own.
            let gradient = match k {
                FOCAL => gradient[FOCAL],
                CLOCK => -of_clock,
                _ => -gradient[k],
            };
            let step = adam::step([&mut first[row][k], &mut second[row][k]], gradient, bias);
            values[row][k] = (1.0 - rates.decay * share) * values[row][k] - rates.rate * of_numbers[k] * step;
        }
    }

    /// What was found of each sensor.
    pub(crate) fn errors(&self, given: &GivenSensors) -> Vec<SensorError> {
        let rows = given.sensors.iter().zip(&self.values[0]);
        let error = |(sensor, numbers): (&GivenSensor, &[f32; NUMBERS])| {
            let [x, y, z, a, b, c, focal, clock] = numbers.map(f64::from);
            SensorError {
                sensor: sensor.number,
                shift: DVec3::new(x, y, z),
                turn: DVec3::new(a, b, c),
                focal_factor: focal.exp(),
                clock_seconds: clock,
            }
        };
        rows.map(error).collect()
    }
}
