//! Reads `tracks.json`, which may lie beside a capture of any format: objects that move, and when its photos were taken.

use std::fs::File;
use std::io::Read;

use scene::BadInput;
use scene::objects::{self, Tracks};

use super::files::{self, CaptureRoot};

const FILE: &str = "tracks.json";
/// A city of 1 km² with 1,500 actors has 31 MB.
const MAX_BYTES: u64 = 1 << 28;

/// The objects of the capture; `None` without the file.
pub(super) fn find(root: &CaptureRoot) -> Result<Option<Tracks>, BadInput> {
    let Some(path) = root.file(FILE) else { return Ok(None) };
    let bad = |problem: String, advice: &str| BadInput::new(files::show(&path), problem, advice);
    let mut bytes = Vec::new();
    let read = File::open(&path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
    read.map_err(|error| bad(format!("cannot be read ({error})"), "check the file"))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(bad(format!("is larger than {} MB", MAX_BYTES >> 20), "leave out objects that are not needed"));
    }
    objects::read(&bytes).map(Some).map_err(|error| bad(error.to_string(), "correct the file or remove it"))
}

/// The time of a photo of this name: files may name it with the folder of the photos before it.
pub(super) fn seconds(tracks: &Tracks, name: &str) -> Option<f64> {
    let found = tracks.seconds.get(name).or_else(|| tracks.seconds.get(name.strip_prefix("images/")?));
    found.or_else(|| tracks.seconds.get(&format!("images/{name}"))).copied()
}
