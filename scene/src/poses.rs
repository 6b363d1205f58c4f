//! Refined cameras of training views, and the errors of sensors that were found.
//!
//! Structure from motion and satellite navigation leave errors in the poses of a capture, and a rig has errors of its
//! clocks, mounts and focal lengths. Training can refine them together with the splats. A refined pose replaces that of the
//! capture, and the focal lengths are multiplied by a factor.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, Rigid};
use crate::capture::{Capture, View};
use crate::error::CodecError;
use crate::frame::{self, Kind};
use crate::sensors::{self, Motion, Taken};

/// Poses. The header is their number and the errors of sensors. The bulk has, for each view in ascending order, the view
/// (u32), camera_from_world as seven f64 (the unit quaternion xyzw and the translation in metres), and the factor of the
/// focal lengths (f64); little endian.
pub const POSES: Kind = Kind(*b"pose", 2);

const BYTES: usize = 4 + 8 * 8;

/// Refined cameras by view of the capture. Views without one keep the capture's.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Poses {
    of_views: BTreeMap<u32, RefinedCamera>,
    /// What was found of each sensor, where sensors were refined. The cameras have it already.
    pub sensors: Vec<SensorError>,
}

/// What training found of a view's camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinedCamera {
    /// Its pose.
    pub camera_from_world: Rigid,
    /// What the focal lengths of the capture are multiplied by.
    pub focal_factor: f64,
}

/// What training found of a sensor. The correct camera is the given one moved by this in its own axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SensorError {
    /// Number of the sensor, as [`crate::sensors`] counts them.
    pub sensor: u32,
    /// Translation of the mount, metres.
    pub shift: DVec3,
    /// Rotation vector of the mount, radians.
    pub turn: DVec3,
    /// What the focal lengths are multiplied by.
    pub focal_factor: f64,
    /// Seconds that the photos were taken after the times of their poses.
    pub clock_seconds: f64,
}

impl SensorError {
    /// The correct camera of a photo, from the given one and how the sensor moved when it took the photo, if that is known.
    pub fn corrected(&self, given: &Camera, motion: Option<&Motion>) -> Camera {
        let by_clock = |of: fn(&Motion) -> DVec3| motion.map_or(DVec3::ZERO, |motion| self.clock_seconds * of(motion));
        let moved = Rigid {
            rotation: DQuat::from_scaled_axis(self.turn + by_clock(|motion| motion.spin)),
            translation: self.shift + by_clock(|motion| motion.velocity),
        };
        Camera {
            pinhole: given.pinhole.with_focal_factor(self.focal_factor),
            camera_from_world: moved.inverse().after(&given.camera_from_world),
        }
    }

    fn is_sane(&self) -> bool {
        let numbers = [self.shift.length(), self.turn.length(), self.clock_seconds];
        numbers.iter().all(|number| number.is_finite()) && is_factor(self.focal_factor)
    }
}

/// Whether focal lengths can be multiplied by this, and stay finite.
fn is_factor(factor: f64) -> bool {
    (1e-3..=1e3).contains(&factor)
}

impl FromIterator<(u32, RefinedCamera)> for Poses {
    fn from_iter<T: IntoIterator<Item = (u32, RefinedCamera)>>(of_views: T) -> Self {
        Self { of_views: of_views.into_iter().collect(), sensors: Vec::new() }
    }
}

#[derive(Serialize, Deserialize)]
struct Header {
    count: u64,
    sensors: Vec<SensorError>,
}

impl Poses {
    /// The refined camera of a view, or the given one if the view has none.
    pub fn apply(&self, view: u32, camera: Camera) -> Camera {
        let Some(&RefinedCamera { camera_from_world, focal_factor }) = self.of_views.get(&view) else { return camera };
        let pinhole = camera.pinhole.with_focal_factor(focal_factor);
        Camera { camera_from_world, pinhole }
    }

    /// The cameras of a capture's views as training found them: those of views that were trained on, and of all others the given ones
    /// with the errors of their sensors taken out.
    pub fn corrected(&self, views: &[View]) -> Vec<Camera> {
        let taken = if self.sensors.is_empty() { Vec::new() } else { sensors::sensors(views).of_views };
        let of_sensor = |i: usize| {
            let Taken { sensor, motion } = taken.get(i)?;
            let error = self.sensors.iter().find(|error| error.sensor == *sensor)?;
            Some(error.corrected(&views[i].camera, motion.as_ref()))
        };
        let camera = |(i, view): (usize, &View)| match u32::try_from(i) {
            Ok(number) if self.of_views.contains_key(&number) => self.apply(number, view.camera),
            _ => of_sensor(i).unwrap_or(view.camera),
        };
        views.iter().enumerate().map(camera).collect()
    }

    /// The capture with its cameras [`corrected`](Self::corrected).
    #[must_use]
    pub fn in_capture(&self, capture: &Capture) -> Capture {
        let mut capture = capture.clone();
        let corrected = self.corrected(&capture.views);
        capture.views.iter_mut().zip(corrected).for_each(|(view, camera)| view.camera = camera);
        capture
    }

    /// Views with their refined cameras, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &RefinedCamera)> {
        self.of_views.iter().map(|(&view, refined)| (view, refined))
    }

    /// Encodes a frame.
    pub fn to_frame(&self) -> Vec<u8> {
        let mut bulk = Vec::with_capacity(BYTES * self.of_views.len());
        for (view, RefinedCamera { camera_from_world: pose, focal_factor }) in &self.of_views {
            bulk.extend(view.to_le_bytes());
            let numbers =
                pose.rotation.to_array().into_iter().chain(pose.translation.to_array()).chain([*focal_factor]);
            bulk.extend(numbers.flat_map(f64::to_le_bytes));
        }
        let header = Header { count: self.of_views.len() as u64, sensors: self.sensors.clone() };
        frame::encode(POSES, &header, &bulk)
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// As [`frame::decode`]; a bulk that does not match the header, views out of order, a pose that is not
    /// [sane](Rigid::is_sane), or numbers that are not finite.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(POSES, bytes)?;
        if header.count.checked_mul(BYTES as u64) != Some(bulk.len() as u64) {
            return Err(CodecError::new("poses do not match their header"));
        }
        if !header.sensors.iter().all(SensorError::is_sane) {
            return Err(CodecError::new("an error of a sensor is not finite"));
        }
        let mut poses = BTreeMap::new();
        for row in bulk.chunks_exact(BYTES) {
            let view = u32::from_le_bytes(row[..4].try_into().expect("four bytes"));
            let number =
                |n: usize| f64::from_le_bytes(row[4 + 8 * n..12 + 8 * n].try_into().expect("eight bytes of the row"));
            let rotation = DQuat::from_array([0, 1, 2, 3].map(number));
            let pose = Rigid { rotation, translation: DVec3::from_array([4, 5, 6].map(number)) };
            if !pose.is_sane() {
                return Err(CodecError::new(format!("the pose of view {view} is not finite or not a rotation")));
            }
            if poses.last_key_value().is_some_and(|(&last, _)| last >= view) {
                return Err(CodecError::new("poses are not in ascending order of their views"));
            }
            let focal_factor = number(7);
            if !is_factor(focal_factor) {
                return Err(CodecError::new(format!(
                    "the focal length of view {view} is not multiplied by 0.001 to 1000"
                )));
            }
            poses.insert(view, RefinedCamera { camera_from_world: pose, focal_factor });
        }
        Ok(Self { of_views: poses, sensors: header.sensors })
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::camera::Pinhole;

    fn some() -> Poses {
        let pose = |view: u32| {
            let angle = 0.1 * f64::from(view % 7);
            let rotation = DQuat::from_rotation_x(angle);
            let camera_from_world = Rigid { rotation, translation: DVec3::new(angle, 2.0, -3.0) };
            (view, RefinedCamera { camera_from_world, focal_factor: 1.0 + angle })
        };
        let poses: Poses = [0, 3, 7, u32::MAX].map(pose).into_iter().collect();
        Poses { sensors: vec![error(0.02)], ..poses }
    }

    fn error(clock_seconds: f64) -> SensorError {
        let (shift, turn) = (DVec3::X, DVec3::new(0.0, 0.1, -0.2));
        SensorError { sensor: 3, shift, turn, focal_factor: 0.99, clock_seconds }
    }

    #[test]
    fn views_that_were_not_trained_on_are_corrected_by_their_sensor() {
        let pinhole = Pinhole { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        // Two sensors of a car that drives along x at 10 m/s and looks there.
        let ahead = DQuat::from_mat3(&DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X)).inverse();
        let view = |(i, name): (u32, &str)| {
            let centre = DVec3::X * f64::from(i);
            let camera_from_world = Rigid { rotation: ahead, translation: -(ahead * centre) };
            View {
                name: format!("{name}/{i:04}.png"),
                camera: Camera { pinhole, camera_from_world },
                mips: Vec::new(),
                masked: false,
                depth: None,
                seconds: Some(0.1 * f64::from(i)),
            }
        };
        let views: Vec<View> = (0..8).map(|i| view((i, "left"))).chain((0..8).map(|i| view((i, "right")))).collect();
        let poses = |sensors| Poses { sensors, ..[some().of_views[&3]].map(|own| (9, own)).into_iter().collect() };
        let late = SensorError { sensor: 1, shift: DVec3::new(0.0, 0.5, 0.0), turn: DVec3::ZERO, ..error(0.05) };
        let found = poses(vec![late]).corrected(&views);
        for (i, (found, view)) in found.iter().zip(&views).enumerate() {
            let moved = found.centre() - view.camera.centre();
            if i == 9 {
                assert_eq!(*found, poses(Vec::new()).apply(9, view.camera));
            } else if i < 8 {
                assert_eq!(*found, view.camera);
            } else {
                // Half a metre on, as its photos are late, and half a metre down.
                assert!((moved - DVec3::new(0.5, 0.0, -0.5)).length() < 1e-9, "{i}: {moved}");
                assert!((found.pinhole.fx - 0.99 * 40.0).abs() < 1e-9);
            }
        }
        assert_eq!(poses(Vec::new()).corrected(&views)[10], views[10].camera);
    }

    #[test]
    fn poses_round_trip_and_damage_is_detected() {
        for poses in [some(), Poses::default()] {
            let bytes = poses.to_frame();
            assert_eq!(Poses::from_frame(&bytes).unwrap(), poses);
            for at in 0..bytes.len() {
                let mut damaged = bytes.clone();
                damaged[at] ^= 0x40;
                assert!(Poses::from_frame(&damaged).is_err(), "flip at {at} was not detected");
            }
        }
    }

    #[test]
    fn inconsistent_frames_with_a_valid_checksum_are_refused() {
        let of_sensors = |count: u64, bulk: &[u8], clock_seconds: f64| {
            let header = Header { count, sensors: vec![error(clock_seconds)] };
            Poses::from_frame(&frame::encode(POSES, &header, bulk))
        };
        let forged = |count: u64, bulk: &[u8]| of_sensors(count, bulk, 0.02);
        let frame = some().to_frame();
        let good = &frame[frame.len() - 4 * BYTES..];
        assert_eq!(forged(4, good).unwrap(), some());
        assert!(forged(u64::MAX, good).is_err() && forged(3, good).is_err());
        assert!(of_sensors(4, good, f64::NAN).unwrap_err().0.contains("sensor"));
        let mut repeated = good.to_vec();
        repeated[BYTES..BYTES + 4].fill(0);
        assert!(forged(4, &repeated).unwrap_err().0.contains("order"));
        for wrong in [f64::NAN, 2.0] {
            let mut insane = good.to_vec();
            insane[4..12].copy_from_slice(&wrong.to_le_bytes());
            assert!(forged(4, &insane).unwrap_err().0.contains("not a rotation"));
            insane = good.to_vec();
            insane[60..68].copy_from_slice(&(-wrong).to_le_bytes());
            assert!(forged(4, &insane).unwrap_err().0.contains("focal length"));
        }
    }
}
