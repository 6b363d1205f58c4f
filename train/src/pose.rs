//! Refines camera poses together with the splats, with Adam on a small displacement of each camera.
//!
//! A displacement is a rigid motion of the camera in its own axes, six numbers: the translation in metres and the
//! rotation vector in radians. Its gradient is that of the renderer with the sign turned, to first order in the
//! rotation. Camera axes make Adam's scale per number useful: an image says little about a motion along the optical
//! axis and much about one across it. A translation moves the image as a rotation does, times the depth, so its
//! learning rate is that of the rotation times the median depth of the view (BARF, Lin et al. 2021, and CamP, Park et
//! al. 2023, discuss both).
//!
//! Splats and cameras are determined up to a common translation, rotation and scale. These seven freedoms are removed:
//! after every step the mean translation and rotation of all cameras, in the world's axes, and their growth about the
//! mean camera are subtracted. The model therefore keeps the capture's geographic frame.
//!
//! As exposures, poses are trained once, in the block that covers the whole scene, and stay fixed in all others.

use glam::{DMat3, DQuat, DVec3};
use scene::poses::{Poses, RefinedCamera};
use scene::sensors::Taken;
use scene::{Camera, Rigid, Splats};

pub(crate) use self::adam::{Rates, TRANSLATION_RATE};
use self::adam::{joined, median, parts};
use self::path::{ObjectTimes, PathRates, PathTraining};
use self::sensors::{GivenSensors, SensorTraining};
use crate::view::TrainView;

mod adam;
pub(crate) mod path;
pub(crate) mod sensors;

/// Splats whose depths a view's median is taken of.
const SAMPLED_SPLATS: usize = 4096;

/// The given cameras of the views, which displacements refer to.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GivenPoses {
    /// Ascending.
    pub(crate) views: Vec<u32>,
    pub(crate) poses: Vec<Rigid>,
    /// Median depth of the splats in each view, metres.
    pub(crate) depths: Vec<f32>,
    /// Each optical centre less the mean of all, in the world's axes, metres.
    pub(crate) offsets: Vec<DVec3>,
    /// Whether the seven freedoms are removed; not where the splats are frozen.
    pub(crate) is_anchored: bool,
    /// What errors of sensors do, where those are refined.
    pub(crate) sensors: Option<GivenSensors>,
    /// When the cameras see the object that is trained, where its path is refined.
    pub(crate) times: Option<ObjectTimes>,
}

impl GivenPoses {
    /// The cameras of these views. `splats` are those at the start of training.
    pub(crate) fn of(
        views: &[TrainView],
        splats: &Splats,
        is_anchored: bool,
        taken: Option<&[Taken]>,
        times: Option<&ObjectTimes>,
    ) -> Self {
        let mut windows: Vec<&TrainView> = views.iter().collect();
        windows.sort_by_key(|view| view.view);
        windows.dedup_by_key(|view| view.view);
        let depths: Vec<Option<f32>> = windows.iter().map(|view| median_depth(view, splats)).collect();
        let mut known: Vec<f32> = depths.iter().copied().flatten().collect();
        let typical = median(&mut known).unwrap_or(1.0);
        let centres: Vec<DVec3> = windows.iter().map(|view| view.camera.centre()).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let views: Vec<u32> = windows.iter().map(|view| view.view).collect();
        let depths: Vec<f32> = depths.into_iter().map(|depth| depth.unwrap_or(typical)).collect();
        Self {
            poses: windows.iter().map(|view| view.camera.camera_from_world).collect(),
            sensors: taken.map(|taken| GivenSensors::of(&views, &depths, taken)),
            views,
            depths,
            offsets: centres.into_iter().map(|centre| centre - mean).collect(),
            is_anchored,
            times: times.cloned(),
        }
    }

    /// Sum of the squared offsets, m²; at least a little, as cameras may all be in one place.
    pub(crate) fn spread(&self) -> f64 {
        self.offsets.iter().map(|offset| offset.length_squared()).sum::<f64>().max(1e-6)
    }
}

/// Median depth in metres of the splats that project into a window; `None` if none does.
fn median_depth(view: &TrainView, splats: &Splats) -> Option<f32> {
    let camera = view.camera.mip(view.mip).window(view.rect);
    let (width, height) = (f64::from(view.rect.width), f64::from(view.rect.height));
    let depth = |i: usize| {
        let (pixel, depth) = camera.project(splats.mean(i).as_dvec3());
        let is_inside = (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y);
        (is_inside && depth > 0.0 && depth.is_finite()).then_some(depth as f32)
    };
    let every = splats.len().div_ceil(SAMPLED_SPLATS).max(1);
    let mut depths: Vec<f32> = (0..splats.len()).step_by(every).filter_map(depth).collect();
    median(&mut depths)
}

/// A camera pose after a displacement in its own axes.
pub(crate) fn displaced(camera_from_world: &Rigid, displacement: &[f32; 6]) -> Rigid {
    let [translation, rotation] = parts(displacement);
    let moved = Rigid { rotation: DQuat::from_scaled_axis(rotation), translation };
    moved.inverse().after(camera_from_world)
}

/// Rates of one step, of what is refined.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PoseRates {
    /// Of each camera by itself.
    pub(crate) views: Option<Rates>,
    /// Of all cameras of a sensor; the step of one photo is a share of it.
    pub(crate) sensors: Option<Rates>,
    /// Of the path of the object that is trained.
    pub(crate) path: Option<PathRates>,
}

/// Displacements in training, each with its own Adam state. A view's step count is the number of times that it was
/// rendered while poses were trained.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PoseTraining {
    /// Ascending.
    pub(crate) views: Vec<u32>,
    /// Adam steps of each view.
    pub(crate) steps: Vec<u32>,
    /// Displacement, first and second moment of each view.
    pub(crate) values: [Vec<[f32; 6]>; 3],
    /// Where errors of sensors are refined.
    pub(crate) sensors: Option<SensorTraining>,
    /// Where the path of an object is refined.
    pub(crate) path: Option<PathTraining>,
}

impl PoseTraining {
    /// No displacement of any view.
    pub(crate) fn new(given: &GivenPoses) -> Self {
        let zeros = || vec![[0.0; 6]; given.views.len()];
        Self {
            views: given.views.clone(),
            steps: vec![0; given.views.len()],
            values: [zeros(), zeros(), zeros()],
            sensors: given.sensors.as_ref().map(SensorTraining::new),
            path: given.times.as_ref().map(PathTraining::new),
        }
    }

    /// A view's camera, refined.
    pub(crate) fn apply(&self, given: &GivenPoses, view: u32, camera: &Camera) -> Camera {
        let Ok(at) = self.views.binary_search(&view) else { return *camera };
        let RefinedCamera { camera_from_world, focal_factor } = self.refined(given, at, &camera.camera_from_world);
        Camera { camera_from_world, pinhole: camera.pinhole.with_focal_factor(focal_factor) }
    }

    /// The camera in a row, from its given pose.
    fn refined(&self, given: &GivenPoses, at: usize, pose: &Rigid) -> RefinedCamera {
        let [motion @ .., focal] = self.displacement(given, at);
        let pose = displaced(pose, &motion);
        let path = self.path.as_ref().zip(given.times.as_ref());
        let camera_from_world = path.map_or(pose, |(path, times)| path.apply(times, given.views[at], &pose));
        RefinedCamera { camera_from_world, focal_factor: f64::from(focal).exp() }
    }

    /// The displacement of the camera in a row: its own, and that by its sensor; and what ln(focal length) is greater by.
    fn displacement(&self, given: &GivenPoses, at: usize) -> [f32; 7] {
        let [x, y, z, a, b, c] = self.values[0][at];
        let mut sum = [x, y, z, a, b, c, 0.0];
        if let (Some(sensors), Some(given)) = (&self.sensors, &given.sensors) {
            sum.iter_mut().zip(sensors.displacement(given, at)).for_each(|(sum, by_sensor)| *sum += by_sensor);
        }
        sum
    }

    /// The motion of the object at each time in seconds, where its path is refined.
    pub(crate) fn motions(&self, given: &GivenPoses) -> Vec<(f64, Rigid)> {
        self.path.as_ref().zip(given.times.as_ref()).map_or(Vec::new(), |(path, times)| path.motions(times))
    }

    /// The refined poses.
    pub(crate) fn poses(&self, given: &GivenPoses) -> Poses {
        let rows = given.views.iter().zip(&given.poses).enumerate();
        let mut poses: Poses = rows.map(|(at, (&view, pose))| (view, self.refined(given, at, pose))).collect();
        let sensors = self.sensors.as_ref().zip(given.sensors.as_ref());
        poses.sensors = sensors.map_or(Vec::new(), |(sensors, given)| sensors.errors(given));
        poses
    }

    /// One Adam step of what is refined, from the renderer's gradients of a view's pose and focal length
    /// ([`render::Gradients`]). Then removes the common motion of all cameras, where they move by themselves.
    pub(crate) fn step(&mut self, given: &GivenPoses, view: u32, gradient: &[f32; 7], rates: &PoseRates) {
        let (Ok(at), true) = (self.views.binary_search(&view), gradient.iter().all(|value| value.is_finite())) else {
            return;
        };
        if let (Some(sensors), Some(given), Some(rates)) = (&mut self.sensors, &given.sensors, &rates.sensors) {
            sensors.step(given, at, gradient, rates);
        }
        if let (Some(times), Some(rates)) = (&given.times, rates.path) {
            let refined = self.refined(given, at, &given.poses[at]).camera_from_world;
            let [of_pose @ .., _] = *gradient;
            self.path.iter_mut().for_each(|path| path.step(times, view, &refined, &of_pose, rates));
        }
        let Some(rates) = &rates.views else { return };
        let depth = given.depths.get(at).copied().unwrap_or(1.0);
        self.steps[at] = self.steps[at].saturating_add(1);
        let bias = adam::bias(self.steps[at]);
        let [values, first, second] = &mut self.values;
        for (k, gradient) in gradient[..6].iter().enumerate() {
            let rate = if k < 3 { TRANSLATION_RATE * rates.rate * depth } else { rates.rate };
            let step = adam::step([&mut first[at][k], &mut second[at][k]], -gradient, bias);
            values[at][k] = (1.0 - rates.decay) * values[at][k] - rate * step;
        }
        if given.is_anchored {
            remove_common_motion(values, given);
        }
    }
}

/// Subtracts the mean translation, the mean rotation and the growth of all cameras.
fn remove_common_motion(displacements: &mut [[f32; 6]], given: &GivenPoses) {
    let (mut shift, mut turn, mut growth) = (DVec3::ZERO, DVec3::ZERO, 0.0);
    let axes: Vec<DMat3> = given.poses.iter().map(|pose| DMat3::from_quat(pose.rotation)).collect();
    for ((displacement, axes), offset) in displacements.iter().zip(&axes).zip(&given.offsets) {
        let [translation, rotation] = parts(displacement).map(|part| axes.transpose() * part);
        shift += translation;
        turn += rotation;
        growth += translation.dot(*offset);
    }
    let count = displacements.len().max(1) as f64;
    let (shift, turn, growth) = (shift / count, turn / count, growth / given.spread());
    for ((displacement, axes), offset) in displacements.iter_mut().zip(&axes).zip(&given.offsets) {
        let common = [*axes * (shift + growth * *offset), *axes * turn];
        displacement.iter_mut().zip(joined(common)).for_each(|(value, common)| *value -= common);
    }
}

#[cfg(test)]
mod tests {
    use scene::sensors::Motion;
    use scene::{Pinhole, Rect};

    use super::*;
    use crate::random::uniform;

    fn random_vector(key: u64, size: f64) -> DVec3 {
        DVec3::from_array([0, 1, 2].map(|k| size * (f64::from(uniform(key, k)) - 0.5)))
    }

    fn views(count: u32) -> Vec<TrainView> {
        let pinhole = Pinhole { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        let rect = Rect { x: 0, y: 0, width: 40, height: 30 };
        let view = |view: u32| {
            let rotation = DQuat::from_scaled_axis(random_vector(u64::from(view), 3.0));
            let camera_from_world = Rigid { rotation, translation: random_vector(100 + u64::from(view), 20.0) };
            TrainView {
                view: 2 * view,
                mip: 0,
                rect,
                camera: Camera { pinhole, camera_from_world },
                camera_from_context: None,
            }
        };
        (0..count).rev().map(view).collect()
    }

    #[test]
    fn a_displacement_moves_the_camera_in_its_own_axes() {
        let pose = views(1)[0].camera.camera_from_world;
        let moved = displaced(&pose, &[1.0, 2.0, 3.0, 0.0, 0.0, 0.0]);
        // The old camera sees the new optical centre at the displacement.
        assert!((pose.apply(moved.inverse().translation) - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-6);
        // Turned to the right, it sees what lay on the right in the middle.
        let turned = displaced(&pose, &[0.0, 0.0, 0.0, 0.0, 0.3, 0.0]);
        let right = pose.inverse().apply(DVec3::new(0.3f64.tan(), 0.0, 1.0));
        let seen = turned.apply(right);
        assert!(seen.x.abs() < 1e-6 && seen.y.abs() < 1e-6 && seen.z > 1.0, "{seen}");
    }

    #[test]
    fn a_sensors_error_corrects_the_cameras_as_training_displaced_them() {
        let views = views(9);
        let motion = |view: u64| Motion { velocity: random_vector(view, 20.0), spin: random_vector(view + 50, 0.4) };
        let taken: Vec<Taken> = (0..17).map(|view| Taken { sensor: 0, motion: Some(motion(view)) }).collect();
        let given = GivenPoses::of(&views, &Splats::new(0), true, Some(&taken), None);
        let mut training = PoseTraining::new(&given);
        let numbers = [0.2, -0.1, 0.3, 0.02, -0.01, 0.03, 0.04, 0.05];
        training.sensors.as_mut().unwrap().values[0][0] = numbers;
        let poses = training.poses(&given);
        for view in &views {
            let trained = poses.apply(view.view, view.camera);
            let corrected = poses.sensors[0].corrected(&view.camera, taken[view.view as usize].motion.as_ref());
            let off = trained.camera_from_world.inverse().after(&corrected.camera_from_world);
            assert!(off.translation.length() < 1e-5 && off.rotation.angle_between(DQuat::IDENTITY) < 1e-5, "{off:?}");
            assert!((trained.pinhole.fx - corrected.pinhole.fx).abs() < 1e-5);
        }
    }

    #[test]
    fn the_gradient_of_a_displacement_is_that_of_the_pose_with_the_sign_turned() {
        let pose = views(1)[0].camera.camera_from_world;
        let point = pose.inverse().apply(DVec3::new(0.4, -0.3, 5.0));
        for k in 0..6 {
            let mut displacement = [0.0f32; 6];
            displacement[k] = 1e-3;
            let moved = displaced(&pose, &displacement).apply(point) - pose.apply(point);
            let p = pose.apply(point);
            let [rho, omega] = parts(&displacement);
            assert!((moved + rho + omega.cross(p)).length() < 1e-5, "{k}: {moved}");
        }
    }

    #[test]
    fn a_common_motion_of_all_cameras_is_removed_and_nothing_else() {
        let given = GivenPoses::of(&views(9), &Splats::new(0), true, None, None);
        assert_eq!(given.views, (0..9).map(|view| 2 * view).collect::<Vec<u32>>());
        let axes: Vec<DMat3> = given.poses.iter().map(|pose| DMat3::from_quat(pose.rotation)).collect();
        let own = |of: &dyn Fn(usize) -> [DVec3; 2]| -> Vec<[f32; 6]> {
            (0..9).map(|i| joined(of(i).map(|part| axes[i] * part))).collect()
        };
        let [shift, turn] = [random_vector(1, 0.3), random_vector(2, 0.1)];
        let mut common = own(&|i| [shift + 0.02 * given.offsets[i], turn]);
        remove_common_motion(&mut common, &given);
        assert!(common.iter().flatten().all(|value| value.abs() < 1e-6), "{common:?}");
        let mut single = own(&|i| if i == 4 { [shift, turn] } else { [DVec3::ZERO; 2] });
        let before = single.clone();
        remove_common_motion(&mut single, &given);
        let left = |rows: &[[f32; 6]]| rows[4].iter().map(|v| v * v).sum::<f32>().sqrt();
        assert!(left(&single) > 0.5 * left(&before));
        let again = single.clone();
        remove_common_motion(&mut single, &given);
        let change = single.iter().flatten().zip(again.iter().flatten()).map(|(a, b)| (a - b).abs());
        assert!(change.fold(0.0, f32::max) < 1e-6, "removing twice changes more");
    }

    #[test]
    fn gradients_that_are_not_finite_or_of_unknown_views_change_nothing() {
        let given = GivenPoses::of(&views(3), &Splats::new(0), true, None, None);
        let mut training = PoseTraining::new(&given);
        let before = training.clone();
        let rates = PoseRates { views: Some(Rates { rate: 0.1, decay: 0.0 }), sensors: None, path: None };
        training.step(&given, 2, &[f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], &rates);
        training.step(&given, 3, &[1.0; 7], &rates);
        assert_eq!(training, before);
        training.step(&given, 2, &[1.0; 7], &rates);
        assert_ne!(training, before);
    }
}
