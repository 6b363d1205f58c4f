//! What the cars' lidar and radar measure, wherever a photo of theirs is kept: readings in the formats of KITTI, the truth
//! beside them.

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

use super::views::Station;
use super::{Progress, Settings, SynthError, impossible, make};

/// Writes `lidar/` and `radar/`, as far as they are asked for.
pub(super) fn write(
    out: &Path,
    world: &World,
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    settings: &Settings,
    progress: Progress,
) -> Result<(), SynthError> {
    let seed = settings.city.seed;
    if settings.lidar {
        let lidar = Lidar { seed, ..Lidar::default() };
        let turn = |station: &Station, pose: &Rigid, motion: &Motion, folder: &Path| {
            let sweep = lidar.sweep(world, pose, motion, station.seconds, &settings.faults);
            let sweep = sweep.map_err(|e: SenseError| impossible(&e))?;
            let read: Vec<&Return> = sweep.returns.iter().filter(|point| !point.lost).collect();
            save_points(folder, station, &read)?;
            Ok::<_, SynthError>(read.len())
        };
        sense("lidar", &lidar.mount, out, legs, stations, settings, progress, &turn)?;
    }
    if settings.radar {
        let radar = Radar { seed, ..Radar::default() };
        let look = |station: &Station, pose: &Rigid, motion: &Motion, folder: &Path| {
            let found = radar.sweep(&world.at(station.seconds), pose, motion, &settings.faults);
            let found = found.map_err(|e: SenseError| impossible(&e))?;
            save(&folder.join(format!("{}.csv", station.name)), table(&found).as_bytes())?;
            Ok(found.len())
        };
        sense("radar", &radar.mount, out, legs, stations, settings, progress, &look)?;
    }
    Ok(())
}

/// Measures at a station, writes what was measured into a folder, and says how much it was.
type Measure<'a> = &'a (dyn Fn(&Station, &Rigid, &Motion, &Path) -> Result<usize, SynthError> + Sync);

/// Measures at all stations where the sensor is not silent, and writes when and where that was.
fn sense(
    what: &'static str,
    mount: &Mount,
    out: &Path,
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    settings: &Settings,
    progress: Progress,
    measure: Measure,
) -> Result<(), SynthError> {
    let folder = out.join(what);
    make(&folder)?;
    let done = AtomicUsize::new(0);
    let one = |station: &Station| -> Result<Option<String>, SynthError> {
        progress(what, done.fetch_add(1, Ordering::Relaxed) + 1, stations.len());
        let place = legs.get(station.leg).and_then(|leg| sensor_pose_at(leg, mount, station.seconds));
        let Some((pose, motion)) = place.filter(|_| !faults::is_dropped_out(&settings.faults, what, station.seconds)) else {
            return Ok(None);
        };
        let readings = measure(station, &pose, &motion, &folder)?;
        let line = json!({
            "name": station.name,
            "seconds": station.seconds,
            "world_from_sensor": pose,
            "velocity": motion.velocity,
            "spin": motion.spin,
            "readings": readings,
        });
        Ok(Some(format!("{line}\n")))
    };
    // all of them first, then the first failure in their order, whichever thread is faster
    let lines: Vec<_> = stations.par_iter().map(one).collect();
    let mut poses = String::new();
    for line in lines {
        poses.extend(line?);
    }
    save(&folder.join("poses.jsonl"), poses.as_bytes())?;
    Ok(())
}

fn save_points(folder: &Path, station: &Station, read: &[&Return]) -> Result<(), SaveError> {
    let (mut points, mut labels, mut truth) = (Vec::new(), Vec::new(), Vec::new());
    for point in read {
        let place = point.direction * point.range;
        place.to_array().into_iter().chain([point.intensity]).for_each(|value| points.extend(value.to_le_bytes()));
        labels.extend((point.class as u32 | (point.instance & 0xFFFF) << 16).to_le_bytes());
        truth.extend(point.point.to_array());
        let through_glass = f64::from(u8::from(point.through_glass));
        let after = point.seconds - station.seconds;
        truth.extend([point.true_range, f64::from(point.true_intensity), after, through_glass]);
    }
    let path = |extension: &str| folder.join(format!("{}.{extension}", station.name));
    save(&path("bin"), &points)?;
    save(&path("label"), &labels)?;
    save(&path("npy"), &npy::write(&[read.len(), 7], &truth))
}

fn table(found: &[Detection]) -> String {
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
        row.expect("a string takes all");
    }
    text
}
