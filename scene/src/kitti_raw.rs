//! Reads calibration and positions of the KITTI raw recordings.
//!
//! | file | holds |
//! |---|---|
//! | `calib_cam_to_cam.txt` | `P_rect_0X`, the projections of the rectified cameras in the axes of rectified camera 0; their sizes `S_rect_0X`; `R_rect_00`, which rectifies camera 0 |
//! | `calib_velo_to_cam.txt` | camera 0, not rectified, from the Velodyne: `R` and `T` |
//! | `calib_imu_to_velo.txt` | the Velodyne from the IMU: `R` and `T` |
//! | `oxts/data/FRAME.txt` | a line of 30 numbers: position, orientation and motion of the IMU |
//! | `oxts/timestamps.txt`, `image_0X/timestamps.txt` | a line for each frame: its time |
//! | `tracklet_labels.xml` | boxes of objects, in the axes of the Velodyne of each frame |
//!
//! The IMU's axes are x ahead, y left, z up, as the Velodyne's. The world is x east, y north, z up in metres, its origin the
//! first position.
//!
//! Source: the readme and `dataformat.txt` of the raw data's development kit; its `latlonToMercator.m` for the positions.

mod tracklets;

use std::collections::BTreeMap;
use std::time::UNIX_EPOCH;

use glam::{DQuat, DVec3, EulerRot};

use crate::camera::{CameraModel, Rigid};
use crate::capture::GeoOrigin;
use crate::error::CodecError;
use crate::kitti::projection;
use crate::kitti360::{entries, numbers, rigid, text};

pub use self::tracklets::{Tracklet, read_tracklets};

/// Radius of the earth in the Mercator projection, metres.
const EARTH_METRES: f64 = 6_378_137.0;
/// Numbers of a line of oxts.
const OXTS_NUMBERS: usize = 30;
/// Largest latitude, degrees: the Mercator projection has no poles.
const MAX_LATITUDE: f64 = 85.0;

/// A rectified camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawCamera {
    /// Intrinsics: a pinhole.
    pub model: CameraModel,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Its pose from rectified camera 0.
    pub from_first: Rigid,
}

/// The rectified cameras by number, 0 to 3, and what rectifies camera 0.
#[derive(Debug, Clone, PartialEq)]
pub struct RawCameras {
    /// By number: 0 and 1 are grey, 2 and 3 in colour.
    pub cameras: BTreeMap<u8, RawCamera>,
    /// `R_rect_00`.
    pub rectified_from_camera: Rigid,
}

/// Reads `calib_cam_to_cam.txt`.
///
/// # Errors
/// No camera, a row that is missing or has other than its numbers, or values out of range.
pub fn read_cameras(bytes: &[u8]) -> Result<RawCameras, CodecError> {
    let entries = entries(bytes)?;
    let mut cameras = BTreeMap::new();
    for number in 0..4 {
        let [p, s] = ["P_rect", "S_rect"].map(|key| format!("{key}_0{number}"));
        if !entries.contains_key(p.as_str()) && !entries.contains_key(s.as_str()) {
            continue;
        }
        let projected = projection(&row::<12>(&entries, &p)?);
        let (model, from_first) =
            projected.ok_or_else(|| CodecError::new(format!("{p} is not the projection of a rectified camera")))?;
        let [width, height] = row::<2>(&entries, &s)?;
        let side = |pixels: f64| (1.0..=65_536.0).contains(&pixels).then_some(pixels.round() as u32);
        let (Some(width), Some(height)) = (side(width), side(height)) else {
            return Err(CodecError::new(format!("{s} is not the size of a photo")));
        };
        cameras.insert(number, RawCamera { model, width, height, from_first });
    }
    if cameras.is_empty() {
        return Err(CodecError::new("has none of P_rect_00 to P_rect_03"));
    }
    let r = row::<9>(&entries, "R_rect_00")?;
    let rectified_from_camera = rigid(&[r[0], r[1], r[2], 0.0, r[3], r[4], r[5], 0.0, r[6], r[7], r[8], 0.0]);
    let not_a_rotation = || CodecError::new("R_rect_00 is not a rotation");
    Ok(RawCameras { cameras, rectified_from_camera: rectified_from_camera.ok_or_else(not_a_rotation)? })
}

/// Reads `calib_velo_to_cam.txt` or `calib_imu_to_velo.txt`: the rows `R` and `T`.
///
/// # Errors
/// A row that is missing or has other than its numbers, or an `R` that is not a rotation.
pub fn read_mounting(bytes: &[u8]) -> Result<Rigid, CodecError> {
    let entries = entries(bytes)?;
    let (r, t) = (row::<9>(&entries, "R")?, row::<3>(&entries, "T")?);
    let pose = rigid(&[r[0], r[1], r[2], t[0], r[3], r[4], r[5], t[1], r[6], r[7], r[8], t[2]]);
    pose.ok_or_else(|| CodecError::new("R and T are not a rigid transform"))
}

/// A row of a calibration file.
fn row<const N: usize>(entries: &BTreeMap<&str, Vec<f64>>, key: &str) -> Result<[f64; N], CodecError> {
    let row = entries.get(key).and_then(|values| <[f64; N]>::try_from(values.as_slice()).ok());
    row.ok_or_else(|| CodecError::new(format!("has no row {key} of {N} numbers")))
}

/// Position, orientation and motion of the IMU at a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Oxts {
    /// Position.
    pub place: GeoOrigin,
    /// Roll, pitch and yaw, radians: turns about x, then y, then z; yaw 0 is east.
    pub angles: [f64; 3],
    /// Velocity to the east, to the north and up, metres per second.
    pub velocity: DVec3,
    /// Angular velocity about the IMU's axes, radians per second.
    pub spin: DVec3,
}

impl Oxts {
    /// The rotation of [`angles`](Self::angles): world from IMU.
    pub fn rotation(&self) -> DQuat {
        let [roll, pitch, yaw] = self.angles;
        DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll).normalize()
    }
}

/// Reads a file of `oxts/data`.
///
/// # Errors
/// Other than 30 numbers, one that is not finite, a latitude of over 85 degrees, or values out of range.
pub fn read_oxts(bytes: &[u8]) -> Result<Oxts, CodecError> {
    let values = numbers(text(bytes)?)?;
    let v = <[f64; OXTS_NUMBERS]>::try_from(values.as_slice())
        .map_err(|_| CodecError::new(format!("has {} numbers instead of {OXTS_NUMBERS}", values.len())))?;
    let place = GeoOrigin { latitude_degrees: v[0], longitude_degrees: v[1], altitude_metres: v[2] };
    let oxts = Oxts {
        place,
        angles: [v[3], v[4], v[5]],
        velocity: DVec3::new(v[7], v[6], v[10]),
        spin: DVec3::new(v[17], v[18], v[19]),
    };
    let is_sane = v[0].abs() <= MAX_LATITUDE
        && v[1].abs() <= 360.0
        && v[2].abs() < 1e6
        && oxts.angles.iter().all(|angle| angle.abs() < 10.0)
        && oxts.velocity.length() < 1e3
        && oxts.spin.length() < 1e3;
    if is_sane { Ok(oxts) } else { Err(CodecError::new("has a position, an angle or a speed out of range")) }
}

/// Reads a file of times: microseconds since 1970 of each frame from the first.
///
/// # Errors
/// A line that is no time after 1970.
pub fn read_times(bytes: &[u8]) -> Result<Vec<i64>, CodecError> {
    let time = |(number, line): (usize, &str)| {
        let since =
            humantime::parse_rfc3339_weak(line.trim()).ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        let microseconds = since.and_then(|since| i64::try_from(since.as_micros()).ok());
        microseconds
            .ok_or_else(|| CodecError::new(format!("line {} is not a time as 2011-09-26 13:02:25.96", number + 1)))
    };
    text(bytes)?.trim_end().lines().enumerate().map(time).collect()
}

/// Mercator's projection around a first position, at the scale of its latitude.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mercator {
    scale: f64,
    origin: DVec3,
}

impl Mercator {
    /// The projection whose world has its origin at this position.
    pub fn new(first: &GeoOrigin) -> Self {
        let unmoved = Self { scale: first.latitude_degrees.to_radians().cos(), origin: DVec3::ZERO };
        Self { origin: unmoved.place(first), ..unmoved }
    }

    /// The world position, metres.
    pub fn place(&self, geo: &GeoOrigin) -> DVec3 {
        let north = (0.25 * std::f64::consts::PI + 0.5 * geo.latitude_degrees.to_radians()).tan().ln();
        let metres = self.scale * EARTH_METRES;
        DVec3::new(metres * geo.longitude_degrees.to_radians(), metres * north, geo.altitude_metres) - self.origin
    }

    /// The inverse of [`place`](Self::place).
    pub fn geo(&self, place: DVec3) -> GeoOrigin {
        let at = place + self.origin;
        let metres = self.scale * EARTH_METRES;
        let latitude = 2.0 * (at.y / metres).exp().atan() - 0.5 * std::f64::consts::PI;
        GeoOrigin {
            latitude_degrees: latitude.to_degrees(),
            longitude_degrees: (at.x / metres).to_degrees(),
            altitude_metres: at.z,
        }
    }

    /// The IMU's pose.
    pub fn world_from_imu(&self, oxts: &Oxts) -> Rigid {
        Rigid { rotation: oxts.rotation(), translation: self.place(&oxts.place) }
    }
}

#[cfg(test)]
mod tests;
