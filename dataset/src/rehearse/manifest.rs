//! `manifest.json`: what a folder was made with, and, once all is there, what is in it.

use std::fs;
use std::path::Path;

use city::{City, Class};
use scene::BadInput;
use serde_json::{Value, json};
use store::file::{SaveError, save};

use super::{RehearseError, Settings, Summary, make};

const NAME: &str = "manifest.json";

/// Makes the folder, and says in it what is being made. A folder that has anything else in it is refused: nothing of
/// anybody's is overwritten, and no photo of another city stays between the new ones.
pub(super) fn claim(out: &Path, settings: &Settings) -> Result<(), RehearseError> {
    make(out)?;
    let is_empty = fs::read_dir(out).map_err(|e| SaveError::new(out, &e))?.next().is_none();
    let own = || -> Option<Value> {
        let text = fs::read(out.join(NAME)).ok()?;
        serde_json::from_slice::<Value>(&text).ok()?.get("settings").cloned()
    };
    if !is_empty && own() != Some(json!(settings)) {
        let problem = "is not empty, and holds no rehearsal of the same settings";
        return Err(BadInput::new(out.display().to_string(), problem, "give another folder, or empty it").into());
    }
    put(out, &json!({ "complete": false, "settings": settings }))?;
    Ok(())
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
