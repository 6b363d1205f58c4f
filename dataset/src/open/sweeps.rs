//! Finds the sweeps of a lidar and of a radar beside a capture of any format:
//!
//! ```text
//! lidar/poses.jsonl      a line per sweep (see `scene::lidar`)
//! lidar/NAME.bin         its points, four f32 each: x ahead, y left, z up in metres, intensity
//! radar/poses.jsonl      a line per sweep, which must have the velocity of the sensor and its height
//! radar/NAME.csv         its detections (see `crate::radar`)
//! ```

use std::collections::BTreeMap;
use std::path::PathBuf;

use glam::DVec3;
use rayon::prelude::*;
use scene::lidar::{self, SweepPose};
use scene::{BadInput, View};

use super::files::{self, CaptureRoot, Found, stem};
use super::parsed::{ParsedSweep, PosedImage};
use crate::lidar::{PointFormat, Sweep};
use crate::radar::RadarSweep;

/// The largest file of poses.
const MAX_POSES_BYTES: u64 = 1 << 30;
/// A sweep that does not name its photos was taken at the time of those within this distance of the sensor, metres.
const OWN_METRES: f64 = 2.5;
/// A radar looks ahead: its z axis has at least this part of the world's, as no road is steeper.
const LEAST_UP: f64 = 0.7;

/// The sweeps of the capture's lidar, in the file's order; none if it has no such file.
pub(super) fn of_lidar(root: &CaptureRoot, views: &[View]) -> Result<Vec<Sweep>, BadInput> {
    let sweep = |Listed { pose, path, views }| Sweep {
        path,
        format: PointFormat::Floats(4),
        readings: pose.readings,
        world_from_sensor: pose.world_from_sensor,
        turn: pose.turn(),
        views,
    };
    Ok(listed(root, "lidar", "bin", views)?.into_iter().map(sweep).collect())
}

/// The sweeps of the capture's radar, in the file's order; none if it has no such file.
pub(super) fn of_radar(root: &CaptureRoot, views: &[View]) -> Result<Vec<RadarSweep>, BadInput> {
    let sweep = |Listed { pose, path, views }| {
        let SweepPose { name, readings, world_from_sensor, .. } = pose;
        let lacks = |key: &str| {
            let advice = "add it to the line of the sweep in radar/poses.jsonl, or remove the folder";
            BadInput::new(format!("radar sweep {name}"), format!("does not have the key {key}"), advice)
        };
        let velocity = pose.velocity.ok_or_else(|| lacks("velocity"))?;
        let height = pose.height.ok_or_else(|| lacks("height"))?;
        if (world_from_sensor.rotation * DVec3::Z).z < LEAST_UP {
            let advice = "turn the capture, or remove the folder radar";
            let problem = "does not stand upright: the z axis of a capture with a radar must point up";
            return Err(BadInput::new(format!("radar sweep {name}"), problem, advice));
        }
        Ok(RadarSweep { path, readings, world_from_sensor, velocity, height, views })
    };
    listed(root, "radar", "csv", views)?.into_iter().map(sweep).collect()
}

/// A line of a file of poses.
struct Listed {
    pose: SweepPose,
    /// Canonical path of its readings, inside the capture.
    path: PathBuf,
    /// The views taken during the sweep, ascending.
    views: Vec<u32>,
}

/// What `SENSOR/poses.jsonl` lists.
fn listed(root: &CaptureRoot, sensor: &str, extension: &str, views: &[View]) -> Result<Vec<Listed>, BadInput> {
    let Some(path) = root.file(&format!("{sensor}/poses.jsonl")) else { return Ok(Vec::new()) };
    let bad = |problem: String, advice: &str| BadInput::new(files::show(&path), problem, advice);
    if path.metadata().is_ok_and(|data| data.len() > MAX_POSES_BYTES) {
        return Err(bad("is too large for poses".into(), "correct or remove the file"));
    }
    let poses =
        lidar::read_poses(&files::read(&path)?).map_err(|e| bad(e.to_string(), "correct or remove the file"))?;
    let index: BTreeMap<&str, u32> = views.iter().map(|view| stem(&view.name)).zip(0..).collect();
    let sweep = |pose: SweepPose| -> Result<Listed, BadInput> {
        let name = format!("{sensor}/{}.{extension}", pose.name);
        let Found::File(readings) = root.image(&name)? else {
            return Err(bad(format!("names the sweep {name}, which is not there"), "put the file there"));
        };
        let origin = pose.world_from_sensor.translation;
        let mut taken: Vec<u32> = match &pose.photos {
            Some(photos) => photos.iter().filter_map(|name| index.get(stem(name)).copied()).collect(),
            None => {
                let is_near = |view: &View| view.camera.centre().distance(origin) <= OWN_METRES;
                (0..).zip(views).filter(|(_, view)| is_near(view)).map(|(i, _)| i).collect()
            }
        };
        taken.sort_unstable();
        taken.dedup();
        Ok(Listed { pose, path: readings, views: taken })
    };
    let sweeps: Vec<_> = poses.into_par_iter().map(sweep).collect();
    let sweeps = sweeps.into_iter().collect::<Result<Vec<_>, _>>()?;
    if !sweeps.is_empty() && sweeps.iter().all(|sweep| sweep.views.is_empty()) {
        let problem = "has no sweep that was taken with one of the capture's photos";
        return Err(bad(problem.into(), "correct the names of photos in it, or remove the folder"));
    }
    Ok(sweeps)
}

/// The sweeps that a reader parsed; `images` are those of the views, in order.
pub(super) fn with_views(parsed: Vec<ParsedSweep>, images: &[PosedImage]) -> Vec<Sweep> {
    let index: BTreeMap<u32, u32> = images.iter().map(|image| image.id).zip(0..).collect();
    let sweep = |sweep: ParsedSweep| {
        let ParsedSweep { path, format, world_from_sensor, turn, images } = sweep;
        let mut views: Vec<u32> = images.iter().filter_map(|id| index.get(id).copied()).collect();
        views.sort_unstable();
        Sweep { path, format, readings: None, world_from_sensor, turn, views }
    };
    parsed.into_iter().map(sweep).collect()
}
