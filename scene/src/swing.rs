//! Splats that swing as their object walks: limbs of people.
//!
//! A person who walks repeats the same motion with every stride (two steps), and the stride is a length on the path, so that limbs stand
//! still when the person does. The centre of a splat moves about its place in the object's axes as a Fourier series of low order of the
//! way in strides.

use std::f64::consts::TAU;

use glam::Vec3;

use crate::error::CodecError;
use crate::frame::{self, Kind};
use crate::splats::{Splats, column};

/// Harmonics of the stride: legs swing once in it, knees and hips bob twice.
pub const HARMONICS: usize = 2;
/// Functions of the way that displacements are sums of: cosine and sine of each harmonic.
pub const TERMS: usize = 2 * HARMONICS;
/// Numbers of a splat: x, y and z for each term.
pub const NUMBERS: usize = 3 * TERMS;

/// How splats of an object swing: a header of the stride, and as the bulk the amplitudes of every splat (f32, little endian).
pub const SWING: Kind = Kind(*b"swng", 1);
/// Strides of people, giants and toys, metres.
const STRIDES: std::ops::Range<f64> = 0.05..20.0;
/// The greatest amplitude, metres.
const MAX_AMPLITUDE: f32 = 100.0;

/// How splats of an object swing.
#[derive(Debug, Clone, PartialEq)]
pub struct Swing {
    /// Length of a stride, metres.
    pub stride_metres: f64,
    /// Of each splat: x, y, z of the first term, then of the others, metres.
    pub amplitudes: Vec<[f32; NUMBERS]>,
}

impl Swing {
    /// The splats where they are after this many metres of the way. There must be as many as amplitudes.
    pub fn swung(&self, splats: &Splats, metres: f64) -> Splats {
        let mut swung = splats.clone();
        displace(&mut swung, &self.amplitudes, &terms(metres / self.stride_metres));
        swung
    }

    /// How the splats with these indices swing, in that order.
    #[must_use]
    pub fn select(&self, rows: &[u32]) -> Self {
        Self { amplitudes: rows.iter().map(|&i| self.amplitudes[i as usize]).collect(), ..*self }
    }

    /// Encodes it.
    pub fn to_frame(&self) -> Vec<u8> {
        let bulk: Vec<u8> = self.amplitudes.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        frame::encode(SWING, &self.stride_metres, &bulk)
    }

    /// Decodes how this many splats swing.
    ///
    /// # Errors
    /// Bytes that are none or damaged, of another number of splats, or numbers that no splat swings by.
    pub fn from_frame(bytes: &[u8], splats: usize) -> Result<Self, CodecError> {
        let (stride_metres, bulk): (f64, _) = frame::decode(SWING, bytes)?;
        if Some(bulk.len()) != splats.checked_mul(4 * NUMBERS) {
            return Err(CodecError::new(format!("it swings another number of splats than {splats}")));
        }
        let number = |at: usize| f32::from_le_bytes(std::array::from_fn(|k| bulk[4 * at + k]));
        let amplitudes: Vec<[f32; NUMBERS]> =
            (0..splats).map(|i| std::array::from_fn(|k| number(NUMBERS * i + k))).collect();
        let is_sane = amplitudes.iter().flatten().all(|value| value.abs() <= MAX_AMPLITUDE);
        if !STRIDES.contains(&stride_metres) || !is_sane {
            return Err(CodecError::new("it has a stride or amplitudes that are out of range"));
        }
        Ok(Self { stride_metres, amplitudes })
    }
}

/// The terms after this many strides.
pub fn terms(strides: f64) -> [f32; TERMS] {
    std::array::from_fn(|k| {
        let angle = TAU * (k / 2 + 1) as f64 * strides.rem_euclid(1.0);
        (if k.is_multiple_of(2) { angle.cos() } else { angle.sin() }) as f32
    })
}

/// Moves the centres of splats by their amplitudes.
pub fn displace(splats: &mut Splats, amplitudes: &[[f32; NUMBERS]], terms: &[f32; TERMS]) {
    for (axis, means) in splats.columns_mut()[column::MEAN..column::MEAN + 3].iter_mut().enumerate() {
        for (mean, of_splat) in means.iter_mut().zip(amplitudes) {
            *mean += displacement(of_splat, terms)[axis];
        }
    }
}

/// The displacement of a splat, metres.
pub fn displacement(amplitudes: &[f32; NUMBERS], terms: &[f32; TERMS]) -> Vec3 {
    amplitudes.chunks_exact(3).zip(terms).map(|(of_term, term)| *term * Vec3::from_slice(of_term)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splats::Splat;

    #[test]
    fn splats_swing_about_their_places_and_repeat_with_the_stride() {
        let mut splats = Splats::new(1);
        (0..2).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -2.0, Vec3::ONE, 0.7)));
        let mut swings = [0.0; NUMBERS];
        // x by the cosine of the first harmonic, z by the sine of the second.
        (swings[0], swings[11]) = (0.5, 0.1);
        let swing = Swing { stride_metres: 1.4, amplitudes: vec![[0.0; NUMBERS], swings] };
        for (strides, place) in [
            (0.0, Vec3::new(1.5, 1.0, 1.0)),
            (0.125, Vec3::new(1.0 + 0.5 * 0.5f32.sqrt(), 1.0, 1.1)),
            (0.5, Vec3::new(0.5, 1.0, 1.0)),
            (7.25, Vec3::new(1.0, 1.0, 1.0)),
        ] {
            let swung = swing.swung(&splats, 1.4 * strides);
            assert_eq!(swung.mean(0), Vec3::ZERO);
            assert!((swung.mean(1) - place).length() < 1e-5, "{strides}: {}", swung.mean(1));
            assert_eq!(swung.columns()[3..], splats.columns()[3..]);
        }
        assert_eq!(swing.select(&[1]).amplitudes, [swings]);
    }

    #[test]
    fn a_swing_survives_its_frame_and_a_wrong_one_is_refused() {
        let row = |value: f32| std::array::from_fn(|k| value * k as f32);
        let swing = Swing { stride_metres: 1.3, amplitudes: vec![row(0.01), row(-0.02), row(0.0)] };
        let bytes = swing.to_frame();
        assert_eq!(Swing::from_frame(&bytes, 3), Ok(swing.clone()));
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x20;
            assert!(Swing::from_frame(&damaged, 3).is_err(), "flip at {at} was not detected");
        }
        assert!(Swing::from_frame(&bytes, 2).is_err() && Swing::from_frame(&bytes, usize::MAX).is_err());
        for wrong in [
            Swing { stride_metres: f64::NAN, ..swing.clone() },
            Swing { stride_metres: 0.0, ..swing.clone() },
            Swing { amplitudes: vec![row(f32::INFINITY); 3], ..swing.clone() },
            Swing { amplitudes: vec![row(1e6); 3], ..swing },
        ] {
            assert!(Swing::from_frame(&wrong.to_frame(), 3).unwrap_err().to_string().contains("out of range"));
        }
    }
}
