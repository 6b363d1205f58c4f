//! Refined poses of training views.
//!
//! Structure from motion and satellite navigation leave errors in the poses of a capture. Training can refine them
//! together with the splats. A refined pose replaces that of the capture; the intrinsics stay.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, Rigid};
use crate::error::CodecError;
use crate::frame::{self, Kind};

/// Poses. The header is their number. The bulk has, for each view in ascending order, the view (u32) and
/// camera_from_world as seven f64: the unit quaternion xyzw and the translation in metres; little endian.
pub const POSES: Kind = Kind(*b"pose", 1);

const BYTES: usize = 4 + 7 * 8;

/// Poses (camera_from_world) by view of the capture. Views without one keep the capture's.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Poses(BTreeMap<u32, Rigid>);

impl FromIterator<(u32, Rigid)> for Poses {
    fn from_iter<T: IntoIterator<Item = (u32, Rigid)>>(of_views: T) -> Self {
        Self(of_views.into_iter().collect())
    }
}

#[derive(Serialize, Deserialize)]
struct Header {
    count: u64,
}

impl Poses {
    /// The pose of a view, if it has one.
    pub fn of(&self, view: u32) -> Option<&Rigid> {
        self.0.get(&view)
    }

    /// The camera of a view with its pose, or unchanged if the view has none.
    pub fn apply(&self, view: u32, camera: Camera) -> Camera {
        self.of(view).map_or(camera, |&camera_from_world| Camera { camera_from_world, ..camera })
    }

    /// Views with their poses, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &Rigid)> {
        self.0.iter().map(|(&view, pose)| (view, pose))
    }

    /// Number of views with a pose.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True if no view has a pose.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Encodes a frame.
    pub fn to_frame(&self) -> Vec<u8> {
        let mut bulk = Vec::with_capacity(BYTES * self.0.len());
        for (view, pose) in &self.0 {
            bulk.extend(view.to_le_bytes());
            let numbers = pose.rotation.to_array().into_iter().chain(pose.translation.to_array());
            bulk.extend(numbers.flat_map(f64::to_le_bytes));
        }
        frame::encode(POSES, &Header { count: self.0.len() as u64 }, &bulk)
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// As [`frame::decode`]; a bulk that does not match the header, views out of order, or a pose that is not
    /// [sane](Rigid::is_sane).
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(POSES, bytes)?;
        if header.count.checked_mul(BYTES as u64) != Some(bulk.len() as u64) {
            return Err(CodecError::new("poses do not match their header"));
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
            poses.insert(view, pose);
        }
        Ok(Self(poses))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some() -> Poses {
        let pose = |view: u32| {
            let angle = 0.1 * f64::from(view % 7);
            (view, Rigid { rotation: DQuat::from_rotation_x(angle), translation: DVec3::new(angle, 2.0, -3.0) })
        };
        [0, 3, 7, u32::MAX].map(pose).into_iter().collect()
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
        let forged = |count: u64, bulk: &[u8]| Poses::from_frame(&frame::encode(POSES, &Header { count }, bulk));
        let frame = some().to_frame();
        let good = &frame[frame.len() - 4 * BYTES..];
        assert_eq!(forged(4, good).unwrap(), some());
        assert!(forged(u64::MAX, good).is_err() && forged(3, good).is_err());
        let mut repeated = good.to_vec();
        repeated[BYTES..BYTES + 4].fill(0);
        assert!(forged(4, &repeated).unwrap_err().0.contains("order"));
        for wrong in [f64::NAN, 2.0] {
            let mut insane = good.to_vec();
            insane[4..12].copy_from_slice(&wrong.to_le_bytes());
            assert!(forged(4, &insane).unwrap_err().0.contains("not a rotation"));
        }
    }
}
