//! Reads and writes SOG of version 2, PlayCanvas' compressed splats, as separate files: `meta.json` and lossless WebP pictures.
//!
//! Every picture of the splats has a pixel for each, row by row: the low and the high bytes of the positions (16 bits of
//! sign(x) ln(1 + |x|) between the least and the largest), the rotation (which component is largest, and the three others), the log
//! scales and the colours (each a byte that names one of 256 values), the opacity. SH coefficients above degree 0 come from a palette
//! of at most 65,536 entries, in rows of 64. Axes are those of an INRIA PLY.
//!
//! Source: the specification of SOG and of streamed SOG in PlayCanvas' user manual, and the reader of `splat-transform`, which decides
//! where the manual is silent: codes of rotations count from w, and codebooks of scales have logarithms.

mod bundle;
mod codebook;
mod palette;
mod picture;
mod read;

use std::f32::consts::SQRT_2;

use serde::{Deserialize, Serialize};

pub use self::bundle::bundle;
pub use self::read::{read, read_bundle};
use self::{codebook::Codebook, palette::Palette, picture::Picture};
use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

/// Name of the file that lists the others.
pub const META: &str = "meta.json";
/// Most splats of a chunk that is written: what viewers load at once.
pub const MAX_SPLATS: usize = 1 << 20;
/// Entries of the palette in a row of its picture.
const ROW: usize = 64;
/// Codes of rotations: this plus the index of the largest component.
const FIRST_ROTATION: u8 = 252;

/// A file of a SOG.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct File {
    /// Its name, without a folder.
    pub name: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
struct Meta {
    version: u32,
    count: usize,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    antialias: bool,
    means: Means,
    scales: Coded,
    quats: Files,
    sh0: Coded,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    sh_n: Option<Rest>,
}

#[derive(Serialize, Deserialize)]
struct Means {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [String; 2],
}

#[derive(Serialize, Deserialize)]
struct Coded {
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Serialize, Deserialize)]
struct Files {
    files: [String; 1],
}

#[derive(Serialize, Deserialize)]
struct Rest {
    count: usize,
    bands: u8,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// Encodes splats in the order that they have; `meta.json` comes last.
///
/// # Errors
/// No splats, more than [`MAX_SPLATS`], or one that is not finite.
pub fn write(splats: &Splats, antialiased: bool) -> Result<Vec<File>, CodecError> {
    let count = splats.len();
    if count == 0 || count > MAX_SPLATS {
        return Err(CodecError::new(format!("SOG of {count} splats; 1 to {MAX_SPLATS} are written")));
    }
    if let Some(row) = (0..count).find(|&i| !splats.is_finite(i)) {
        return Err(CodecError::new(format!("splat {row} has numbers that are not finite, which SOG cannot hold")));
    }
    let mut files = Vec::new();
    let mut put = |name: &str, picture: &Picture| -> Result<String, CodecError> {
        files.push(File { name: name.to_owned(), bytes: picture.encode()? });
        Ok(name.to_owned())
    };

    let logarithms = [0, 1, 2].map(|axis| splats.col(axis).iter().map(|&x| signed_log(x)).collect::<Vec<f32>>());
    let mins = [0, 1, 2].map(|axis: usize| logarithms[axis].iter().copied().fold(f32::INFINITY, f32::min));
    let maxs = [0, 1, 2].map(|axis: usize| logarithms[axis].iter().copied().fold(f32::NEG_INFINITY, f32::max));
    let place = |axis: usize, i: usize| {
        let range = f64::from(maxs[axis]) - f64::from(mins[axis]);
        let share = (f64::from(logarithms[axis][i]) - f64::from(mins[axis])) / range.max(1e-30);
        (65_535.0 * share).round() as u16
    };
    let bytes = |shift: u32| {
        Picture::of(count, |i| {
            let [x, y, z] = [0, 1, 2].map(|axis| (place(axis, i) >> shift) as u8);
            [x, y, z, 255]
        })
    };
    let means = Means { mins, maxs, files: [put("means_l.webp", &bytes(0))?, put("means_u.webp", &bytes(8))?] };

    let col = |k: usize| splats.col(k);
    let rotation = |i: usize| rotation_code([0, 1, 2, 3].map(|k| col(column::QUAT + k)[i]));
    let quats = Files { files: [put("quats.webp", &Picture::of(count, rotation))?] };

    let scales_book = Codebook::of((0..3).flat_map(|k| col(column::LOG_SCALE + k).iter().copied()));
    let scale = |i: usize| {
        let [a, b, c] = [0, 1, 2].map(|k| scales_book.code(col(column::LOG_SCALE + k)[i]));
        [a, b, c, 255]
    };
    let scales = put("scales.webp", &Picture::of(count, scale))?;

    let colours_book = Codebook::of((0..3).flat_map(|c| col(column::SH + c).iter().copied()));
    let colour = |i: usize| {
        let [r, g, b] = [0, 1, 2].map(|c| colours_book.code(col(column::SH + c)[i]));
        let opacity = 1.0 / (1.0 + (-col(column::OPACITY)[i]).exp());
        [r, g, b, (255.0 * opacity).round() as u8]
    };
    let sh0 = put("sh0.webp", &Picture::of(count, colour))?;

    let sh_n = match splats.sh_degree() {
        0 => None,
        bands => {
            let palette = Palette::of(splats);
            let book = Codebook::of(palette.centroids.iter().copied());
            let (rows, coefficients) = (palette.len().div_ceil(ROW), sh_coefficients(bands) - 1);
            let mut centroids = Picture::new(ROW * coefficients, rows);
            for (entry, values) in palette.centroids.chunks_exact(3 * coefficients).enumerate() {
                for (k, rgb) in values.chunks_exact(3).enumerate() {
                    let at = (entry / ROW * ROW + entry % ROW) * coefficients + k;
                    centroids.set(at, [book.code(rgb[0]), book.code(rgb[1]), book.code(rgb[2]), 255]);
                }
            }
            let label = |i: usize| {
                let [low, high] = palette.labels[i].to_le_bytes();
                [low, high, 0, 255]
            };
            let files = [put("shN_centroids.webp", &centroids)?, put("shN_labels.webp", &Picture::of(count, label))?];
            Some(Rest { count: palette.len(), bands, codebook: book.values(), files })
        }
    };

    let meta = Meta {
        version: 2,
        count,
        antialias: antialiased,
        means,
        scales: Coded { codebook: scales_book.values(), files: [scales] },
        quats,
        sh0: Coded { codebook: colours_book.values(), files: [sh0] },
        sh_n,
    };
    let bytes = serde_json::to_vec(&meta).map_err(|error| CodecError::new(format!("{META}: {error}")))?;
    files.push(File { name: META.to_owned(), bytes });
    Ok(files)
}

fn signed_log(x: f32) -> f32 {
    x.abs().ln_1p().copysign(x)
}

/// The three smaller components of a rotation wxyz in their order, and which one is left out.
fn rotation_code(quat: [f32; 4]) -> [u8; 4] {
    let norm = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
    let quat = if norm > 0.0 { quat.map(|v| v / norm) } else { [1.0, 0.0, 0.0, 0.0] };
    let mut largest = 0;
    for k in 1..4 {
        if quat[k].abs() > quat[largest].abs() {
            largest = k;
        }
    }
    let scale = SQRT_2.copysign(quat[largest]);
    let mut code = [0, 0, 0, FIRST_ROTATION + largest as u8];
    for (to, k) in (0..4).filter(|&k| k != largest).enumerate() {
        code[to] = (255.0 * (0.5 * scale * quat[k] + 0.5)).round().clamp(0.0, 255.0) as u8;
    }
    code
}

#[cfg(test)]
mod tests;
