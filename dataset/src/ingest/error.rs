//! Why a capture could not be ingested.

use scene::BadInput;
use store::StoreError;

/// Why an ingest stopped.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IngestError {
    /// An invalid file or option.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
}
