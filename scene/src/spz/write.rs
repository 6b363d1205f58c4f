//! Encodes SPZ plane by plane, so that splats of a city need not lie in memory at once.

use std::io::{self, Write};

use flate2::{Compression, write::GzEncoder};

use super::quantise::{self, Rotation, sh_sign};
use super::{ANTIALIASED, MAGIC, Version};
use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

/// Fractional bits of written positions where their range allows it: steps of a quarter of a millimetre.
const FRACTIONAL_BITS: u8 = 12;

/// Planes of a file: positions, opacities, colours, scales, rotations, SH coefficients.
pub const PLANES: usize = 6;

/// Encodes splats as SPZ.
///
/// # Errors
/// A splat that is not finite or is over 8,388 km from the origin, or over four billion splats.
pub fn write(splats: &Splats, antialiased: bool, version: Version) -> Result<Vec<u8>, CodecError> {
    if let Some(row) = (0..splats.len()).find(|&i| !splats.is_finite(i)) {
        let all = (row..splats.len()).filter(|&i| !splats.is_finite(i)).count();
        return Err(CodecError::new(format!(
            "splat {row} has numbers that are not finite ({all} of {} splats have), which SPZ cannot hold",
            splats.len()
        )));
    }
    let layout = Layout::new(splats.len() as u64, splats.sh_degree(), farthest(splats), antialiased, version)?;
    let mut zipper = Zipper::new();
    let mut bytes = zipper.add(&layout.header())?;
    for plane in 0..PLANES {
        bytes.extend(zipper.add(&layout.plane(splats, plane))?);
    }
    bytes.extend(zipper.finish()?);
    Ok(bytes)
}

/// The greatest magnitude of a coordinate, metres.
pub(super) fn farthest(splats: &Splats) -> f32 {
    splats.columns()[..3].iter().flatten().fold(0.0f32, |far, &v| far.max(v.abs()))
}

/// How the splats of a file are stored: the header, then [`PLANES`] planes with a row for each splat, all in one gzip stream
/// ([`Zipper`]).
#[derive(Debug, Clone, Copy)]
pub struct Layout {
    header: [u8; 16],
    fractional_bits: u8,
    rotation: Rotation,
    sh_degree: u8,
}

impl Layout {
    /// The layout of this many splats, none of whose coordinates is greater than `farthest`, metres.
    ///
    /// # Errors
    /// More than 8,388 km, or over four billion splats.
    pub fn new(
        count: u64,
        sh_degree: u8,
        farthest: f32,
        antialiased: bool,
        version: Version,
    ) -> Result<Self, CodecError> {
        let count = u32::try_from(count).map_err(|_| CodecError::new("more splats than SPZ supports"))?;
        let fits = |bits: &u8| (f64::from(farthest) * f64::from(1u32 << bits)).round() < f64::from(1 << 23);
        let fractional_bits = (0..=FRACTIONAL_BITS).rev().find(fits);
        let fractional_bits =
            fractional_bits.ok_or_else(|| CodecError::new(format!("a splat {farthest} m out, too far for SPZ")))?;
        let number = if version == Version::V2 { 2u32 } else { 3 };
        let mut header = [0; 16];
        for (to, word) in header.chunks_exact_mut(4).zip([MAGIC, number, count]) {
            to.copy_from_slice(&word.to_le_bytes());
        }
        header[12..].copy_from_slice(&[sh_degree, fractional_bits, if antialiased { ANTIALIASED } else { 0 }, 0]);
        let rotation = if version == Version::V2 { Rotation::FirstThree } else { Rotation::SmallestThree };
        Ok(Self { header, fractional_bits, rotation, sh_degree })
    }

    /// The header.
    pub fn header(&self) -> [u8; 16] {
        self.header
    }

    /// The rows of one plane, 0 to [`PLANES`], of finite splats. Those of all splats of the file follow each other.
    pub fn plane(&self, splats: &Splats, plane: usize) -> Vec<u8> {
        let rows = 0..splats.len();
        let col = |k: usize| splats.col(k);
        match plane {
            0 => rows
                .flat_map(|i| [0, 1, 2].map(|axis| (i, axis)))
                .flat_map(|(i, axis)| quantise::position(quantise::FLIP[axis] * col(axis)[i], self.fractional_bits))
                .collect(),
            1 => rows.map(|i| quantise::opacity(col(column::OPACITY)[i])).collect(),
            2 => rows.flat_map(|i| [0, 1, 2].map(|c| quantise::colour(col(column::SH + c)[i]))).collect(),
            3 => rows.flat_map(|i| [0, 1, 2].map(|k| quantise::log_scale(col(column::LOG_SCALE + k)[i]))).collect(),
            4 => {
                let word = |i: usize| self.rotation.pack([0, 1, 2, 3].map(|k| col(column::QUAT + k)[i])).to_le_bytes();
                rows.flat_map(|i| word(i).into_iter().take(self.rotation.bytes())).collect()
            }
            _ => {
                // A part may have fewer coefficients than the file.
                let stored = 3..3 * sh_coefficients(self.sh_degree);
                let value = |i: usize, k: usize| splats.columns().get(column::SH + k).map_or(0.0, |column| column[i]);
                let code = |i: usize, k: usize| quantise::sh(sh_sign(k / 3) * value(i, k), k / 3);
                rows.flat_map(|i| stored.clone().map(move |k| code(i, k))).collect()
            }
        }
    }
}

/// A gzip stream that hands out what it has compressed.
pub struct Zipper(GzEncoder<Vec<u8>>);

impl Zipper {
    /// A stream of nothing.
    #[expect(clippy::new_without_default, reason = "a stream is not a value")]
    pub fn new() -> Self {
        Self(GzEncoder::new(Vec::new(), Compression::default()))
    }

    /// Compresses bytes and returns what there is of the stream since the last call.
    ///
    /// # Errors
    /// None, as memory takes all.
    pub fn add(&mut self, bytes: &[u8]) -> Result<Vec<u8>, CodecError> {
        self.0.write_all(bytes).map_err(|error| failed(&error))?;
        Ok(std::mem::take(self.0.get_mut()))
    }

    /// Ends the stream and returns the rest of it.
    ///
    /// # Errors
    /// None, as memory takes all.
    pub fn finish(self) -> Result<Vec<u8>, CodecError> {
        self.0.finish().map_err(|error| failed(&error))
    }
}

fn failed(error: &io::Error) -> CodecError {
    CodecError::new(format!("gzip: {error}"))
}
