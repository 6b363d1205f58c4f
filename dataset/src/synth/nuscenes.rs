//! Writes the drives of the cars as a data set in the layout of nuScenes: a scene for each drive, a sample for each place with a
//! photo or a sweep. `scene::nuscenes` describes the tables.
//!
//! ```text
//! nuscenes/v1.0-mini/*.json                       the thirteen tables that the owners' devkit needs
//! nuscenes/samples/CAM_FRONT_LEFT/NAME.png ...    the photos, copied
//! nuscenes/samples/LIDAR_TOP/NAME.pcd.bin         with a lidar: sweeps corrected for the car's motion
//! nuscenes/maps/none.png                          one dark pixel: the devkit needs a map
//! ```
//!
//! The vehicle's origin is on the road under the car's centre. Each reading has an `ego_pose` of its own; those of photos have
//! the errors of the reported cameras.

mod objects;
mod sample;
mod sweep;
mod tables;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use city::sense::Shot;
use city::sense::rig::Mount;
use city::trace::World;
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use scene::Rigid;
use serde_json::json;
use store::file::{SaveError, save};

use self::objects::Scene;
pub(super) use self::objects::{Object, around};
pub(super) use self::sample::Sample;
pub(super) use self::sweep::{LIDAR, save_sweep};
use self::tables::{Tables, chained, quaternion, token};
use super::lidar_turn::LidarTurn;
use super::output::create_folder;
use super::settings::{Progress, Settings, SynthError};
use super::shots::Station;

/// The folder below the capture.
pub(super) const FOLDER: &str = "nuscenes";
const VERSION: &str = "v1.0-mini";
const MAP: &str = "maps/none.png";

/// Writes tables and photos; the sweeps are there ([`save_sweep`]). `shots` are sorted by name, `turns` those of the stations.
pub(super) fn write(
    out: &Path,
    world: &World,
    shots: &[Shot],
    stations: &[Station],
    turns: &[Option<LidarTurn>],
    settings: &Settings,
    progress: Progress,
) -> Result<(), SynthError> {
    let root = out.join(FOLDER);
    let mounts = settings.rig.rig().cameras;
    let mut drives: BTreeMap<usize, Vec<Sample>> = BTreeMap::new();
    for (i, station) in stations.iter().enumerate() {
        let find = |name: &String| shots.binary_search_by(|shot| shot.name.cmp(name)).ok().map(|at| &shots[at]);
        let photos: Vec<&Shot> = station.photos.iter().filter_map(find).collect();
        let turn = turns.get(i).and_then(Option::as_ref);
        if !photos.is_empty() || turn.is_some() {
            drives.entry(station.leg).or_default().push(Sample { station, photos, turn });
        }
    }
    let mut tables = Tables::default();
    for mount in &mounts {
        create_folder(&root.join("samples").join(channel(mount)))?;
        tables.push("sensor", json!({ "token": sensor(mount), "channel": channel(mount), "modality": "camera" }));
    }
    if let Some(shot) = shots.iter().find(|shot| mount_of(&mounts, shot).is_some()) {
        let k = shot.reported.pinhole;
        let matrix = json!([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]]);
        let row = |mount: &Mount| calibrated(&channel(mount), &vehicle_from_camera(mount), &matrix);
        tables.extend("calibrated_sensor", mounts.iter().map(row).collect());
    }
    if turns.iter().any(Option::is_some) {
        tables.push("sensor", json!({ "token": token(&["sensor", LIDAR]), "channel": LIDAR, "modality": "lidar" }));
        tables.push("calibrated_sensor", calibrated(LIDAR, &sweep::vehicle_from_sensor(), &json!([])));
    }
    objects::push_classes(&mut tables);
    let mut logs = Vec::new();
    for (done, (leg, samples)) in drives.iter().enumerate() {
        progress("nuscenes", done + 1, drives.len());
        logs.push(push_drive(&mut tables, &root, out, world, *leg, samples, &mounts)?);
    }
    let map = json!({ "token": token(&["map"]), "category": "semantic_prior", "filename": MAP, "log_tokens": logs });
    tables.push("map", map);
    create_folder(&root.join("maps"))?;
    image::GrayImage::new(1, 1).save(root.join(MAP)).map_err(|e| SaveError::new(&root.join(MAP), &e))?;
    tables.save(&root.join(VERSION))?;
    Ok(())
}

/// Adds the rows of a drive, copies its photos, and returns the token of its log.
fn push_drive(
    tables: &mut Tables,
    root: &Path,
    out: &Path,
    world: &World,
    leg: usize,
    samples: &[Sample],
    mounts: &[Mount],
) -> Result<String, SynthError> {
    let name = format!("scene-{leg:04}");
    let (scene, log) = (token(&["scene", &name]), token(&["log", &name]));
    let mut by_channel: BTreeMap<String, Vec<_>> = BTreeMap::new();
    for sample in samples {
        let time = sample.microseconds();
        let mut push = |channel: &str, file: String, format: &str, size: [u32; 2], vehicle: Rigid| {
            let ego = token(&["ego_pose", &file]);
            let translation = vehicle.translation.to_array();
            let rotation = quaternion(vehicle.rotation);
            let row = json!({ "token": ego, "timestamp": time, "translation": translation, "rotation": rotation });
            tables.push("ego_pose", row);
            by_channel.entry(channel.into()).or_default().push(json!({
                "token": token(&["sample_data", &file]), "sample_token": sample.token(), "ego_pose_token": ego,
                "calibrated_sensor_token": token(&["calibrated_sensor", channel]), "timestamp": time,
                "fileformat": format, "is_key_frame": true, "width": size[0], "height": size[1], "filename": file,
            }));
        };
        for shot in &sample.photos {
            let Some(mount) = mount_of(mounts, shot) else { continue };
            let file = format!("samples/{}/{}.png", channel(mount), shot.name);
            let from = out.join(format!("images/{}.png", shot.name));
            save(&root.join(&file), &fs::read(&from).map_err(|e| SaveError::new(&from, &e))?)?;
            let world_from_camera = shot.reported.camera_from_world.inverse();
            let vehicle = world_from_camera.after(&vehicle_from_camera(mount).inverse());
            let k = shot.reported.pinhole;
            push(&channel(mount), file, "png", [k.width, k.height], vehicle);
        }
        if let Some(turn) = sample.turn {
            let vehicle = sweep::world_from_vehicle(&turn.pose);
            push(LIDAR, sweep::file(sample.station), "pcd", [0, 0], vehicle);
        }
    }
    by_channel.into_values().for_each(|rows| tables.extend("sample_data", chained(rows)));
    let row =
        |sample: &Sample| json!({ "token": sample.token(), "timestamp": sample.microseconds(), "scene_token": scene });
    tables.extend("sample", chained(samples.iter().map(row).collect()));
    let objects: Vec<Vec<Object>> = samples.par_iter().map(|sample| around(world, sample)).collect();
    objects::push(tables, &Scene { name: &name, city: world.city(), samples, objects: &objects });
    let end = |sample: Option<&Sample>| sample.map_or(String::new(), Sample::token);
    tables.push(
        "scene",
        json!({
            "token": scene, "name": name, "description": "A drive through a generated city", "log_token": log,
            "nbr_samples": samples.len(), "first_sample_token": end(samples.first()), "last_sample_token": end(samples.last()),
        }),
    );
    tables.push(
        "log",
        json!({
            "token": log, "logfile": name, "vehicle": "generated", "date_captured": "1970-01-01", "location": "generated-city",
        }),
    );
    Ok(log)
}

/// The mount of the car's camera that took a shot; `None` for other cameras.
pub(super) fn mount_of<'a>(mounts: &'a [Mount], shot: &Shot) -> Option<&'a Mount> {
    let name = shot.sensor.strip_prefix("street-")?;
    mounts.iter().find(|mount| mount.name == name)
}

/// The name of a camera as nuScenes writes it: `CAM_BACK_LEFT` for `rear-left`.
fn channel(mount: &Mount) -> String {
    format!("CAM_{}", mount.name.replace("rear", "back").replace('-', "_").to_uppercase())
}

fn sensor(mount: &Mount) -> String {
    token(&["sensor", &channel(mount)])
}

fn calibrated(channel: &str, mounting: &Rigid, matrix: &serde_json::Value) -> serde_json::Value {
    json!({
        "token": token(&["calibrated_sensor", channel]), "sensor_token": token(&["sensor", channel]),
        "translation": mounting.translation.to_array(), "rotation": quaternion(mounting.rotation), "camera_intrinsic": matrix,
    })
}

/// A level camera: x right, y down, z ahead.
pub(super) fn vehicle_from_camera(mount: &Mount) -> Rigid {
    let ahead = DQuat::from_rotation_z(mount.yaw_degrees.to_radians()) * DVec3::X;
    let axes = DMat3::from_cols(ahead.cross(DVec3::Z), DVec3::NEG_Z, ahead);
    Rigid { rotation: DQuat::from_mat3(&axes).normalize(), translation: mount.offset }
}
