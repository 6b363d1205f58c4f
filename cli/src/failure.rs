//! Errors of commands: one line and an exit code.

use std::path::Path;

use blocks::PlanError;
use coordinator::LocalError;
use dataset::ingest::IngestError;
use dataset::synth::SynthError;
use eval::EvalError;
use model::ModelError;
use scene::BadInput;
use store::StoreError;
use store::file::SaveError;
use tempfile::TempDir;

/// Why a command failed.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Bad usage or bad input: exit code 2.
    Input(String),
    /// The work failed: exit code 1.
    Work(String),
}

impl Failure {
    pub(crate) fn exit_code(&self) -> u8 {
        match self {
            Self::Input(_) => 2,
            Self::Work(_) => 1,
        }
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Input(text) | Self::Work(text)) = self;
        // Texts of files and libraries may hold line ends and control characters.
        f.write_str(&proto::one_line(text))
    }
}

impl From<BadInput> for Failure {
    fn from(error: BadInput) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<PlanError> for Failure {
    fn from(error: PlanError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<StoreError> for Failure {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::BadUrl(error) => error.into(),
            other => Self::Work(other.to_string()),
        }
    }
}

impl From<SaveError> for Failure {
    fn from(error: SaveError) -> Self {
        Self::Work(error.to_string())
    }
}

impl From<SynthError> for Failure {
    fn from(error: SynthError) -> Self {
        match error {
            SynthError::BadInput(error) => error.into(),
            SynthError::Save(error) => error.into(),
        }
    }
}

impl From<IngestError> for Failure {
    fn from(error: IngestError) -> Self {
        match error {
            IngestError::BadInput(error) => error.into(),
            IngestError::Store(error) => error.into(),
        }
    }
}

impl From<ModelError> for Failure {
    fn from(error: ModelError) -> Self {
        match error {
            ModelError::BadInput(error) => error.into(),
            ModelError::Store(error) => error.into(),
            other => Self::Work(other.to_string()),
        }
    }
}

impl From<EvalError> for Failure {
    fn from(error: EvalError) -> Self {
        if error.is_bad_input() { Self::Input(error.to_string()) } else { Self::Work(error.to_string()) }
    }
}

impl From<LocalError> for Failure {
    fn from(error: LocalError) -> Self {
        match error {
            LocalError::Input(line) => Self::Input(line),
            other => Self::Work(other.to_string()),
        }
    }
}

/// For `map_err` on file system calls; `action` is a participle: "made", "written".
pub(crate) fn cannot<E: std::fmt::Display>(action: &str, path: &Path) -> impl Fn(E) -> Failure {
    let (action, path) = (action.to_owned(), path.display().to_string());
    move |error| {
        Failure::Work(format!("{path}: cannot be {action}: {error}; check the folder and the space on the disk"))
    }
}

/// Creates a folder and its parents, if it does not exist.
pub(crate) fn make_folder(path: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(path).map_err(cannot("made", path))
}

/// A temporary folder, deleted when dropped.
pub(crate) fn temporary_folder() -> Result<TempDir, Failure> {
    tempfile::tempdir().map_err(|error| Failure::Work(format!("no temporary folder: {error}")))
}
