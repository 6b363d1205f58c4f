//! Finds the true depths, boxes and instances of captures that `plat synth --truth` wrote.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use scene::BadInput;
use serde_json::Value;

use super::files::{CaptureRoot, show};
use super::{nuscenes, waymo};

/// The manifest of a synthetic capture.
const MANIFEST: &str = "manifest.json";
/// Manifests of the largest cities have 20 kB.
const MANIFEST_BYTES: u64 = 1 << 20;
/// The folder of true depths, and that of true instances.
const DEPTH: &str = "depth";
const INSTANCE: &str = "instance";
/// The objects of each photo, and the cameras as they were.
const BOXES: [&str; 2] = ["boxes3d.json", "truth/transforms.json"];

/// The folder of a capture; `None` of a scene of nuScenes or a segment of Waymo, whose paths are no folders.
fn root_of(path: &Path) -> Result<Option<CaptureRoot>, BadInput> {
    let is_named = nuscenes::named_scene(path).is_some() || waymo::named_segment(path).is_some();
    if is_named { Ok(None) } else { CaptureRoot::new(path).map(Some) }
}

/// The manifest of a synthetic capture; `None` of other captures, whose manifests are no error.
fn manifest_of(root: &CaptureRoot) -> Result<Option<Value>, BadInput> {
    let Some(manifest) = root.file(MANIFEST) else { return Ok(None) };
    let mut bytes = Vec::new();
    let read = File::open(&manifest).and_then(|file| file.take(MANIFEST_BYTES).read_to_end(&mut bytes));
    read.map_err(|error| BadInput::new(show(&manifest), format!("cannot be read ({error})"), "check the file"))?;
    let manifest = serde_json::from_slice::<Value>(&bytes).ok();
    Ok(manifest.filter(|of| of["made_by"].as_str().is_some_and(|by| by.starts_with("plat "))))
}

/// The folder of the capture's true depths; `None` unless its manifest says that it has them.
///
/// # Errors
/// A path that is no capture, or a manifest that promises depths that are not there.
pub(crate) fn truth_folder(path: &Path) -> Result<Option<PathBuf>, BadInput> {
    folder_of(path, DEPTH)
}

/// The folder of the capture's true instances: for each photo NAME a NAME.png of 24-bit numbers, red first; `None` unless
/// its manifest says that it has them.
///
/// # Errors
/// A path that is no capture, or a manifest that promises instances that are not there.
pub(crate) fn truth_instances(path: &Path) -> Result<Option<PathBuf>, BadInput> {
    folder_of(path, INSTANCE)
}

fn folder_of(path: &Path, name: &str) -> Result<Option<PathBuf>, BadInput> {
    let Some(root) = root_of(path)? else { return Ok(None) };
    if manifest_of(&root)?.is_none_or(|manifest| manifest["settings"]["truth"] != Value::Bool(true)) {
        return Ok(None);
    }
    let folder = root.path(name).canonicalize().ok().filter(|folder| folder.is_dir());
    folder.filter(|folder| folder.starts_with(root.path(""))).map(Some).ok_or_else(|| {
        let problem = format!("has no folder {name}, which its {MANIFEST} says it has");
        BadInput::new(show(path), problem, "write the capture again with plat synth --truth")
    })
}

/// The files of the capture's true boxes and true cameras; `None` unless it is a complete synthetic capture that has
/// them.
///
/// # Errors
/// A path that is no capture.
pub(crate) fn truth_boxes(path: &Path) -> Result<Option<[PathBuf; 2]>, BadInput> {
    let Some(root) = root_of(path)? else { return Ok(None) };
    if manifest_of(&root)?.is_none_or(|manifest| manifest["complete"] != Value::Bool(true)) {
        return Ok(None);
    }
    let [boxes, cameras] = BOXES.map(|name| root.file(name));
    Ok(boxes.zip(cameras).map(|(boxes, cameras)| [boxes, cameras]))
}
