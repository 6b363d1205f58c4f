//! Per-view exposures: an affine colour transform from the mean exposure to that of each photo.
//!
//! Photos of one place differ in exposure and white balance. Without this transform splats fit the differences with
//! view-dependent colour (H3DGS, Kerbl et al. 2024, uses the same transform). Exposures are for training only: viewers
//! render without them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::error::CodecError;
use crate::frame::{self, Kind};

/// Exposures. The header is their number. The bulk has, for each view in ascending order, the view (u32) and twelve
/// f32, little endian.
pub const EXPOSURES: Kind = Kind(*b"expo", 1);

const BYTES: usize = 4 + 12 * 4;

/// The affine transform from a rendered colour to the photo's: one row per channel of the photo, with a column per
/// rendered channel and one for the offset. Colours are sRGB values in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposure(pub [[f32; 4]; 3]);

impl Exposure {
    /// The identity transform.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// The factor by which the transform brightens a grey of 0.5; 1 for the identity.
    pub fn gain(&self) -> f32 {
        self.0.iter().map(|[r, g, b, add]| r + g + b + 2.0 * add).sum::<f32>() / 3.0
    }
}

/// Exposures by view of the capture. Views without one have the mean exposure.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exposures(BTreeMap<u32, Exposure>);

impl FromIterator<(u32, Exposure)> for Exposures {
    fn from_iter<T: IntoIterator<Item = (u32, Exposure)>>(of_views: T) -> Self {
        Self(of_views.into_iter().collect())
    }
}

#[derive(Serialize, Deserialize)]
struct Header {
    count: u64,
}

impl Exposures {
    /// The exposure of a view, if it has one.
    pub fn of(&self, view: u32) -> Option<&Exposure> {
        self.0.get(&view)
    }

    /// Views with their exposures, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &Exposure)> {
        self.0.iter().map(|(&view, exposure)| (view, exposure))
    }

    /// Number of views with an exposure.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True if no view has an exposure.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Encodes a frame.
    pub fn to_frame(&self) -> Vec<u8> {
        let mut bulk = Vec::with_capacity(BYTES * self.0.len());
        for (view, exposure) in &self.0 {
            bulk.extend(view.to_le_bytes());
            bulk.extend(exposure.0.iter().flatten().flat_map(|value| value.to_le_bytes()));
        }
        frame::encode(EXPOSURES, &Header { count: self.0.len() as u64 }, &bulk)
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// As [`frame::decode`]; a bulk that does not match the header, views out of order, or numbers that are not finite.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(EXPOSURES, bytes)?;
        if header.count.checked_mul(BYTES as u64) != Some(bulk.len() as u64) {
            return Err(CodecError::new("exposures do not match their header"));
        }
        let mut exposures = BTreeMap::new();
        for row in bulk.chunks_exact(BYTES) {
            let word = |n: usize| -> [u8; 4] { row[4 * n..4 * n + 4].try_into().expect("four bytes") };
            let view = u32::from_le_bytes(word(0));
            let number = |r: usize, c: usize| f32::from_le_bytes(word(1 + 4 * r + c));
            let exposure = [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| number(r, c)));
            if exposure.iter().flatten().any(|value| !value.is_finite()) {
                return Err(CodecError::new(format!("the exposure of view {view} is not finite")));
            }
            if exposures.last_key_value().is_some_and(|(&last, _)| last >= view) {
                return Err(CodecError::new("exposures are not in ascending order of their views"));
            }
            exposures.insert(view, Exposure(exposure));
        }
        Ok(Self(exposures))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some() -> Exposures {
        let of = |view: u32| {
            let mut exposure = Exposure::IDENTITY;
            exposure.0[view as usize % 3][3] = 0.01 * view as f32;
            (view, exposure)
        };
        [0, 3, 7, u32::MAX].map(of).into_iter().collect()
    }

    #[test]
    fn exposures_round_trip_and_damage_is_detected() {
        for exposures in [some(), Exposures::default()] {
            let bytes = exposures.to_frame();
            assert_eq!(Exposures::from_frame(&bytes).unwrap(), exposures);
            for at in 0..bytes.len() {
                let mut damaged = bytes.clone();
                damaged[at] ^= 0x40;
                assert!(Exposures::from_frame(&damaged).is_err(), "flip at {at} was not detected");
            }
        }
    }

    #[test]
    fn inconsistent_frames_with_a_valid_checksum_are_refused() {
        let forged =
            |count: u64, bulk: &[u8]| Exposures::from_frame(&frame::encode(EXPOSURES, &Header { count }, bulk));
        let frame = some().to_frame();
        let good = &frame[frame.len() - 4 * BYTES..];
        assert_eq!(forged(4, good).unwrap(), some());
        assert!(forged(u64::MAX, good).is_err() && forged(3, good).is_err());
        let mut repeated = good.to_vec();
        repeated[BYTES..BYTES + 4].fill(0);
        assert!(forged(4, &repeated).unwrap_err().0.contains("order"));
        let mut infinite = good.to_vec();
        infinite[8..12].copy_from_slice(&f32::INFINITY.to_le_bytes());
        assert!(forged(4, &infinite).unwrap_err().0.contains("not finite"));
    }

    #[test]
    fn gain_is_that_of_grey() {
        assert_eq!(Exposure::IDENTITY.gain(), 1.0);
        let doubled = Exposure(Exposure::IDENTITY.0.map(|row| row.map(|value| 2.0 * value)));
        assert_eq!(doubled.gain(), 2.0);
    }
}
