//! Reads KITTI-360 calibration, poses and Velodyne scans.
//!
//! The vehicle's pose is world_from_imu. `calib_cam_to_pose.txt` has imu_from_camera for each camera before
//! rectification. `R_rect` rotates that camera to the rectified one, whose intrinsics are the left 3×3 part of
//! `P_rect`. Only the rectified perspective cameras 00 and 01 are supported; 02 and 03 are fisheyes of another model.
//!
//! Source: the data set's documentation, "Raw data", and its scripts (`loadCalibration.py`).

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;
use crate::lidar::read_points;

/// A rectified perspective camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KittiCamera {
    /// Intrinsics: a pinhole.
    pub model: CameraModel,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Rectifying rotation.
    pub rectified_from_camera: Rigid,
}

/// Reads `perspective.txt`: cameras by name, `image_00` and `image_01`.
///
/// # Errors
/// Truncated lines, values out of range, or no camera.
pub fn read_perspective(bytes: &[u8]) -> Result<BTreeMap<String, KittiCamera>, CodecError> {
    let entries = entries(bytes)?;
    let mut cameras = BTreeMap::new();
    for number in ["00", "01"] {
        let get = |key: &str| entries.get(format!("{key}_{number}").as_str());
        let (Some(p), Some(s)) = (get("P_rect"), get("S_rect")) else { continue };
        let wrong = |key: &str| CodecError::new(format!("{key}_{number} has missing values or values out of range"));
        let p = <[f64; 12]>::try_from(p.as_slice()).map_err(|_| wrong("P_rect"))?;
        let s = <[f64; 2]>::try_from(s.as_slice()).map_err(|_| wrong("S_rect"))?;
        let rectified_from_camera = match get("R_rect") {
            Some(r) => {
                let r = <[f64; 9]>::try_from(r.as_slice()).map_err(|_| wrong("R_rect"))?;
                rigid(&[r[0], r[1], r[2], 0.0, r[3], r[4], r[5], 0.0, r[6], r[7], r[8], 0.0])
                    .ok_or_else(|| wrong("R_rect"))?
            }
            None => Rigid::IDENTITY,
        };
        let side = |pixels: f64| (1.0..=65_536.0).contains(&pixels).then_some(pixels.round() as u32);
        let (Some(width), Some(height)) = (side(s[0]), side(s[1])) else { return Err(wrong("S_rect")) };
        if p[0] <= 0.0 || p[5] <= 0.0 {
            return Err(wrong("P_rect"));
        }
        let model = CameraModel::Pinhole([p[0], p[5], p[2], p[6]]);
        cameras.insert(format!("image_{number}"), KittiCamera { model, width, height, rectified_from_camera });
    }
    if cameras.is_empty() {
        return Err(CodecError::new("has neither P_rect_00 with S_rect_00 nor P_rect_01 with S_rect_01"));
    }
    Ok(cameras)
}

/// Reads `calib_cam_to_pose.txt`: imu_from_camera by camera name.
///
/// # Errors
/// Lines that are not rigid transforms.
pub fn read_cam_to_pose(bytes: &[u8]) -> Result<BTreeMap<String, Rigid>, CodecError> {
    let pose = |(name, values): (&str, Vec<f64>)| {
        let pose = <[f64; 12]>::try_from(values.as_slice()).ok().and_then(|values| rigid(&values));
        let pose = pose.ok_or_else(|| {
            CodecError::new(format!("'{}' is not a rigid transform", name.escape_debug().take(40).collect::<String>()))
        })?;
        Ok((name.to_string(), pose))
    };
    entries(bytes)?.into_iter().map(pose).collect()
}

/// Reads `calib_cam_to_velo.txt`: velodyne_from_camera of camera 00.
///
/// # Errors
/// Not twelve numbers of a rigid transform.
pub fn read_cam_to_velo(bytes: &[u8]) -> Result<Rigid, CodecError> {
    let values = numbers(text(bytes)?)?;
    let values = <[f64; 12]>::try_from(values.as_slice()).ok().and_then(|values| rigid(&values));
    values.ok_or_else(|| CodecError::new("is not a rigid transform of twelve numbers"))
}

/// Reads `poses.txt` or `cam0_to_world.txt`: transforms to the world by frame number, as 12 or 16 numbers.
///
/// # Errors
/// A line without a frame number and a rigid transform, a repeated frame, or no poses.
pub fn read_poses(bytes: &[u8]) -> Result<BTreeMap<u32, Rigid>, CodecError> {
    let mut poses = BTreeMap::new();
    for (i, line) in text(bytes)?.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let wrong = |what: &str| CodecError::new(format!("line {} {what}", i + 1));
        let (frame, values) = line.trim().split_once(char::is_whitespace).ok_or_else(|| wrong("is cut short"))?;
        let frame: u32 = frame.parse().map_err(|_| wrong("does not start with a frame number"))?;
        let values = numbers(values).map_err(|_| wrong("has a word that is not a number"))?;
        let pose = match values.as_slice() {
            [rows @ .., 0.0, 0.0, 0.0, 1.0] if rows.len() == 12 => rows.try_into().ok(),
            rows => rows.try_into().ok(),
        };
        let pose = pose.and_then(rigid).ok_or_else(|| wrong("is not a rigid transform"))?;
        if poses.insert(frame, pose).is_some() {
            return Err(wrong("repeats a frame"));
        }
    }
    if poses.is_empty() {
        return Err(CodecError::new("has no poses"));
    }
    Ok(poses)
}

/// Reads every `step`-th point of a Velodyne scan: x, y, z in the scanner's frame, metres. Points that are not finite
/// are dropped.
///
/// # Errors
/// A length that is not a multiple of 16 bytes, the size of a point.
pub fn read_scan(bytes: &[u8], step: usize) -> Result<Vec<DVec3>, CodecError> {
    Ok(read_points(bytes, 4)?.into_iter().step_by(step.max(1)).collect())
}

/// Lines `name: numbers`. Lines with other values are skipped.
pub(crate) fn entries(bytes: &[u8]) -> Result<BTreeMap<&str, Vec<f64>>, CodecError> {
    let lines = text(bytes)?.lines().filter_map(|line| line.split_once(':'));
    Ok(lines.filter_map(|(name, values)| Some((name.trim(), numbers(values).ok()?))).collect())
}

pub(crate) fn text(bytes: &[u8]) -> Result<&str, CodecError> {
    std::str::from_utf8(bytes).map_err(|_| CodecError::new("is not UTF-8 text"))
}

pub(crate) fn numbers(text: &str) -> Result<Vec<f64>, CodecError> {
    let number = |word: &str| word.parse::<f64>().ok().filter(|v| v.is_finite());
    let numbers = text.split_ascii_whitespace().map(number).collect::<Option<Vec<_>>>();
    numbers.ok_or_else(|| CodecError::new("has a word that is not a number"))
}

/// The transform of a row-major 3×4 matrix; `None` unless its rotation is orthonormal within 1e-3.
pub(crate) fn rigid(rows: &[f64; 12]) -> Option<Rigid> {
    let column = |k: usize| DVec3::new(rows[k], rows[4 + k], rows[8 + k]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let deviation = matrix.transpose() * matrix - DMat3::IDENTITY;
    if deviation.to_cols_array().iter().any(|v| v.abs() > 1e-3) || matrix.determinant() < 0.0 {
        return None;
    }
    let rigid = Rigid { rotation: DQuat::from_mat3(&matrix).normalize(), translation: column(3) };
    rigid.is_sane().then_some(rigid)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERSPECTIVE: &str = "calib_time: 01-Jan-2013\ncorner_dist: 0.0\nS_00: 1392 512\nK_00: 1 0 0 0 1 0 0 0 1\n\
        S_rect_00: 1408 376\nR_rect_00: 0 -1 0 1 0 0 0 0 1\nP_rect_00: 552.5 0 682.0 0 0 552.5 238.7 0 0 0 1 0\n\
        S_rect_01: 1408 376\nP_rect_01: 552.5 0 682.0 -328.3 0 552.5 238.7 0 0 0 1 0\n";

    #[test]
    fn cameras_and_poses_are_read() {
        let cameras = read_perspective(PERSPECTIVE.as_bytes()).unwrap();
        let first = cameras["image_00"];
        assert_eq!(first.model, CameraModel::Pinhole([552.5, 552.5, 682.0, 238.7]));
        assert_eq!((first.width, first.height, cameras.len()), (1408, 376, 2));
        assert!((first.rectified_from_camera.apply(DVec3::X) - DVec3::Y).length() < 1e-12);
        let poses = read_poses(b"3 1 0 0 5 0 1 0 6 0 0 1 7\n10 1 0 0 5 0 1 0 6 0 0 1 8 0 0 0 1 \n").unwrap();
        assert_eq!(poses.keys().copied().collect::<Vec<_>>(), [3, 10]);
        assert_eq!(poses[&10].translation, DVec3::new(5.0, 6.0, 8.0));
        let imu = read_cam_to_pose(b"image_00: 0 0 1 1 -1 0 0 2 0 -1 0 3\n").unwrap()["image_00"];
        assert_eq!(imu.apply(DVec3::Z), DVec3::new(2.0, 2.0, 3.0));
        assert_eq!(read_cam_to_velo(b"1 0 0 1 0 1 0 2 0 0 1 3").unwrap().translation, DVec3::new(1.0, 2.0, 3.0));
        let scan: Vec<u8> = [1.0f32, 2.0, 3.0, 0.5, f32::NAN, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0, 1.0]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        assert_eq!(read_scan(&scan, 1).unwrap(), [DVec3::new(1.0, 2.0, 3.0), DVec3::new(4.0, 5.0, 6.0)]);
        assert_eq!(read_scan(&scan, 3).unwrap().len(), 1);
        assert!(read_scan(&scan[1..], 1).is_err());
    }

    #[test]
    fn invalid_files_are_refused() {
        for bad in
            ["", "3 1 0 0", "a 1 0 0 5 0 1 0 6 0 0 1 7", "3 2 0 0 5 0 1 0 6 0 0 1 7", "3 nan 0 0 5 0 1 0 6 0 0 1 7"]
        {
            assert!(read_poses(bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(read_poses(b"3 1 0 0 5 0 1 0 6 0 0 1 7\n3 1 0 0 5 0 1 0 6 0 0 1 7\n").is_err());
        for (from, to) in [("1408 376", "0 376"), ("552.5 0", "-1 0"), ("0 -1 0 1 0 0 0 0 1", "0 1 0 1 0 0 0 0 1")] {
            assert!(read_perspective(PERSPECTIVE.replace(from, to).as_bytes()).is_err(), "{to}");
        }
        assert!(read_perspective(b"S_00: 1392 512").is_err() && read_cam_to_velo(b"1 2 3").is_err());
        assert!(read_cam_to_pose(b"image_00: 1 2 3").is_err());
    }
}
