//! What moves in the sweeps of a lidar: points where other sweeps see through.
//!
//! A sweep is a picture of ranges. A point of one sweep lies, seen from another, nearer than what that one measured in its direction:
//! then nothing was there at the other's time, and the point is of something that moved (as in Removert, Kim and Kim 2020). Where the
//! other measured the same range the point stands still; where it measured a nearer one, it says nothing. Points that moved form
//! clusters, each of which is a sighting.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

use crate::tracking::{Place, Sighting};

/// Cells of a range image: in azimuth over the whole turn, and in elevation between these angles, radians. They are about as large as
/// the steps of a coarse lidar; of a fine one, each holds the nearest of several returns.
const COLUMNS: usize = 360;
const ROWS: usize = 60;
const ELEVATIONS: [f64; 2] = [-0.6, 0.6];
/// Ranges of the same surface differ by this, metres, and by this share of the range.
const MARGIN_METRES: f64 = 0.4;
const MARGIN_SHARE: f64 = 0.01;
/// A point moved if at least this many sweeps see through it, and this many times as many as see it.
const LEAST_VOTES: u32 = 2;
const VOTES_FACTOR: u32 = 3;
/// Where no cell of the ground beside a place has a height, those up to this many cells away say it.
const GROUND_REACH: i64 = 3;
/// Cells of the ground that are higher than the lowest beside them by more than this have no ground, metres.
const STEP_METRES: f64 = 0.35;
/// Heights above the ground of points of objects, metres.
const HEIGHTS: std::ops::Range<f64> = 0.25..4.2;
/// Side of the cells by which points are clustered, metres. Of a vehicle a lidar may see a side and the roof, and nothing between them:
/// what lies up to this many cells beside a cluster of this many cells along x or y belongs to it. No person is as long.
const CELL_METRES: f64 = 0.4;
const REACH: i64 = 3;
const LONG: i64 = 3;
/// A cluster has at least this many points that moved.
const LEAST_POINTS: usize = 3;
/// No person is higher, metres.
const PERSON_METRES: f64 = 2.1;
/// The longest side of a cluster: no vehicle is longer, metres.
const MAX_METRES: f64 = 20.0;
/// Points that a sighting keeps at most.
const MAX_POINTS: usize = 400;
/// 1σ of the middle of a cluster, metres.
const MIDDLE_METRES: f64 = 0.6;

/// A sweep, in ground axes (z up), metres.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// Seconds.
    pub seconds: f64,
    /// Where the sensor was in the middle of the sweep.
    pub sensor: DVec3,
    /// The returns.
    pub points: Vec<DVec3>,
}

/// The range that a sweep measured in each direction, metres.
pub struct RangeImage {
    sensor: DVec3,
    /// The nearest in each cell; infinite without a return.
    ranges: Vec<f32>,
}

/// What a sweep says about a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Vote {
    Through,
    Stands,
    Nothing,
}

impl RangeImage {
    /// Of a sweep.
    pub fn of(scan: &Scan) -> Self {
        let mut ranges = vec![f32::INFINITY; COLUMNS * ROWS];
        for point in &scan.points {
            if let Some(([column, row], range)) = place(*point - scan.sensor) {
                let nearest = &mut ranges[row as usize * COLUMNS + column as usize % COLUMNS];
                *nearest = nearest.min(range as f32);
            }
        }
        Self { sensor: scan.sensor, ranges }
    }

    /// Where its sensor was.
    pub fn sensor(&self) -> DVec3 {
        self.sensor
    }

    fn vote(&self, point: DVec3) -> Vote {
        let Some(([column, row], range)) = place(point - self.sensor) else { return Vote::Nothing };
        let margin = MARGIN_METRES + MARGIN_SHARE * range;
        let at = |row: usize, column: usize| f64::from(self.ranges[row * COLUMNS + column % COLUMNS]);
        if at(row as usize, column as usize).is_infinite() {
            return Vote::Nothing;
        }
        // The four cells that are nearest.
        let [left, lower] = [column, row].map(|along| (along - 0.5).floor());
        let (mut is_through, mut stands) = (true, false);
        for (i, j) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
            let column = (left + i).rem_euclid(COLUMNS as f64) as usize;
            let row = (lower + j).clamp(0.0, (ROWS - 1) as f64) as usize;
            let measured = at(row, column);
            is_through &= measured > range + margin;
            stands |= (measured - range).abs() <= margin;
        }
        match (is_through, stands) {
            (true, _) => Vote::Through,
            (_, true) => Vote::Stands,
            _ => Vote::Nothing,
        }
    }
}

/// Where a direction lies in a range image, in columns and rows, and the range.
fn place(from_sensor: DVec3) -> Option<([f64; 2], f64)> {
    let range = from_sensor.length();
    let elevation = (from_sensor.z / range).asin();
    let [low, high] = ELEVATIONS;
    let row = (elevation - low) / (high - low) * ROWS as f64;
    let azimuth = from_sensor.y.atan2(from_sensor.x);
    let column = (azimuth + PI) / TAU * COLUMNS as f64;
    (0.0..ROWS as f64).contains(&row).then_some(([column, row], range))
}

/// Heights of the ground, from the lowest points of a scene. The height of a cell is that of its lowest point but two: a few come from
/// below.
#[derive(Debug)]
pub struct GroundHeights {
    /// Side of a cell, metres.
    side: f64,
    /// The three lowest points of each cell, lowest first.
    lowest: HashMap<[i64; 2], [f32; 3]>,
}

impl GroundHeights {
    /// Without points, in cells of this side in metres.
    pub fn new(side: f64) -> Self {
        Self { side, lowest: HashMap::new() }
    }

    /// Adds points, in ground axes.
    pub fn add(&mut self, points: &[DVec3]) {
        for point in points {
            let lowest = self.lowest.entry(square(point.truncate(), self.side)).or_insert([f32::INFINITY; 3]);
            let z = point.z as f32;
            if z < lowest[2] {
                lowest[2] = z;
                lowest.sort_by(f32::total_cmp);
            }
        }
    }

    /// The height of the ground at a place; `None` where no points are near it.
    pub fn height(&self, place: DVec2) -> Option<f64> {
        self.height_within(place, 1).or_else(|| self.height_within(place, GROUND_REACH))
    }

    fn height_within(&self, place: DVec2, reach: i64) -> Option<f64> {
        let heights: Vec<f64> = (around(square(place, self.side), reach).filter_map(|at| self.lowest.get(&at)))
            .map(|lowest| f64::from(lowest[2]))
            .filter(|z| z.is_finite())
            .collect();
        let least = heights.iter().copied().reduce(f64::min)?;
        let ground: Vec<f64> = heights.into_iter().filter(|z| z - least <= STEP_METRES).collect();
        Some(ground.iter().sum::<f64>() / ground.len() as f64)
    }
}

fn square(place: DVec2, side: f64) -> [i64; 2] {
    [place.x, place.y].map(|along| (along / side).floor() as i64)
}

/// The cells up to `reach` beside one.
fn around([x, y]: [i64; 2], reach: i64) -> impl Iterator<Item = [i64; 2]> {
    (-reach..=reach).flat_map(move |i| (-reach..=reach).map(move |j| [x + i, y + j]))
}

/// Whether a point is of something that moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    Moved,
    Stands,
    Unknown,
}

/// The points of a sweep that are higher than the ground and not too high for objects, with what other sweeps say about them.
pub struct JudgedScan {
    pub(crate) sensor: DVec3,
    pub(crate) points: Vec<(DVec3, Verdict)>,
}

impl JudgedScan {
    /// Of a sweep. `others` are sweeps of other times from near places.
    pub fn new(scan: &Scan, others: &[&RangeImage], ground: &GroundHeights) -> Self {
        let is_above = |point: &DVec3| {
            let ground = ground.height(point.truncate());
            ground.is_some_and(|ground| HEIGHTS.contains(&(point.z - ground)))
        };
        let judged = |point: DVec3| {
            let (mut through, mut stands) = (0, 0);
            for other in others {
                match other.vote(point) {
                    Vote::Through => through += 1,
                    Vote::Stands => stands += 1,
                    Vote::Nothing => {}
                }
            }
            match () {
                () if through >= LEAST_VOTES && through >= VOTES_FACTOR * stands => (point, Verdict::Moved),
                () if stands <= through => (point, Verdict::Unknown),
                () => (point, Verdict::Stands),
            }
        };
        let points = scan.points.iter().copied().filter(is_above).map(judged).collect();
        Self { sensor: scan.sensor, points }
    }

    /// The clusters of what moved.
    pub fn sightings(&self, ground: &GroundHeights) -> Vec<Sighting> {
        // Cells of points: those that moved, and those that no other sweep says anything of.
        let mut cells: BTreeMap<[i64; 2], (Vec<DVec3>, Vec<DVec3>)> = BTreeMap::new();
        for (point, verdict) in &self.points {
            let (moved, unknown) = cells.entry(square(point.truncate(), CELL_METRES)).or_default();
            match verdict {
                Verdict::Moved => moved.push(*point),
                Verdict::Unknown => unknown.push(*point),
                Verdict::Stands => {}
            }
        }
        let clusters = joined(connected(cells.iter().filter(|(_, (moved, _))| !moved.is_empty()).map(|(at, _)| *at)));
        clusters.iter().filter_map(|cluster| self.sighting(cluster, &cells, ground)).collect()
    }

    fn sighting(
        &self,
        cluster: &Cluster,
        cells: &BTreeMap<[i64; 2], (Vec<DVec3>, Vec<DVec3>)>,
        ground: &GroundHeights,
    ) -> Option<Sighting> {
        // Above a person there may be a tree.
        let ceiling = if is_long(cluster) { f64::INFINITY } else { PERSON_METRES };
        let is_low = |point: &DVec3| ground.height(point.truncate()).is_none_or(|ground| point.z - ground <= ceiling);
        let mut points: Vec<DVec3> = cluster.iter().flat_map(|at| &cells[at].0).copied().filter(is_low).collect();
        if points.len() < LEAST_POINTS {
            return None;
        }
        let beside: Cluster = cluster.iter().flat_map(|&at| around(at, 1)).collect();
        points.extend(
            beside.iter().filter_map(|at| cells.get(at)).flat_map(|(_, unknown)| unknown).copied().filter(is_low),
        );
        let every = points.len().div_ceil(MAX_POINTS).max(1);
        let points: Vec<DVec3> = points.into_iter().step_by(every).collect();
        let (low, high) =
            points.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
        if (high - low).truncate().max_element() > MAX_METRES {
            return None;
        }
        let middle = 0.5 * (low + high).truncate();
        Some(Sighting {
            place: Place::around(middle, MIDDLE_METRES),
            points,
            sensor: self.sensor.truncate(),
            ground: ground.height(middle).unwrap_or(low.z),
            moves: true,
            kind: None,
        })
    }
}

/// Cells that are connected.
type Cluster = BTreeSet<[i64; 2]>;

/// The groups of cells that touch.
fn connected(cells: impl Iterator<Item = [i64; 2]>) -> Vec<Cluster> {
    let mut left: Cluster = cells.collect();
    let mut clusters = Vec::new();
    while let Some(seed) = left.pop_first() {
        let mut cluster = BTreeSet::from([seed]);
        let mut next = VecDeque::from([seed]);
        while let Some(here) = next.pop_front() {
            for at in around(here, 1).filter(|at| left.remove(at)) {
                cluster.insert(at);
                next.push_back(at);
            }
        }
        clusters.push(cluster);
    }
    clusters
}

/// Whether a cluster is longer than a person is wide.
fn is_long(cluster: &Cluster) -> bool {
    (0..2).any(|axis| {
        let along = || cluster.iter().map(|at| at[axis]);
        along().max().zip(along().min()).is_some_and(|(high, low)| high - low >= LONG)
    })
}

/// The clusters, of which those beside a long one are its parts.
fn joined(mut clusters: Vec<Cluster>) -> Vec<Cluster> {
    let mut at = 0;
    while at < clusters.len() {
        if is_long(&clusters[at]) {
            let near: Cluster = clusters[at].iter().flat_map(|&cell| around(cell, REACH)).collect();
            let part = (0..clusters.len()).find(|&other| other != at && !clusters[other].is_disjoint(&near));
            if let Some(part) = part {
                let part_of = clusters.remove(part);
                at -= usize::from(part < at);
                clusters[at].extend(part_of);
                continue;
            }
        }
        at += 1;
    }
    clusters
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rays from a sensor 1.8 m above a plane, that meet a wall 25 m to the left and a box of 4 × 2 × 2 m.
    fn scan(seconds: f64, sensor: DVec2, vehicle: DVec2) -> Scan {
        let sensor = sensor.extend(1.8);
        let mut points = Vec::new();
        for column in 0..720 {
            for row in 0..48 {
                let (azimuth, elevation) = (f64::from(column) / 720.0 * TAU, f64::from(row - 36) / 90.0);
                let along =
                    DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
                let mut range = 60.0f64;
                if along.z < 0.0 {
                    range = range.min(-sensor.z / along.z);
                }
                if along.y > 0.0 {
                    range = range.min((25.0 - sensor.y) / along.y);
                }
                let (low, high) =
                    (vehicle.extend(0.0) - DVec3::new(2.0, 1.0, 0.0), vehicle.extend(0.0) + DVec3::new(2.0, 1.0, 2.0));
                let (a, b) = ((low - sensor) / along, (high - sensor) / along);
                let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
                if near > 0.0 && near <= far {
                    range = range.min(near);
                }
                if range < 60.0 {
                    points.push(sensor + range * along);
                }
            }
        }
        Scan { seconds, sensor, points }
    }

    #[test]
    fn what_drives_is_found_and_what_stands_is_not() {
        // One car drives past a parked one: in each sweep there is only one of the two.
        let drives = |i: usize| DVec2::new(-12.0 + 3.0 * i as f64, 8.0);
        let sensor = |i: usize| DVec2::new(i as f64, 0.0);
        let moving: Vec<Scan> = (0..9).map(|i| scan(0.3 * i as f64, sensor(i), drives(i))).collect();
        let parked: Vec<Scan> = (0..9).map(|i| scan(0.3 * i as f64, sensor(i), DVec2::new(6.0, 9.0))).collect();
        let found = |scans: &[Scan]| -> Vec<Vec<Sighting>> {
            let mut ground = GroundHeights::new(1.0);
            scans.iter().for_each(|scan| ground.add(&scan.points));
            let images: Vec<RangeImage> = scans.iter().map(RangeImage::of).collect();
            let others = |i: usize| {
                images.iter().enumerate().filter(|(j, _)| j.abs_diff(i) >= 2).map(|(_, of)| of).collect::<Vec<_>>()
            };
            (0..scans.len()).map(|i| JudgedScan::new(&scans[i], &others(i), &ground).sightings(&ground)).collect()
        };
        for (i, seen) in found(&moving).iter().enumerate() {
            assert_eq!(
                seen.len(),
                1,
                "{i}: {:?}",
                seen.iter().map(|s| (s.place.middle, s.points.len(), s.points.first().copied())).collect::<Vec<_>>()
            );
            assert!((seen[0].place.middle - drives(i)).length() < 1.6, "{i}: {}", seen[0].place.middle);
            assert!(seen[0].ground.abs() < 0.05 && seen[0].points.len() > 20);
        }
        assert!(found(&parked).iter().all(Vec::is_empty));
    }

    #[test]
    fn the_ground_is_where_most_low_points_are() {
        let mut ground = GroundHeights::new(1.0);
        let slope = |x: f64| 0.1 * x;
        let grid = (0..400).map(|i| DVec2::new(f64::from(i % 20), f64::from(i / 20)) * 0.3);
        let mut points: Vec<DVec3> = grid.map(|at| at.extend(slope(at.x))).collect();
        points.extend([DVec3::new(3.0, 3.0, -4.0), DVec3::new(3.1, 3.0, -4.0)]);
        points.extend((0..50).map(|i| DVec3::new(3.5, 3.5, 1.0 + 0.02 * f64::from(i))));
        ground.add(&points);
        let found = ground.height(DVec2::splat(3.2)).unwrap();
        assert!((found - slope(3.2)).abs() < 0.15, "{found}");
        assert_eq!(ground.height(DVec2::splat(90.0)), None);
    }
}
