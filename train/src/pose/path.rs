//! Refines the path of an object that is trained in its own axes, where it stands still and the cameras move.
//!
//! Boxes of data sets and of trackers are off by decimetres and degrees, differently at each time, and one set of splats
//! that has to fit all of them is blurred (Street Gaussians, Yan et al. 2024, section 3.3, refines its boxes too). Each time
//! at which photos show the object has a rigid motion of the object in its own axes, shared by all photos of that time. The
//! axes of the object, not those of the camera, keep what is known apart: a turn of the object about itself is one number,
//! where a camera would need a shift and a turn that cancel; and a vehicle is surer to stay on the road and upright than in
//! its lane.
//!
//! An object's photos are few, often small, and each is drawn a dozen times: Adam on each time by itself makes paths worse.
//! Errors of boxes are alike at neighbouring times, as hands and filters smooth them, so that a photo's gradient moves the
//! times around its own. One scale for all times, unlike Adam's, lets a photo that shows the object small move it little.
//!
//! Splats and path are determined up to a common motion, which is removed after every step: the object stays in its box.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};
use scene::Rigid;

use super::adam::{joined, parts};
use crate::swing::Walk;

/// Standard deviation of the times that a photo moves with its own, seconds.
const TOGETHER_SECONDS: f64 = 0.5;
/// Learning rates, relative to that of a shift along x and y: x ahead, y left, z up; then turns about these.
const SHARES: [f32; 6] = [1.0, 1.0, 0.2, 0.2, 0.2, 1.0];
/// Larger gradients, in units of the usual, count as this.
const MAX_GRADIENT: f32 = 2.0;
/// What is kept of the mean squares in a step.
const MEMORY: f32 = 0.99;

/// When the views of a job were taken, and how large the object is.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectTimes {
    /// Times of the views, ascending, without repetition, seconds.
    seconds: Vec<f64>,
    /// Place of each view's time in `seconds`.
    of_views: BTreeMap<u32, usize>,
    /// A turn by one radian moves the object's ends by this much, metres.
    lever: f32,
    /// Of a person, whose limbs swing.
    pub walk: Option<Walk>,
}

impl ObjectTimes {
    /// Of views with their times in seconds, and the length in metres of the object's longest side.
    pub fn of(views: impl Iterator<Item = (u32, f64)>, length: f64) -> Self {
        let views: BTreeMap<u32, f64> = views.filter(|(_, seconds)| seconds.is_finite()).collect();
        let mut seconds: Vec<f64> = views.values().copied().collect();
        seconds.sort_unstable_by(f64::total_cmp);
        seconds.dedup();
        let place = |at: f64| seconds.partition_point(|other| *other < at);
        let of_views = views.iter().map(|(&view, &at)| (view, place(at))).collect();
        Self { of_views, lever: (0.5 * length).max(0.1) as f32, seconds, walk: None }
    }
}

/// Rates of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PathRates {
    /// How far a step of the usual gradient moves the object, or its ends as it turns: metres.
    pub(crate) metres: f32,
    /// Share of a motion that the step takes back.
    pub(crate) decay: f32,
}

/// Motions of an object in training.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PathTraining {
    /// Steps done.
    pub(crate) steps: u32,
    /// Mean squares of the gradients of all times: where photos say much, the object moves far.
    pub(crate) squares: [f32; 6],
    /// The motion at each time, metres and radians.
    pub(crate) motions: Vec<[f32; 6]>,
}

impl PathTraining {
    /// The path as it is given.
    pub(crate) fn new(times: &ObjectTimes) -> Self {
        Self { steps: 0, squares: [0.0; 6], motions: vec![[0.0; 6]; times.seconds.len()] }
    }

    /// The camera of a view in the refined axes of the object.
    pub(crate) fn apply(&self, times: &ObjectTimes, view: u32, camera_from_object: &Rigid) -> Rigid {
        let numbers = times.of_views.get(&view).and_then(|&at| self.motions.get(at));
        numbers.map_or(*camera_from_object, |numbers| camera_from_object.after(&motion(numbers)))
    }

    /// One step of the motions around the time of a view, from the renderer's gradient of the pose of its refined camera
    /// ([`render::Gradients`]). Then removes the common motion of all times.
    pub(crate) fn step(
        &mut self,
        times: &ObjectTimes,
        view: u32,
        refined: &Rigid,
        gradient: &[f32; 6],
        rates: PathRates,
    ) {
        let Some(&at) = times.of_views.get(&view).filter(|_| gradient.iter().all(|value| value.is_finite())) else {
            return;
        };
        self.steps = self.steps.saturating_add(1);
        let bias = 1.0 - MEMORY.powi(self.steps.min(1 << 20) as i32);
        let nearness = |seconds: f64| (-0.5 * ((seconds - times.seconds[at]) / TOGETHER_SECONDS).powi(2)).exp() as f32;
        let near: Vec<f32> = times.seconds.iter().map(|&seconds| nearness(seconds)).collect();
        for (k, gradient) in of_object(refined, gradient).into_iter().enumerate() {
            let unit = if k < 3 { rates.metres } else { rates.metres / times.lever };
            let square = &mut self.squares[k];
            *square = MEMORY * *square + (1.0 - MEMORY) * gradient * gradient;
            let usual = (*square / bias).sqrt().max(f32::MIN_POSITIVE);
            let step = unit * SHARES[k] * (gradient / usual).clamp(-MAX_GRADIENT, MAX_GRADIENT);
            for (row, near) in self.motions.iter_mut().zip(&near) {
                row[k] -= near * (rates.decay * row[k] + step);
            }
        }
        let count = self.motions.len() as f32;
        for k in 0..6 {
            let mean = self.motions.iter().map(|row| row[k]).sum::<f32>() / count;
            self.motions.iter_mut().for_each(|row| row[k] -= mean);
        }
    }

    /// Each time in seconds with the motion of the object then, in its own axes: what `world_from_object` is followed by.
    pub(crate) fn motions(&self, times: &ObjectTimes) -> Vec<(f64, Rigid)> {
        times.seconds.iter().zip(&self.motions).map(|(&seconds, numbers)| (seconds, motion(numbers))).collect()
    }
}

fn motion(numbers: &[f32; 6]) -> Rigid {
    let [translation, rotation] = parts(numbers);
    Rigid { rotation: DQuat::from_scaled_axis(rotation), translation }
}

/// The gradient of a motion of the object in its own axes, from that of the camera's pose, (ρ, ω) of `exp(ξ)·camera_from_object`:
/// the adjoint, transposed.
fn of_object(camera_from_object: &Rigid, gradient: &[f32; 6]) -> [f32; 6] {
    let [of_shift, of_turn] = parts(gradient);
    let object_from_camera = DMat3::from_quat(camera_from_object.rotation).transpose();
    let about_object: DVec3 = of_turn + of_shift.cross(camera_from_object.translation);
    joined([of_shift, about_object].map(|part| object_from_camera * part))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Rigid {
        let rotation = DQuat::from_scaled_axis(DVec3::new(0.4, -1.1, 0.3));
        Rigid { rotation, translation: DVec3::new(0.5, -0.7, 9.0) }
    }

    fn times() -> ObjectTimes {
        ObjectTimes::of([(4, 2.0), (7, 1.0), (9, 2.0), (11, f64::NAN)].into_iter(), 4.0)
    }

    #[test]
    fn the_gradient_of_a_motion_is_that_of_the_camera_in_the_objects_axes() {
        // A loss of a camera's pose: the place of a point in the camera's axes, along a direction.
        let (camera, point, along) = (camera(), DVec3::new(0.8, -0.5, 0.6), DVec3::new(0.3, -0.9, 0.5));
        let seen = camera.apply(point);
        // d(along · exp(ξ) p)/dξ = (along, p × along).
        let gradient = of_object(&camera, &joined([along, seen.cross(along)]));
        for (k, slope) in gradient.into_iter().enumerate() {
            let mut numbers = [0.0; 6];
            numbers[k] = 1e-3;
            let moved = camera.after(&motion(&numbers)).apply(point);
            let difference = along.dot(moved - seen) / 1e-3;
            assert!((difference - f64::from(slope)).abs() < 2e-3, "{k}: {difference} {slope}");
        }
    }

    #[test]
    fn photos_of_one_time_share_its_motion_and_the_mean_stays() {
        let (times, camera) = (times(), camera());
        assert_eq!(times.seconds, [1.0, 2.0]);
        let mut path = PathTraining::new(&times);
        let rates = PathRates { metres: 0.1, decay: 0.1 };
        path.step(&times, 4, &camera, &[1.0, -2.0, 0.5, 0.1, 0.2, -0.3], rates);
        path.step(&times, 9, &camera, &[1.0, -2.0, 0.5, 0.1, 0.2, -0.3], rates);
        assert_eq!((path.steps, path.apply(&times, 4, &camera)), (2, path.apply(&times, 9, &camera)));
        assert_ne!(path.apply(&times, 9, &camera), path.apply(&times, 7, &camera));
        for k in 0..6 {
            assert!(path.motions.iter().map(|row| row[k]).sum::<f32>().abs() < 1e-6);
        }
        // A view without a time, one that is not known, and a gradient that is not finite change nothing.
        let before = path.clone();
        path.step(&times, 11, &camera, &[1.0; 6], rates);
        path.step(&times, 5, &camera, &[1.0; 6], rates);
        path.step(&times, 4, &camera, &[f32::NAN; 6], rates);
        assert_eq!((path.clone(), path.apply(&times, 11, &camera)), (before, camera));
        let motions = path.motions(&times);
        assert_eq!((motions[0].0, motions[1].0), (1.0, 2.0));
        assert!(motions[1].1.translation.length() > 0.05);
    }
}
