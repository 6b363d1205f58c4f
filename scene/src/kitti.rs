//! Reads calibration and poses of the KITTI odometry benchmark and of SemanticKITTI.
//!
//! `calib.txt` has `P0` to `P3`, the projections of the rectified cameras in the axes of camera 0: `K · [I | t]` with
//! intrinsics K. `Tr` is camera 0 from the Velodyne. A line of `poses.txt` is world_from_camera 0 of a frame, the first one
//! the identity.
//!
//! Source: the readme of the benchmark's development kit.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;
use crate::kitti360::{entries, numbers, rigid, text};

/// The sensors of a sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// By number 0 to 3: intrinsics, a pinhole, and the camera's pose from camera 0.
    pub cameras: BTreeMap<u8, (CameraModel, Rigid)>,
    /// Camera 0 from the Velodyne, if the file has it.
    pub camera_from_velodyne: Option<Rigid>,
}

/// Reads `calib.txt`.
///
/// # Errors
/// A camera without positive focal lengths, a `Tr` that is not rigid, or no camera.
pub fn read_calibration(bytes: &[u8]) -> Result<Calibration, CodecError> {
    let entries = entries(bytes)?;
    let rows = |key: &str| -> Result<Option<[f64; 12]>, CodecError> {
        let Some(values) = entries.get(key) else { return Ok(None) };
        let rows = <[f64; 12]>::try_from(values.as_slice());
        rows.map(Some).map_err(|_| CodecError::new(format!("{key} has {} numbers instead of twelve", values.len())))
    };
    let mut cameras = BTreeMap::new();
    for number in 0..4 {
        let Some(p) = rows(&format!("P{number}"))? else { continue };
        let not_rectified = || CodecError::new(format!("P{number} is not the projection of a rectified camera"));
        cameras.insert(number, projection(&p).ok_or_else(not_rectified)?);
    }
    if cameras.is_empty() {
        return Err(CodecError::new("has none of P0 to P3"));
    }
    let not_rigid = || CodecError::new("Tr is not a rigid transform");
    let camera_from_velodyne = rows("Tr")?.map(|rows| rigid(&rows).ok_or_else(not_rigid)).transpose()?;
    Ok(Calibration { cameras, camera_from_velodyne })
}

/// Intrinsics and pose of a rectified camera from its projection `K · [I | t]`, row by row; `None` for another matrix.
pub(crate) fn projection(p: &[f64; 12]) -> Option<(CameraModel, Rigid)> {
    let [fx, fy, cx, cy] = [p[0], p[5], p[2], p[6]];
    if fx <= 0.0 || fy <= 0.0 || [p[1], p[4], p[8], p[9]] != [0.0; 4] || p[10] != 1.0 {
        return None;
    }
    // The last column is K · t.
    let z = p[11];
    let pose =
        Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new((p[3] - cx * z) / fx, (p[7] - cy * z) / fy, z) };
    pose.is_sane().then_some((CameraModel::Pinhole([fx, fy, cx, cy]), pose))
}

/// Reads `poses.txt`: world_from_camera 0, by frame.
///
/// # Errors
/// A line that is not a rigid transform of twelve numbers, or no line.
pub fn read_poses(bytes: &[u8]) -> Result<Vec<Rigid>, CodecError> {
    let pose = |(i, line): (usize, &str)| {
        let rows = numbers(line).ok().and_then(|values| <[f64; 12]>::try_from(values.as_slice()).ok());
        let wrong = || CodecError::new(format!("line {} is not a rigid transform of twelve numbers", i + 1));
        rows.and_then(|rows| rigid(&rows)).ok_or_else(wrong)
    };
    let lines = text(bytes)?.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let poses = lines.map(pose).collect::<Result<Vec<_>, _>>()?;
    if poses.is_empty() { Err(CodecError::new("has no poses")) } else { Ok(poses) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CALIBRATION: &str = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n\
        Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n";

    #[test]
    fn calibration_and_poses_are_read() {
        let found = read_calibration(CALIBRATION.as_bytes()).unwrap();
        assert_eq!(found.cameras[&1].0, CameraModel::Pinhole([700.0, 700.0, 600.0, 180.0]));
        // The second camera stands 0.54 m to the right of the first.
        assert!((found.cameras[&1].1.inverse().translation - DVec3::new(0.54, 0.0, 0.0)).length() < 1e-12);
        let ahead = found.camera_from_velodyne.unwrap().apply(DVec3::X);
        assert!((ahead - DVec3::new(0.1, 0.2, 1.3)).length() < 1e-12);
        let poses = read_poses(b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 2 0 0 1 3\n\n").unwrap();
        assert_eq!((poses.len(), poses[1].translation), (2, DVec3::new(1.0, 2.0, 3.0)));
    }

    #[test]
    fn invalid_files_are_refused() {
        for (from, to) in
            [("700", "-700"), ("P0: 700 0", "P0: 700 1"), ("Tr: 0 -1", "Tr: 0 -2"), ("0.3", ""), ("1 0\n", "2 0\n")]
        {
            assert!(read_calibration(CALIBRATION.replacen(from, to, 1).as_bytes()).is_err(), "{to}");
        }
        assert!(read_calibration(b"Tr: 1").is_err() && read_poses(b"").is_err() && read_poses(b"1 0 0 0").is_err());
        assert!(read_poses(b"2 0 0 0 0 1 0 0 0 0 1 0").is_err());
    }
}
