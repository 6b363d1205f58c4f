//! `manifest.json`: the settings of a synthetic capture and, once it is complete, its contents.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use city::{City, Class};
use scene::BadInput;
use serde_json::{Value, json};
use store::file::{SaveError, save};

use super::output::create_folder;
use super::settings::{Settings, Summary, SynthError};

const NAME: &str = "manifest.json";
/// All folders of a synthetic capture.
const FOLDERS: [&str; 16] = [
    "images",
    "masks",
    "sparse",
    "truth",
    "depth",
    "normals",
    "semantic",
    "instance",
    "material",
    "behind",
    "lidar",
    "radar",
    "occupancy",
    "kitti_raw",
    "nuscenes",
    "waymo",
];
/// All files of a synthetic capture except the manifest.
const FILES: [&str; 6] =
    ["transforms.json", "sparse_pc.ply", "reference_lla.json", "tracks.json", "boxes3d.json", "city.glb"];

/// Creates the folder and an incomplete manifest in it. A folder with other contents is refused: no other file is overwritten,
/// and no photo of another city remains between the new ones.
pub(super) fn begin(out: &Path, settings: &Settings) -> Result<(), SynthError> {
    create_folder(out)?;
    let is_empty = fs::read_dir(out).map_err(|e| SaveError::new(out, &e))?.next().is_none();
    if !is_empty && existing_settings(out) != Some(json!(settings)) {
        let problem = "is not empty, and holds no synthetic capture of the same settings";
        return Err(BadInput::new(out.display().to_string(), problem, "give another folder, or empty it").into());
    }
    write(out, &json!({ "complete": false, "settings": settings }))?;
    Ok(())
}

/// Removes the files of a synthetic capture of other settings, and nothing else.
pub(super) fn remove_other(out: &Path, settings: &Settings) -> Result<(), SaveError> {
    if existing_settings(out).is_none_or(|made| made == json!(settings)) {
        return Ok(());
    }
    let ignore_missing = |path: &Path, removed: std::io::Result<()>| match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(SaveError::new(path, &error)),
        _ => Ok(()),
    };
    for name in FOLDERS {
        let path = out.join(name);
        ignore_missing(&path, fs::remove_dir_all(&path))?;
    }
    // The manifest last: an interrupted removal can then be repeated.
    for name in FILES.into_iter().chain([NAME]) {
        let path = out.join(name);
        ignore_missing(&path, fs::remove_file(&path))?;
    }
    Ok(())
}

/// The settings in the folder's manifest.
fn existing_settings(out: &Path) -> Option<Value> {
    let text = fs::read(out.join(NAME)).ok()?;
    serde_json::from_slice::<Value>(&text).ok()?.get("settings").cloned()
}

/// Writes the complete manifest, with the classes and materials of label images.
pub(super) fn complete(out: &Path, settings: &Settings, city: &City, summary: &Summary) -> Result<(), SaveError> {
    let classes: Vec<Value> =
        (0..=u8::MAX).filter_map(|row| Some(json!({ "id": row, "name": class_name(row)? }))).collect();
    let manifest = json!({
        "complete": true,
        "made_by": concat!("plat ", env!("CARGO_PKG_VERSION")),
        "settings": settings,
        "summary": summary,
        "world": "metres, x east, y north, z up; the city is centred on the origin, which reference_lla.json places",
        "cameras": "OpenCV axes (x right, y down, z ahead); sparse/0 and transforms.json are as reported, truth/ as it was",
        "classes": classes,
        "materials": city.materials,
    });
    write(out, &manifest)
}

fn write(out: &Path, manifest: &Value) -> Result<(), SaveError> {
    let text = serde_json::to_string_pretty(manifest).expect("plain data") + "\n";
    save(&out.join(NAME), text.as_bytes())
}

/// The name of the class with this value in label images.
fn class_name(row: u8) -> Option<String> {
    let class = Class::ALL.iter().find(|class| **class as u8 == row)?;
    json!(class).as_str().map(str::to_owned)
}
