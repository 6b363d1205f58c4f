//! How the exposure of each view differs from the mean: an affine transform of its colours.
//!
//! Photos of one place differ in exposure and white balance. Without a word for that, splats take each photo's at its word and a
//! place's colour comes to depend on who looks (H3DGS, Kerbl et al. 2024, has the same transform). Not for viewers: a model
//! is drawn without any.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::error::CodecError;
use crate::frame::{self, Kind};

/// Exposures; the header is their number, the bulk for each, by view, the view (u32) and the twelve numbers (f32), little endian.
pub const EXPOSURES: Kind = Kind(*b"expo", 1);

const BYTES: usize = 4 + 12 * 4;

/// Of a drawn colour to that of the photo: a row for each channel of the photo; a column for each channel drawn, then one
/// for what is added. Colours are sRGB values in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposure(pub [[f32; 4]; 3]);

impl Exposure {
    /// Changes nothing.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// How much brighter grey of 0.5 becomes: 1 for the identity.
    pub fn gain(&self) -> f32 {
        self.0.iter().map(|[r, g, b, add]| r + g + b + 2.0 * add).sum::<f32>() / 3.0
    }
}

/// Exposures by view of the capture. Views without one are as the mean.
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
    /// That of a view, if it has one.
    pub fn of(&self, view: u32) -> Option<&Exposure> {
        self.0.get(&view)
    }

    /// Views with theirs, in order.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &Exposure)> {
        self.0.iter().map(|(&view, exposure)| (view, exposure))
    }

    /// Number of views that have one.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// No view has one.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// As a frame.
    pub fn to_frame(&self) -> Vec<u8> {
        let mut bulk = Vec::with_capacity(BYTES * self.0.len());
        for (view, exposure) in &self.0 {
            bulk.extend(view.to_le_bytes());
            bulk.extend(exposure.0.iter().flatten().flat_map(|value| value.to_le_bytes()));
        }
        frame::encode(EXPOSURES, &Header { count: self.0.len() as u64 }, &bulk)
    }

    /// From a frame.
    ///
    /// # Errors
    /// As [`frame::decode`]; a bulk of another length than promised, views out of order, or numbers that are not finite.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(EXPOSURES, bytes)?;
        if header.count.checked_mul(BYTES as u64) != Some(bulk.len() as u64) {
            return Err(CodecError::new("exposures do not fit their header"));
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
                return Err(CodecError::new("exposures are not in the order of their views"));
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
    fn exposures_round_trip_and_damage_is_seen() {
        for exposures in [some(), Exposures::default()] {
            let bytes = exposures.to_frame();
            assert_eq!(Exposures::from_frame(&bytes).unwrap(), exposures);
            for at in 0..bytes.len() {
                let mut damaged = bytes.clone();
                damaged[at] ^= 0x40;
                assert!(Exposures::from_frame(&damaged).is_err(), "flip at {at} went unseen");
            }
        }
    }

    #[test]
    fn lies_with_a_good_checksum_are_refused() {
        let lie = |count: u64, bulk: &[u8]| Exposures::from_frame(&frame::encode(EXPOSURES, &Header { count }, bulk));
        let frame = some().to_frame();
        let good = &frame[frame.len() - 4 * BYTES..];
        assert_eq!(lie(4, good).unwrap(), some());
        assert!(lie(u64::MAX, good).is_err() && lie(3, good).is_err());
        let mut twice = good.to_vec();
        twice[BYTES..BYTES + 4].fill(0);
        assert!(lie(4, &twice).unwrap_err().0.contains("order"));
        let mut endless = good.to_vec();
        endless[8..12].copy_from_slice(&f32::INFINITY.to_le_bytes());
        assert!(lie(4, &endless).unwrap_err().0.contains("not finite"));
    }

    #[test]
    fn gain_is_of_grey() {
        assert_eq!(Exposure::IDENTITY.gain(), 1.0);
        let doubled = Exposure(Exposure::IDENTITY.0.map(|row| row.map(|value| 2.0 * value)));
        assert_eq!(doubled.gain(), 2.0);
    }
}
