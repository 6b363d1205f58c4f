//! Finds the true depths of captures that `plat synth --truth` wrote.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use scene::BadInput;
use serde_json::Value;

use super::files::{CaptureRoot, show};

/// The manifest of a synthetic capture.
const MANIFEST: &str = "manifest.json";
/// Manifests of the largest cities have 20 kB.
const MANIFEST_BYTES: u64 = 1 << 20;
/// The folder of true depths.
const DEPTH: &str = "depth";

/// The folder of the capture's true depths; `None` unless its manifest says that it has them.
///
/// # Errors
/// A path that is no capture, or a manifest that promises depths that are not there.
pub(crate) fn truth_folder(path: &Path) -> Result<Option<PathBuf>, BadInput> {
    let root = CaptureRoot::new(path)?;
    let Some(manifest) = root.file(MANIFEST) else { return Ok(None) };
    let mut bytes = Vec::new();
    let read = File::open(&manifest).and_then(|file| file.take(MANIFEST_BYTES).read_to_end(&mut bytes));
    read.map_err(|error| BadInput::new(show(&manifest), format!("cannot be read ({error})"), "check the file"))?;
    // Manifests of other programs are no error.
    let Ok(manifest) = serde_json::from_slice::<Value>(&bytes) else { return Ok(None) };
    let is_ours = manifest["made_by"].as_str().is_some_and(|by| by.starts_with("plat "));
    if !is_ours || manifest["settings"]["truth"] != Value::Bool(true) {
        return Ok(None);
    }
    let folder = root.path(DEPTH).canonicalize().ok().filter(|folder| folder.is_dir());
    folder.filter(|folder| folder.starts_with(root.path(""))).map(Some).ok_or_else(|| {
        let problem = format!("has no folder {DEPTH}, which its {MANIFEST} says it has");
        BadInput::new(show(path), problem, "write the capture again with plat synth --truth")
    })
}
