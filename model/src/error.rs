//! Errors of writing models.

use std::path::{Path, PathBuf};

use scene::{BadInput, BlockId, CodecError};
use store::StoreError;
use store::file::SaveError;

/// Why a model could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The input is not a model, or its splats do not fit the format.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// The store of the plan's results failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A file could not be written.
    #[error(transparent)]
    Save(#[from] SaveError),
    /// A file or folder could not be created or removed.
    #[error("{}: cannot be {action}: {error}; check the folder and the space on the disk", path.display())]
    Folder {
        /// The file or folder.
        path: PathBuf,
        /// What was tried, as a participle.
        action: &'static str,
        /// The system's error.
        error: std::io::Error,
    },
    /// The plan's results have no artefact of this block.
    #[error("block {0} has no result")]
    NoResult(BlockId),
    /// The artefact of this block is damaged.
    #[error("block {0}: {1}")]
    DamagedResult(BlockId, CodecError),
    /// The plan's results have no artefact of this object, or the capture does not have it.
    #[error("object {0} has no result")]
    NoObject(u32),
    /// The artefact of this object is damaged.
    #[error("object {0}: {1}")]
    DamagedObject(String, CodecError),
    /// The artefact of the refined poses is damaged.
    #[error("refined poses: {0}")]
    DamagedPoses(CodecError),
}

/// For `map_err` on file system calls.
pub(crate) fn cannot(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> ModelError {
    let path = path.to_path_buf();
    move |error| ModelError::Folder { path, action, error }
}
