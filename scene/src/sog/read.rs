//! Decodes SOG of hostile origin: sizes are checked against the bytes at hand before memory is taken, and numbers are finite.

use std::f32::consts::FRAC_1_SQRT_2;

use super::bundle::Archive;
use super::picture::Picture;
use super::{FIRST_ROTATION, META, Meta, ROW};
use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

/// Largest decoded size: this many bytes plus this factor times those of all pictures. Splats of SH degree 3 take 15 times their
/// pictures' bytes; more than twice that is a decompression bomb.
const MEMORY_BYTES: u64 = 32 << 20;
const MEMORY_FACTOR: u64 = 32;
/// Pixels at most of a picture, for each splat or entry, and besides: writers pad pictures to some size.
const PIXELS_EACH: usize = 4;
const PIXELS_MORE: usize = 1 << 16;
/// Entries at most of a palette, which two bytes name.
const MAX_ENTRIES: usize = 1 << 16;

/// Decodes splats from the bytes of a `.sog`, an archive of `meta.json` and the files that it names. The flag is true if they are to
/// be rendered anti-aliased.
///
/// # Errors
/// No ZIP archive, one that is damaged or needs more than plain deflate, and as [`read`].
pub fn read_bundle(bytes: &[u8]) -> Result<(Splats, bool), CodecError> {
    let archive = Archive::open(bytes)?;
    read(&archive.file(META)?, |name| archive.file(name))
}

/// Decodes splats from the bytes of `meta.json`; `file` reads another file by its name, which may be anything: the caller confines
/// it. The flag is true if they are to be rendered anti-aliased.
///
/// # Errors
/// Another version, more splats than the pictures can hold, a picture of the wrong size, a number that is not finite, and what `file`
/// returns.
pub fn read(
    meta: &[u8],
    mut file: impl FnMut(&str) -> Result<Vec<u8>, CodecError>,
) -> Result<(Splats, bool), CodecError> {
    let meta: Meta = serde_json::from_slice(meta).map_err(|error| CodecError::new(format!("{META}: {error}")))?;
    if meta.version != 2 {
        return Err(CodecError::new(format!("SOG of version {}; version 2 can be read", meta.version)));
    }
    let rest = meta.sh_n.as_ref().filter(|rest| rest.bands > 0);
    let bands = rest.map_or(0, |rest| rest.bands);
    if bands > 3 {
        return Err(CodecError::new(format!("SOG with {bands} SH bands; up to 3 can be read")));
    }
    if !meta.means.mins.iter().chain(&meta.means.maxs).all(|limit| limit.is_finite()) {
        return Err(CodecError::new("the limits of the means are not finite"));
    }
    let (count, coefficients) = (meta.count, sh_coefficients(bands));
    let [low, high] = &meta.means.files;
    let mut names = vec![low, high, &meta.quats.files[0], &meta.scales.files[0], &meta.sh0.files[0]];
    names.extend(rest.iter().flat_map(|rest| &rest.files));
    let stored: Vec<Vec<u8>> = names.iter().map(|name| file(name)).collect::<Result<_, _>>()?;
    let bytes: u64 = stored.iter().map(|bytes| bytes.len() as u64).sum();
    let needed = (count as u64).saturating_mul(4 * (column::SH + 3 * coefficients) as u64);
    if needed > MEMORY_BYTES + MEMORY_FACTOR * bytes {
        return Err(CodecError::new(format!("pictures of {bytes} bytes cannot hold the {count} splats of {META}")));
    }
    let picture = |index: usize, count: usize, pixels_each: usize| -> Result<Picture, CodecError> {
        let most = (PIXELS_EACH * count + PIXELS_MORE) * pixels_each;
        let bad = |error: CodecError| CodecError::new(format!("{:?}: {error}", names[index]));
        let picture = Picture::decode(&stored[index], most).map_err(bad)?;
        if picture.len() < count * pixels_each {
            let problem = format!("{:?} has {} pixels of {}", names[index], picture.len(), count * pixels_each);
            return Err(CodecError::new(problem));
        }
        Ok(picture)
    };

    let mut splats = Splats::new(bands);
    let columns = splats.columns_mut();
    columns.iter_mut().for_each(|column| column.reserve_exact(count));
    let (low, high) = (picture(0, count, 1)?, picture(1, count, 1)?);
    for i in 0..count {
        let (low, high) = (low.get(i), high.get(i));
        for axis in 0..3 {
            let share = f32::from(u16::from_le_bytes([low[axis], high[axis]])) / 65_535.0;
            let (min, max) = (meta.means.mins[axis], meta.means.maxs[axis]);
            columns[axis].push(signed_exp(min + (max - min) * share));
        }
    }
    drop((low, high));
    let quats = picture(2, count, 1)?;
    for i in 0..count {
        let quat = rotation_of(quats.get(i)).into_iter().enumerate();
        quat.for_each(|(k, value)| columns[column::QUAT + k].push(value));
    }
    drop(quats);
    let (scales, values) = (picture(3, count, 1)?, book(&meta.scales.codebook, "scales")?);
    for i in 0..count {
        (0..3).for_each(|k| columns[column::LOG_SCALE + k].push(values[usize::from(scales.get(i)[k])]));
    }
    drop(scales);
    let (colours, values) = (picture(4, count, 1)?, book(&meta.sh0.codebook, "sh0")?);
    for i in 0..count {
        let pixel = colours.get(i);
        (0..3).for_each(|c| columns[column::SH + c].push(values[usize::from(pixel[c])]));
        columns[column::OPACITY].push(crate::ply::logit_of_byte(pixel[3]));
    }
    drop(colours);
    if let Some(rest) = rest {
        if rest.count > MAX_ENTRIES {
            return Err(CodecError::new(format!("a palette of {} entries; two bytes name {MAX_ENTRIES}", rest.count)));
        }
        let values = book(&rest.codebook, "shN")?;
        let (centroids, labels) = (picture(5, rest.count, coefficients - 1)?, picture(6, count, 1)?);
        if centroids.width() != ROW * (coefficients - 1) {
            return Err(CodecError::new(format!("{:?} has another size than {} entries", rest.files[0], rest.count)));
        }
        for i in 0..count {
            let pixel = labels.get(i);
            let entry = usize::from(u16::from_le_bytes([pixel[0], pixel[1]]));
            for k in 0..coefficients - 1 {
                let rgb = if entry < rest.count { Some(centroids.get(entry * (coefficients - 1) + k)) } else { None };
                for c in 0..3 {
                    columns[column::SH + 3 * (k + 1) + c].push(rgb.map_or(0.0, |rgb| values[usize::from(rgb[c])]));
                }
            }
        }
    }
    match (0..count).find(|&row| !splats.is_finite(row)) {
        Some(row) => Err(CodecError::new(format!("splat {row} has numbers that are not finite"))),
        None => Ok((splats, meta.antialias)),
    }
}

fn book(coded: &[f32], what: &str) -> Result<[f32; 256], CodecError> {
    let found = <[f32; 256]>::try_from(coded).ok().filter(|values| values.iter().all(|value| value.is_finite()));
    found.ok_or_else(|| CodecError::new(format!("the codebook of {what} does not have 256 finite values")))
}

fn signed_exp(l: f32) -> f32 {
    l.abs().exp_m1().copysign(l)
}

/// The rotation wxyz of a code; no rotation where there is none of that code.
pub(super) fn rotation_of(code: [u8; 4]) -> [f32; 4] {
    let Some(largest) = code[3].checked_sub(FIRST_ROTATION).map(usize::from) else { return [1.0, 0.0, 0.0, 0.0] };
    let mut quat = [0.0; 4];
    for (from, k) in (0..4).filter(|&k| k != largest).enumerate() {
        quat[k] = (f32::from(code[from]) / 255.0 * 2.0 - 1.0) * FRAC_1_SQRT_2;
    }
    quat[largest] = (1.0 - quat.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    quat
}
