//! Writes `tracks.json`, the trajectories of moving actors, and `boxes3d.json`, the objects visible in each photo. Both have one
//! line per entry, so that they can be read incrementally.

use std::collections::BTreeMap;
use std::path::Path;

use city::sense::Shot;
use city::trace::{Frame, motion};
use city::{Actor, City, Class};
use glam::{DQuat, DVec3, Vec3};
use scene::Rigid;
use serde_json::{Value, json};
use store::file::{SaveError, save};

/// Tracks cover the time of the photos and this many seconds before and after.
const MARGIN_SECONDS: f64 = 2.0;

/// The classes with boxes.
const BOXED: [Class; 9] = [
    Class::TrafficLight,
    Class::TrafficSign,
    Class::Person,
    Class::Rider,
    Class::Car,
    Class::Truck,
    Class::Bus,
    Class::Motorcycle,
    Class::Bicycle,
];

/// Writes the tracks of all moving actors.
pub(super) fn write_tracks(out: &Path, city: &City, shots: &[Shot]) -> Result<(), SaveError> {
    let seconds = |start: f64, pick: fn(f64, f64) -> f64| shots.iter().map(|shot| shot.seconds).fold(start, pick);
    let (from, to) = (seconds(f64::INFINITY, f64::min), seconds(f64::NEG_INFINITY, f64::max));
    let track = |actor: &Actor| {
        let path = &actor.trajectory.as_ref()?.waypoints;
        // One more pose on each side, for interpolation.
        let first = path.partition_point(|w| w.seconds < from - MARGIN_SECONDS).saturating_sub(1);
        let last = (path.partition_point(|w| w.seconds <= to + MARGIN_SECONDS) + 1).min(path.len());
        let poses = path.get(first..last)?.iter().map(|w| {
            let Rigid { rotation: q, translation: t } = w.world_from_asset;
            json!([round(w.seconds, 1e3), metres(t), quaternion(q)])
        });
        let (low, high) = bounds_at_all_times(city, actor)?;
        Some(json!({
            "instance": actor.instance,
            "class": actor.class,
            "asset": city.assets.get(actor.asset as usize)?.name,
            "low": metres(low.as_dvec3()),
            "high": metres(high.as_dvec3()),
            "poses": poses.collect::<Vec<Value>>(),
        }))
    };
    let lines = city.actors.iter().filter_map(track).map(|value| value.to_string());
    let about = "poses: [seconds, [x, y, z], quaternion [x, y, z, w]], world_from_object, straight and by slerp between \
                 them; low, high: the object's corners in its own axes (x ahead, y left, z up), metres; seconds: when each photo was \
                 taken";
    let times: BTreeMap<String, f64> =
        shots.iter().map(|shot| (format!("images/{}.png", shot.name), shot.seconds)).collect();
    let text = json_lines("tracks", about, lines);
    let text = text.trim_end().trim_end_matches('}');
    save(&out.join("tracks.json"), format!("{text}, \"seconds\": {}}}\n", json!(times)).as_bytes())
}

/// Writes the lines made by [`Instances::boxes`], one per shot.
pub(super) fn write_boxes(out: &Path, lines: &[String]) -> Result<(), SaveError> {
    let about = "centre, size and rotation (quaternion [x, y, z, w]) of world_from_box, metres; x ahead, y left, z up; \
                 velocity in the world, m/s; pixels: how many show it; box2d: [left, top, right, bottom] of those";
    save(&out.join("boxes3d.json"), json_lines("images", about, lines.iter().cloned()).as_bytes())
}

/// A JSON object with a description and a list, one line per entry.
fn json_lines(name: &str, about: &str, lines: impl Iterator<Item = String>) -> String {
    let lines: Vec<String> = lines.collect();
    format!("{{\"about\": {}, \"{name}\": [\n{}\n]}}\n", json!(about), lines.join(",\n"))
}

/// The city's actors with boxes, by instance.
pub(super) struct Instances<'a> {
    city: &'a City,
    actors: BTreeMap<u32, &'a Actor>,
}

/// The visible pixels of an actor in a photo.
struct VisiblePixels {
    count: u32,
    /// Left, top, right and bottom; the last two exclusive.
    bounds: [u32; 4],
}

impl<'a> Instances<'a> {
    pub(super) fn new(city: &'a City) -> Self {
        let boxed = city.actors.iter().filter(|actor| actor.instance > 0 && BOXED.contains(&actor.class));
        Self { city, actors: boxed.map(|actor| (actor.instance, actor)).collect() }
    }

    /// The boxes of the objects visible in a photo, as a line of `boxes3d.json`.
    pub(super) fn boxes(&self, shot: &Shot, frame: &Frame) -> String {
        let mut visible: BTreeMap<u32, VisiblePixels> = BTreeMap::new();
        for (i, instance) in (0..).zip(&frame.first.instance).filter(|(_, instance)| **instance > 0) {
            let (x, y) = (i % frame.width, i / frame.width);
            let pixels = visible.entry(*instance).or_insert(VisiblePixels { count: 0, bounds: [x, y, x, y] });
            let [left, top, right, bottom] = pixels.bounds;
            pixels.count += 1;
            pixels.bounds = [left.min(x), top.min(y), right.max(x + 1), bottom.max(y + 1)];
        }
        let boxes: Vec<Value> =
            visible.iter().filter_map(|(instance, visible)| self.box_of(shot, *instance, visible)).collect();
        json!({ "image": format!("images/{}.png", shot.name), "seconds": shot.seconds, "boxes": boxes }).to_string()
    }

    fn box_of(&self, shot: &Shot, instance: u32, visible: &VisiblePixels) -> Option<Value> {
        let actor = self.actors.get(&instance)?;
        let pose = motion::pose_at(actor, shot.seconds);
        let (low, high) = bounds(self.city, motion::asset_at(actor, shot.seconds))?;
        let centre = pose.apply((0.5 * (low + high)).as_dvec3());
        Some(json!({
            "instance": instance,
            "class": actor.class,
            "moves": actor.trajectory.is_some(),
            "centre": metres(centre),
            "size": metres((high - low).as_dvec3()),
            "rotation": quaternion(pose.rotation),
            "velocity": metres(motion::velocity_at(actor, shot.seconds, centre)),
            "pixels": visible.count,
            "box2d": visible.bounds,
        }))
    }
}

/// Bounding box of an actor in its own axes: a pedestrian's in all phases of the gait.
pub(super) fn bounds_at_all_times(city: &City, actor: &Actor) -> Option<(Vec3, Vec3)> {
    let gait = actor.trajectory.as_ref().map_or(&[][..], |trajectory| &trajectory.gait);
    let phases = gait.iter().chain([&actor.asset]).filter_map(|&asset| bounds(city, asset));
    phases.reduce(|(low, high), (other_low, other_high)| (low.min(other_low), high.max(other_high)))
}

/// Bounding box of an asset in its own axes.
pub(super) fn bounds(city: &City, asset: u32) -> Option<(Vec3, Vec3)> {
    let positions = &city.assets.get(asset as usize)?.mesh.positions;
    let first = *positions.first()?;
    Some(positions.iter().fold((first, first), |(low, high), p| (low.min(*p), high.max(*p))))
}

fn metres(v: DVec3) -> [f64; 3] {
    v.to_array().map(|c| round(c, 1e3))
}

fn quaternion(q: DQuat) -> [f64; 4] {
    [q.x, q.y, q.z, q.w].map(|c| round(c, 1e6))
}

fn round(value: f64, parts: f64) -> f64 {
    (value * parts).round() / parts
}
