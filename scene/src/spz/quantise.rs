//! Quantises the attributes of SPZ. Codes are fixed points: decoding and encoding a written code gives the same code.

use std::f32::consts::FRAC_1_SQRT_2;

/// Signs of x, y and z between SPZ's axes and INRIA's.
pub(super) const FLIP: [f32; 3] = [1.0, -1.0, -1.0];
/// Scale of stored colours, whose range is wider than that of a display.
const COLOUR_SCALE: f32 = 0.15;
/// Largest magnitude of a 9-bit component.
const MAX_MAGNITUDE: f32 = 511.0;

/// Sign of SH coefficient `k` (1 to 15) under [`FLIP`]: the product of the signs of its polynomial's odd powers.
pub(super) const fn sh_sign(k: usize) -> f32 {
    const SIGNS: [f32; 16] = [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];
    SIGNS[k]
}

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// 24 bits of fixed point, low byte first.
pub(super) fn position(value: f32, fractional_bits: u8) -> [u8; 3] {
    let fixed = (f64::from(value) * f64::from(1u32 << fractional_bits)).round() as i32;
    let [a, b, c, _] = fixed.to_le_bytes();
    [a, b, c]
}

pub(super) fn from_position([a, b, c]: [u8; 3], fractional_bits: u8) -> f32 {
    let fixed = i32::from_le_bytes([0, a, b, c]) >> 8;
    fixed as f32 / (1u32 << fractional_bits) as f32
}

/// Opacity from a logit.
pub(super) fn opacity(logit: f32) -> u8 {
    byte(255.0 / (1.0 + (-logit).exp()))
}

/// Colour from the SH coefficient of degree 0.
pub(super) fn colour(value: f32) -> u8 {
    byte(value * (COLOUR_SCALE * 255.0) + 127.5)
}

pub(super) fn from_colour(byte: u8) -> f32 {
    (f32::from(byte) / 255.0 - 0.5) / COLOUR_SCALE
}

pub(super) fn log_scale(value: f32) -> u8 {
    byte((value + 10.0) * 16.0)
}

pub(super) fn from_log_scale(byte: u8) -> f32 {
    f32::from(byte) / 16.0 - 10.0
}

/// An SH coefficient, rounded to 5 bits in degree 1 and to 4 bits above; zero stays zero.
pub(super) fn sh(value: f32, coefficient: usize) -> u8 {
    let step = if coefficient < 4 { 8 } else { 16 };
    let fixed = (value * 128.0).round().clamp(-256.0, 256.0) as i32 + 128;
    ((fixed + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}

pub(super) fn from_sh(byte: u8) -> f32 {
    (f32::from(byte) - 128.0) / 128.0
}

/// How rotations are stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Rotation {
    /// x, y and z with 8 bits over -1 to 1, where w is not negative.
    FirstThree,
    /// Two bits for the index of the largest of x, y, z, w, then sign and 9 bits over 0 to √½ for each of the others.
    SmallestThree,
}

impl Rotation {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::FirstThree => 3,
            Self::SmallestThree => 4,
        }
    }

    /// Packs wxyz in INRIA's axes, of any length.
    pub(super) fn pack(self, [w, x, y, z]: [f32; 4]) -> u32 {
        let code = |xyzw: [f32; 4]| match self {
            Self::FirstThree => first_three(xyzw),
            Self::SmallestThree => smallest_three(xyzw),
        };
        // Rounding may make another component the largest or the three longer than one: iterate to a fixed point.
        let mut word = code([FLIP[0] * x, FLIP[1] * y, FLIP[2] * z, w]);
        for _ in 0..8 {
            let again = code(self.components(word));
            if again == word {
                break;
            }
            word = again;
        }
        word
    }

    /// Unpacks wxyz in INRIA's axes, of unit length.
    pub(super) fn unpack(self, word: u32) -> [f32; 4] {
        let [x, y, z, w] = self.components(word);
        [w, FLIP[0] * x, FLIP[1] * y, FLIP[2] * z]
    }

    /// Unpacks xyzw in SPZ's axes.
    fn components(self, word: u32) -> [f32; 4] {
        let rest = |sum: f32| (1.0 - sum).max(0.0).sqrt();
        let mut xyzw = [0.0; 4];
        match self {
            Self::FirstThree => {
                let [x, y, z, _] = word.to_le_bytes().map(|byte| f32::from(byte) / 127.5 - 1.0);
                xyzw = [x, y, z, rest(x * x + y * y + z * z)];
            }
            Self::SmallestThree => {
                let largest = (word >> 30) as usize;
                let (mut bits, mut sum) = (word, 0.0);
                for k in (0..4).rev().filter(|&k| k != largest) {
                    let magnitude = FRAC_1_SQRT_2 * (bits & 511) as f32 / MAX_MAGNITUDE;
                    xyzw[k] = if bits & 512 == 0 { magnitude } else { -magnitude };
                    sum += magnitude * magnitude;
                    bits >>= 10;
                }
                xyzw[largest] = rest(sum);
            }
        }
        xyzw
    }
}

fn normalised(xyzw: [f32; 4]) -> [f32; 4] {
    let length = xyzw.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    if length > 0.0 { xyzw.map(|v| (f64::from(v) / length) as f32) } else { [0.0, 0.0, 0.0, 1.0] }
}

fn first_three(xyzw: [f32; 4]) -> u32 {
    let [x, y, z, w] = normalised(xyzw);
    let half = if w < 0.0 { -127.5 } else { 127.5 };
    u32::from_le_bytes([byte(x * half + 127.5), byte(y * half + 127.5), byte(z * half + 127.5), 0])
}

fn smallest_three(xyzw: [f32; 4]) -> u32 {
    let xyzw = normalised(xyzw);
    let largest_magnitude = xyzw.iter().fold(0.0f32, |largest_magnitude, v| largest_magnitude.max(v.abs()));
    // The first of the components that rounding could reorder. The margin is one and a half steps: with a whole number,
    // two codes could map to each other.
    let threshold = largest_magnitude - 1.5 * FRAC_1_SQRT_2 / MAX_MAGNITUDE;
    let largest = xyzw.iter().position(|v| v.abs() >= threshold).unwrap_or(3);
    let negative = xyzw[largest] < 0.0;
    let mut word = largest as u32;
    for v in (0..4).filter(|&k| k != largest).map(|k| xyzw[k]) {
        let magnitude = (MAX_MAGNITUDE * v.abs() / FRAC_1_SQRT_2).round().min(MAX_MAGNITUDE) as u32;
        let sign = u32::from(magnitude > 0 && (v < 0.0) != negative);
        word = word << 10 | sign << 9 | magnitude;
    }
    word
}
