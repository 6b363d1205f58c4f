//! Parses a scene of nuScenes: photos of all cameras, sweeps of the lidar, and boxes of objects.
//!
//! ```text
//! v1.0-VERSION/*.json                   tables (see `scene::nuscenes`)
//! samples/CHANNEL/*.jpg, *.pcd.bin      as sample_data says: key frames
//! sweeps/CHANNEL/*.jpg, *.pcd.bin       as sample_data says: data between them; optional
//! ```
//!
//! Each scene is a capture. Of a data set with several, one is named after its folder: `FOLDER/scene-0061`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use scene::nuscenes::{self, CalibratedSensor, Datum};
use scene::transforms::Intrinsics;
use scene::{BadInput, Rigid};

use self::boxes::Boxes;
use self::tables::Tables;
use super::files::{CaptureRoot, Found, listed};
use super::parsed::{OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::PointFormat;

mod boxes;
mod tables;

/// A photo belongs to the sweep nearest in time, within this.
const SAME_MICROSECONDS: u64 = 100_000;

/// The folder of a data set and the name of a scene, if the path is `FOLDER/SCENE`, which is no folder itself.
pub(super) fn named_scene(path: &Path) -> Option<(&Path, &str)> {
    let (folder, scene) = (path.parent()?, path.file_name()?.to_str()?);
    let root = CaptureRoot::new(folder).ok().filter(|_| !path.exists())?;
    (!versions(&root).is_empty()).then_some((folder, scene))
}

/// Whether there is a data set.
pub(super) fn is_present(root: &CaptureRoot) -> bool {
    !versions(root).is_empty()
}

/// Folders of tables, sorted.
fn versions(root: &CaptureRoot) -> Vec<String> {
    let entries = root.path("").read_dir().into_iter().flatten();
    let mut names: Vec<String> = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).collect();
    names.retain(|name| name.starts_with("v1.0-") && root.file(&format!("{name}/scene.json")).is_some());
    names.sort();
    names
}

/// Parses the scene of this name, or the only one.
pub(super) fn read(root: &CaptureRoot, scene: Option<&str>, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let (tables, scene) = choose(root, scene)?;
    let samples = tables.read("sample", |bytes| nuscenes::read_samples(bytes, &scene))?;
    let data = tables.read("sample_data", |bytes| nuscenes::read_data(bytes, &samples))?;
    let wanted: BTreeSet<&str> = data.iter().map(|datum| datum.ego_pose.as_str()).collect();
    let vehicles = tables.read("ego_pose", |bytes| nuscenes::read_ego_poses(bytes, &wanted))?;
    let mounted = tables.read("calibrated_sensor", nuscenes::read_calibrated_sensors)?;
    let modalities = tables.read("sensor", nuscenes::read_modalities)?;
    let boxes = Boxes::read(&tables, &samples)?;

    let (mut images, mut times, mut sweeps) = (Vec::new(), Vec::new(), Vec::new());
    for datum in &data {
        let sensor = tables.row(&mounted, "sample_data", "calibrated_sensor", &datum.calibrated_sensor)?;
        let modality = tables.row(&modalities, "calibrated_sensor", "sensor", &sensor.sensor)?;
        let vehicle = tables.row(&vehicles, "sample_data", "ego_pose", &datum.ego_pose)?;
        let world_from_sensor = vehicle.after(&sensor.vehicle_from_sensor);
        match modality.as_str() {
            "camera" => {
                // Data sets are often shared without the photos between key frames.
                if !datum.is_key_frame && root.file(&datum.file).is_none() && !options.cameras_only {
                    continue;
                }
                times.push(datum.microseconds);
                images.push(image(&tables, images.len() as u32, datum, sensor, &world_from_sensor, &boxes)?);
            }
            "lidar" if options.lidar => {
                if let Found::File(path) = root.image(&datum.file)? {
                    let (format, images) = (PointFormat::Floats(5), Vec::new());
                    sweeps.push((
                        datum.microseconds,
                        ParsedSweep { path, format, world_from_sensor, turn: None, images },
                    ));
                }
            }
            _ => {}
        }
    }
    if images.is_empty() {
        return Err(tables.bad("sample_data", format!("has no photo of the scene {scene:.40}")));
    }
    assign(&times, &mut sweeps);
    if !sweeps.is_empty() && sweeps.iter().all(|(_, sweep)| sweep.images.is_empty()) {
        let problem = "has no sweep within 0.1 s of a photo, so that its timestamps cannot be right";
        return Err(tables.bad("sample_data", problem.into()));
    }
    Ok(ParsedCapture {
        objects: boxes.tracks.objects(),
        labels: boxes.labels,
        sweeps: sweeps.into_iter().map(|(_, sweep)| sweep).collect(),
        ..ParsedCapture::new("nuscenes", images, RawPoints::default())
    })
}

/// The tables that hold a scene, and its token.
fn choose<'a>(root: &'a CaptureRoot, wanted: Option<&str>) -> Result<(Tables<'a>, String), BadInput> {
    let mut scenes: BTreeMap<String, (String, String)> = BTreeMap::new();
    for version in versions(root) {
        let tables = Tables { root, version };
        for (token, name) in tables.read("scene", nuscenes::read_names)? {
            scenes.entry(name).or_insert((tables.version.clone(), token));
        }
    }
    let names: Vec<&str> = scenes.keys().map(String::as_str).collect();
    let listed = listed(names.iter());
    let chosen = match (wanted, names.as_slice()) {
        (_, []) => return Err(BadInput::new(root.to_string(), "has no scene", "download the data set again")),
        (Some(name), _) => name,
        (None, [only]) => only,
        (None, [first, ..]) => {
            let problem = format!("has {} scenes, each a capture of its own: {listed}", names.len());
            return Err(BadInput::new(root.to_string(), problem, format!("name one, as in {root}/{first:.40}")));
        }
    };
    let Some((version, token)) = scenes.get(chosen) else {
        let problem = format!("has no scene {chosen:.100}");
        return Err(BadInput::new(root.to_string(), problem, format!("name one that it has: {listed}")));
    };
    Ok((Tables { root, version: version.clone() }, token.clone()))
}

fn image(
    tables: &Tables,
    id: u32,
    datum: &Datum,
    sensor: &CalibratedSensor,
    world_from_sensor: &Rigid,
    boxes: &Boxes,
) -> Result<PosedImage, BadInput> {
    let Some(model) = &sensor.lens else {
        return Err(tables.bad("calibrated_sensor", format!("has a camera without intrinsics, of {:.100}", datum.file)));
    };
    let camera_from_world = world_from_sensor.inverse();
    let size = Some(datum.size).filter(|(width, height)| *width > 0 && *height > 0);
    Ok(PosedImage {
        row: None,
        id,
        name: datum.file.clone(),
        file: datum.file.clone(),
        depth: None,
        mask: None,
        intrinsics: Intrinsics::from_model(model, size),
        camera_from_world,
        boxes: boxes.tracks.seen(datum.microseconds, &camera_from_world, model, size),
        seconds: boxes.tracks.seconds(datum.microseconds),
    })
}

/// Gives each photo to the sweep nearest in time. Both are sorted by time.
fn assign(times: &[i64], sweeps: &mut [(i64, ParsedSweep)]) {
    for (id, &time) in (0..).zip(times) {
        let after = sweeps.partition_point(|(other, _)| *other < time);
        let near = sweeps[after.saturating_sub(1)..].iter_mut().take(2);
        let nearest = near.min_by_key(|(other, _)| other.abs_diff(time));
        if let Some((_, sweep)) = nearest.filter(|(other, _)| other.abs_diff(time) <= SAME_MICROSECONDS) {
            sweep.images.push(id);
        }
    }
}
