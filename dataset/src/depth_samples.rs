//! The artefact of the depths measured in one view by lidar: single pixels of mip 0 with a depth each.
//!
//! A frame of kind [`DEPTHS`]. The header has the image's size, the nearest depth and the number of samples. The bulk is a zstd
//! frame of six planes of bytes: four of the gaps between the samples' pixel numbers (`y · width + x`, ascending, u32 little
//! endian), two of their codes (u16). A depth is the nearest one times `2^(code / 4096)`, so that steps are 0.017 % of it.

use scene::frame::{self, Kind};
use scene::{CodecError, Rect};
use serde::{Deserialize, Serialize};

/// Frames of depths.
pub const DEPTHS: Kind = Kind(*b"dpth", 1);
/// Most samples of a view; of more, an even choice is stored.
pub const MAX_SAMPLES: usize = 1 << 20;
/// The largest artefact: samples that do not compress.
pub const MAX_BYTES: u64 = (PLANES * MAX_SAMPLES) as u64 + (1 << 16);

const PLANES: usize = 6;
/// Codes per doubling of the depth.
const CODES_PER_OCTAVE: f32 = 4096.0;
const ZSTD_LEVEL: i32 = 3;

/// Measured depths of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthSamples {
    width: u32,
    height: u32,
    /// Pixel number and depth in metres, by pixel.
    samples: Vec<(u32, f32)>,
}

#[derive(Serialize, Deserialize)]
struct Header {
    width: u32,
    height: u32,
    nearest: f32,
    count: u32,
}

impl DepthSamples {
    /// Depths at pixels `(x, y)` of an image of this size, along the optical axis. The nearest of a pixel counts. Pixels outside and
    /// depths that are not positive and finite are left out, also those over 65,000 times as far as the nearest.
    pub fn new(width: u32, height: u32, depths: impl Iterator<Item = (u32, u32, f32)>) -> Self {
        let is_inside = |&(x, y, depth): &(u32, u32, f32)| x < width && y < height && depth > 0.0 && depth.is_finite();
        let mut samples: Vec<(u32, f32)> = depths.filter(is_inside).map(|(x, y, d)| (y * width + x, d)).collect();
        samples.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        samples.dedup_by_key(|sample| sample.0);
        if samples.len() > MAX_SAMPLES {
            samples = (0..MAX_SAMPLES).map(|i| samples[i * samples.len() / MAX_SAMPLES]).collect();
        }
        let nearest = samples.iter().map(|s| s.1).fold(f32::INFINITY, f32::min);
        samples.retain(|s| s.1 <= 65_000.0 * nearest);
        Self { width, height, samples }
    }

    /// The number of samples.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// True without samples.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Size in memory, bytes.
    pub fn memory_bytes(&self) -> usize {
        size_of_val(self.samples.as_slice())
    }

    /// Pixel and depth of each sample, by rows.
    pub fn iter(&self) -> impl Iterator<Item = (u32, u32, f32)> {
        self.samples.iter().map(|&(pixel, depth)| (pixel % self.width, pixel / self.width, depth))
    }

    /// Encodes the artefact.
    pub fn encode(&self) -> Vec<u8> {
        let nearest = self.samples.iter().map(|s| s.1).fold(f32::INFINITY, f32::min);
        let count = self.samples.len();
        let mut planes = vec![0u8; PLANES * count];
        let mut last = 0;
        for (i, &(pixel, depth)) in self.samples.iter().enumerate() {
            let code = (CODES_PER_OCTAVE * (depth / nearest).log2()).round() as u16;
            let bytes = (pixel - last).to_le_bytes().into_iter().chain(code.to_le_bytes());
            bytes.enumerate().for_each(|(plane, byte)| planes[plane * count + i] = byte);
            last = pixel;
        }
        let header = Header { width: self.width, height: self.height, nearest, count: count as u32 };
        let bulk = zstd::bulk::compress(&planes, ZSTD_LEVEL).expect("zstd compresses any bytes in memory");
        frame::encode(DEPTHS, &header, &bulk)
    }

    /// Decodes the artefact of a view of this size.
    ///
    /// # Errors
    /// Damaged, of another size, or values out of range.
    pub fn decode(bytes: &[u8], width: u32, height: u32) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(DEPTHS, bytes)?;
        let area = u64::from(width) * u64::from(height);
        let count = header.count as usize;
        if (header.width, header.height) != (width, height) || count > MAX_SAMPLES || count as u64 > area {
            return Err(CodecError::new("depths of an image of another size, or too many of them"));
        }
        if count > 0 && !(header.nearest > 0.0 && header.nearest.is_finite()) {
            return Err(CodecError::new("the nearest depth is not positive and finite"));
        }
        let damaged = |_| CodecError::new("depths do not decompress");
        let planes = zstd::bulk::decompress(bulk, PLANES * count).map_err(damaged)?;
        if planes.len() != PLANES * count {
            return Err(CodecError::new("depths are cut short"));
        }
        let byte = |plane: usize, i: usize| planes[plane * count + i];
        let mut samples = Vec::with_capacity(count);
        let mut pixel = 0u64;
        for i in 0..count {
            let gap = u32::from_le_bytes([0, 1, 2, 3].map(|plane| byte(plane, i)));
            pixel += u64::from(gap);
            if (gap == 0 && i > 0) || pixel >= area {
                return Err(CodecError::new("pixels of depths are not ascending or not inside the image"));
            }
            let code = u16::from_le_bytes([4, 5].map(|plane| byte(plane, i)));
            samples.push((pixel as u32, header.nearest * (f32::from(code) / CODES_PER_OCTAVE).exp2()));
        }
        if samples.iter().any(|sample| !sample.1.is_finite()) {
            return Err(CodecError::new("depths are not finite"));
        }
        Ok(Self { width, height, samples })
    }

    /// Merges the depths of a window of a mip into a plane (`rect`'s pixels, 0 = none; empty if there is none yet): the nearest of a
    /// pixel counts.
    pub(crate) fn merge_into(&self, plane: &mut Vec<f32>, mip: u8, rect: Rect) {
        let row = |y: u32| (u64::from(y) << mip) * u64::from(self.width);
        let at = |row: u64| self.samples.partition_point(|sample| u64::from(sample.0) < row);
        let rows = at(row(rect.y))..at(row(rect.y + rect.height));
        for &(pixel, depth) in &self.samples[rows] {
            let (x, y) = ((pixel % self.width) >> mip, (pixel / self.width) >> mip);
            if !(rect.x..rect.x + rect.width).contains(&x) {
                continue;
            }
            if plane.is_empty() {
                plane.resize(rect.area() as usize, 0.0);
            }
            let nearest = &mut plane[((y - rect.y) * rect.width + x - rect.x) as usize];
            if *nearest == 0.0 || depth < *nearest {
                *nearest = depth;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn depths_round_trip_within_a_step(depths in prop::collection::vec((0u32..40, 0u32..30, 0.01f32..600.0), 0..200)) {
            let samples = DepthSamples::new(37, 29, depths.iter().copied());
            let bytes = samples.encode();
            let read = DepthSamples::decode(&bytes, 37, 29).unwrap();
            prop_assert_eq!(read.len(), samples.len());
            for ((x, y, depth), (u, v, found)) in samples.iter().zip(read.iter()) {
                let nearest = depths.iter().filter(|d| (d.0, d.1) == (x, y)).map(|d| d.2).fold(f32::INFINITY, f32::min);
                prop_assert!((x, y) == (u, v) && depth == nearest && (found / depth - 1.0).abs() < 1e-4);
            }
            prop_assert!(DepthSamples::decode(&bytes, 36, 29).is_err());
            for end in 0..bytes.len() {
                prop_assert!(DepthSamples::decode(&bytes[..end], 37, 29).is_err());
            }
        }

        #[test]
        fn hostile_frames_do_not_panic(count in 0u32..2000, nearest in any::<f32>(), bulk in prop::collection::vec(any::<u8>(), 0..600)) {
            let header = Header { width: 40, height: 40, nearest, count };
            for bulk in [bulk.clone(), zstd::bulk::compress(&bulk, 1).unwrap()] {
                if let Ok(read) = DepthSamples::decode(&frame::encode(DEPTHS, &header, &bulk), 40, 40) {
                    prop_assert!(read.iter().all(|(x, y, d)| x < 40 && y < 40 && d > 0.0 && d.is_finite()));
                }
            }
        }
    }

    #[test]
    fn windows_of_mips_hold_the_nearest_depth_of_each_pixel() {
        let depths = [(0, 0, 9.0), (10, 7, 4.0), (11, 6, 3.0), (12, 6, 5.0), (39, 29, 2.0)];
        let samples = DepthSamples::new(40, 30, depths.into_iter());
        let mut plane = Vec::new();
        samples.merge_into(&mut plane, 1, Rect { x: 5, y: 3, width: 3, height: 2 });
        assert_eq!(plane, [3.0, 5.0, 0.0, 0.0, 0.0, 0.0]);
        samples.merge_into(&mut plane, 0, Rect { x: 10, y: 6, width: 3, height: 2 });
        assert_eq!(plane, [3.0, 3.0, 5.0, 4.0, 0.0, 0.0], "the nearer of old and new");
        let mut none = Vec::new();
        samples.merge_into(&mut none, 0, Rect { x: 20, y: 20, width: 5, height: 5 });
        assert!(none.is_empty());
    }

    #[test]
    fn depths_that_cannot_be_are_left_out() {
        let odd =
            [(0, 0, f32::NAN), (1, 0, 0.0), (2, 0, -1.0), (3, 0, f32::INFINITY), (9, 0, 1.0), (4, 0, 2.0), (5, 0, 1e9)];
        let samples = DepthSamples::new(8, 1, odd.into_iter());
        assert_eq!(samples.iter().collect::<Vec<_>>(), [(4, 0, 2.0)]);
    }
}
