//! Sparse points as structure from motion would reconstruct them: features on true surfaces with the views that match them,
//! displaced by a fraction of a pixel.
//!
//! Visibility is tested per view, at the city time of its photo, so that moving cars occlude. A grid over the ground plane limits
//! the test to features within reach.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::random::{Random, bits};
use city::sense::Shot;
use city::trace::{Moment, Ray, World};
use glam::{DVec2, DVec3, I64Vec2};
use rayon::prelude::*;
use scene::SparsePoints;

use super::photos::Feature;
use super::settings::Progress;

/// Side of a grid cell, metres.
const CELL_METRES: f64 = 16.0;
/// A feature is matched in views where its scale differs at most by this factor from the view that detected it.
const MAX_SCALE_RATIO: f64 = 3.0;
/// Minimum cosine between the surface normal and the direction to the view.
const MIN_FACING_COSINE: f64 = 0.15;
/// Probability of a match in a view that sees the feature.
const MATCH_PROBABILITY: f32 = 0.85;
/// Minimum of views per point.
const MIN_TRACK: usize = 2;
/// Standard deviation of a point along each axis, in pixels of the view that sees it largest.
const NOISE_PIXELS: f64 = 0.35;

/// The points, in the order of the views that detected them.
pub(super) fn points(
    world: &World,
    shots: &[Shot],
    features: Vec<Vec<Feature>>,
    seed: u64,
    progress: Progress,
) -> SparsePoints {
    let features: Vec<Feature> = features.into_iter().flatten().collect();
    let cell = |place: DVec2| (place / CELL_METRES).floor().as_i64vec2();
    let mut grid: BTreeMap<[i64; 2], Vec<u32>> = BTreeMap::new();
    for (i, found) in features.iter().enumerate() {
        grid.entry(cell(found.position.truncate()).to_array()).or_default().push(i as u32);
    }
    let done = AtomicUsize::new(0);
    let seen: Vec<Vec<u32>> = shots
        .par_iter()
        .enumerate()
        .map(|(view, shot)| {
            let (moment, centre, reach) = (world.at(shot.seconds), shot.camera.centre(), reach(shot));
            let (low, high) = (cell(centre.truncate() - reach), cell(centre.truncate() + reach));
            let near = (low.y..=high.y).flat_map(|y| (low.x..=high.x).map(move |x| I64Vec2::new(x, y).to_array()));
            let mut seen: Vec<u32> = near
                .filter_map(|at| grid.get(&at))
                .flatten()
                .copied()
                .filter(|&i| {
                    Random::new(bits(seed ^ 0xF01D, bits(u64::from(i), view as u64))).chance(MATCH_PROBABILITY)
                })
                .filter(|&i| sees(&moment, shot, centre, reach, &features[i as usize]))
                .collect();
            seen.sort_unstable();
            progress("points", done.fetch_add(1, Ordering::Relaxed) + 1, shots.len());
            seen
        })
        .collect();
    tracks(shots, &features, &seen, seed)
}

/// Maximum distance of matches, metres: larger for aerial views than for street views.
fn reach(shot: &Shot) -> f64 {
    60.0 + 2.0 * shot.camera.centre().z.max(0.0)
}

/// Whether the feature lies in the image, faces the camera, has a similar scale there, and is not occluded.
fn sees(moment: &Moment, shot: &Shot, centre: DVec3, reach: f64, feature: &Feature) -> bool {
    let away = centre - feature.position;
    let distance = away.length();
    let (pixel, depth) = shot.camera.project(feature.position);
    let k = &shot.camera.pinhole;
    let inside =
        pixel.x >= 1.0 && pixel.y >= 1.0 && pixel.x <= f64::from(k.width) - 1.0 && pixel.y <= f64::from(k.height) - 1.0;
    let scale = depth / k.fx / feature.footprint;
    if distance > reach || depth < 0.3 || !inside || !(1.0 / MAX_SCALE_RATIO..=MAX_SCALE_RATIO).contains(&scale) {
        return false;
    }
    let towards = (away / distance).as_vec3();
    if f64::from(feature.normal.dot(towards)) < MIN_FACING_COSINE {
        return false;
    }
    // Offset from the surface against self-occlusion.
    let start = feature.position.as_vec3() + 0.02 * feature.normal;
    !moment.is_occluded(&Ray { t_max: distance as f32 - 0.02, ..Ray::new(start, towards) })
}

/// Inverts the features seen by each view to tracks, and adds triangulation noise to the points.
fn tracks(shots: &[Shot], features: &[Feature], seen: &[Vec<u32>], seed: u64) -> SparsePoints {
    let mut views: Vec<Vec<u32>> = vec![Vec::new(); features.len()];
    for (view, seen) in (0..).zip(seen) {
        seen.iter().for_each(|&i| views[i as usize].push(view));
    }
    let mut points = SparsePoints { track_start: vec![0], ..SparsePoints::default() };
    for (i, (found, track)) in features.iter().zip(views).enumerate() {
        if track.len() < MIN_TRACK {
            continue;
        }
        let footprint = |&view: &u32| {
            let camera = &shots[view as usize].camera;
            camera.project(found.position).1 / camera.pinhole.fx
        };
        let finest = track.iter().map(footprint).fold(f64::INFINITY, f64::min);
        let mut random = Random::new(bits(seed ^ 0x0153, i as u64));
        let mut normal = || f64::from(random.normal());
        let error = DVec3::new(normal(), normal(), normal()) * NOISE_PIXELS * finest;
        points.positions.push(found.position + error);
        points.colours.push(found.colour);
        points.seen_by.extend(track);
        points.track_start.push(points.seen_by.len() as u32);
    }
    points
}
