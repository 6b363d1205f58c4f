//! Writes lidar and radar sweeps of the cars at each station: readings in the formats of KITTI, with ground truth beside them.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::Waypoint;
use city::faults;
use city::sense::lidar::{Lidar, Return};
use city::sense::radar::{Detection, Radar};
use city::sense::rig::{Mount, sensor_pose_at};
use city::sense::{Motion, SenseError};
use city::trace::World;
use rayon::prelude::*;
use scene::{Rigid, npy};
use serde_json::json;
use store::file::{SaveError, save};

use super::kitti_raw;
use super::lidar_turn::LidarTurn;
use super::nuscenes;
use super::output::create_folder;
use super::settings::{Progress, Settings, SynthError, unsupported};
use super::shots::Station;

/// Writes `lidar/` and `radar/`, as far as the settings enable them, and returns the turns of the lidar by station.
pub(super) fn write(
    out: &Path,
    world: &World,
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    settings: &Settings,
    progress: Progress,
) -> Result<Vec<Option<LidarTurn>>, SynthError> {
    let seed = settings.city.seed;
    let mut turns = Vec::new();
    if settings.lidar {
        if settings.nuscenes {
            create_folder(&out.join(nuscenes::FOLDER).join("samples").join(nuscenes::LIDAR))?;
        }
        let lidar = Lidar { seed, ..Lidar::default() };
        let lidar_sweep = |station: &Station, pose: &Rigid, motion: &Motion, folder: &Path| {
            let sweep = lidar.sweep(world, pose, motion, station.seconds, &settings.faults);
            let sweep = sweep.map_err(|e: SenseError| unsupported(&e))?;
            let returns: Vec<&Return> = sweep.returns.iter().filter(|point| !point.lost).collect();
            save_points(folder, station, &returns)?;
            if settings.nuscenes {
                nuscenes::save_sweep(&out.join(nuscenes::FOLDER), station, pose, motion, &returns)?;
            }
            if settings.kitti_raw {
                kitti_raw::save_sweep(out, station, pose, motion, &returns)?;
            }
            let mut hits = BTreeMap::new();
            returns.iter().for_each(|found| *hits.entry(found.instance).or_default() += 1);
            Ok::<_, SynthError>((returns.len(), LidarTurn { pose: *pose, hits }))
        };
        let turn_seconds = 1.0 / lidar.turns_per_second;
        turns = run_sensor(
            "lidar",
            &lidar.mount,
            Some(turn_seconds),
            out,
            legs,
            stations,
            settings,
            progress,
            &lidar_sweep,
        )?;
    }
    if settings.radar {
        let radar = Radar { seed, ..Radar::default() };
        let radar_sweep = |station: &Station, pose: &Rigid, motion: &Motion, folder: &Path| {
            let found = radar.sweep(&world.at(station.seconds), pose, motion, &settings.faults);
            let found = found.map_err(|e: SenseError| unsupported(&e))?;
            save(&folder.join(format!("{}.csv", station.name)), radar_csv(&found).as_bytes())?;
            Ok((found.len(), ()))
        };
        run_sensor("radar", &radar.mount, None, out, legs, stations, settings, progress, &radar_sweep)?;
    }
    Ok(turns)
}

/// Measures at a station, writes the readings into a folder, and returns their number and what is kept of them.
type Measure<'a, T> = &'a (dyn Fn(&Station, &Rigid, &Motion, &Path) -> Result<(usize, T), SynthError> + Sync);

/// Measures at all stations where the sensor has not dropped out, writes its poses to `poses.jsonl`, and returns what is kept by
/// station.
fn run_sensor<T: Send>(
    sensor: &'static str,
    mount: &Mount,
    turn_seconds: Option<f64>,
    out: &Path,
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    settings: &Settings,
    progress: Progress,
    measure: Measure<T>,
) -> Result<Vec<Option<T>>, SynthError> {
    let folder = out.join(sensor);
    create_folder(&folder)?;
    let done = AtomicUsize::new(0);
    let one = |station: &Station| -> Result<Option<(String, T)>, SynthError> {
        progress(sensor, done.fetch_add(1, Ordering::Relaxed) + 1, stations.len());
        let pose = legs.get(station.leg).and_then(|leg| sensor_pose_at(leg, mount, station.seconds));
        let Some((pose, motion)) = pose.filter(|_| !faults::is_dropped_out(&settings.faults, sensor, station.seconds))
        else {
            return Ok(None);
        };
        let (readings, kept) = measure(station, &pose, &motion, &folder)?;
        let line = json!({
            "name": station.name,
            "seconds": station.seconds,
            "world_from_sensor": pose,
            "velocity": motion.velocity,
            "spin": motion.spin,
            "height": mount.offset.z,
            "readings": readings,
            "photos": station.photos,
            "turn_seconds": turn_seconds.unwrap_or(0.0),
        });
        Ok(Some((format!("{line}\n"), kept)))
    };
    // All results first, then the first error in station order, whichever thread is faster.
    let lines: Vec<_> = stations.par_iter().map(one).collect();
    let (mut poses, mut all) = (String::new(), Vec::new());
    for line in lines {
        all.push(line?.map(|(line, kept)| {
            poses += &line;
            kept
        }));
    }
    save(&folder.join("poses.jsonl"), poses.as_bytes())?;
    Ok(all)
}

fn save_points(folder: &Path, station: &Station, returns: &[&Return]) -> Result<(), SaveError> {
    let (mut points, mut labels, mut truth) = (Vec::new(), Vec::new(), Vec::new());
    for point in returns {
        let position = point.direction * point.range;
        position.to_array().into_iter().chain([point.intensity]).for_each(|value| points.extend(value.to_le_bytes()));
        labels.extend((point.class as u32 | (point.instance & 0xFFFF) << 16).to_le_bytes());
        truth.extend(point.point.to_array());
        let through_glass = f64::from(u8::from(point.through_glass));
        let delay = point.seconds - station.seconds;
        truth.extend([point.true_range, f64::from(point.true_intensity), delay, through_glass]);
    }
    let path = |extension: &str| folder.join(format!("{}.{extension}", station.name));
    save(&path("bin"), &points)?;
    save(&path("label"), &labels)?;
    save(&path("npy"), &npy::write(&[returns.len(), 7], &truth))
}

fn radar_csv(found: &[Detection]) -> String {
    let mut text = String::from(
        "range,azimuth,velocity,power,ghost,true_range,true_azimuth,true_velocity,x,y,z,class,instance,material\n",
    );
    for d in found {
        let (ghost, class, p) = (u8::from(d.ghost), d.class as u8, d.point);
        let row = writeln!(
            text,
            "{},{},{},{},{ghost},{},{},{},{},{},{},{class},{},{}",
            d.range,
            d.azimuth,
            d.velocity,
            d.power,
            d.true_range,
            d.true_azimuth,
            d.true_velocity,
            p.x,
            p.y,
            p.z,
            d.instance,
            d.material,
        );
        row.expect("writing to a string cannot fail");
    }
    text
}
