//! Writes the model folder of a finished plan.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use blocks::{ObjectTask, Plan};
use scene::objects::{self, Tracks};
use scene::poses::SensorError;
use scene::sensors::Sensors;
use scene::transforms::{self, Frame, Intrinsics, Transforms};
use scene::{ArtefactId, BlockId, Camera, CameraModel, Capture, Poses, Splats, Swing, frame, ply};
use serde::Serialize;
use store::BlockingStore;
use store::file::{AtomicFile, save};

use crate::error::{ModelError, cannot};
use crate::files::{
    CAMERAS_FILE, EXPOSURES_FILE, MANIFEST_FILE, MERGED_FILE, OBJECTS_FOLDER, PATHS_FILE, PLAN_FILE, POSES_FILE,
    SENSORS_FILE, block_file, save_json,
};
use crate::manifest::{BlockEntry, Manifest, VERSION};
use crate::read::read_block;
use crate::{ModelObject, ply_comments, swing_file};

/// Creates the model folder under `out` and writes the plan. First removes an older model's manifest, merged file and reports,
/// so that an interrupted write never passes for a model, nor old figures for those of this model.
pub(crate) fn begin(out: &Path, plan: &Plan) -> Result<PathBuf, ModelError> {
    let folder = out.join("model");
    if folder.join(MANIFEST_FILE).exists() {
        fs::remove_dir_all(&folder).map_err(cannot("replaced", &folder))?;
    }
    for file in [MERGED_FILE, CAMERAS_FILE, SENSORS_FILE, "report.json", "eval/report.json", "eval/sheet.png"]
        .map(|name| out.join(name))
    {
        if file.exists() {
            fs::remove_file(&file).map_err(cannot("replaced", &file))?;
        }
    }
    let objects = out.join(OBJECTS_FOLDER);
    if objects.join(PATHS_FILE).exists() {
        fs::remove_dir_all(&objects).map_err(cannot("replaced", &objects))?;
    }
    let blocks = folder.join("blocks");
    fs::create_dir_all(&blocks).map_err(cannot("made", &blocks))?;
    save(&folder.join(PLAN_FILE), &plan.to_frame())?;
    Ok(folder)
}

/// Sizes of a written model.
pub struct Written {
    /// Splats of the finest cut.
    pub splats: u64,
    /// Bytes of `merged.ply`.
    pub bytes: u64,
    /// Objects that move.
    pub objects: usize,
}

/// Writes the results of all tasks of a plan for this capture, in the plan's order, under `out`. Holds one block in memory at a time, as a model
/// may be larger than memory.
///
/// # Errors
/// A task without a result, a store that fails, a damaged result, a file that cannot be written.
pub fn write(
    out: &Path,
    plan: &Plan,
    results: &[ArtefactId],
    store: &BlockingStore,
    capture: &Capture,
    downscale: u32,
) -> Result<Written, ModelError> {
    let folder = begin(out, plan)?;
    let (leaves, sh_degree) = (plan.leaves(), plan.settings.sh_degree);
    let owned = |splats: &Splats, block| leaves.keep(splats, &plan.ground, block).with_sh_degree(sh_degree);

    let (mut blocks, mut exposures, mut poses) = (Vec::new(), None, None);
    let (mut count, mut attributes) = (0, BTreeSet::new());
    for (index, task) in plan.tasks.iter().enumerate() {
        let block = task.block;
        let artefact = *results.get(index).ok_or(ModelError::NoResult(block))?;
        let bytes = store.get(artefact)?;
        let decoded = frame::decode_result(&bytes);
        let (splats, about) = decoded.map_err(|error| ModelError::DamagedResult(block, error))?;
        exposures = exposures.or(about.exposures);
        poses = poses.or(about.poses);
        save(&folder.join("blocks").join(block_file(block)), &bytes)?;
        blocks.push(BlockEntry { block, artefact, splats: splats.len() as u64 });
        attributes.extend(splats.attribute_names());
        count += owned(&splats, block).len();
    }

    let attributes: Vec<String> = attributes.into_iter().collect();
    let bytes = write_merged(out, &folder, plan, count, &attributes)?;

    let objects = objects_of(plan, results, store, capture)?;
    save_objects(out, &objects, plan.settings.antialiased)?;
    if let Some(id) = exposures {
        save(&folder.join(EXPOSURES_FILE), &store.get(id)?)?;
    }
    if let Some(id) = poses {
        let bytes = store.get(id)?;
        let decoded = Poses::from_frame(&bytes).map_err(ModelError::DamagedPoses)?;
        save(&folder.join(POSES_FILE), &bytes)?;
        save(&out.join(CAMERAS_FILE), &cameras(capture, &decoded))?;
        if !decoded.sensors.is_empty() {
            save_json(&out.join(SENSORS_FILE), &sensors(capture, &decoded))?;
        }
    }
    let manifest = Manifest {
        version: VERSION,
        plan: plan.id(),
        antialiased: plan.settings.antialiased,
        sh_degree,
        geo_origin: capture.geo_origin,
        ground: plan.ground,
        test_every: plan.settings.test_every,
        test_stretches: plan.settings.test_stretches,
        downscale,
        exposures,
        poses,
        splats: count as u64,
        blocks,
    };
    save_json(&folder.join(MANIFEST_FILE), &manifest)?;
    Ok(Written { splats: count as u64, bytes, objects: objects.len() })
}

/// Writes `merged.ply` of `count` splats from the block files in `folder`, one block in memory at a time. Returns its bytes.
pub(crate) fn write_merged(
    out: &Path,
    folder: &Path,
    plan: &Plan,
    count: usize,
    attributes: &[String],
) -> Result<u64, ModelError> {
    let (leaves, sh_degree) = (plan.leaves(), plan.settings.sh_degree);
    let mut order: Vec<BlockId> = plan.tasks.iter().map(|task| task.block).collect();
    order.sort_unstable();
    let mut merged = AtomicFile::create(&out.join(MERGED_FILE))?;
    let header = ply::header(count, sh_degree, attributes, ply_comments(plan.settings.antialiased));
    merged.write(&header)?;
    let mut bytes = header.len() as u64;
    for block in order {
        let owned = leaves.keep(&read_block(folder, block)?, &plan.ground, block).with_sh_degree(sh_degree);
        let rows = ply::rows(&owned.with_attributes(attributes));
        merged.write(&rows)?;
        bytes += rows.len() as u64;
    }
    merged.commit()?;
    Ok(bytes)
}

/// The objects that move, of a plan that trains some. Where a job was cut short before them, there are none.
fn objects_of(
    plan: &Plan,
    results: &[ArtefactId],
    store: &BlockingStore,
    capture: &Capture,
) -> Result<Vec<ModelObject>, ModelError> {
    let results = results.get(plan.first_object()..).unwrap_or_default();
    let object = |(task, id): (&ObjectTask, &ArtefactId)| {
        let about = capture.objects.get(task.object as usize).ok_or(ModelError::NoObject(task.object))?;
        let decoded = objects::from_frame(&store.get(*id)?, about);
        let (about, splats, swing) = decoded.map_err(|error| ModelError::DamagedObject(about.id.clone(), error))?;
        Ok(ModelObject { about, splats, swing })
    };
    plan.object_tasks.iter().zip(results).map(object).collect()
}

/// Writes the splats of each object, in its own axes, and the paths of all; nothing without any.
pub(crate) fn save_objects(out: &Path, objects: &[ModelObject], antialiased: bool) -> Result<(), ModelError> {
    if objects.is_empty() {
        return Ok(());
    }
    let folder = out.join(OBJECTS_FOLDER);
    fs::create_dir_all(&folder).map_err(cannot("made", &folder))?;
    for ModelObject { about, splats, swing } in objects {
        save(&folder.join(format!("{}.ply", about.id)), &ply::write(splats, ply_comments(antialiased)))?;
        save_swing(&folder, &about.id, swing.as_ref())?;
    }
    // Last: objects without their paths are none.
    let objects = objects.iter().map(|object| object.about.clone()).collect();
    save(&folder.join(PATHS_FILE), &objects::write(&Tracks { objects, ..Tracks::default() }))?;
    Ok(())
}

/// Writes how the splats of an object swing, if they do; if not, removes what a run that was cut short left of another object of its name.
pub(crate) fn save_swing(folder: &Path, id: &str, swing: Option<&Swing>) -> Result<(), ModelError> {
    let path = folder.join(swing_file(id));
    match swing {
        Some(swing) => save(&path, &swing.to_frame())?,
        None if path.exists() => fs::remove_file(&path).map_err(cannot("replaced", &path))?,
        None => {}
    }
    Ok(())
}

/// What was found of each sensor, as people read it.
fn sensors(capture: &Capture, poses: &Poses) -> Vec<FoundSensor> {
    let Sensors { names, of_views } = scene::sensors::sensors(&capture.views);
    let found = |error: &SensorError| FoundSensor {
        sensor: names.get(error.sensor as usize).cloned().unwrap_or_default(),
        photos: of_views.iter().filter(|taken| taken.sensor == error.sensor).count(),
        clock_seconds: error.clock_seconds,
        shift_metres: error.shift.to_array(),
        turn_degrees: error.turn.to_array().map(f64::to_degrees),
        focal_factor: error.focal_factor,
    };
    poses.sensors.iter().map(found).collect()
}

/// An entry of `sensors.json`.
#[derive(Debug, Serialize)]
struct FoundSensor {
    /// What the names of its photos have in common.
    sensor: String,
    /// Number of its photos.
    photos: usize,
    /// Seconds that the photos were taken after the times of their poses.
    clock_seconds: f64,
    /// Where the camera is in the axes of the given one (x right, y down, z ahead).
    shift_metres: [f64; 3],
    /// Rotation vector of the camera in the axes of the given one.
    turn_degrees: [f64; 3],
    /// What the given focal lengths are multiplied by.
    focal_factor: f64,
}

/// A `transforms.json` of the views that have a refined camera, with the names of the capture's views as paths.
fn cameras(capture: &Capture, poses: &Poses) -> Vec<u8> {
    let frame = |(number, _): (u32, _)| {
        let view = capture.views.get(number as usize)?;
        let Camera { pinhole: k, camera_from_world } = poses.apply(number, view.camera);
        let lens = CameraModel::Pinhole([k.fx, k.fy, k.cx, k.cy]);
        let intrinsics = Intrinsics::from_model(&lens, Some((k.width, k.height)));
        Some(Frame {
            file_path: view.name.clone(),
            mask_path: None,
            depth_file_path: None,
            intrinsics,
            camera_from_world,
        })
    };
    transforms::write(&Transforms { frames: poses.iter().filter_map(frame).collect(), ply_file_path: None })
}
