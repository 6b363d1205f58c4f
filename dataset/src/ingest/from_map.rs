//! Target depths of a view from its depth map.

use glam::DVec2;
use scene::{BadInput, Capture};

use super::undistorter::{LastUndistorter, undistorter};
use crate::depth_maps::alignment::{Alignment, MIN_POINTS};
use crate::depth_maps::{DepthKind, Sampler};
use crate::observations::Observations;
use crate::open::{Photo, Source};

/// Metric maps must agree with the sparse points within this factor, in the median. It finds millimetres and feet taken for metres.
const MAX_RATIO: f64 = 2.0;

/// What became of the depth map of a view.
pub(super) struct FromMap {
    /// Pixels of mip 0 with a depth each.
    pub(super) samples: Vec<(u32, u32, f32)>,
    /// Median ratio of a metric map to the sparse points of the view, if there are enough of them.
    ratio: Option<f64>,
    /// Why the map is not used.
    left_out: Option<String>,
}

/// The depth maps of a capture.
pub(super) struct Maps<'a> {
    source: &'a Source,
    downscale: u32,
    /// Present if there are any maps.
    observations: Option<Observations>,
}

impl<'a> Maps<'a> {
    pub(super) fn new(source: &'a Source, downscale: u32) -> Self {
        let observations = (source.depth_maps() > 0).then(|| Observations::new(&source.capture));
        Self { source, downscale, observations }
    }

    /// Whether a view has one.
    pub(super) fn has(&self, view: usize) -> bool {
        self.source.photos[view].depth.is_some()
    }

    /// Reads the map of an ingested view, aligns it and takes its depths at used pixels. `None` if the view has no map.
    ///
    /// # Errors
    /// A map that cannot be read.
    pub(super) fn measure(
        &self,
        capture: &Capture,
        number: usize,
        is_used: &dyn Fn(u32, u32) -> bool,
        last_undistorter: &mut LastUndistorter,
    ) -> Result<Option<FromMap>, BadInput> {
        let photo = &self.source.photos[number];
        let (Some(file), Some(observations)) = (&photo.depth, &self.observations) else { return Ok(None) };
        let map = file.read(photo.width, photo.height)?;
        let ideal = self.source.capture.views[number].camera.pinhole;
        let sampler = Sampler {
            map: &map,
            undistorter: undistorter(photo, ideal, last_undistorter)?,
            photo: DVec2::new(f64::from(photo.width), f64::from(photo.height)),
            downscale: self.downscale,
        };
        let camera = &capture.views[number].camera;
        let (width, height) = (camera.pinhole.width, camera.pinhole.height);
        let at_point = |&point: &u32| {
            let (at, depth) = camera.project(capture.points.positions[point as usize]);
            let inside = (0.0..f64::from(width)).contains(&at.x) && (0.0..f64::from(height)).contains(&at.y);
            let is_seen = depth > 0.0 && depth.is_finite() && inside && is_used(at.x as u32, at.y as u32);
            Some((sampler.at(at).filter(|_| is_seen)?, depth))
        };
        let points: Vec<(f32, f64)> = observations.of(number).iter().filter_map(at_point).collect();
        let samples = |depth: &dyn Fn(f32) -> Option<f32>| {
            let used = sampler.grid(width, height).filter(|&(x, y, _)| is_used(x, y));
            used.filter_map(|(x, y, value)| Some((x, y, depth(value)?))).collect()
        };
        Ok(Some(match file.kind {
            DepthKind::Metric => FromMap { samples: samples(&Some), ratio: ratio(&points), left_out: None },
            kind => match Alignment::fit(kind, &points) {
                Ok(aligned) => FromMap { samples: samples(&|value| aligned.depth(value)), ratio: None, left_out: None },
                Err(reason) => FromMap { samples: Vec::new(), ratio: None, left_out: Some(reason) },
            },
        }))
    }
}

/// Median ratio of a metric map's depths to those of points; `None` for few points.
fn ratio(points: &[(f32, f64)]) -> Option<f64> {
    let ratios: Vec<f64> = points.iter().map(|&(value, depth)| f64::from(value) / depth).collect();
    median(ratios).filter(|_| points.len() >= MIN_POINTS)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The number of maps that are used, and the photos whose map is not, with the reason.
///
/// # Errors
/// No map can be used, or metric maps that have another unit than the sparse points.
pub(super) fn check(maps: Vec<(usize, FromMap)>, photos: &[Photo], names: &[&str]) -> Result<Used, BadInput> {
    let path = maps.first().and_then(|(view, _)| photos[*view].depth.as_ref());
    let Some(folder) = path.and_then(|file| file.path.parent()) else { return Ok(Used::default()) };
    let bad = |problem, advice| Err(BadInput::new(folder.display().to_string(), problem, advice));
    let ratios: Vec<f64> = maps.iter().filter_map(|(_, map)| map.ratio).collect();
    let count = ratios.len();
    if let Some(ratio) = median(ratios).filter(|ratio| !(1.0 / MAX_RATIO..=MAX_RATIO).contains(ratio)) {
        let problem = format!(
            "has depth maps whose depths are {ratio:.4} times those of the sparse points (median of {count} photos)"
        );
        let advice = "give their unit with --depth-unit, or --depth-kind relative or inverse if they have none";
        return bad(problem, advice);
    }
    let total = maps.len();
    let left_out: Vec<(String, String)> =
        maps.into_iter().filter_map(|(view, map)| Some((names[view].to_string(), map.left_out?))).collect();
    match left_out.first() {
        Some((name, reason)) if left_out.len() == total => {
            let problem = format!("has no depth map that can be aligned; that of {name}: {reason}");
            bad(problem, "check --depth-kind; relative maps need sparse points with tracks, such as COLMAP's")
        }
        _ => Ok(Used { maps: total - left_out.len(), left_out }),
    }
}

/// The depth maps that give target depths.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Used {
    /// Their number.
    pub maps: usize,
    /// Photos whose map could not be aligned, with the reason.
    pub left_out: Vec<(String, String)>,
}
