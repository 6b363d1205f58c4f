//! The road that a car with a radar drove over, as wide as the radar found it free.
//!
//! The sensor's pose and its height give the height and the tilt of the road under the car. Between two sweeps the road is a plane
//! through both. Across the path it reaches to what stands beside it: to the nearest detections that stand still and that another
//! sweep found in the same place.
//!
//! A detection stands still if its radial velocity is that of the sensor's own motion. Reflections by two surfaces do not stay in
//! place when the sensor moves, so other sweeps do not find them again. The detections themselves are no samples: elevation is not
//! measured, and at the best height 6 of 10 are within 5 % of the depth that a photo shows there (docs/decisions/0090).

use std::collections::{BTreeMap, HashSet};

use glam::{DVec2, DVec3, I64Vec3};
use rayon::prelude::*;
use scene::radar::Detection;
use scene::{BadInput, Rigid, SparsePoints};

use super::RadarSweep;
use crate::lidar::{Return, Scan};

/// Difference to the radial velocity of something that stands, metres per second: velocities are measured to 0.1, and directions to
/// half a degree.
const STANDING_SPEED: f64 = 0.4;
/// Sweeps agree on places this far apart: a cell of range, and one of azimuth at a range.
const AGREEMENT_METRES: f64 = 0.5;
const AGREEMENT_RADIANS: f64 = 0.02;
/// Side of the cells in which places are looked up, metres, and the farthest that places may differ.
const CELL_METRES: f64 = 2.0;
/// Sweeps are independent if their sensor moved this far between them, metres.
const BASELINE_METRES: f64 = 1.0;
/// Half the width of the road where nothing stands beside it: a little more than a car's.
const HALF_CAR: f64 = 1.2;
/// The farthest that the road may reach to the side of the path, metres. A cross slope of 2 % is 12 cm there.
const MAX_HALF_ROAD: f64 = 6.0;
/// What stands beside the road stands on something: the road ends before it, metres.
const MARGIN_METRES: f64 = 0.7;
/// What stands this far along the path before or after a place bounds the road there, metres.
const BESIDE_METRES: f64 = 2.0;
/// Distance between samples of the road, metres.
const STEP_METRES: f64 = 0.25;
/// Side of the cubes in which sparse points make initial points of the road needless, metres.
const SPARSE_METRES: f64 = 0.25;
/// Consecutive sweeps this close were taken on one drive, metres.
const DRIVE_METRES: f64 = 20.0;
/// Most detections of all sweeps: 80,000 sweeps of a car's radar.
const MAX_DETECTIONS: usize = 20_000_000;
/// Sweeps read before their detections are counted.
const CHUNK: usize = 32;
/// Half the angle that something moving hides, radians.
const SHADOW_RADIANS: f64 = 0.05;

/// The road between a sweep and the next.
#[derive(Debug, Clone, PartialEq)]
pub struct RoadStrip {
    /// Where the sensor was.
    origin: DVec3,
    /// The views taken at its time, ascending.
    views: Vec<u32>,
    /// Places on the road, world metres, and whether they are initial points.
    places: Vec<(DVec3, bool)>,
    /// What moved.
    moving: Vec<MovingEcho>,
    /// The middle of the sector that was watched, in the world, of unit length, and how far it reaches to each side, radians.
    ahead: DVec3,
    half_angle: f64,
}

/// A detection of something that moved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MovingEcho {
    /// Its direction in the world, of unit length.
    pub(crate) towards: DVec3,
    /// Metres.
    pub(crate) range: f64,
    /// Its velocity over ground in that direction, metres per second.
    pub(crate) speed: f64,
}

/// The detections of each sweep.
fn read(sweeps: &[RadarSweep]) -> Result<Vec<Vec<Detection>>, BadInput> {
    let (mut read, mut count) = (Vec::with_capacity(sweeps.len()), 0);
    for chunk in sweeps.chunks(CHUNK) {
        // All results first, then the first error in order, whichever thread is faster.
        let found: Vec<_> = chunk.par_iter().map(RadarSweep::read).collect();
        for (sweep, found) in chunk.iter().zip(found) {
            let found = found?;
            count += found.len();
            if count > MAX_DETECTIONS {
                let problem =
                    format!("is where the sweeps of the radar have over {MAX_DETECTIONS} detections together");
                let advice = "leave out sweeps in radar/poses.jsonl, or the weakest detections";
                return Err(BadInput::new(sweep.path.display().to_string(), problem, advice));
            }
            read.push(found);
        }
    }
    Ok(read)
}

/// The road along the drives of a radar. Where the capture has sparse points there are no initial points.
///
/// # Errors
/// A sweep that cannot be read.
pub(crate) fn strips(sweeps: Vec<RadarSweep>, points: &SparsePoints) -> Result<Vec<RoadStrip>, BadInput> {
    let read = read(&sweeps)?;
    let (mut standing, mut moving) = (Vec::new(), Vec::new());
    for (sweep, found) in sweeps.iter().zip(&read) {
        let pose = &sweep.world_from_sensor;
        let own = pose.rotation.inverse() * sweep.velocity;
        let towards = |of: &Detection| DVec3::new(of.azimuth.cos(), of.azimuth.sin(), 0.0);
        let speed = |of: &Detection| of.velocity + own.dot(towards(of));
        let (still, moves): (Vec<&Detection>, Vec<&Detection>) =
            found.iter().partition(|of| speed(of).abs() < STANDING_SPEED);
        standing.push(still.iter().map(|of| (pose.apply(of.range * towards(of)), of.range)).collect());
        let moved =
            |of: &&Detection| MovingEcho { towards: pose.rotation * towards(of), range: of.range, speed: speed(of) };
        moving.push(moves.iter().map(moved).collect::<Vec<_>>());
    }
    let obstacles = Obstacles::new(&standing, &sweeps);
    let triangulated: HashSet<I64Vec3> = points.positions.iter().map(|place| cube(*place)).collect();
    let road = |pair: &[RadarSweep]| road(&pair[0], &pair[1], &obstacles, &triangulated);
    let places: Vec<_> = sweeps.par_windows(2).map(road).collect();
    let places = places.into_iter().chain([Vec::new()]);
    let azimuths = || read.iter().flatten().map(|of| of.azimuth);
    // What all sweeps together reach on both sides.
    let half_angle = azimuths().fold(0.0, f64::max).min(-azimuths().fold(0.0, f64::min)).min(std::f64::consts::PI);
    let strip = |((sweep, places), moving): ((RadarSweep, Vec<(DVec3, bool)>), _)| RoadStrip {
        origin: sweep.world_from_sensor.translation,
        views: sweep.views,
        places,
        moving,
        ahead: sweep.world_from_sensor.rotation * DVec3::X,
        half_angle,
    };
    Ok(sweeps.into_iter().zip(places).zip(moving).map(strip).collect())
}

impl RoadStrip {
    /// Where the sensor was, world metres.
    pub(crate) fn origin(&self) -> DVec3 {
        self.origin
    }

    /// What moved at the time of the sweep.
    pub(crate) fn moving(&self) -> &[MovingEcho] {
        &self.moving
    }

    /// The middle direction of the sector that was watched, in the world, of unit length.
    pub(crate) fn ahead(&self) -> DVec3 {
        self.ahead
    }

    /// How far that sector reaches to each side, radians.
    pub(crate) fn half_angle(&self) -> f64 {
        self.half_angle
    }

    /// Whether there is any road.
    pub(crate) fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// The places on the road.
    pub(crate) fn places(&self) -> impl Iterator<Item = DVec3> {
        self.places.iter().map(|(place, _)| *place)
    }

    /// Whether something that moved at the time of the sweep hides a place.
    pub(crate) fn hides(&self, place: DVec3) -> bool {
        let from = place - self.origin;
        let range = from.length();
        let is_behind =
            |of: &MovingEcho| range > of.range - MARGIN_METRES && from.dot(of.towards) > range * SHADOW_RADIANS.cos();
        self.moving.iter().any(is_behind)
    }
}

impl Scan for RoadStrip {
    fn origin(&self) -> DVec3 {
        self.origin
    }

    fn views(&self) -> &[u32] {
        &self.views
    }

    fn returns(&self) -> Result<Vec<Return>, BadInput> {
        let initial = self.places.iter().filter(|(_, is_initial)| *is_initial);
        let of = |(place, _): &(DVec3, bool)| Return { place: *place, range: place.distance(self.origin) as f32 };
        Ok(initial.map(of).collect())
    }
}

/// Places where something stands, that two sweeps found, by square cells of the ground.
struct Obstacles(BTreeMap<[i64; 2], Vec<DVec2>>);

impl Obstacles {
    /// Of the places of each sweep with their ranges.
    fn new(standing: &[Vec<(DVec3, f64)>], sweeps: &[RadarSweep]) -> Self {
        let mut all: BTreeMap<[i64; 2], Vec<(usize, DVec2)>> = BTreeMap::new();
        for (sweep, places) in standing.iter().enumerate() {
            for (place, _) in places {
                let place = place.truncate();
                all.entry(cell(place)).or_default().push((sweep, place));
            }
        }
        let origin = |sweep: usize| sweeps[sweep].world_from_sensor.translation;
        let is_confirmed = |own: usize, place: DVec2, range: f64| {
            let reach = (AGREEMENT_METRES + AGREEMENT_RADIANS * range).min(CELL_METRES);
            around(place).filter_map(|cell| all.get(&cell)).flatten().any(|&(other, there)| {
                other != own
                    && there.distance_squared(place) < reach * reach
                    && origin(other).distance_squared(origin(own)) > BASELINE_METRES * BASELINE_METRES
            })
        };
        let of_sweep = |(sweep, places): (usize, &Vec<(DVec3, f64)>)| -> Vec<DVec2> {
            let flat = places.iter().map(|(place, range)| (place.truncate(), *range));
            flat.filter(|(place, range)| is_confirmed(sweep, *place, *range)).map(|(place, _)| place).collect()
        };
        let confirmed: Vec<_> = standing.par_iter().enumerate().map(of_sweep).collect();
        let mut cells: BTreeMap<[i64; 2], Vec<DVec2>> = BTreeMap::new();
        for place in confirmed.into_iter().flatten() {
            cells.entry(cell(place)).or_default().push(place);
        }
        Self(cells)
    }

    /// How far the road reaches to the left and to the right of a place on a path with this direction to the left.
    fn clearance(&self, place: DVec2, left: DVec2) -> [f64; 2] {
        let mut nearest = [f64::INFINITY; 2];
        let steps = ((MAX_HALF_ROAD + MARGIN_METRES) / CELL_METRES).ceil() as i32;
        let mut cells: Vec<[i64; 2]> =
            (-steps..=steps).flat_map(|i| around(place + left * (CELL_METRES * f64::from(i)))).collect();
        cells.sort_unstable();
        cells.dedup();
        for found in cells.iter().filter_map(|cell| self.0.get(cell)).flatten() {
            let from = *found - place;
            let side = from.dot(left);
            if from.perp_dot(left).abs() < BESIDE_METRES {
                let nearest = &mut nearest[usize::from(side < 0.0)];
                *nearest = nearest.min(side.abs());
            }
        }
        nearest.map(
            |side| if side < MAX_HALF_ROAD + MARGIN_METRES { (side - MARGIN_METRES).max(HALF_CAR) } else { HALF_CAR },
        )
    }
}

fn cell(place: DVec2) -> [i64; 2] {
    (place / CELL_METRES).floor().as_i64vec2().to_array()
}

/// The cell of a place and the eight beside it.
fn around(place: DVec2) -> impl Iterator<Item = [i64; 2]> {
    let steps = || [-CELL_METRES, 0.0, CELL_METRES].into_iter();
    steps().flat_map(move |x| steps().map(move |y| cell(place + DVec2::new(x, y))))
}

/// The cube of [`SPARSE_METRES`] that a place is in.
fn cube(place: DVec3) -> I64Vec3 {
    (place / SPARSE_METRES).floor().as_i64vec3()
}

/// Places on the road between two sweeps of a drive, and whether they are initial points: every second one along and across, in
/// cubes without sparse points.
fn road(a: &RadarSweep, b: &RadarSweep, obstacles: &Obstacles, sparse: &HashSet<I64Vec3>) -> Vec<(DVec3, bool)> {
    let under = |sweep: &RadarSweep| {
        let Rigid { rotation, translation } = sweep.world_from_sensor;
        (translation - rotation * DVec3::Z * sweep.height, rotation * DVec3::Y)
    };
    let ((start, left), (end, end_left)) = (under(a), under(b));
    let length = start.distance(end);
    if !(length > STEP_METRES && length < DRIVE_METRES && left.dot(end_left) > 0.8) {
        return Vec::new();
    }
    let mut places = Vec::new();
    let along = (length / STEP_METRES).round() as i32;
    for i in 0..along {
        let share = f64::from(i) / f64::from(along);
        let (middle, left) = (start.lerp(end, share), left.lerp(end_left, share).normalize());
        let free = obstacles.clearance(middle.truncate(), left.truncate());
        let [to_left, to_right] = free.map(|metres| (metres / STEP_METRES) as i32);
        let place = |j: i32| {
            let place = middle + left * (STEP_METRES * f64::from(j));
            (place, i % 2 == 0 && j % 2 == 0 && !sparse.contains(&cube(place)))
        };
        places.extend((-to_right..=to_left).map(place));
    }
    places
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::DQuat;

    use super::*;

    /// A drive of ten sweeps 4 m apart along x, at 10 m/s, 0.6 m above the ground.
    fn drive(folder: &Path, rows: impl Fn(DVec3) -> String) -> Vec<RadarSweep> {
        let sweep = |i: u32| {
            let at = DVec3::new(4.0 * f64::from(i), 0.0, 0.6);
            let path = folder.join(format!("{i}.csv"));
            std::fs::write(&path, format!("range,azimuth,velocity,power\n{}", rows(at))).unwrap();
            let world_from_sensor = Rigid { rotation: DQuat::IDENTITY, translation: at };
            RadarSweep {
                path,
                readings: None,
                world_from_sensor,
                velocity: DVec3::X * 10.0,
                height: 0.6,
                views: vec![i],
            }
        };
        (0..10).map(sweep).collect()
    }

    /// A detection at this place from there, of something with a velocity along x.
    fn row(from: DVec3, place: DVec3, speed: f64) -> String {
        let way = (place - from).truncate();
        let azimuth = way.y.atan2(way.x);
        format!("{},{},{},20\n", way.length(), azimuth, (speed - 10.0) * azimuth.cos())
    }

    fn widths(strip: &RoadStrip) -> [f64; 2] {
        let across = || strip.places().map(|place| place.y);
        [across().fold(0.0, f64::max), across().fold(0.0, f64::min)]
    }

    #[test]
    fn the_road_reaches_to_what_stands_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let rails = |from: DVec3| -> String {
            // A rail on the right, 3 m away.
            (0..40).map(|i| row(from, DVec3::new(f64::from(i), -3.0, 0.0), 0.0)).collect()
        };
        let points = SparsePoints { positions: vec![DVec3::new(8.1, 0.1, 0.1)], ..SparsePoints::default() };
        let strips = strips(drive(folder.path(), rails), &points).unwrap();
        assert_eq!(strips.len(), 10);
        for strip in &strips[1..9] {
            assert!(strip.places().all(|place| place.z.abs() < 1e-9), "the road is flat");
            let [left, right] = widths(strip);
            // Nothing is known of the left.
            assert!((left - 1.0).abs() < 1e-9 && (right + 2.25).abs() < 1e-9, "{left} {right}");
        }
        assert_eq!(strips[9].places().count(), 0, "it ends with the last sweep");
        // Every second place along and across, but for the cube that has a sparse point.
        let count = |strip: &RoadStrip| strip.returns().unwrap().len();
        assert_eq!((count(&strips[1]), count(&strips[2])), (8 * 7, 8 * 7 - 1));
    }

    #[test]
    fn reflections_and_what_moves_do_not_bound_the_road() {
        let folder = tempfile::tempdir().unwrap();
        let others = |from: DVec3| {
            // Half a metre beside the sensor, wherever it is; and a car that keeps its distance.
            let ghost = row(from, from + DVec3::new(0.5, 1.4, 0.0), 0.0);
            ghost + &row(from, from + DVec3::new(12.0, 1.5, 0.0), 10.0)
        };
        let strips = strips(drive(folder.path(), others), &SparsePoints::default()).unwrap();
        assert!(strips[..9].iter().all(|strip| widths(strip) == [1.0, -1.0]), "{:?}", widths(&strips[3]));
        // The car hides what is behind it.
        let ahead = |x: f64| DVec3::new(4.0 * 3.0 + x, 0.0, 0.0);
        assert!(strips[3].hides(ahead(20.0) + DVec3::Y * 2.5) && !strips[3].hides(ahead(20.0) - DVec3::Y * 3.0));
        assert!(!strips[3].hides(ahead(8.0) + DVec3::Y));
    }

    #[test]
    fn the_sector_is_what_sweeps_reach_on_both_sides() {
        let folder = tempfile::tempdir().unwrap();
        let both = |from: DVec3| {
            let at = |azimuth: f64| row(from, from + DVec3::new(azimuth.cos(), azimuth.sin(), 0.0) * 9.0, 0.0);
            at(0.5) + &at(-0.3)
        };
        let found = strips(drive(folder.path(), both), &SparsePoints::default()).unwrap();
        assert!(found.iter().all(|strip| strip.ahead() == DVec3::X && (strip.half_angle() - 0.3).abs() < 1e-9));
        let none = strips(drive(folder.path(), |_| String::new()), &SparsePoints::default()).unwrap();
        assert!(none.iter().all(|strip| strip.half_angle() == 0.0), "nothing is known of it");
    }

    #[test]
    fn a_gap_in_a_drive_has_no_road() {
        let folder = tempfile::tempdir().unwrap();
        let mut sweeps = drive(folder.path(), |_| String::new());
        sweeps.drain(3..8);
        let strips = strips(sweeps, &SparsePoints::default()).unwrap();
        let empty = |strip: &RoadStrip| strip.places().next().is_none();
        assert_eq!(strips.iter().map(empty).collect::<Vec<_>>(), [false, false, true, false, true]);
    }
}
