//! Samples initial points for a capture without sparse points, in the volume that several views see.
//!
//! The depth range is estimated from the cameras alone. Where optical axes converge, the subject lies near their common point;
//! otherwise its distance is assumed to be a multiple of the spacing of neighbouring cameras, whose views overlap. RawPoints are
//! sampled in the frusta of views, uniformly in inverse depth (a Halton sequence, so the result is deterministic), and points
//! that many views see are kept. They are grey, because no pixel is decoded.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use scene::{Camera, SparsePoints};

/// Maximum of points returned.
const MAX_POINTS: usize = 20_000;
/// Candidates sampled.
const CANDIDATES: usize = 80_000;
/// With fewer points the views are taken not to overlap.
const MIN_POINTS: usize = 100;
/// Maximum of views used, evenly spread over the names.
const MAX_VIEWS: usize = 256;
/// A point is kept if at least this share of the 90th percentile of view counts sees it.
const MIN_VIEW_SHARE: f64 = 0.3;

/// RawPoints without tracks; `None` if views do not overlap, or there are fewer than two.
pub(super) fn sample(cameras: &[Camera]) -> Option<SparsePoints> {
    let cameras: Vec<Camera> = cameras.iter().step_by(cameras.len().div_ceil(MAX_VIEWS).max(1)).copied().collect();
    let (near, far) = depth_range(&cameras)?;
    let candidate = |i: usize| {
        let [x, y, z, which] = [2, 3, 5, 7].map(|base| radical_inverse(i + 1, base));
        let camera = &cameras[((which * cameras.len() as f64) as usize).min(cameras.len() - 1)];
        let k = &camera.pinhole;
        let depth = 1.0 / (1.0 / near + z * (1.0 / far - 1.0 / near));
        let pixel = (x * f64::from(k.width), y * f64::from(k.height));
        let ray = DVec3::new((pixel.0 - k.cx) / k.fx, (pixel.1 - k.cy) / k.fy, 1.0);
        let point = camera.camera_from_world.inverse().apply(depth * ray);
        let sees = |camera: &&Camera| {
            let (pixel, depth) = camera.project(point);
            let (w, h) = (f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
            (near..=far).contains(&depth) && (0.0..w).contains(&pixel.x) && (0.0..h).contains(&pixel.y)
        };
        (cameras.iter().filter(sees).count(), point)
    };
    let candidates: Vec<(usize, DVec3)> = (0..CANDIDATES).into_par_iter().map(candidate).collect();
    let mut counts: Vec<usize> = candidates.iter().map(|&(count, _)| count).collect();
    counts.sort_unstable();
    let min_views = (MIN_VIEW_SHARE * counts[counts.len() * 9 / 10] as f64).max(2.0);
    let seen = candidates.into_iter().filter(|&(count, point)| count as f64 >= min_views && point.is_finite());
    let positions: Vec<DVec3> = seen.map(|(_, point)| point).take(MAX_POINTS).collect();
    let colours = vec![[128; 3]; positions.len()];
    (positions.len() >= MIN_POINTS).then_some(SparsePoints { positions, colours, ..Default::default() })
}

/// The nearest and the farthest depth at which points are sampled.
fn depth_range(cameras: &[Camera]) -> Option<(f64, f64)> {
    if let Some(focus) = focus(cameras) {
        let depths = sorted(cameras.iter().map(|camera| (focus - camera.centre()).dot(camera.forward())));
        // The focus counts only if at most a fifth of the cameras have it behind them.
        let (middle, behind) = (depths[depths.len() / 2], depths[depths.len() / 5]);
        if behind > 0.0 {
            return Some((0.25 * middle, 2.0 * middle));
        }
    }
    let centres: Vec<DVec3> = cameras.iter().map(Camera::centre).collect();
    let spacings = centres.iter().enumerate().map(|(i, a)| {
        let others = centres.iter().enumerate().filter(|&(j, _)| j != i);
        others.map(|(_, b)| a.distance(*b)).fold(f64::INFINITY, f64::min)
    });
    let spacing = *sorted(spacings).get(cameras.len() / 2)?;
    let middle = centres.iter().sum::<DVec3>() / centres.len() as f64;
    let extent = 2.0 * sorted(centres.iter().map(|centre| centre.distance(middle)))[cameras.len() * 19 / 20];
    let spacing = spacing.max(extent / 50.0);
    (spacing > 0.0 && spacing.is_finite() && extent.is_finite())
        .then(|| (2.0 * spacing, (20.0 * spacing).max(extent.min(100.0 * spacing))))
}

/// The least-squares intersection of the optical axes; `None` if they are nearly parallel.
fn focus(cameras: &[Camera]) -> Option<DVec3> {
    let (mut matrix, mut vector) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = camera.forward();
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += across;
        vector += across * camera.centre();
    }
    let scale = 1.0 / cameras.len() as f64;
    ((matrix * scale).determinant() > 0.01).then(|| matrix.inverse() * vector).filter(|focus| focus.is_finite())
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

/// The radical inverse of `i` in a base: a low-discrepancy sequence in 0 to 1.
fn radical_inverse(mut i: usize, base: usize) -> f64 {
    let (mut value, mut place) = (0.0, 1.0 / base as f64);
    while i > 0 {
        value += (i % base) as f64 * place;
        i /= base;
        place /= base as f64;
    }
    value
}
