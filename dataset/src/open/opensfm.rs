//! A `reconstruction.json` of OpenSfM, alone or in the `opensfm` folder of an OpenDroneMap project.

use std::path::{Path, PathBuf};

use scene::opensfm::{self, Sfm};
use scene::transforms::Intrinsics;
use scene::{BadInput, SparsePoints};

use super::files::{self, Root};
use super::{Contents, Points, Posed};

/// What OpenSfM calls it.
pub(super) const FILE: &str = "reconstruction.json";

/// The file, if the capture has one.
pub(super) fn find(root: &Root) -> Option<PathBuf> {
    root.file(FILE).or_else(|| root.file(&format!("opensfm/{FILE}")))
}

/// Reads the file.
pub(super) fn read(root: &Root, path: &Path) -> Result<Contents, BadInput> {
    let Sfm { shots, positions, colours, origin, others } = opensfm::read(&files::read(path)?)
        .map_err(|e| BadInput::new(files::show(path), e.to_string(), "correct the file or reconstruct again"))?;
    let folder = if root.path("images").is_dir() { "images/" } else { "" };
    let posed = shots.into_iter().zip(0..).map(|(shot, id)| Posed {
        id,
        file: format!("{folder}{}", shot.name),
        name: shot.name,
        mask: None,
        intrinsics: Intrinsics::from_model(&shot.camera.model, Some((shot.camera.width, shot.camera.height))),
        camera_from_world: shot.camera_from_world,
    });
    let why = "it belongs to another reconstruction, which is smaller";
    Ok(Contents {
        format: "opensfm",
        posed: posed.collect(),
        points: Points(SparsePoints { positions, colours, ..Default::default() }),
        origin,
        left_out: others.into_iter().map(|name| (name, why.to_string())).collect(),
    })
}
