//! Annotated boxes: vehicles and people around a sample that a camera sees or the lidar hit.

use std::collections::BTreeMap;

use city::sense::Shot;
use city::trace::{Moment, Ray, RayMask, World, motion};
use city::{Actor, City, Class};
use glam::DVec3;
use scene::Rigid;
use serde_json::{Value, json};

use super::super::tracks_and_boxes::bounds;
use super::sample::Sample;
use super::tables::{Tables, chained, quaternion, token};

const CATEGORIES: [&str; 6] = [
    "human.pedestrian.adult",
    "vehicle.bicycle",
    "vehicle.bus.rigid",
    "vehicle.car",
    "vehicle.motorcycle",
    "vehicle.truck",
];
const ATTRIBUTES: [&str; 7] = [
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.moving",
    "pedestrian.standing",
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
];
/// Levels of visibility and their upper ends.
const VISIBILITIES: [(&str, f64); 4] = [("0-40", 0.4), ("40-60", 0.6), ("60-80", 0.8), ("80-100", f64::INFINITY)];

/// Objects this near to the car are annotated, metres.
const RANGE_METRES: f64 = 70.0;
/// Speed of an object that moves, metres per second.
const MOVING_SPEED: f64 = 0.2;
/// Rays towards an object that find out how much of it a camera sees.
const RAYS: usize = 48;
/// The rays aim at corners of the mesh, moved by this share towards its middle, so that they do not pass by.
const INWARDS: f32 = 0.03;

/// An annotated object of a sample.
pub(crate) struct Object {
    /// Row of [`City::actors`].
    pub(crate) actor: usize,
    /// Number of returns on it.
    pub(crate) points: u32,
    /// Share that the camera sees which sees most of it.
    visible: f64,
}

/// The samples of a drive with their objects.
pub(super) struct Scene<'a> {
    pub(super) name: &'a str,
    pub(super) city: &'a City,
    pub(super) samples: &'a [Sample<'a>],
    pub(super) objects: &'a [Vec<Object>],
}

/// Categories, attributes and levels of visibility.
pub(super) fn push_classes(tables: &mut Tables) {
    for (table, names) in [("category", &CATEGORIES[..]), ("attribute", &ATTRIBUTES)] {
        let row =
            |name: &&str| json!({ "token": token(&[table, name]), "name": name, "description": "as in nuScenes" });
        tables.extend(table, names.iter().map(row).collect());
    }
    for (i, (level, _)) in VISIBILITIES.iter().enumerate() {
        let description = format!("{level} % of the object are visible to the camera that sees most of it");
        let row = json!({ "token": (i + 1).to_string(), "level": format!("v{level}"), "description": description });
        tables.push("visibility", row);
    }
}

/// The objects of a sample.
pub(crate) fn around(world: &World, sample: &Sample) -> Vec<Object> {
    let (city, seconds) = (world.city(), sample.station.seconds);
    let moment = world.at(seconds);
    let here = match (sample.turn, sample.photos.first()) {
        (Some(turn), _) => turn.pose.translation,
        (None, Some(shot)) => shot.camera.centre(),
        (None, None) => return Vec::new(),
    };
    let object = |(row, actor): (usize, &Actor)| {
        category(actor.class).filter(|_| actor.instance > 0)?;
        if motion::pose_at(actor, seconds).translation.distance(here) > RANGE_METRES {
            return None;
        }
        let points = sample.turn.and_then(|turn| turn.hits.get(&actor.instance)).copied().unwrap_or(0);
        let shares = sample.photos.iter().map(|shot| visible_share(&moment, city, row, seconds, shot));
        let visible = shares.fold(0.0, f64::max);
        (points > 0 || visible > 0.0).then_some(Object { actor: row, points, visible })
    };
    city.actors.iter().enumerate().filter_map(object).collect()
}

/// The share of an actor's corners whose rays from a camera are in the picture and meet the actor first.
fn visible_share(moment: &Moment, city: &City, row: usize, seconds: f64, shot: &Shot) -> f64 {
    let actor = &city.actors[row];
    let Some(asset) = city.assets.get(motion::asset_at(actor, seconds) as usize) else { return 0.0 };
    let Some((low, high)) = bounds(city, motion::asset_at(actor, seconds)) else { return 0.0 };
    let (pose, middle) = (motion::pose_at(actor, seconds), 0.5 * (low + high));
    let (from, k) = (shot.camera.centre(), shot.camera.pinhole);
    let corners = &asset.mesh.positions;
    let step = corners.len().div_ceil(RAYS).max(1);
    let is_seen = |corner: &glam::Vec3| {
        let aim = pose.apply(corner.lerp(middle, INWARDS).as_dvec3());
        let (pixel, depth) = shot.camera.project(aim);
        let inside =
            depth > 0.0 && pixel.min_element() >= 0.0 && pixel.x < f64::from(k.width) && pixel.y < f64::from(k.height);
        let ray = Ray::new(from.as_vec3(), (aim - from).normalize_or_zero().as_vec3());
        inside && moment.cast(&ray, RayMask::Opaque).is_some_and(|hit| hit.actor as usize == row)
    };
    let (seen, all) =
        corners.iter().step_by(step).fold((0, 0), |(seen, all), p| (seen + u32::from(is_seen(p)), all + 1));
    f64::from(seen) / f64::from(all.max(1))
}

/// Adds the rows of a scene's instances and annotations.
pub(super) fn push(tables: &mut Tables, scene: &Scene) {
    let mut by_actor: BTreeMap<usize, Vec<Value>> = BTreeMap::new();
    for (sample, objects) in scene.samples.iter().zip(scene.objects) {
        for object in objects {
            if let Some(row) = annotation(scene, sample, object) {
                by_actor.entry(object.actor).or_default().push(row);
            }
        }
    }
    for (row, annotations) in by_actor {
        let actor = &scene.city.actors[row];
        let annotations = chained(annotations);
        let end = |row: Option<&Value>| row.map_or(Value::Null, |row| row["token"].clone());
        tables.push(
            "instance",
            json!({
                "token": instance(scene, actor), "category_token": token(&["category", category(actor.class).unwrap_or_default()]),
                "nbr_annotations": annotations.len(), "first_annotation_token": end(annotations.first()),
                "last_annotation_token": end(annotations.last()),
            }),
        );
        tables.extend("sample_annotation", annotations);
    }
}

fn annotation(scene: &Scene, sample: &Sample, object: &Object) -> Option<Value> {
    let (actor, seconds) = (&scene.city.actors[object.actor], sample.station.seconds);
    let (low, high) = bounds(scene.city, motion::asset_at(actor, seconds))?;
    let Rigid { rotation, translation } = motion::pose_at(actor, seconds);
    let middle = translation + rotation * (0.5 * (low + high)).as_dvec3();
    let [length, width, height] = (high - low).as_dvec3().to_array();
    let level = VISIBILITIES.iter().position(|(_, end)| object.visible <= *end).unwrap_or(0) + 1;
    Some(json!({
        "token": token(&["sample_annotation", &sample.station.name, &actor.instance.to_string()]),
        "sample_token": sample.token(), "instance_token": instance(scene, actor), "visibility_token": level.to_string(),
        "attribute_tokens": [token(&["attribute", attribute(actor, seconds, middle)])],
        "translation": middle.to_array(), "size": [width, length, height], "rotation": quaternion(rotation),
        "num_lidar_pts": object.points, "num_radar_pts": 0,
    }))
}

/// An object is another instance in each scene.
fn instance(scene: &Scene, actor: &Actor) -> String {
    token(&["instance", scene.name, &actor.instance.to_string()])
}

fn category(class: Class) -> Option<&'static str> {
    Some(match class {
        Class::Person | Class::Rider => "human.pedestrian.adult",
        Class::Bicycle => "vehicle.bicycle",
        Class::Bus => "vehicle.bus.rigid",
        Class::Car => "vehicle.car",
        Class::Motorcycle => "vehicle.motorcycle",
        Class::Truck => "vehicle.truck",
        _ => return None,
    })
}

fn attribute(actor: &Actor, seconds: f64, place: DVec3) -> &'static str {
    let moves = motion::velocity_at(actor, seconds, place).length() > MOVING_SPEED;
    match (actor.class, moves, actor.trajectory.is_some()) {
        (Class::Bicycle | Class::Motorcycle, _, true) => "cycle.with_rider",
        (Class::Bicycle | Class::Motorcycle, _, false) => "cycle.without_rider",
        (Class::Person | Class::Rider, true, _) => "pedestrian.moving",
        (Class::Person | Class::Rider, false, _) => "pedestrian.standing",
        (_, true, _) => "vehicle.moving",
        (_, false, true) => "vehicle.stopped",
        (_, false, false) => "vehicle.parked",
    }
}
