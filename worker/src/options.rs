//! How a worker is started, and why it ends with an error.

use proto::Access;
use scene::BadInput;

/// A worker's identity and its coordinator.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// `http://host:port`, `https://host:port`, or the URL of the store that holds the leader's lease.
    pub coordinator_url: String,
    /// Credentials for the coordinator, and the certificates by which it is verified.
    pub access: Access,
    /// Unique among the workers that run at the same time; printable ASCII without spaces.
    pub worker_id: String,
    /// The backend's full name; only jobs whose plan names the same backend are granted.
    pub backend: String,
    /// Only tasks with a memory estimate of at most this many bytes are granted; 0 = no limit.
    pub memory_bytes: u64,
}

/// Why a worker ended with an error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WorkerError {
    /// Its options are wrong.
    #[error(transparent)]
    Input(#[from] BadInput),
    /// The coordinator rejects its calls.
    #[error("the coordinator refuses this worker: {0}")]
    Refused(String),
}
