//! Initial points from lidar and radar: the sweeps of a capture, thinned to one return per voxel, with the views that see each.
//!
//! A voxel keeps the return that was measured from the smallest distance. The voxels grow until there are few enough of them:
//! a lidar measures streets by the million, and initial points as dense as that would leave no splats for the rest of the scene.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;
use scene::{BadInput, Camera, SparsePoints};

use super::{Return, Scan, Seen, visible};

/// Side of the smallest voxel, metres.
const VOXEL_METRES: f64 = 0.1;
/// Factor by which voxels grow while there are too many.
const GROWTH: f64 = 1.25;
/// Most initial points, as a multiple of the capture's sparse points.
const PER_SPARSE_POINT: usize = 4;
/// Bounds of that maximum.
const MAX_POINTS: std::ops::RangeInclusive<usize> = 40_000..=1_000_000;
/// Returns that are kept until it is known which of them a camera sees, as a multiple of the maximum.
const UNSEEN_FACTOR: usize = 4;
/// Most sweeps that are read for initial points, spread evenly.
const MAX_SWEEPS: usize = 4000;
/// Sweeps read before the voxels are thinned again.
const CHUNK: usize = 32;
/// A view may see the points that were measured from within this distance of its camera. A camera elsewhere, such as one in
/// the air, may look at them through roofs, which the lidar does not measure.
const NEAR_METRES: f64 = 15.0;

/// Initial points from sweeps.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Seeds {
    /// Points with tracks, grey: [`crate::ingest`] colours them.
    pub(crate) points: SparsePoints,
    /// The view that shows each point best, one of its track: taken during the sweep that measured it if there is one, and the
    /// nearest of those.
    pub(crate) best_view: Vec<u32>,
}

/// A return with the sweep that measured it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Measured {
    place: DVec3,
    range: f32,
    sweep: u32,
    /// Its number among those whose visibility was tested.
    number: usize,
}

impl Measured {
    /// Orders the returns of a voxel, the best first, whatever the order in which they come.
    fn rank(&self) -> (u32, u32, [u64; 3]) {
        (self.range.to_bits(), self.sweep, self.place.to_array().map(f64::to_bits))
    }
}

/// Initial points from these sweeps for a capture with this many sparse points. Points that no camera sees are left out.
///
/// # Errors
/// A sweep that cannot be read.
pub(crate) fn seeds(sweeps: &[&dyn Scan], cameras: &[Camera], sparse_points: usize) -> Result<Seeds, BadInput> {
    let max = (PER_SPARSE_POINT * sparse_points).clamp(*MAX_POINTS.start(), *MAX_POINTS.end());
    let Voxels { side, returns } = thinned(sweeps, UNSEEN_FACTOR * max)?;
    let measured = sorted(returns);
    // Returns are sorted by sweep: `start[s] .. start[s + 1]` are those of sweep `s`.
    let start: Vec<usize> = (0..=sweeps.len()).map(|s| measured.partition_point(|m| (m.sweep as usize) < s)).collect();
    let seen_by = |view: usize| -> Vec<Seen> {
        let centre = cameras[view].centre();
        let is_near = |sweep: &usize| {
            start[*sweep] < start[*sweep + 1]
                && (sweeps[*sweep].origin().distance_squared(centre) <= NEAR_METRES * NEAR_METRES
                    || sweeps[*sweep].views().binary_search(&(view as u32)).is_ok())
        };
        let near = (0..sweeps.len()).filter(is_near).flat_map(|sweep| start[sweep]..start[sweep + 1]);
        visible(&cameras[view], near.map(|i| (i as u32, measured[i].place)))
    };
    let seen: Vec<Vec<Seen>> = (0..cameras.len()).into_par_iter().map(seen_by).collect();
    let mut tracks: Vec<Vec<u32>> = vec![Vec::new(); measured.len()];
    for (view, seen) in (0..).zip(&seen) {
        seen.iter().for_each(|seen| tracks[seen.point as usize].push(view));
    }
    let mut kept = Voxels::new(side);
    (0..)
        .zip(&measured)
        .filter(|(i, _)| !tracks[*i].is_empty())
        .for_each(|(i, m)| kept.insert(Measured { number: i, ..*m }));
    let mut seeds = Seeds::default();
    seeds.points.track_start.push(0);
    for point in sorted(kept.at_most(max).returns) {
        let track = &tracks[point.number];
        let distance = |view: u32| {
            let is_other = sweeps[point.sweep as usize].views().binary_search(&view).is_err();
            (is_other, cameras[view as usize].centre().distance_squared(point.place).to_bits(), view)
        };
        seeds.best_view.extend(track.iter().copied().min_by_key(|&view| distance(view)));
        seeds.points.positions.push(point.place);
        seeds.points.colours.push([128; 3]);
        seeds.points.seen_by.extend_from_slice(track);
        seeds.points.track_start.push(seeds.points.seen_by.len() as u32);
    }
    seeds.points.measured = seeds.points.len() as u32;
    Ok(seeds)
}

/// Returns by sweep.
fn sorted(returns: HashMap<I64Vec3, Measured>) -> Vec<Measured> {
    let mut returns: Vec<Measured> = returns.into_values().collect();
    returns.sort_by_key(|m| (m.sweep, m.rank()));
    returns
}

/// At most `max` returns of the sweeps, one per voxel.
fn thinned(sweeps: &[&dyn Scan], max: usize) -> Result<Voxels, BadInput> {
    let chosen: Vec<usize> = (0..sweeps.len()).step_by(sweeps.len().div_ceil(MAX_SWEEPS).max(1)).collect();
    let mut voxels = Voxels::new(VOXEL_METRES);
    for chunk in chosen.chunks(CHUNK) {
        let read = |&sweep: &usize| -> Result<Voxels, BadInput> {
            let mut own = Voxels::new(voxels.side);
            for Return { place, range } in sweeps[sweep].returns()? {
                own.insert(Measured { place, range, sweep: sweep as u32, number: 0 });
            }
            Ok(own)
        };
        // All results first, then the first error in order, whichever thread is faster.
        let read: Vec<_> = chunk.par_iter().map(read).collect();
        for own in read {
            own?.returns.into_values().for_each(|measured| voxels.insert(measured));
            voxels = voxels.at_most(max);
        }
    }
    Ok(voxels)
}

/// One return per voxel of this side.
struct Voxels {
    side: f64,
    returns: HashMap<I64Vec3, Measured>,
}

impl Voxels {
    fn new(side: f64) -> Self {
        Self { side, returns: HashMap::new() }
    }

    fn insert(&mut self, measured: Measured) {
        match self.returns.entry((measured.place / self.side).floor().as_i64vec3()) {
            Entry::Occupied(mut held) if measured.rank() < held.get().rank() => drop(held.insert(measured)),
            Entry::Occupied(_) => {}
            Entry::Vacant(free) => drop(free.insert(measured)),
        }
    }

    /// Larger voxels, so that there are at most `max`.
    fn at_most(mut self, max: usize) -> Self {
        while self.returns.len() > max {
            let mut grown = Self::new(GROWTH * self.side);
            self.returns.into_values().for_each(|measured| grown.insert(measured));
            self = grown;
        }
        self
    }
}
