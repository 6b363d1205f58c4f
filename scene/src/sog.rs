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

use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};

use serde::{Deserialize, Serialize};

pub use self::bundle::bundle;
use self::{codebook::Codebook, palette::Palette, picture::Picture};
use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

/// Name of the file that lists the others.
pub const META: &str = "meta.json";
/// Most splats of a chunk that is written: what viewers load at once.
pub const MAX_SPLATS: usize = 1 << 20;
/// Most splats of a chunk that is read: a picture of 16,383 pixels a side.
const MAX_READ: usize = 16_383 * 16_383;
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

/// Decodes splats from the bytes of `meta.json`; `file` reads another file by its name, which may be anything: the caller confines
/// it. The flag is true if they are to be rendered anti-aliased.
///
/// # Errors
/// Another version, a picture of the wrong size, a number that is not finite, and what `file` returns.
pub fn read(
    meta: &[u8],
    mut file: impl FnMut(&str) -> Result<Vec<u8>, CodecError>,
) -> Result<(Splats, bool), CodecError> {
    let meta: Meta = serde_json::from_slice(meta).map_err(|error| CodecError::new(format!("{META}: {error}")))?;
    let count = meta.count;
    if meta.version != 2 {
        return Err(CodecError::new(format!("SOG of version {}; version 2 can be read", meta.version)));
    }
    if count > MAX_READ {
        return Err(CodecError::new(format!("SOG of {count} splats; up to {MAX_READ} can be read")));
    }
    let mut picture = |name: &str| -> Result<Picture, CodecError> {
        let picture = Picture::decode(&file(name)?).map_err(|error| CodecError::new(format!("{name}: {error}")))?;
        if picture.len() < count {
            return Err(CodecError::new(format!("{name} has {} pixels for {count} splats", picture.len())));
        }
        Ok(picture)
    };
    let book = |coded: &[f32], what: &str| -> Result<[f32; 256], CodecError> {
        let found = <[f32; 256]>::try_from(coded).ok().filter(|values| values.iter().all(|value| value.is_finite()));
        found.ok_or_else(|| CodecError::new(format!("the codebook of {what} does not have 256 finite values")))
    };
    if !meta.means.mins.iter().chain(&meta.means.maxs).all(|limit| limit.is_finite()) {
        return Err(CodecError::new("the limits of the means are not finite"));
    }

    let bands = meta.sh_n.as_ref().map_or(0, |rest| rest.bands);
    if bands > 3 {
        return Err(CodecError::new(format!("SOG with {bands} SH bands; up to 3 can be read")));
    }
    let low = picture(&meta.means.files[0])?;
    let mut splats = Splats::new(bands);
    let columns = splats.columns_mut();
    columns.iter_mut().for_each(|column| column.reserve_exact(count));
    let high = picture(&meta.means.files[1])?;
    for i in 0..count {
        let (low, high) = (low.get(i), high.get(i));
        for axis in 0..3 {
            let share = f32::from(u16::from_le_bytes([low[axis], high[axis]])) / 65_535.0;
            let (min, max) = (meta.means.mins[axis], meta.means.maxs[axis]);
            columns[axis].push(signed_exp(min + (max - min) * share));
        }
    }
    drop((low, high));
    let quats = picture(&meta.quats.files[0])?;
    for i in 0..count {
        let quat = rotation_of(quats.get(i)).into_iter().enumerate();
        quat.for_each(|(k, value)| columns[column::QUAT + k].push(value));
    }
    let (scales, values) = (picture(&meta.scales.files[0])?, book(&meta.scales.codebook, "scales")?);
    for i in 0..count {
        (0..3).for_each(|k| columns[column::LOG_SCALE + k].push(values[usize::from(scales.get(i)[k])]));
    }
    let (colours, values) = (picture(&meta.sh0.files[0])?, book(&meta.sh0.codebook, "sh0")?);
    for i in 0..count {
        let pixel = colours.get(i);
        (0..3).for_each(|c| columns[column::SH + c].push(values[usize::from(pixel[c])]));
        columns[column::OPACITY].push(crate::ply::logit_of_byte(pixel[3]));
    }
    if let Some(rest) = meta.sh_n.filter(|rest| rest.bands > 0) {
        let values = book(&rest.codebook, "shN")?;
        let labels = picture(&rest.files[1])?;
        let centroids = Picture::decode(&file(&rest.files[0])?)?;
        let coefficients = sh_coefficients(bands) - 1;
        if centroids.width() != ROW * coefficients || centroids.len() < rest.count.saturating_mul(coefficients) {
            return Err(CodecError::new(format!("{} has another size than {} entries", rest.files[0], rest.count)));
        }
        for i in 0..count {
            let pixel = labels.get(i);
            let entry = usize::from(u16::from_le_bytes([pixel[0], pixel[1]]));
            for k in 0..coefficients {
                let rgb = if entry < rest.count { Some(centroids.get(entry * coefficients + k)) } else { None };
                for c in 0..3 {
                    columns[column::SH + 3 * (k + 1) + c].push(rgb.map_or(0.0, |rgb| values[usize::from(rgb[c])]));
                }
            }
        }
    }
    Ok((splats, meta.antialias))
}

fn signed_log(x: f32) -> f32 {
    x.abs().ln_1p().copysign(x)
}

fn signed_exp(l: f32) -> f32 {
    l.abs().exp_m1().copysign(l)
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

/// The rotation wxyz of a code; no rotation where there is none of that code.
fn rotation_of(code: [u8; 4]) -> [f32; 4] {
    let Some(largest) = code[3].checked_sub(FIRST_ROTATION).map(usize::from) else { return [1.0, 0.0, 0.0, 0.0] };
    let mut quat = [0.0; 4];
    for (from, k) in (0..4).filter(|&k| k != largest).enumerate() {
        quat[k] = (f32::from(code[from]) / 255.0 * 2.0 - 1.0) * FRAC_1_SQRT_2;
    }
    quat[largest] = (1.0 - quat.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    quat
}

#[cfg(test)]
mod tests;
