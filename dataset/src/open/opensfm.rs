//! Parses a `reconstruction.json` of OpenSfM, alone or in the `opensfm` folder of an OpenDroneMap project.

use std::path::{Path, PathBuf};

use scene::opensfm::{self, Sfm};
use scene::transforms::Intrinsics;
use scene::{BadInput, SparsePoints};

use super::files::{self, CaptureRoot};
use super::parsed::{ParsedCapture, PosedImage, RawPoints};

/// OpenSfM's name of the file.
pub(super) const FILE: &str = "reconstruction.json";

/// The file, if the capture has one.
pub(super) fn find(root: &CaptureRoot) -> Option<PathBuf> {
    root.file(FILE).or_else(|| root.file(&format!("opensfm/{FILE}")))
}

/// Parses the file.
pub(super) fn read(root: &CaptureRoot, path: &Path) -> Result<ParsedCapture, BadInput> {
    let Sfm { shots, positions, colours, origin, others } = opensfm::read(&files::read(path)?)
        .map_err(|e| BadInput::new(files::show(path), e.to_string(), "correct the file or reconstruct again"))?;
    let folder = if root.path("images").is_dir() { "images/" } else { "" };
    let images = shots.into_iter().zip(0..).map(|(shot, id)| PosedImage {
        row: None,
        id,
        file: format!("{folder}{}", shot.name),
        name: shot.name,
        mask: None,
        depth: None,
        intrinsics: Intrinsics::from_model(&shot.camera.model, Some((shot.camera.width, shot.camera.height))),
        camera_from_world: shot.camera_from_world,
        boxes: Vec::new(),
        seconds: None,
    });
    let reason = "it belongs to another reconstruction, which is smaller";
    let points = RawPoints(SparsePoints { positions, colours, ..Default::default() });
    Ok(ParsedCapture {
        origin,
        left_out: others.into_iter().map(|name| (name, reason.to_string())).collect(),
        ..ParsedCapture::new("opensfm", images.collect(), points)
    })
}
