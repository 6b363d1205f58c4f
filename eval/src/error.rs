//! Errors of an evaluation.

use std::path::PathBuf;

use dataset::ingest::IngestError;
use dataset::windows::WindowError;
use scene::BadInput;
use store::StoreError;
use store::file::SaveError;
use train::TrainError;

/// Why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// An option or a file is wrong.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// The capture's photos cannot be ingested.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The store of photos failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A photo cannot be read back.
    #[error(transparent)]
    Window(#[from] WindowError),
    /// A picture cannot be written.
    #[error(transparent)]
    Save(#[from] SaveError),
    /// A folder cannot be created.
    #[error("{}: cannot be made: {error}; check the folder and the space on the disk", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        error: std::io::Error,
    },
    /// There is no temporary folder.
    #[error("no temporary folder: {0}")]
    NoTemporaryFolder(std::io::Error),
    /// The renderer's device failed.
    #[error("{0}")]
    Renderer(String),
    /// Pruning failed.
    #[error(transparent)]
    Train(#[from] TrainError),
}

impl EvalError {
    /// Whether the caller's input is at fault, rather than the work.
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::BadInput(_) | Self::Ingest(IngestError::BadInput(_)) | Self::Store(StoreError::BadUrl(_)))
    }
}
