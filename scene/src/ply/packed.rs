//! Reads PlayCanvas' `.compressed.ply`: 16 bytes per splat, quantised to the value range of each chunk of 256 splats.
//!
//! Element `chunk` holds min and max of positions, log scales and (in newer files) colours. Element `vertex` holds four
//! words: position and log scale with 11, 10 and 11 bits between min and max; the rotation as two bits for the index of
//! the largest component (in the order w, x, y, z) and 10 bits for each of the others; colour and opacity with 8 bits
//! each. Element `sh` holds the coefficients of higher degrees as bytes over -4 to 4, channel-major like INRIA's.
//!
//! Source: PlayCanvas' `splat-transform` (`write-compressed-ply`) and engine (`gsplat-compressed-data`).

use super::header::{Header, Kind};
use crate::error::CodecError;
use crate::splats::{SH_C0, Splats, column, sh_coefficients};

/// Splats per chunk.
const CHUNK: usize = 256;
const WORDS: [&str; 4] = ["packed_position", "packed_scale", "packed_rotation", "packed_color"];

/// True if the vertices are packed.
pub(super) fn is_packed(header: &Header) -> bool {
    header.has("chunk") && header.declares("vertex", WORDS[0])
}

/// Unpacks the splats.
pub(super) fn read(header: &Header) -> Result<Splats, CodecError> {
    let (chunks, vertices) = (header.element("chunk")?, header.element("vertex")?);
    let words = WORDS.map(|name| vertices.find(name));
    let mut wanted = Vec::with_capacity(4);
    for word in words {
        wanted.push(word?);
    }
    if wanted.iter().any(|&p| vertices.properties[p].kind != Kind::U32) {
        return Err(CodecError::new("packed splats are not words of 32 bits"));
    }
    if chunks.count != vertices.count.div_ceil(CHUNK) {
        let (chunks, count) = (chunks.count, vertices.count);
        return Err(CodecError::new(format!("{count} packed splats in {chunks} chunks, not of {CHUNK} each")));
    }
    let ranges = |what: &[&str]| -> Result<Vec<[Vec<f32>; 2]>, CodecError> {
        let range = |axis: &&str| {
            let places = [chunks.find(&format!("min_{axis}"))?, chunks.find(&format!("max_{axis}"))?];
            let columns = chunks.columns::<f32>(&places)?;
            <[Vec<f32>; 2]>::try_from(columns).map_err(|_| CodecError::new("a range is a minimum and a maximum"))
        };
        what.iter().map(range).collect()
    };
    let (positions, scales) = (ranges(&["x", "y", "z"])?, ranges(&["scale_x", "scale_y", "scale_z"])?);
    // Files of the first version have no colour range: it is 0 to 1.
    let colours = if header.declares("chunk", "min_r") { ranges(&["r", "g", "b"])? } else { Vec::new() };
    let all = positions.iter().chain(&scales).chain(&colours).flatten().flatten();
    if all.into_iter().any(|v| !v.is_finite()) {
        return Err(CodecError::new("a chunk's range is not finite"));
    }

    let (sh_degree, higher) = higher(header, vertices.count)?;
    let [position, scale, rotation, colour] = <[Vec<u32>; 4]>::try_from(vertices.columns::<u32>(&wanted)?)
        .map_err(|_| CodecError::new("a packed splat is four words"))?;
    let mut columns: Vec<Vec<f32>> = Vec::with_capacity(column::SH + 3 * sh_coefficients(sh_degree));
    let between = |range: &[Vec<f32>; 2], i: usize, t: f32| {
        let (min, max) = (range[0][i / CHUNK], range[1][i / CHUNK]);
        min + t * (max - min)
    };
    for (words, ranges) in [(&position, &positions), (&scale, &scales)] {
        for (range, (shift, bits)) in ranges.iter().zip([(21, 11), (11, 10), (0, 11)]) {
            let value = |(i, &word): (usize, &u32)| between(range, i, unit(word >> shift, bits));
            columns.push(words.iter().enumerate().map(value).collect());
        }
    }
    let quats: Vec<[f32; 4]> = rotation.iter().map(|&word| unpack_rotation(word)).collect();
    columns.extend((0..4).map(|k| quats.iter().map(|q| q[k]).collect::<Vec<f32>>()));
    columns.push(colour.iter().map(|&word| logit_of_byte(word as u8)).collect());
    for (channel, shift) in [24, 16, 8].into_iter().enumerate() {
        let value = |(i, &word): (usize, &u32)| {
            let t = unit(word >> shift, 8);
            (colours.get(channel).map_or(t, |range| between(range, i, t)) - 0.5) / SH_C0
        };
        columns.push(colour.iter().enumerate().map(value).collect());
    }
    columns.extend(higher);
    Splats::from_columns(columns).ok_or_else(|| CodecError::new("columns of unequal length"))
}

/// SH degree and the columns of the coefficients of degree 1 and above.
fn higher(header: &Header, count: usize) -> Result<(u8, Vec<Vec<f32>>), CodecError> {
    if !header.has("sh") {
        return Ok((0, Vec::new()));
    }
    let sh = header.element("sh")?;
    if sh.count != count || sh.properties.iter().any(|p| p.kind != Kind::U8) {
        return Err(CodecError::new("element 'sh' is not bytes, or its number of rows is not that of the splats"));
    }
    let number = sh.properties.len();
    let sh_degree = (1..=3).find(|&d| 3 * (sh_coefficients(d) - 1) == number);
    let sh_degree = sh_degree.ok_or_else(|| CodecError::new(format!("{number} properties of element 'sh'")))?;
    let coefficients = sh_coefficients(sh_degree) - 1;
    let names = (0..coefficients).flat_map(|k| (0..3).map(move |c| format!("f_rest_{}", c * coefficients + k)));
    let wanted = names.map(|name| sh.find(&name)).collect::<Result<Vec<_>, _>>()?;
    let mut columns = sh.columns::<f32>(&wanted)?;
    // The outermost bytes stand for the ends of the range, the others for the middle of their interval.
    let value = |byte: f32| match byte {
        0.0 => -4.0,
        255.0 => 4.0,
        byte => ((byte + 0.5) / 256.0 - 0.5) * 8.0,
    };
    columns.iter_mut().flatten().for_each(|v| *v = value(*v));
    Ok((sh_degree, columns))
}

/// The lowest `bits` bits of a word, scaled to 0..1.
fn unit(word: u32, bits: u32) -> f32 {
    let mask = (1u32 << bits) - 1;
    (word & mask) as f32 / mask as f32
}

/// Unpacks a rotation, wxyz.
fn unpack_rotation(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut others = [20, 10, 0].into_iter().map(|shift| (unit(word >> shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    let mut quat: [f32; 4] =
        std::array::from_fn(|k| if k == largest { 0.0 } else { others.next().expect("three others") });
    quat[largest] = (1.0 - quat.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    quat
}

/// The logit of an opacity of `byte / 255`. The outermost bytes are moved inwards by a quarter of a step, so that every
/// logit is finite and is quantised to the same byte again.
pub(crate) fn logit_of_byte(byte: u8) -> f32 {
    let opacity = f32::from(byte).clamp(0.25, 254.75) / 255.0;
    (opacity / (1.0 - opacity)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of `count` splats with these words, over one range.
    fn file(count: usize, words: [u32; 4], sh: &[u8]) -> Vec<u8> {
        let axes = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
        let chunks = count.div_ceil(CHUNK);
        let mut text = format!("ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n");
        axes.iter().for_each(|axis| text += &format!("property float min_{axis}\nproperty float max_{axis}\n"));
        text += &format!("element vertex {count}\n");
        WORDS.iter().for_each(|word| text += &format!("property uint {word}\n"));
        if !sh.is_empty() {
            text += &format!("element sh {count}\n");
            (0..sh.len()).for_each(|k| text += &format!("property uchar f_rest_{k}\n"));
        }
        let mut bytes = (text + "end_header\n").into_bytes();
        for chunk in 0..chunks {
            for (min, max) in [(-1.0, 1.0), (0.0, 2.0), (10.0, 30.0), (-6.0, -4.0), (-6.0, -4.0), (-6.0, 0.0)] {
                bytes.extend((min + chunk as f32).to_le_bytes().into_iter().chain((max + chunk as f32).to_le_bytes()));
            }
            bytes.extend([0.0f32, 1.0, 0.0, 1.0, -1.0, 2.0].iter().flat_map(|v| v.to_le_bytes()));
        }
        (0..count).for_each(|_| bytes.extend(words.iter().flat_map(|w| w.to_le_bytes())));
        (0..count).for_each(|_| bytes.extend(sh));
        bytes
    }

    #[test]
    fn words_unpack_to_their_values() {
        let position = (2047 << 21) | 2047;
        let scale = 1023 << 11;
        // Largest is y (2): w and z are 0.7071·(2·600/1023 - 1), x is the negative.
        let rotation = (2u32 << 30) | (600 << 20) | (423 << 10) | 600;
        let colour = (255 << 24) | (255 << 8) | 51;
        let sh: Vec<u8> = (0..9).map(|k| [0, 128, 255][k / 3]).collect();
        let splats = super::super::read(&file(300, [position, scale, rotation, colour], &sh)).unwrap();
        assert_eq!((splats.len(), splats.sh_degree()), (300, 1));
        let splat = splats.get(257);
        assert_eq!(splat.mean.to_array(), [2.0, 1.0, 31.0]);
        assert_eq!(splat.log_scale.to_array(), [-5.0, -3.0, -5.0]);
        let near = |a: f32, b: f32| assert!((a - b).abs() < 1e-5, "{a} {b}");
        let small = (600.0 / 1023.0 - 0.5) * 2.0f32.sqrt();
        near(splat.quat[0], small);
        near(splat.quat[1], -small);
        near(splat.quat[3], small);
        near(splat.quat.iter().map(|v| v * v).sum(), 1.0);
        near(1.0 / (1.0 + (-splat.opacity_logit).exp()), 0.2);
        near(splat.sh[0][0] * SH_C0 + 0.5, 1.0);
        near(splat.sh[0][2] * SH_C0 + 0.5, 2.0);
        assert_eq!(splat.sh[1], [-4.0, (128.5 / 256.0 - 0.5) * 8.0, 4.0]);
    }

    #[test]
    fn inconsistent_files_are_refused() {
        let good = file(300, [7; 4], &[1; 9]);
        assert!(super::super::read(&good).is_ok());
        for end in (0..good.len()).step_by(13) {
            assert!(super::super::read(&good[..end]).is_err(), "{end}");
        }
        for (from, to) in [
            ("element chunk 2", "element chunk 1"),
            ("element chunk 2", "element chunk 99999999999999"),
            ("element vertex 300", "element vertex 18446744073709551615"),
            ("element sh 300", "element sh 299"),
            ("property uint packed_scale", "property float packed_scale"),
            ("property float min_z", "property float mix_z"),
            ("property uchar f_rest_3", "property uchar f_rest_2"),
        ] {
            let at = good.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            let bad = [&good[..at], to.as_bytes(), &good[at + from.len()..]].concat();
            assert!(super::super::read(&bad).is_err(), "{to}");
        }
        let at = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let mut bad = good.clone();
        bad[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(super::super::read(&bad).is_err());
    }

    #[test]
    fn guitar_has_consistent_normals() {
        let shared =
            std::env::var("PLAT_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared").into());
        let path = std::path::Path::new(&shared).join("data/splats/playcanvas/guitar.compressed.ply");
        let Ok(bytes) = std::fs::read(path) else {
            println!("skipped: ../shared/data not present");
            return;
        };
        let splats = super::super::read(&bytes).unwrap();
        assert_eq!((splats.len(), splats.sh_degree()), (90_854, 0));
        assert!((0..splats.len()).all(|i| splats.is_finite(i)));
        // Splats are flat on the surface and neighbours in the file are neighbours on it, so their shortest axes agree.
        let agreement = |order: [usize; 4]| {
            let normal = |i: usize| {
                let splat = splats.get(i);
                let [w, x, y, z] = order.map(|k| splat.quat[k]);
                let shortest = splat.log_scale.to_array().iter().position(|&s| s == splat.log_scale.min_element());
                glam::Quat::from_xyzw(x, y, z, w) * glam::Vec3::AXES[shortest.unwrap()]
            };
            (1..splats.len()).map(|i| f64::from(normal(i).dot(normal(i - 1)).abs())).sum::<f64>() / splats.len() as f64
        };
        let right = agreement([0, 1, 2, 3]);
        for wrong in [[3, 0, 1, 2], [0, 2, 1, 3], [1, 0, 2, 3], [0, 3, 2, 1], [3, 2, 1, 0]] {
            assert!(right > agreement(wrong), "{wrong:?}: {right} {}", agreement(wrong));
        }
    }
}
