//! Depth maps in files: a depth for each pixel of a photo, computed or measured by another program.
//!
//! A map is an npy array of floats or a 16-bit grey PNG, of its photo's size or a smaller one of the same shape. It belongs to the
//! pixels of the photo file, before undistortion. 0 is no depth. Maps of [`DepthKind::Metric`] are depths along the optical
//! axis. The others are of models that see one photo, which cannot know its scale: they are aligned to the sparse points of their
//! view ([`alignment`]).

pub(crate) mod alignment;

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::PathBuf;

use glam::DVec2;
use image::DynamicImage;
use scene::{BadInput, CodecError, npy};

use crate::photo;
use crate::undistortion::Undistorter;

/// Metres that a value of a PNG stands for unless [`DepthMapOptions::unit`] says otherwise: nerfstudio's millimetres.
const PNG_METRES: f64 = 1e-3;
/// Room for the header of an npy file, bytes.
const HEADER_BYTES: u64 = 64 << 10;
/// Most target depths of a view that come from its map; of more pixels, every second, fourth … in both directions is taken.
const MAX_SAMPLES: u64 = 1 << 18;

/// What the values of depth maps are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthKind {
    /// Depths along the optical axis, in a known unit.
    #[default]
    Metric,
    /// `a · depth + b`, with `a > 0` and `b` of each view unknown.
    Relative,
    /// `a / depth + b`, with `a > 0` and `b` of each view unknown (disparity).
    Inverse,
}

/// How to find and read depth maps.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthMapOptions {
    /// Their folder; `None` takes those that the capture names, or its folder `depths`.
    pub folder: Option<PathBuf>,
    /// What the values are.
    pub kind: DepthKind,
    /// World units (metres) of a value of 1, for metric maps. `None`: 1 for npy, 0.001 for PNG.
    pub unit: Option<f64>,
}

/// The depth map of a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthFile {
    /// Canonical path.
    pub path: PathBuf,
    /// What its values are.
    pub kind: DepthKind,
    /// World units of a value of 1, positive; 1 unless the map is metric.
    pub unit: f64,
}

/// The values of a map, times its unit, by rows; 0 = none.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DepthMap {
    width: u32,
    height: u32,
    values: Vec<f32>,
}

impl DepthFile {
    /// A map at this path, whose extension says how it is read.
    pub(crate) fn new(path: PathBuf, options: &DepthMapOptions) -> Self {
        let default = if is_npy(&path) { 1.0 } else { PNG_METRES };
        let unit = if options.kind == DepthKind::Metric { options.unit.unwrap_or(default) } else { 1.0 };
        Self { path, kind: options.kind, unit }
    }

    /// Reads the map of a photo of this size. Takes 12 bytes a pixel at most (16 for doubles).
    ///
    /// # Errors
    /// Not a map, of another shape or larger than the photo, or with values that are not finite, or negative in a metric map.
    pub(crate) fn read(&self, width: u32, height: u32) -> Result<DepthMap, BadInput> {
        let bad = |problem: String| {
            BadInput::new(self.path.display().to_string(), problem, "correct or remove this depth map")
        };
        let limit = 8 * u64::from(width) * u64::from(height) + HEADER_BYTES;
        let file = File::open(&self.path).map_err(|e| bad(format!("cannot be read ({e})")))?;
        let mut bytes = Vec::new();
        file.take(limit + 1).read_to_end(&mut bytes).map_err(|e| bad(format!("cannot be read ({e})")))?;
        if bytes.len() as u64 > limit {
            return Err(bad(format!("is larger than a depth map of {width}×{height} pixels can be")));
        }
        let read = if is_npy(&self.path) { read_npy(&bytes, width, height) } else { read_png(&bytes, width, height) };
        let mut map = read.map_err(|error| bad(error.to_string()))?;
        let is_bad = |v: &f32| !v.is_finite() || (*v < 0.0 && self.kind == DepthKind::Metric);
        if let Some(pixel) = map.values.iter().position(is_bad) {
            let (x, y) = (pixel as u32 % map.width, pixel as u32 / map.width);
            return Err(bad(format!("has the value {} at column {x} of row {y}; no depth is 0", map.values[pixel])));
        }
        if self.unit != 1.0 {
            map.values.iter_mut().for_each(|value| *value = (f64::from(*value) * self.unit) as f32);
        }
        Ok(map)
    }
}

fn is_npy(path: &std::path::Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("npy"))
}

fn read_npy(bytes: &[u8], width: u32, height: u32) -> Result<DepthMap, CodecError> {
    let (shape, values) = npy::read_f32(bytes)?;
    let (rows, columns) = match shape[..] {
        [rows, columns] | [1, rows, columns] | [rows, columns, 1] => (rows, columns),
        _ => return Err(CodecError::new(format!("has an array of shape {shape:?} instead of rows and columns"))),
    };
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    check_shape([side(columns), side(rows)], [width, height])?;
    Ok(DepthMap { width: side(columns), height: side(rows), values })
}

fn read_png(bytes: &[u8], width: u32, height: u32) -> Result<DepthMap, CodecError> {
    let (columns, rows) =
        photo::size(Cursor::new(bytes)).map_err(|_| CodecError::new("is not an image, or its header is damaged"))?;
    check_shape([columns, rows], [width, height])?;
    let DynamicImage::ImageLuma16(image) = photo::open(bytes, columns, rows)? else {
        return Err(CodecError::new("is not a 16-bit grey PNG"));
    };
    let values = image.into_raw().into_iter().map(f32::from).collect();
    Ok(DepthMap { width: columns, height: rows, values })
}

/// Refuses maps larger than their photo or of another shape, up to a pixel.
fn check_shape(map: [u32; 2], photo: [u32; 2]) -> Result<(), CodecError> {
    let [w, h, width, height] = [map[0], map[1], photo[0], photo[1]].map(f64::from);
    let is_inside = map[0] >= 1 && map[1] >= 1 && w <= width && h <= height;
    if is_inside && (h - height * w / width).abs() <= 1.0 {
        return Ok(());
    }
    let [w, h] = map;
    let problem = format!("has {w}×{h} pixels, its photo {width}×{height}: not the same shape, or larger");
    Err(CodecError::new(problem))
}

/// A map as the ideal, downscaled camera of its view sees it.
pub(crate) struct Sampler<'a> {
    pub(crate) map: &'a DepthMap,
    /// Of the photo.
    pub(crate) undistorter: &'a Undistorter,
    /// Width and height of the photo.
    pub(crate) photo: DVec2,
    /// Divisor of the photo's size.
    pub(crate) downscale: u32,
}

impl Sampler<'_> {
    /// The value at a position of mip 0 in pixels, that of the map's pixel there: a mean over an edge is the depth of nothing.
    pub(crate) fn at(&self, position: DVec2) -> Option<f32> {
        let photo = self.undistorter.source(position * f64::from(self.downscale));
        let size = DVec2::new(f64::from(self.map.width), f64::from(self.map.height));
        let place = photo * size / self.photo;
        if !(place.cmpge(DVec2::ZERO).all() && place.cmplt(size).all()) {
            return None;
        }
        let value = self.map.values[place.y as usize * self.map.width as usize + place.x as usize];
        (value != 0.0 && value.is_finite()).then_some(value)
    }

    /// The pixels of mip 0, of this size, that become target depths, with their values.
    pub(crate) fn grid(&self, width: u32, height: u32) -> impl Iterator<Item = (u32, u32, f32)> {
        let count = |step: u32| u64::from(width.div_ceil(step)) * u64::from(height.div_ceil(step));
        let step = (0..31).map(|bit| 1 << bit).find(|&step| count(step) <= MAX_SAMPLES).unwrap_or(1 << 31);
        let axis = move |side: u32| (step / 2..side).step_by(step as usize);
        axis(height).flat_map(move |y| {
            axis(width).filter_map(move |x| {
                let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                Some((x, y, self.at(centre)?))
            })
        })
    }
}

#[cfg(test)]
mod tests;
