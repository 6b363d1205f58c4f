//! Refines the path of an object that is trained in its own axes, where it stands still and the cameras move.
//!
//! Boxes of data sets and of trackers are off by decimetres and degrees, differently at each time, and one set of splats
//! that has to fit all of them is blurred (Street Gaussians, Yan et al. 2024, section 3.3, refines its boxes too). Each time
//! at which photos show the object has a rigid motion of the object in its own axes, shared by all photos of that time. The
//! axes of the object, not those of the camera, keep what is known apart: a turn of the object about itself is one number,
//! where a camera would need a shift and a turn that cancel.
//!
//! Splats and path are determined up to a common motion, which is removed after every step: the object stays in its box.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};
use scene::Rigid;

use super::adam::{self, joined};
use super::parts;

/// When the views of a job were taken, and how large the object is.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectTimes {
    /// Times of the views, ascending, without repetition, seconds.
    seconds: Vec<f64>,
    /// Place of each view's time in `seconds`.
    of_views: BTreeMap<u32, usize>,
    /// A turn by one radian moves the object's ends by this much, metres.
    lever: f32,
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
        Self { of_views, lever: (0.5 * length).max(0.1) as f32, seconds }
    }
}

/// Rates of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PathRates {
    /// Learning rate of translations, and of rotations at the object's ends: metres.
    pub(crate) metres: f32,
    /// Share of a time's motion that the step takes back.
    pub(crate) decay: f32,
}

/// Motions of an object in training, with their Adam state.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PathTraining {
    /// Adam steps of each time.
    pub(crate) steps: Vec<u32>,
    /// Motion (metres, radians), first and second moment of each time.
    pub(crate) values: [Vec<[f32; 6]>; 3],
}

impl PathTraining {
    /// The path as it is given.
    pub(crate) fn new(times: &ObjectTimes) -> Self {
        let zeros = || vec![[0.0; 6]; times.seconds.len()];
        Self { steps: vec![0; times.seconds.len()], values: [zeros(), zeros(), zeros()] }
    }

    /// The camera of a view in the refined axes of the object.
    pub(crate) fn apply(&self, times: &ObjectTimes, view: u32, camera_from_object: &Rigid) -> Rigid {
        let numbers = times.of_views.get(&view).and_then(|&at| self.values[0].get(at));
        numbers.map_or(*camera_from_object, |numbers| camera_from_object.after(&motion(numbers)))
    }

    /// One Adam step of the time of a view, from the renderer's gradient of the pose of its refined camera
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
        self.steps[at] = self.steps[at].saturating_add(1);
        let bias = adam::bias(self.steps[at]);
        let [values, first, second] = &mut self.values;
        for (k, gradient) in of_object(refined, gradient).into_iter().enumerate() {
            let rate = if k < 3 { rates.metres } else { rates.metres / times.lever };
            let step = adam::step([&mut first[at][k], &mut second[at][k]], gradient, bias);
            values[at][k] = (1.0 - rates.decay) * values[at][k] - rate * step;
        }
        let count = values.len() as f32;
        for k in 0..6 {
            let mean = values.iter().map(|row| row[k]).sum::<f32>() / count;
            values.iter_mut().for_each(|row| row[k] -= mean);
        }
    }

    /// Each time in seconds with the motion of the object then, in its own axes: what `world_from_object` is followed by.
    pub(crate) fn motions(&self, times: &ObjectTimes) -> Vec<(f64, Rigid)> {
        times.seconds.iter().zip(&self.values[0]).map(|(&seconds, numbers)| (seconds, motion(numbers))).collect()
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
        let rates = PathRates { metres: 0.1, decay: 0.0 };
        path.step(&times, 4, &camera, &[1.0, -2.0, 0.5, 0.1, 0.2, -0.3], rates);
        path.step(&times, 9, &camera, &[1.0, -2.0, 0.5, 0.1, 0.2, -0.3], rates);
        assert_eq!((path.steps.clone(), path.apply(&times, 4, &camera)), (vec![0, 2], path.apply(&times, 9, &camera)));
        assert_ne!(path.apply(&times, 9, &camera), path.apply(&times, 7, &camera));
        for k in 0..6 {
            assert!(path.values[0].iter().map(|row| row[k]).sum::<f32>().abs() < 1e-6);
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
