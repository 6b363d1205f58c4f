//! Writes the drives of the cars in the layout of the Waymo Open Dataset, Perception, version 2: a segment for each drive, a frame
//! for each place with a photo or a sweep. `scene::waymo` describes the tables.
//!
//! ```text
//! waymo/COMPONENT/drive_LEG.parquet      camera_calibration, camera_image, vehicle_pose, lidar_box, stats, and with a lidar
//!                                        lidar_calibration, lidar, lidar_pose: columns as in the owners' devkit
//! ```
//!
//! The vehicle's origin is on the road under the car's centre. A photo's pose has the errors of the reported camera; that of a
//! frame is true. The cameras of the rig that look to the rear have no place in the data set.

mod boxes;
mod component;
mod lasers;
mod photos;
mod segment;

use std::collections::BTreeMap;
use std::path::Path;

use city::Waypoint;
use city::sense::Shot;
use city::sense::rig::{Mount, sensor_pose_at};
use city::trace::World;
use glam::DVec3;
use scene::parquet::Cells;

use self::component::{Component, keys, matrix};
use self::segment::{Frame, Segment};
use super::lidar_turn::LidarTurn;
use super::nuscenes::Sample;
use super::settings::{Progress, Settings, SynthError};
use super::shots::Station;

/// Writes all segments. The sweeps are in the capture's `lidar/`. `shots` are sorted by name, `turns` those of the stations.
pub(super) fn write(
    out: &Path,
    world: &World,
    shots: &[Shot],
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    turns: &[Option<LidarTurn>],
    settings: &Settings,
    progress: Progress,
) -> Result<(), SynthError> {
    let mounts = settings.rig.rig().cameras;
    let cameras = photos::cameras(&mounts);
    let car = Mount { name: String::new(), offset: DVec3::ZERO, yaw_degrees: 0.0 };
    let mut drives: BTreeMap<usize, Vec<Frame>> = BTreeMap::new();
    for (i, station) in stations.iter().enumerate() {
        let find = |name: &String| shots.binary_search_by(|shot| shot.name.cmp(name)).ok().map(|at| &shots[at]);
        let photos = station.photos.iter().filter_map(find).collect();
        let sample = Sample { station, photos, turn: turns.get(i).and_then(Option::as_ref) };
        let pose = legs.get(station.leg).and_then(|leg| sensor_pose_at(leg, &car, station.seconds));
        if let Some((world_from_vehicle, _)) = pose {
            drives.entry(station.leg).or_default().push(Frame { sample, world_from_vehicle });
        }
    }
    for (done, (leg, frames)) in (0..).zip(drives) {
        progress("waymo", done + 1, legs.len());
        let segment = Segment { out, name: format!("drive_{leg:04}"), leg: &legs[leg], frames };
        if photos::write(&segment, &cameras)? {
            write_poses(&segment)?;
            write_stats(&segment)?;
            boxes::write(&segment, world)?;
            lasers::write(&segment)?;
        }
    }
    Ok(())
}

fn write_poses(segment: &Segment) -> Result<(), SynthError> {
    let mut columns = keys(&segment.name, segment.frames.iter().map(|frame| frame.time()));
    let poses = segment.frames.iter().map(|frame| matrix(&frame.world_from_vehicle));
    columns.push(("[VehiclePoseComponent].world_from_vehicle.transform", Cells::Doubles(poses.collect())));
    Component::write(segment.out, "vehicle_pose", &segment.name, columns)
}

fn write_stats(segment: &Segment) -> Result<(), SynthError> {
    let rows = segment.frames.len();
    let mut columns = keys(&segment.name, segment.frames.iter().map(|frame| frame.time()));
    let text = |text: &str| Cells::Text(vec![text.to_owned(); rows]);
    columns.extend([
        ("[StatsComponent].time_of_day", text("Day")),
        ("[StatsComponent].location", text("generated-city")),
        ("[StatsComponent].weather", text("sunny")),
        ("[StatsComponent].lidar_object_counts.types", Cells::Int8s(vec![Vec::new(); rows])),
        ("[StatsComponent].lidar_object_counts.counts", Cells::Int32s(vec![Vec::new(); rows])),
        ("[StatsComponent].camera_object_counts.types", Cells::Int8s(vec![Vec::new(); rows])),
        ("[StatsComponent].camera_object_counts.counts", Cells::Int32s(vec![Vec::new(); rows])),
    ]);
    Component::write(segment.out, "stats", &segment.name, columns)
}
