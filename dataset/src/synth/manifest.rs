//! `manifest.json`: what a folder was made with, and, once all is there, what is in it.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use city::{City, Class};
use scene::BadInput;
use serde_json::{Value, json};
use store::file::{SaveError, save};

use super::{Settings, Summary, SynthError, make};

const NAME: &str = "manifest.json";
/// Everything else that a rehearsal writes.
const FOLDERS: [&str; 13] = [
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
];
/// See [`FOLDERS`].
const FILES: [&str; 6] =
    ["transforms.json", "sparse_pc.ply", "reference_lla.json", "tracks.json", "boxes3d.json", "city.glb"];

/// Makes the folder, and says in it what is being made. A folder that has anything else in it is refused: nothing of
/// anybody's is overwritten, and no photo of another city stays between the new ones.
pub(super) fn claim(out: &Path, settings: &Settings) -> Result<(), SynthError> {
    make(out)?;
    let is_empty = fs::read_dir(out).map_err(|e| SaveError::new(out, &e))?.next().is_none();
    if !is_empty && made_with(out) != Some(json!(settings)) {
        let problem = "is not empty, and holds no rehearsal of the same settings";
        return Err(BadInput::new(out.display().to_string(), problem, "give another folder, or empty it").into());
    }
    put(out, &json!({ "complete": false, "settings": settings }))?;
    Ok(())
}

/// Removes what a rehearsal of other settings left, and nothing else.
pub(super) fn forget(out: &Path, settings: &Settings) -> Result<(), SaveError> {
    if made_with(out).is_none_or(|made| made == json!(settings)) {
        return Ok(());
    }
    let gone = |path: &Path, done: std::io::Result<()>| match done {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(SaveError::new(path, &error)),
        _ => Ok(()),
    };
    for name in FOLDERS {
        let path = out.join(name);
        gone(&path, fs::remove_dir_all(&path))?;
    }
    // The manifest last: until then what is left is a rehearsal's.
    for name in FILES.into_iter().chain([NAME]) {
        let path = out.join(name);
        gone(&path, fs::remove_file(&path))?;
    }
    Ok(())
}

/// The settings of the rehearsal that a folder holds.
fn made_with(out: &Path) -> Option<Value> {
    let text = fs::read(out.join(NAME)).ok()?;
    serde_json::from_slice::<Value>(&text).ok()?.get("settings").cloned()
}

/// Says that all is there, and what numbers in label images mean.
pub(super) fn complete(out: &Path, settings: &Settings, city: &City, summary: &Summary) -> Result<(), SaveError> {
    let classes: Vec<Value> = (0..=u8::MAX).filter_map(|row| Some(json!({ "id": row, "name": class(row)? }))).collect();
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
    put(out, &manifest)
}

fn put(out: &Path, manifest: &Value) -> Result<(), SaveError> {
    let text = serde_json::to_string_pretty(manifest).expect("plain data") + "\n";
    save(&out.join(NAME), text.as_bytes())
}

/// The name of the class that a label image shows as this number.
fn class(row: u8) -> Option<String> {
    let class = Class::ALL.iter().find(|class| **class as u8 == row)?;
    json!(class).as_str().map(str::to_owned)
}
