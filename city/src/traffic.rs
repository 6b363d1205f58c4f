//! Moving actors: vehicles that circle quarters, pedestrians that circle blocks.
//!
//! All movers on a route follow the same timetable with an offset, so headways hold everywhere, also at corners.
//! Vehicle routes run clockwise (right-hand traffic) in the lane beside a quarter. Quarters do not overlap, so routes
//! neither share a lane nor cross. Vehicles circle the quarters of every second row; the lanes beside the other rows
//! stay free for cars with sensors ([`City::streets`]).

use glam::{DMat3, DQuat, DVec2, DVec3};
use scene::Rigid;

#[cfg(doc)]
use crate::City;
use crate::build::person;
use crate::build::vehicle::{PAINTS, VehicleKind};
use crate::deck::{Deck, LANES};
use crate::parcels::upright;
use crate::props::Prop;
use crate::random::Random;
use crate::roads::{Profile, Quarter, RoadKind, Roads, Step};
use crate::settings::{Layout, Traffic};
use crate::street_furniture::random_car;
use crate::terrain::Terrain;
use crate::types::Waypoint;

/// Duration of trajectories, seconds.
pub(crate) const SECONDS: f64 = 630.0;

/// A moving prop.
pub(crate) struct Mover {
    pub(crate) prop: Prop,
    pub(crate) waypoints: Vec<Waypoint>,
    /// Duration of a gait cycle, seconds; `None` for vehicles.
    pub(crate) gait_seconds: Option<f64>,
}

/// Parameters of a traffic level.
struct TrafficLevel {
    /// Seconds between vehicles on a route.
    headway: f64,
    /// Range of speeds on a straight, metres per second.
    speed: [f32; 2],
    /// Metres of pavement per pedestrian.
    walkers: f64,
}

fn traffic_level(traffic: Traffic) -> Option<TrafficLevel> {
    match traffic {
        Traffic::None => None,
        Traffic::Light => Some(TrafficLevel { headway: 45.0, speed: [10.0, 13.5], walkers: 220.0 }),
        Traffic::Medium => Some(TrafficLevel { headway: 16.0, speed: [8.0, 12.0], walkers: 90.0 }),
        Traffic::Heavy => Some(TrafficLevel { headway: 6.5, speed: [4.5, 10.0], walkers: 40.0 }),
    }
}

/// Whether generated vehicles circle a quarter.
fn has_traffic(quarter: &Quarter) -> bool {
    quarter.row.is_multiple_of(2)
}

/// A closed path with a timetable.
struct Route {
    /// Pose of a mover at each point.
    poses: Vec<Rigid>,
    /// Seconds from the start at each point, and for the whole route.
    times: Vec<f64>,
    duration: f64,
}

impl Route {
    /// Computes a timetable: at most `speed`, with limited lateral and longitudinal acceleration.
    fn new(points: &[DVec3], poses: Vec<Rigid>, speed: f64) -> Self {
        const SIDEWAYS: f64 = 2.2;
        const CHANGE: f64 = 1.4;
        let count = points.len();
        let step = |k: usize| points[k % count].distance(points[(k + 1) % count]);
        let mut speeds: Vec<f64> = (0..count)
            .map(|k| {
                let (a, b, c) = (points[(k + count - 1) % count], points[k], points[(k + 1) % count]);
                let turn = (b - a).truncate().angle_to((c - b).truncate()).abs();
                let radius = 0.5 * (a.distance(b) + b.distance(c)) / turn.max(1e-6);
                (SIDEWAYS * radius).sqrt().clamp(3.0_f64.min(speed), speed)
            })
            .collect();
        // two laps, so that the speeds at the seam agree
        for k in (0..2 * count).rev() {
            let (here, next) = (k % count, (k + 1) % count);
            speeds[here] = speeds[here].min((speeds[next].powi(2) + 2.0 * CHANGE * step(k)).sqrt());
        }
        for k in 0..2 * count {
            let (here, next) = (k % count, (k + 1) % count);
            speeds[next] = speeds[next].min((speeds[here].powi(2) + 2.0 * CHANGE * step(k)).sqrt());
        }
        let mut times = vec![0.0];
        for k in 0..count {
            times.push(times[k] + 2.0 * step(k) / (speeds[k] + speeds[(k + 1) % count]));
        }
        let duration = times.pop().unwrap_or(1.0).max(1.0);
        Self { poses, times, duration }
    }

    /// The waypoints of a mover that left the start `elapsed` seconds before time 0, until [`SECONDS`].
    fn waypoints(&self, elapsed: f64) -> Vec<Waypoint> {
        let mut k = self.times.partition_point(|&t| t <= elapsed).saturating_sub(1);
        let mut lap = 0.0;
        let mut waypoints = Vec::with_capacity((SECONDS / self.duration * self.times.len() as f64) as usize + 3);
        loop {
            let seconds = self.times[k] + lap - elapsed;
            waypoints.push(Waypoint { seconds, world_from_asset: self.poses[k] });
            if seconds > SECONDS {
                return waypoints;
            }
            k += 1;
            if k == self.times.len() {
                k = 0;
                lap += self.duration;
            }
        }
    }

    /// Start offsets around the route, jittered by a share of the headway.
    fn start_times(&self, count: usize, uneven: f64, random: &mut Random) -> Vec<f64> {
        let start = |k: usize, jitter: f64| (k as f64 + uneven * jitter) / count as f64 * self.duration;
        (0..count).map(|k| start(k, random.unit().into())).collect()
    }
}

/// The clockwise lane beside a rectangle of lattice lines.
fn quarter_lane(roads: &Roads, lines: [usize; 4], terrain: &Terrain) -> Vec<DVec3> {
    let mut ring = roads.ring(&roads.walk_around(lines), &|p| p.lane).0;
    ring.reverse();
    thin_points(ring.iter().map(|p| terrain.at(p.at)).collect())
}

/// Removes every second point on straight stretches of a closed path, and duplicate points.
fn thin_points(points: Vec<DVec3>) -> Vec<DVec3> {
    let mut kept: Vec<DVec3> = Vec::with_capacity(points.len());
    let mut skipped = false;
    for (k, &p) in points.iter().enumerate() {
        let next = points[(k + 1) % points.len()];
        let Some(&last) = kept.last() else {
            kept.push(p);
            continue;
        };
        let turn = (p - last).truncate().angle_to((next - p).truncate()).abs();
        // neither a bend nor a change of slope
        let even = (p.z - last.z.midpoint(next.z)).abs() < 0.015 + 0.1 * (p.distance(last) - next.distance(p)).abs();
        let straight = turn < 0.01 && even && !skipped && next.distance(last) < 9.0;
        skipped = straight;
        if !straight && p.distance(last) > 0.3 {
            kept.push(p);
        }
    }
    kept
}

/// Unit direction of a closed path at a point.
fn heading(points: &[DVec3], k: usize) -> DVec3 {
    let count = points.len();
    (points[(k + 1) % count] - points[(k + count - 1) % count]).normalize_or(DVec3::X)
}

/// Poses along a closed path that follow the slope of the road.
fn poses_on_slope(points: &[DVec3]) -> Vec<Rigid> {
    (0..points.len())
        .map(|k| {
            let x = heading(points, k);
            let y = DVec3::Z.cross(x).normalize_or(DVec3::Y);
            let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize();
            Rigid { rotation, translation: points[k] }
        })
        .collect()
}

/// The vehicles of a quarter.
pub(crate) fn vehicles(
    roads: &Roads,
    terrain: &Terrain,
    quarter: usize,
    traffic: Traffic,
    random: &Random,
) -> Vec<Mover> {
    let mut random = random.fork(0x7AFF).fork(quarter as u64);
    let quarter = &roads.quarters[quarter];
    let Some(level) = traffic_level(traffic).filter(|_| has_traffic(quarter)) else { return Vec::new() };
    let points = quarter_lane(roads, quarter.lines, terrain);
    let pace = if matches!(quarter.layout, Layout::Alley | Layout::Winding) { 0.6 } else { 1.0 };
    // routes of a compact city are short: light traffic could give no vehicle
    vehicles_on_route(&points, &level, pace, usize::from(roads.is_compact), &mut random)
}

/// The vehicles on the deck.
pub(crate) fn deck_vehicles(deck: &Deck, traffic: Traffic, random: &Random) -> Vec<Mover> {
    let Some(level) = traffic_level(traffic) else { return Vec::new() };
    // all points are kept, because ramps are curved vertically
    vehicles_on_route(&deck.route(), &level, 1.0, 0, &mut random.fork(0xDEC4))
}

/// Vehicles at intervals on a route; `pace` is a factor on their speed. No buses or lorries: they would cut into the
/// other lane at corners.
fn vehicles_on_route(
    points: &[DVec3],
    level: &TrafficLevel,
    pace: f64,
    min_count: usize,
    random: &mut Random,
) -> Vec<Mover> {
    let speed = pace * f64::from(random.range(level.speed[0], level.speed[1]));
    let route = Route::new(points, poses_on_slope(points), speed);
    let count = ((route.duration / level.headway + f64::from(random.unit())) as usize).max(min_count);
    let starts = route.start_times(count, 0.25, random);
    starts
        .into_iter()
        .map(|elapsed| Mover { prop: random_vehicle(random), waypoints: route.waypoints(elapsed), gait_seconds: None })
        .collect()
}

fn random_vehicle(random: &mut Random) -> Prop {
    let kind = match random.below(12) {
        0 => VehicleKind::Taxi,
        1 => VehicleKind::Motorcycle,
        2 => VehicleKind::Bicycle,
        _ => return random_car(random),
    };
    Prop::Vehicle(kind, random.below(PAINTS) as u8)
}

/// The pedestrians on the pavement of a block.
pub(crate) fn walkers(roads: &Roads, terrain: &Terrain, block: usize, traffic: Traffic, random: &Random) -> Vec<Mover> {
    let mut random = random.fork(0x3A1C).fork(block as u64);
    let Some(level) = traffic_level(traffic) else { return Vec::new() };
    let walk = roads.walk_around(roads.blocks[block].lines);
    let alley = roads.quarters[roads.blocks[block].quarter].layout == Layout::Alley;
    let share = if alley { 1.8 } else { 1.0 };
    let beside_front = |p: &Profile| p.front() - (0.5 * p.pavement).min(0.6);
    let beside_trees = |p: &Profile| p.half + 1.5;
    let mut movers = walkers_on_route(roads, terrain, &walk, &beside_front, false, level.walkers * share, &mut random);
    let wide = walk.iter().all(|step| match step {
        Step::Along { edge, .. } => roads.edges[*edge].as_ref().is_some_and(|e| e.profile.pavement > 2.5),
        Step::Through { .. } => true,
    });
    if wide {
        movers.extend(walkers_on_route(roads, terrain, &walk, &beside_trees, true, level.walkers * share, &mut random));
    }
    movers
}

/// Pedestrians at intervals on a route around a block.
fn walkers_on_route(
    roads: &Roads,
    terrain: &Terrain,
    walk: &[Step],
    distance: &dyn Fn(&Profile) -> f64,
    clockwise: bool,
    gap: f64,
    random: &mut Random,
) -> Vec<Mover> {
    let ring = roads.ring(walk, distance).0;
    let mut points: Vec<DVec3> = ring.iter().map(|p| terrain.at(p.at) + DVec3::Z * p.profile.curb).collect();
    if clockwise {
        points.reverse();
    }
    let points = thin_points(points);
    let length: f64 = (0..points.len()).map(|k| points[k].distance(points[(k + 1) % points.len()])).sum();
    let count = (length / gap + f64::from(random.unit())) as usize;
    let speed = f64::from(random.range(1.0, 1.6));
    let poses = (0..points.len()).map(|k| upright(points[k], heading(&points, k).truncate())).collect();
    let route = Route::new(&points, poses, speed);
    let starts = route.start_times(count, 0.7, random);
    starts
        .into_iter()
        .map(|elapsed| {
            let build = random.below(person::BUILDS);
            let gait_seconds = person::STRIDE * person::scale(build) / speed;
            let prop = Prop::Walker { build: build as u8, phase: 0 };
            Mover { prop, waypoints: route.waypoints(elapsed), gait_seconds: Some(gait_seconds) }
        })
        .collect()
}

/// The lanes without generated traffic: around every second row of quarters, around single quarters of it (for the
/// cross streets), through alleys, along the deck, and around a compact city.
pub(crate) fn free_lanes(roads: &Roads, terrain: &Terrain, deck: Option<&Deck>) -> Vec<Vec<DVec3>> {
    let rows = roads.cells[1] / roads.fine;
    let close = |mut lane: Vec<DVec3>| {
        lane.extend(lane.first().copied());
        lane
    };
    let mut lanes = Vec::new();
    for row in (1..rows).step_by(2) {
        let lines = [0, roads.cells[0], row * roads.fine, (row + 1) * roads.fine];
        lanes.push(close(quarter_lane(roads, lines, terrain)));
        // in a compact city a row may be one quarter, which has been driven around
        let mut quarters = roads.quarters.iter().filter(|q| q.row == row && !(roads.is_compact && q.lines == lines));
        while let Some(quarter) = quarters.next() {
            lanes.push(close(quarter_lane(roads, quarter.lines, terrain)));
            quarters.next();
        }
    }
    if roads.is_compact {
        // the outer lane of the roads at the edge, counter-clockwise, so that every road is driven
        let mut ring = roads.ring(&roads.walk_outside(), &|p| p.lane).0;
        ring.reverse();
        lanes.push(close(thin_points(ring.iter().map(|p| terrain.at(p.at)).collect())));
    }
    lanes.extend(deck.into_iter().flat_map(|deck| [deck.lane(LANES[0], true), deck.lane(LANES[0], false)]));
    lanes.extend(alleys(roads, terrain));
    lanes
}

/// Every run of alleys along a lattice line, in one direction.
fn alleys(roads: &Roads, terrain: &Terrain) -> Vec<Vec<DVec3>> {
    let mut lanes = Vec::new();
    let mut run: Vec<DVec2> = Vec::new();
    let mut end = |run: &mut Vec<DVec2>| {
        if run.len() > 3 {
            lanes.push(run.iter().map(|&p| terrain.at(p)).collect());
        }
        run.clear();
    };
    let mut follow = |edge: usize, run: &mut Vec<DVec2>| match &roads.edges[edge] {
        Some(edge) if edge.profile.kind == RoadKind::Alley => run.extend(edge.path.iter().map(|p| p.0)),
        _ => end(run),
    };
    for j in 0..=roads.cells[1] {
        (0..roads.cells[0]).for_each(|i| follow(roads.horizontal(i, j), &mut run));
        follow(roads.horizontal(0, 0), &mut run);
    }
    for i in 0..=roads.cells[0] {
        (0..roads.cells[1]).for_each(|j| follow(roads.vertical(i, j), &mut run));
        follow(roads.horizontal(0, 0), &mut run);
    }
    lanes
}
