//! Names, reading and JSON of a model's files.

use std::fs;
use std::path::Path;

use scene::{BadInput, BlockId, CodecError};
use serde::Serialize;
use store::file::{SaveError, save};

pub(crate) const MANIFEST_FILE: &str = "model.json";
pub(crate) const PLAN_FILE: &str = "plan.plat";
pub(crate) const EXPOSURES_FILE: &str = "exposures.plat";
pub(crate) const POSES_FILE: &str = "poses.plat";
pub(crate) const CAMERAS_FILE: &str = "cameras.json";
/// What was found of each sensor.
pub(crate) const SENSORS_FILE: &str = "sensors.json";
pub(crate) const MERGED_FILE: &str = "merged.ply";
pub(crate) const OBJECTS_FOLDER: &str = "objects";
pub(crate) const PATHS_FILE: &str = "paths.json";

/// File name of a block's splats.
pub(crate) fn block_file(block: BlockId) -> String {
    format!("{}-{}-{}.plat", block.level, block.x, block.y)
}

/// Reads a file of the model.
pub(crate) fn load(path: &Path) -> Result<Vec<u8>, BadInput> {
    fs::read(path).map_err(|error| {
        BadInput::new(path.display().to_string(), format!("cannot be read ({error})"), "check the path")
    })
}

/// The error of a file whose bytes do not decode.
pub(crate) fn damaged(path: &Path, error: &CodecError) -> BadInput {
    BadInput::new(path.display().to_string(), error.to_string(), "restore the file or train the model again")
}

/// Writes indented JSON with a final newline.
///
/// # Errors
/// A file that cannot be written, or a value that JSON cannot hold.
pub fn save_json(path: &Path, value: &impl Serialize) -> Result<(), SaveError> {
    let mut text = serde_json::to_vec_pretty(value).map_err(|error| SaveError::new(path, &error))?;
    text.push(b'\n');
    save(path, &text)
}
