//! Sparse points as structure from motion leaves them: on true surfaces, where photos have contrast, each with the views
//! that see it and would match it, off by a part of a pixel.
//!
//! One view is looked through after the other, at the city's moment when it was taken, so that cars in the way are in the
//! way; a grid over the ground says which points are near enough to be tried.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::random::{Random, bits};
use city::sense::Shot;
use city::trace::{Moment, Ray, World};
use glam::{DVec2, DVec3, I64Vec2};
use rayon::prelude::*;
use scene::SparsePoints;

use super::Progress;
use super::images::Seed;

/// Side of a cell of the grid, metres.
const CELL: f64 = 16.0;
/// A feature is matched in views that see it at most so many times larger or smaller than the view it was found in.
const SCALES: f64 = 3.0;
/// How squarely a view has to see a surface, as a cosine.
const FACING: f64 = 0.15;
/// Share of the views that see a feature in which it is found again.
const FOUND: f32 = 0.85;
/// Views that a point needs.
const SHORTEST_TRACK: usize = 2;
/// Error of a point along each axis, in pixels of the view that sees it largest (1σ).
const NOISE_PIXELS: f64 = 0.35;

/// The points, in the order of the views they were found in.
pub(super) fn points(
    world: &World,
    shots: &[Shot],
    seeds: Vec<Vec<Seed>>,
    seed: u64,
    progress: Progress,
) -> SparsePoints {
    let seeds: Vec<Seed> = seeds.into_iter().flatten().collect();
    let cell = |place: DVec2| (place / CELL).floor().as_i64vec2();
    let mut grid: BTreeMap<[i64; 2], Vec<u32>> = BTreeMap::new();
    for (i, found) in seeds.iter().enumerate() {
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
                .filter(|&i| Random::new(bits(seed ^ 0xF01D, bits(u64::from(i), view as u64))).chance(FOUND))
                .filter(|&i| sees(&moment, shot, centre, reach, &seeds[i as usize]))
                .collect();
            seen.sort_unstable();
            progress("points", done.fetch_add(1, Ordering::Relaxed) + 1, shots.len());
            seen
        })
        .collect();
    tracks(shots, &seeds, &seen, seed)
}

/// From how far a view's pixels still find anything: farther from a height than from the street.
fn reach(shot: &Shot) -> f64 {
    60.0 + 2.0 * shot.camera.centre().z.max(0.0)
}

/// True where the point lies in the picture, faces the camera, is neither too small nor too large there, and nothing
/// stands between.
fn sees(moment: &Moment, shot: &Shot, centre: DVec3, reach: f64, seed: &Seed) -> bool {
    let away = centre - seed.position;
    let distance = away.length();
    let (pixel, depth) = shot.camera.project(seed.position);
    let k = &shot.camera.pinhole;
    let inside =
        pixel.x >= 1.0 && pixel.y >= 1.0 && pixel.x <= f64::from(k.width) - 1.0 && pixel.y <= f64::from(k.height) - 1.0;
    let scale = depth / k.fx / seed.footprint;
    if distance > reach || depth < 0.3 || !inside || !(1.0 / SCALES..=SCALES).contains(&scale) {
        return false;
    }
    let towards = (away / distance).as_vec3();
    if f64::from(seed.normal.dot(towards)) < FACING {
        return false;
    }
    // off the surface, so that it does not hide itself
    let start = seed.position.as_vec3() + 0.02 * seed.normal;
    !moment.is_occluded(&Ray { t_max: distance as f32 - 0.02, ..Ray::new(start, towards) })
}

/// Turns what each view sees into tracks, and moves points by what triangulation errs.
fn tracks(shots: &[Shot], seeds: &[Seed], seen: &[Vec<u32>], seed: u64) -> SparsePoints {
    let mut views: Vec<Vec<u32>> = vec![Vec::new(); seeds.len()];
    for (view, seen) in (0..).zip(seen) {
        seen.iter().for_each(|&i| views[i as usize].push(view));
    }
    let mut points = SparsePoints { track_start: vec![0], ..SparsePoints::default() };
    for (i, (found, track)) in seeds.iter().zip(views).enumerate() {
        if track.len() < SHORTEST_TRACK {
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
