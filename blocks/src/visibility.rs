//! Visibility: which view sees which sparse point, where in its image and how large a pixel is there.
//!
//! The observations come from the tracks of structure from motion (point, view), projected into the views. A capture
//! without tracks is projected into every view instead. Nothing is rendered, so occlusion is known only as far as
//! tracks express it.

use glam::DVec2;
use scene::{Camera, Capture};

use crate::ground::Square;

/// Mips exist while the shorter side has at least this many pixels.
const MIN_MIP_SIDE: u32 = 16;
/// Limit on (point, view) projections of a capture without tracks; beyond it points are subsampled.
const MAX_PROJECTIONS: usize = 20_000_000;

/// One observation of a sparse point by a view.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observation {
    /// Index of the point.
    pub(crate) point: u32,
    /// Index of the view.
    pub(crate) view: u32,
    /// Image position, pixels of mip 0.
    pub(crate) pixel: [f32; 2],
    /// Depth, metres; positive.
    pub(crate) depth_metres: f64,
}

/// All observations of a capture's sparse points.
#[derive(Debug, Clone, Default)]
pub(crate) struct Observations {
    /// Sorted by (point, view), each pair once.
    pub(crate) all: Vec<Observation>,
    /// Number of observations of each view.
    pub(crate) per_view: Vec<u32>,
}

/// True when points can be projected into the camera: sane pose, positive finite focal lengths, a non-empty image.
pub(crate) fn is_usable(camera: &Camera) -> bool {
    let k = &camera.pinhole;
    let focal = k.fx.is_finite() && k.fy.is_finite() && k.fx > 0.0 && k.fy > 0.0;
    camera.camera_from_world.is_sane() && focal && k.cx.is_finite() && k.cy.is_finite() && k.width > 0 && k.height > 0
}

/// The coarsest mip of an image of this size.
pub(crate) fn max_mip(width: u32, height: u32) -> u8 {
    (width.min(height) / MIN_MIP_SIDE).checked_ilog2().unwrap_or(0) as u8
}

/// Width of a pixel of mip 0 at this depth, metres.
pub(crate) fn footprint_metres(camera: &Camera, depth_metres: f64) -> f64 {
    depth_metres / (camera.pinhole.fx * camera.pinhole.fy).sqrt()
}

impl Observation {
    /// Width of a pixel of mip 0 at the point, metres.
    pub(crate) fn footprint_metres(&self, capture: &Capture) -> f64 {
        footprint_metres(&capture.views[self.view as usize].camera, self.depth_metres)
    }
}

impl Observations {
    /// Collects the observations of a capture.
    ///
    /// A point is observed by the views of its track. A capture without any tracks counts every view that a point
    /// projects into. Observations behind a camera, outside its image or by an unusable camera are dropped.
    pub(crate) fn of(capture: &Capture) -> Self {
        let cameras: Vec<Option<&Camera>> =
            capture.views.iter().map(|v| Some(&v.camera).filter(|c| is_usable(c))).collect();
        let mut observations = Self { all: Vec::new(), per_view: vec![0; capture.views.len()] };
        let points = &capture.points.positions;
        let tracked = !capture.points.seen_by.is_empty();
        let stride = if tracked { 1 } else { (points.len() * cameras.len()).div_ceil(MAX_PROJECTIONS).max(1) };
        let all_views: Vec<u32> = if tracked { Vec::new() } else { (0..cameras.len() as u32).collect() };
        let mut track = Vec::new();
        for point in (0..points.len()).step_by(stride) {
            track.clear();
            track.extend_from_slice(if tracked { capture.points.track(point).unwrap_or(&[]) } else { &all_views });
            track.sort_unstable();
            track.dedup();
            for &view in &track {
                let Some(camera) = cameras.get(view as usize).copied().flatten() else { continue };
                let (pixel, depth_metres) = camera.project(points[point]);
                let size = DVec2::new(f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
                let inside = Square { min: DVec2::ZERO, max: size }.contains(pixel);
                if inside && depth_metres.is_finite() && depth_metres > 0.0 {
                    let observation =
                        Observation { point: point as u32, view, pixel: pixel.as_vec2().to_array(), depth_metres };
                    observations.all.push(observation);
                    observations.per_view[view as usize] += 1;
                }
            }
        }
        observations
    }

    /// Of every view the points that it observes, ascending.
    pub(crate) fn points_by_view(&self) -> Vec<Vec<u32>> {
        let mut points: Vec<Vec<u32>> = self.per_view.iter().map(|&n| Vec::with_capacity(n as usize)).collect();
        for s in &self.all {
            points[s.view as usize].push(s.point);
        }
        points
    }
}

/// The mip whose pixel is closest to `rho_metres` wide at this depth, on a log scale; limited to the mips that exist.
pub(crate) fn mip_for(camera: &Camera, depth_metres: f64, rho_metres: f64) -> u8 {
    let mip = (rho_metres / footprint_metres(camera, depth_metres)).log2().round();
    // `as` saturates and maps NaN to 0.
    (mip as u8).min(max_mip(camera.pinhole.width, camera.pinhole.height))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::testing::{look_at, street};

    #[test]
    fn mips_match_the_resolution() {
        let camera = look_at(DVec3::ZERO, DVec3::X, DVec3::Z);
        // A pixel of mip 0 covers 0.1 m at 50 m.
        let mips = [0.01, 0.1, 0.13, 0.2, 0.41, 100.0, 0.0].map(|rho| mip_for(&camera, 50.0, rho));
        assert_eq!(mips, [0, 0, 0, 1, 2, 4, 0]);
        assert_eq!(mip_for(&camera, f64::NAN, 1.0), 0);
        assert_eq!([max_mip(640, 480), max_mip(16, 900), max_mip(15, 15), max_mip(1000, 749)], [4, 0, 0, 5]);
    }

    #[test]
    fn invalid_tracks_and_cameras_are_dropped() {
        let mut bad = street(12, 600);
        bad.points.seen_by[0] = 4_000_000;
        bad.points.track_start[5] = u32::MAX;
        bad.points.positions[7] = DVec3::NAN;
        bad.views[3].camera.pinhole.fx = 0.0;
        bad.views[4].camera.camera_from_world.translation.x = f64::INFINITY;
        let all = Observations::of(&bad).all;
        assert!(all.iter().all(|s| s.point != 7 && s.view != 3 && s.view != 4 && s.view < 12));
        assert!(!all.is_empty());
    }
}
