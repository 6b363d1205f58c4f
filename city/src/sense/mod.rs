//! Simulated sensors: poses, times, readings and errors. Every reading comes with its ground truth.
//!
//! | module | output |
//! |---|---|
//! | [`rig`] | [`Shot`]s of a car with six cameras along the streets |
//! | [`drives`] | drives of such cars through whole streets, both directions, closely |
//! | [`survey`] | [`Shot`]s of aerial blocks, surveillance cameras and free paths |
//! | [`watch`] | [`Shot`]s of fixed cameras around a place |
//! | [`lidar`] | lidar sweeps: true and noisy ranges, intensities |
//! | [`radar`] | radar detections with radial velocities, and ghosts |
//! | [`inertial`] | GPS fixes, gyro and accelerometer readings, and the drift of reported poses |

pub mod drives;
pub mod inertial;
pub mod lidar;
pub mod radar;
pub mod rig;
pub mod survey;
pub mod watch;

use glam::{DMat3, DQuat, DVec3};
use scene::{Camera, Pinhole, Rigid};
use serde::{Deserialize, Serialize};

/// Largest number of shots or sweeps in a list.
pub const MAX_READINGS: usize = 4_000_000;

/// Invalid sensor settings.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum SenseError {
    /// A number that is not finite or out of range.
    #[error("{0} is out of range")]
    Setting(&'static str),
    /// More readings than [`MAX_READINGS`].
    #[error("{0} readings are more than {MAX_READINGS}")]
    TooMany(u64),
}

/// Linear and angular velocity of a sensor at a time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Motion {
    /// World metres per second.
    pub velocity: DVec3,
    /// Angular velocity in the world: axis times radians per second.
    pub spin: DVec3,
}

impl Motion {
    /// At rest.
    pub const STILL: Self = Self { velocity: DVec3::ZERO, spin: DVec3::ZERO };

    /// The constant motion from one pose to another (`world_from_body`) in this many seconds.
    pub fn between(a: &Rigid, b: &Rigid, seconds: f64) -> Self {
        if seconds.is_nan() || seconds <= 0.0 {
            return Self::STILL;
        }
        let turn = (b.rotation * a.rotation.inverse()).normalize();
        let turn = if turn.w < 0.0 { -turn } else { turn };
        Self { velocity: (b.translation - a.translation) / seconds, spin: turn.to_scaled_axis() / seconds }
    }

    /// Extrapolates a pose, `world_from_body`, by this many seconds.
    pub fn extrapolate(&self, pose: &Rigid, seconds: f64) -> Rigid {
        Rigid {
            rotation: (DQuat::from_scaled_axis(self.spin * seconds) * pose.rotation).normalize(),
            translation: pose.translation + self.velocity * seconds,
        }
    }
}

/// A camera shot: the true camera, the reported camera and the exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// Unique name: sensor and number.
    pub name: String,
    /// Name of the sensor: "front-left", "nadir" ...
    pub sensor: String,
    /// City time at the middle of the exposure, seconds.
    pub seconds: f64,
    /// Ground truth: the camera at that time.
    pub camera: Camera,
    /// The camera as reported, with errors of GPS and mounting.
    pub reported: Camera,
    /// The motion of the camera at that time.
    pub motion: Motion,
    /// Gain on linear light; 1 renders a white wall in full sun as white.
    pub exposure: f32,
    /// Exposure time, seconds; 0 for no motion blur.
    pub shutter_seconds: f64,
    /// Readout time from the first to the last row, seconds; 0 for a global shutter. The middle row is exposed at
    /// `seconds`.
    pub rolling_shutter_seconds: f64,
}

impl Shot {
    /// A shot without motion, blur and pose error.
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

/// Pinhole intrinsics with square pixels and a centred principal point, from the horizontal field of view in degrees.
///
/// # Errors
/// [`SenseError::Setting`] for a field of view outside 1° to 170°, or a size outside 1 to 32,768 pixels.
pub fn pinhole(width: u32, height: u32, field_degrees: f64) -> Result<Pinhole, SenseError> {
    if !(1..=32_768).contains(&width) || !(1..=32_768).contains(&height) {
        return Err(SenseError::Setting("the size of the image"));
    }
    if !(1.0..=170.0).contains(&field_degrees) {
        return Err(SenseError::Setting("the field of view"));
    }
    let f = 0.5 * f64::from(width) / (0.5 * field_degrees).to_radians().tan();
    Ok(Pinhole { width, height, fx: f, fy: f, cx: 0.5 * f64::from(width), cy: 0.5 * f64::from(height) })
}

/// A camera at a point with a viewing direction. The image is upright (y down); for a vertical direction its top is
/// `up`.
pub fn camera_towards(pinhole: Pinhole, centre: DVec3, forward: DVec3, up: DVec3) -> Camera {
    let forward = forward.try_normalize().unwrap_or(DVec3::X);
    let level = DVec3::Z.cross(forward);
    let right = if level.length() > 1e-6 { -level } else { forward.cross(up) };
    let right = right.try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
    let down = forward.cross(right);
    let world_from_camera = DQuat::from_mat3(&DMat3::from_cols(right, down, forward)).normalize();
    Camera { pinhole, camera_from_world: Rigid { rotation: world_from_camera, translation: centre }.inverse() }
}

/// Checks that a number lies in a range.
pub(crate) fn check_range(name: &'static str, value: f64, low: f64, high: f64) -> Result<f64, SenseError> {
    if value >= low && value <= high { Ok(value) } else { Err(SenseError::Setting(name)) }
}

/// Checks a number of readings against [`MAX_READINGS`].
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
    fn a_level_camera_has_an_upright_unmirrored_image() {
        let camera = camera_towards(pinhole(100, 100, 90.0).unwrap(), DVec3::new(1.0, 2.0, 3.0), DVec3::X, DVec3::X);
        let (ahead, depth) = camera.project(DVec3::new(11.0, 2.0, 3.0));
        assert!((ahead.x - 50.0).abs() < 1e-6 && (ahead.y - 50.0).abs() < 1e-6 && (depth - 10.0).abs() < 1e-9);
        let (left_above, _) = camera.project(DVec3::new(11.0, 4.0, 4.0));
        assert!(left_above.x < 50.0 && left_above.y < 50.0, "{left_above}");
    }

    #[test]
    fn a_motion_extrapolates_one_pose_to_the_other() {
        let a = Rigid { rotation: DQuat::from_rotation_z(0.3), translation: DVec3::new(1.0, 2.0, 3.0) };
        let b = Rigid { rotation: DQuat::from_rotation_z(0.7), translation: DVec3::new(2.0, 2.0, 3.0) };
        let there = Motion::between(&a, &b, 0.5).extrapolate(&a, 0.5);
        assert!((there.translation - b.translation).length() < 1e-12);
        assert!(there.rotation.angle_between(b.rotation) < 1e-9);
    }
}
