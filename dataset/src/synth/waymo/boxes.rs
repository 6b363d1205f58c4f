//! Boxes of vehicles and people that a camera sees or the lidar hit: `lidar_box`.

use city::Class;
use city::trace::{World, motion};
use glam::DVec3;
use rayon::prelude::*;
use scene::parquet::Cells;

use super::super::nuscenes::{Object, around};
use super::super::settings::SynthError;
use super::super::tracks_and_boxes::bounds;
use super::component::{Component, keys};
use super::segment::Segment;

/// A row of the table.
struct Row {
    microseconds: i64,
    object: String,
    class: i8,
    /// In the vehicle's axes.
    centre: DVec3,
    /// Length, width, height.
    size: DVec3,
    heading: f64,
    /// In the vehicle's axes.
    speed: DVec3,
    points: u32,
}

/// Writes the table.
pub(super) fn write(segment: &Segment, world: &World) -> Result<(), SynthError> {
    let objects: Vec<Vec<Object>> = segment.frames.par_iter().map(|frame| around(world, &frame.sample)).collect();
    let city = world.city();
    let mut rows = Vec::new();
    for (frame, objects) in segment.frames.iter().zip(&objects) {
        let (seconds, vehicle_from_world) = (frame.sample.station.seconds, frame.world_from_vehicle.inverse());
        for object in objects {
            let actor = &city.actors[object.actor];
            let Some((low, high)) = bounds(city, motion::asset_at(actor, seconds)) else { continue };
            let pose = motion::pose_at(actor, seconds);
            let centre = pose.apply((0.5 * (low + high)).as_dvec3());
            let ahead = vehicle_from_world.rotation * (pose.rotation * DVec3::X);
            rows.push(Row {
                microseconds: frame.time(),
                object: format!("{}-{}", segment.name, actor.instance),
                class: class(actor.class),
                centre: vehicle_from_world.apply(centre),
                size: (high - low).as_dvec3(),
                heading: ahead.y.atan2(ahead.x),
                speed: vehicle_from_world.rotation * motion::velocity_at(actor, seconds, centre),
                points: object.points,
            });
        }
    }
    let doubles = |value: fn(&Row) -> f64| Cells::Double(rows.iter().map(value).collect());
    let whole = |value: fn(&Row) -> i64| Cells::Int64(rows.iter().map(value).collect());
    let mut columns = keys(&segment.name, rows.iter().map(|row| row.microseconds));
    columns.extend([
        ("key.laser_object_id", Cells::Text(rows.iter().map(|row| row.object.clone()).collect())),
        ("[LiDARBoxComponent].box.center.x", doubles(|row| row.centre.x)),
        ("[LiDARBoxComponent].box.center.y", doubles(|row| row.centre.y)),
        ("[LiDARBoxComponent].box.center.z", doubles(|row| row.centre.z)),
        ("[LiDARBoxComponent].box.size.x", doubles(|row| row.size.x)),
        ("[LiDARBoxComponent].box.size.y", doubles(|row| row.size.y)),
        ("[LiDARBoxComponent].box.size.z", doubles(|row| row.size.z)),
        ("[LiDARBoxComponent].box.heading", doubles(|row| row.heading)),
        ("[LiDARBoxComponent].type", Cells::Int8(rows.iter().map(|row| row.class).collect())),
        ("[LiDARBoxComponent].num_lidar_points_in_box", whole(|row| row.points.into())),
        ("[LiDARBoxComponent].num_top_lidar_points_in_box", whole(|row| row.points.into())),
        ("[LiDARBoxComponent].speed.x", doubles(|row| row.speed.x)),
        ("[LiDARBoxComponent].speed.y", doubles(|row| row.speed.y)),
        ("[LiDARBoxComponent].speed.z", doubles(|row| row.speed.z)),
        ("[LiDARBoxComponent].acceleration.x", doubles(|_| 0.0)),
        ("[LiDARBoxComponent].acceleration.y", doubles(|_| 0.0)),
        ("[LiDARBoxComponent].acceleration.z", doubles(|_| 0.0)),
        ("[LiDARBoxComponent].difficulty_level.detection", Cells::Int8(vec![0; rows.len()])),
        ("[LiDARBoxComponent].difficulty_level.tracking", Cells::Int8(vec![0; rows.len()])),
    ]);
    Component::write(segment.out, "lidar_box", &segment.name, columns)
}

/// The number of a class, as in `scene::waymo::CLASSES`.
fn class(class: Class) -> i8 {
    match class {
        Class::Person | Class::Rider => 2,
        Class::Bicycle => 4,
        _ => 1,
    }
}
