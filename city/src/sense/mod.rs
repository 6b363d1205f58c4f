//! Sensors: what is looked at, from where, when and with what errors. Every reading stands beside its truth.
//!
//! | room | makes |
//! |---|---|
//! | [`rig`] | [`Shot`]s of a car with six cameras along the streets |
//! | [`survey`] | [`Shot`]s of aerial blocks, surveillance cameras and free paths |
//! | [`lidar`] | sweeps of a turning lidar: true and noisy ranges, intensities |
//! | [`radar`] | detections with radial velocities, and ghosts |
//! | [`inertial`] | GPS fixes, gyro and accelerometer readings, and the drift of reported poses |

pub mod inertial;
pub mod lidar;
pub mod radar;
pub mod rig;
pub mod survey;

use glam::{DMat3, DQuat, DVec3};
use scene::{Camera, Pinhole, Rigid};
use serde::{Deserialize, Serialize};

/// The most shots or sweeps that one list may hold.
pub const MAX_READINGS: usize = 4_000_000;

/// Settings that ask for what cannot be.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum SenseError {
    /// A number that is not finite or out of its range.
    #[error("{0} is out of range")]
    Setting(&'static str),
    /// More readings than [`MAX_READINGS`].
    #[error("{0} would be more readings than {MAX_READINGS}")]
    TooMany(u64),
}

/// How a sensor moves around a moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Motion {
    /// World metres per second.
    pub velocity: DVec3,
    /// Axis times radians per second, in the world.
    pub spin: DVec3,
}

impl Motion {
    /// At rest.
    pub const STILL: Self = Self { velocity: DVec3::ZERO, spin: DVec3::ZERO };

    /// The motion that takes one pose to another, `world_from_body`, in some seconds.
    pub fn between(a: &Rigid, b: &Rigid, seconds: f64) -> Self {
        if seconds.is_nan() || seconds <= 0.0 {
            return Self::STILL;
        }
        let turn = (b.rotation * a.rotation.inverse()).normalize();
        let turn = if turn.w < 0.0 { -turn } else { turn };
        Self { velocity: (b.translation - a.translation) / seconds, spin: turn.to_scaled_axis() / seconds }
    }

    /// A pose, `world_from_body`, this much later.
    pub fn extrapolate(&self, pose: &Rigid, seconds: f64) -> Rigid {
        Rigid {
            rotation: (DQuat::from_scaled_axis(self.spin * seconds) * pose.rotation).normalize(),
            translation: pose.translation + self.velocity * seconds,
        }
    }
}

/// One picture to take: the camera that takes it and the one that its maker believes in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// Unique in its list: sensor and number.
    pub name: String,
    /// Which of the sensors: "front-left", "nadir" ...
    pub sensor: String,
    /// The city's clock at the middle of the exposure.
    pub seconds: f64,
    /// Truth: the camera at that moment.
    pub camera: Camera,
    /// What is reported: the truth with the errors of GPS and mounting.
    pub reported: Camera,
    /// How the camera moves at that moment.
    pub motion: Motion,
    /// Gain on linear light; 1 shows a white wall in full sun as white.
    pub exposure: f32,
    /// Seconds that the shutter is open; 0 freezes everything.
    pub shutter_seconds: f64,
    /// Seconds from the first to the last row; 0 for a global shutter. The middle row is taken at `seconds`.
    pub rolling_shutter_seconds: f64,
}

impl Shot {
    /// A sharp picture that is reported without error.
    pub fn new(name: String, sensor: &str, seconds: f64, camera: Camera) -> Self {
        Self {
            name,
            sensor: sensor.to_owned(),
            seconds,
            camera,
            reported: camera,
            motion: Motion::STILL,
            exposure: 1.0,
            shutter_seconds: 0.0,
            rolling_shutter_seconds: 0.0,
        }
    }
}

/// A pinhole with square pixels and a centred axis, by its horizontal field of view.
///
/// # Errors
/// [`SenseError::Setting`] for a field of view outside 1° to 170°, or a picture without pixels or beyond 32,768 a side.
pub fn pinhole(width: u32, height: u32, field_degrees: f64) -> Result<Pinhole, SenseError> {
    if !(1..=32_768).contains(&width) || !(1..=32_768).contains(&height) {
        return Err(SenseError::Setting("the size of the picture"));
    }
    if !(1.0..=170.0).contains(&field_degrees) {
        return Err(SenseError::Setting("the field of view"));
    }
    let f = 0.5 * f64::from(width) / (0.5 * field_degrees).to_radians().tan();
    Ok(Pinhole { width, height, fx: f, fy: f, cx: 0.5 * f64::from(width), cy: 0.5 * f64::from(height) })
}

/// A camera at a point that looks along a direction, its picture upright (y down) where the direction is not vertical;
/// straight down, the top of the picture is `up`.
pub fn camera_towards(pinhole: Pinhole, centre: DVec3, forward: DVec3, up: DVec3) -> Camera {
    let forward = forward.try_normalize().unwrap_or(DVec3::X);
    let level = DVec3::Z.cross(forward);
    let right = if level.length() > 1e-6 { -level } else { forward.cross(up) };
    let right = right.try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
    let down = forward.cross(right);
    let world_from_camera = DQuat::from_mat3(&DMat3::from_cols(right, down, forward)).normalize();
    Camera { pinhole, camera_from_world: Rigid { rotation: world_from_camera, translation: centre }.inverse() }
}

/// Checks that a number lies in a range (and is one).
pub(crate) fn check_range(name: &'static str, value: f64, low: f64, high: f64) -> Result<f64, SenseError> {
    if value >= low && value <= high { Ok(value) } else { Err(SenseError::Setting(name)) }
}

/// Checks a number of readings before there are any.
pub(crate) fn check_count(readings: f64) -> Result<usize, SenseError> {
    if readings.is_finite() && readings <= MAX_READINGS as f64 {
        Ok(readings.max(0.0) as usize)
    } else {
        Err(SenseError::TooMany(readings as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_camera_sees_up_as_up_and_left_as_left() {
        let camera = camera_towards(pinhole(100, 100, 90.0).unwrap(), DVec3::new(1.0, 2.0, 3.0), DVec3::X, DVec3::X);
        let (ahead, depth) = camera.project(DVec3::new(11.0, 2.0, 3.0));
        assert!((ahead.x - 50.0).abs() < 1e-6 && (ahead.y - 50.0).abs() < 1e-6 && (depth - 10.0).abs() < 1e-9);
        let (left_above, _) = camera.project(DVec3::new(11.0, 4.0, 4.0));
        assert!(left_above.x < 50.0 && left_above.y < 50.0, "{left_above}");
    }

    #[test]
    fn a_motion_carries_one_pose_to_the_other() {
        let a = Rigid { rotation: DQuat::from_rotation_z(0.3), translation: DVec3::new(1.0, 2.0, 3.0) };
        let b = Rigid { rotation: DQuat::from_rotation_z(0.7), translation: DVec3::new(2.0, 2.0, 3.0) };
        let there = Motion::between(&a, &b, 0.5).extrapolate(&a, 0.5);
        assert!((there.translation - b.translation).length() < 1e-12);
        assert!(there.rotation.angle_between(b.rotation) < 1e-9);
    }
}
