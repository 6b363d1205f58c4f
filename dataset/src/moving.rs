//! Objects that move, from the sweeps of a capture's lidar, objects on its photos, and the times of both.
//!
//! Sweeps are read in the order of time, twice: once for the heights of the ground, and once for what moves, each beside those of other
//! times from near places. A window of sweeps is in memory, so a capture may have any number of them. A radar adds what moves by its
//! velocity. Without sweeps of a lidar, objects on photos are where they touch the ground, which lies where the lowest points of the
//! capture are.

use std::collections::{BTreeSet, VecDeque};

use glam::{DQuat, DVec3};
use perceive::echoes::{Echo, add_echoes};
use perceive::moving_points::{GroundHeights, JudgedScan, RangeImage, Scan};
use perceive::seen_boxes::{SeenBox, add_boxes};
use perceive::tracking::{Kind, Moment, Sighting, Track, Watch, tracks};
use rayon::prelude::*;
use scene::{BadInput, Camera, MovingObject, PathPose, Rigid, View, Zones};

use crate::lidar::{Return, Scan as _, Sweep};
use crate::open::Source;
use crate::radar::{MovingEcho, RoadStrip};

/// Sweeps on each side of one, in the order of time, that may tell what moved in it, and how many of them do, spread evenly.
const WINDOW: usize = 40;
const OTHERS: usize = 12;
/// They are at least this much earlier or later, seconds, from at most this far, metres.
const APART_SECONDS: f64 = 0.6;
const NEAR_METRES: f64 = 25.0;
/// Sweeps that are read at once.
const CHUNK: usize = 16;
/// Points of a sweep that are used at most: a turn of a scanner with 128 beams.
const MAX_RETURNS: usize = 250_000;
/// Sweeps and photos of one time, seconds.
const SAME_SECONDS: f64 = 1e-3;
/// Side of a cell of the ground, metres: from sweeps, and from the capture's points.
const LIDAR_CELL: f64 = 1.0;
const POINTS_CELL: f64 = 3.0;

/// Where objects that move are looked for.
pub struct Looking<'a> {
    /// The capture, for messages.
    pub capture: &'a str,
    /// Its sweeps and points.
    pub source: &'a Source,
    /// Its views, as the zones are of.
    pub views: &'a [View],
    /// Objects on the photos.
    pub zones: Option<&'a Zones>,
    /// Turns up to z.
    pub ground_from_world: DQuat,
}

/// A time at which sweeps or photos were taken.
struct Instant<'a> {
    seconds: f64,
    sweep: Option<&'a Sweep>,
    /// What a radar saw.
    radar: Vec<&'a RoadStrip>,
    /// Indices of photos.
    views: Vec<usize>,
}

impl Looking<'_> {
    /// The objects that move, with their paths in the capture's world. `progress` is called with (steps done, steps in total).
    ///
    /// # Errors
    /// A capture with neither sweeps nor zones, one that does not tell when they were taken, or a sweep that cannot be read.
    pub fn objects(&self, progress: &dyn Fn(usize, usize)) -> Result<Vec<MovingObject>, BadInput> {
        let bad = |problem: &str, advice: &str| BadInput::new(self.capture, problem, advice);
        let sweeps = &self.source.sweeps;
        if sweeps.is_empty() && self.source.road.is_empty() && self.zones.is_none() {
            let advice = "give --detector or --zones, or a capture with a lidar or a radar";
            return Err(bad("has no sweeps that are used, and nobody looks at its photos", advice));
        }
        let instants = self.instants();
        if instants.is_empty() {
            let advice = "name the times of its photos as \"seconds\" in a tracks.json beside it";
            return Err(bad("does not tell when its photos were taken", advice));
        }
        let steps = self.steps();
        let ground = self.ground(&|done| progress(done, steps))?;
        let mut moments: Vec<Moment> = Vec::new();
        let mut window: VecDeque<Option<(Scan, RangeImage)>> = VecDeque::new();
        // The instant of the first in the window, and how many instants have been loaded.
        let (mut first, mut loaded) = (0, 0);
        for from in (0..instants.len()).step_by(CHUNK) {
            let to = (from + CHUNK).min(instants.len());
            let until = (to + WINDOW).min(instants.len());
            let read: Vec<_> = instants[loaded..until].par_iter().map(|instant| self.scan(instant)).collect();
            for read in read {
                window.push_back(read?);
            }
            loaded = until;
            let seen = |at: usize| {
                let others =
                    (at.saturating_sub(WINDOW).max(first)..(at + WINDOW + 1).min(until)).map(|at| &window[at - first]);
                self.sightings(&instants[at], window[at - first].as_ref(), others.flatten(), &ground)
            };
            let found: Vec<_> = (from..to).into_par_iter().map(seen).collect();
            for (instant, sightings) in instants[from..to].iter().zip(found) {
                let watches: Vec<Watch> = instant.radar.iter().map(|strip| self.watch(strip)).collect();
                match moments.last_mut() {
                    Some(moment) if instant.seconds - moment.seconds <= SAME_SECONDS => {
                        moment.sightings.extend(sightings);
                        moment.watches.extend(watches);
                    }
                    _ => moments.push(Moment { seconds: instant.seconds, sightings, watches }),
                }
            }
            let keep_from = to.saturating_sub(WINDOW).max(first);
            window.drain(..keep_from - first);
            first = keep_from;
            progress(sweeps.len() + to, steps);
        }
        let tracks = tracks(&moments, self.zones.is_some(), &|place| ground.height(place));
        Ok((1..).zip(tracks).map(|(number, track)| object(number, &track, self.ground_from_world)).collect())
    }

    /// The number of steps of [`objects`](Self::objects).
    pub fn steps(&self) -> usize {
        self.instants().len() + self.source.sweeps.len()
    }

    /// The times of sweeps with their photos, and of photos without a sweep, in order.
    fn instants(&self) -> Vec<Instant<'_>> {
        let views = &self.source.capture.views;
        let mut instants = Vec::new();
        let mut with_sweep = BTreeSet::new();
        for sweep in &self.source.sweeps {
            let own: Vec<usize> =
                sweep.views.iter().map(|&view| view as usize).filter(|&view| view < views.len()).collect();
            let mut times: Vec<f64> = own.iter().filter_map(|&view| views[view].seconds).collect();
            times.sort_by(f64::total_cmp);
            if let Some(&seconds) = times.get(times.len() / 2) {
                with_sweep.extend(own.iter().copied());
                instants.push(Instant { seconds, sweep: Some(sweep), radar: Vec::new(), views: own });
            }
        }
        if self.zones.is_some() {
            let mut alone: Vec<(f64, usize)> = (views.iter().zip(0..))
                .filter(|(_, at)| !with_sweep.contains(at))
                .filter_map(|(view, at)| Some((view.seconds?, at)))
                .collect();
            alone.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            for group in alone.chunk_by(|a, b| b.0 - a.0 <= SAME_SECONDS) {
                instants.push(Instant {
                    seconds: group[0].0,
                    sweep: None,
                    radar: Vec::new(),
                    views: group.iter().map(|(_, at)| *at).collect(),
                });
            }
        }
        instants.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        let mut of_radar = Vec::new();
        for strip in &self.source.road {
            let mut times: Vec<f64> =
                strip.views().iter().filter_map(|&view| views.get(view as usize)?.seconds).collect();
            times.sort_by(f64::total_cmp);
            let Some(&seconds) = times.get(times.len() / 2) else { continue };
            let near = instants.partition_point(|instant| instant.seconds < seconds - SAME_SECONDS);
            match instants.get_mut(near).filter(|instant| instant.seconds <= seconds + SAME_SECONDS) {
                Some(instant) => instant.radar.push(strip),
                None if strip.moving().is_empty() => {}
                None => of_radar.push(Instant { seconds, sweep: None, radar: vec![strip], views: Vec::new() }),
            }
        }
        instants.extend(of_radar);
        instants.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        instants
    }

    /// The points of a sweep in ground axes; of a large one some, as a window of sweeps is in memory.
    fn turned(&self, returns: &[Return]) -> Vec<DVec3> {
        let every = returns.len().div_ceil(MAX_RETURNS).max(1);
        returns.iter().step_by(every).map(|of| self.ground_from_world * of.place).collect()
    }

    fn ground(&self, progress: &dyn Fn(usize)) -> Result<GroundHeights, BadInput> {
        let sweeps = &self.source.sweeps;
        if sweeps.is_empty() {
            let mut ground = GroundHeights::new(POINTS_CELL);
            let points = &self.source.capture.points.positions;
            ground.add(&points.iter().map(|&point| self.ground_from_world * point).collect::<Vec<_>>());
            return Ok(ground);
        }
        let mut ground = GroundHeights::new(LIDAR_CELL);
        let mut done = 0;
        for chunk in sweeps.chunks(CHUNK) {
            let read: Vec<_> = chunk.par_iter().map(Sweep::read).collect();
            for returns in read {
                ground.add(&self.turned(&returns?));
                done += 1;
                progress(done);
            }
        }
        Ok(ground)
    }

    fn scan(&self, instant: &Instant) -> Result<Option<(Scan, RangeImage)>, BadInput> {
        let Some(sweep) = instant.sweep else { return Ok(None) };
        let sensor = self.ground_from_world * sweep.world_from_sensor.translation;
        let scan = Scan { seconds: instant.seconds, sensor, points: self.turned(&sweep.read()?) };
        let image = RangeImage::of(&scan);
        Ok(Some((scan, image)))
    }

    fn sightings<'a>(
        &self,
        instant: &Instant,
        scan: Option<&(Scan, RangeImage)>,
        others: impl Iterator<Item = &'a (Scan, RangeImage)>,
        ground: &GroundHeights,
    ) -> Vec<Sighting> {
        let judged = scan.map(|(scan, _)| JudgedScan::new(scan, &chosen(scan, others), ground));
        let mut seen = judged.as_ref().map(|judged| judged.sightings(ground)).unwrap_or_default();
        for strip in &instant.radar {
            let echoes: Vec<Echo> = strip.moving().iter().map(|of| self.echo(strip.origin(), of)).collect();
            add_echoes(&mut seen, &echoes, ground);
        }
        if let Some(zones) = self.zones {
            let photos: Vec<(Camera, Vec<SeenBox>)> = instant
                .views
                .iter()
                .map(|&view| (self.on_ground(&self.views[view].camera), boxes(zones, view)))
                .collect();
            let photos: Vec<(Camera, &[SeenBox])> =
                photos.iter().map(|(camera, boxes)| (*camera, &boxes[..])).collect();
            add_boxes(&mut seen, &photos, judged.as_ref(), ground);
        }
        seen
    }

    /// What a radar watched, in ground axes.
    fn watch(&self, strip: &RoadStrip) -> Watch {
        let ahead = (self.ground_from_world * strip.ahead()).truncate().normalize_or_zero();
        let sensor = (self.ground_from_world * strip.origin()).truncate();
        Watch { sensor, ahead, half_angle: strip.half_angle() }
    }

    /// A detection in ground axes.
    fn echo(&self, sensor: DVec3, of: &MovingEcho) -> Echo {
        let place = self.ground_from_world * (sensor + of.range * of.towards);
        Echo { place, sensor: self.ground_from_world * sensor, speed: of.speed }
    }

    /// A camera in ground axes.
    fn on_ground(&self, camera: &Camera) -> Camera {
        let Rigid { rotation, translation } = camera.camera_from_world;
        let rotation = (rotation * self.ground_from_world.inverse()).normalize();
        Camera { camera_from_world: Rigid { rotation, translation }, ..*camera }
    }
}

/// The objects on a photo that may move by themselves.
fn boxes(zones: &Zones, view: usize) -> Vec<SeenBox> {
    let seen = |zone: &scene::Zone| {
        let kind = Kind::of_class(zones.classes.get(usize::from(zone.class))?)?;
        Some(SeenBox { corners: zone.corners, kind })
    };
    zones.of(view).iter().filter_map(seen).collect()
}

/// Those of the others that tell most about a sweep.
fn chosen<'a>(scan: &Scan, others: impl Iterator<Item = &'a (Scan, RangeImage)>) -> Vec<&'a RangeImage> {
    let tells = |(other, image): &&(Scan, RangeImage)| {
        (other.seconds - scan.seconds).abs() >= APART_SECONDS && image.sensor().distance(scan.sensor) <= NEAR_METRES
    };
    let near: Vec<&RangeImage> = others.filter(tells).map(|(_, image)| image).collect();
    let every = near.len().div_ceil(OTHERS).max(1);
    near.into_iter().step_by(every).collect()
}

/// A track as an object whose axes lie in the middle of its box's lower side.
fn object(number: usize, track: &Track, ground_from_world: DQuat) -> MovingObject {
    let half = 0.5 * track.size;
    let world_from_ground = ground_from_world.inverse();
    let path = track.path.iter().map(|at| {
        // Nose up is a turn about the axis to the right.
        let rotation = DQuat::from_rotation_z(at.heading) * DQuat::from_rotation_y(-at.slope);
        let rotation = (world_from_ground * rotation).normalize();
        let translation = world_from_ground * at.place;
        PathPose { seconds: at.seconds, world_from_object: Rigid { rotation, translation } }
    });
    MovingObject {
        id: format!("{}-{number}", track.kind.name()),
        class: track.kind.name().to_owned(),
        low: DVec3::new(-half.x, -half.y, 0.0),
        high: DVec3::new(half.x, half.y, track.size.z),
        path: path.collect(),
    }
}
