//! Initial points for a capture that has none: spread over what several views see.
//!
//! How far away things are follows from the cameras alone. Where optical axes meet, things are about there; else
//! neighbouring cameras, which are made to overlap, stand a fraction of the distance apart. Points are drawn in the
//! frusta of views between a nearest and a farthest depth, evenly in inverse depth (a Halton sequence: the same for
//! ever), and those stay that many views see. They are grey: no pixel was decoded.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use scene::{Camera, SparsePoints};

/// Points that are made at most, and that are drawn to choose from.
const POINTS: usize = 20_000;
const DRAWN: usize = 80_000;
/// Fewer are of no use.
const FEWEST: usize = 100;
/// Views that are looked at, evenly spread over the names.
const VIEWS: usize = 256;
/// A point has to be seen by this share of the views that see a well seen one.
const SHARE: f64 = 0.3;

/// Points without tracks; `None` where views do not overlap, or are fewer than two.
pub(super) fn points(cameras: &[Camera]) -> Option<SparsePoints> {
    let cameras: Vec<Camera> = cameras.iter().step_by(cameras.len().div_ceil(VIEWS).max(1)).copied().collect();
    let (near, far) = depths(&cameras)?;
    let draw = |i: usize| {
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
    let drawn: Vec<(usize, DVec3)> = (0..DRAWN).into_par_iter().map(draw).collect();
    let mut counts: Vec<usize> = drawn.iter().map(|&(count, _)| count).collect();
    counts.sort_unstable();
    let enough = (SHARE * counts[counts.len() * 9 / 10] as f64).max(2.0);
    let seen = drawn.into_iter().filter(|&(count, point)| count as f64 >= enough && point.is_finite());
    let positions: Vec<DVec3> = seen.map(|(_, point)| point).take(POINTS).collect();
    let colours = vec![[128; 3]; positions.len()];
    (positions.len() >= FEWEST).then_some(SparsePoints { positions, colours, ..Default::default() })
}

/// The nearest and the farthest depth at which things are looked for.
fn depths(cameras: &[Camera]) -> Option<(f64, f64)> {
    if let Some(focus) = focus(cameras) {
        let depths = sorted(cameras.iter().map(|camera| (focus - camera.centre()).dot(camera.forward())));
        // Cameras that turn their back on it do not look at it.
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

/// The point nearest to all optical axes, where these are not nearly parallel.
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

/// The digits of `i` in this base, mirrored at the point: a sequence that fills 0 to 1 evenly.
fn radical_inverse(mut i: usize, base: usize) -> f64 {
    let (mut value, mut place) = (0.0, 1.0 / base as f64);
    while i > 0 {
        value += (i % base) as f64 * place;
        i /= base;
        place /= base as f64;
    }
    value
}
