//! How a coordinator is started, and why it ends with an error.

use std::sync::Arc;
use std::time::Duration;

use cluster::Settings;
use scene::BadInput;
use store::Store;
use tokio::sync::mpsc;

use crate::metrics::Metrics;
use crate::security::Security;
use crate::state::StateError;

/// Time limit of open connections after a shutdown.
pub(crate) const GRACE: Duration = Duration::from_secs(2);

/// The configuration of a coordinator.
#[derive(Debug, Clone)]
pub struct Options {
    /// The store of plans and results; a submitted job must name the same URL.
    pub store: Store,
    /// Leases, retries and limits of the scheduler.
    pub settings: Settings,
    /// Pause of an idle worker before its next lease request.
    pub wait_millis: u32,
    /// Whether workers end once all jobs are finished; otherwise they wait for the next job.
    pub drain: bool,
    /// The epoch of its grants: at least 1 and higher than that of any earlier coordinator of the same workers. A durable coordinator
    /// takes its own from the state.
    pub epoch: u64,
    /// Keeps jobs in the store, where several coordinators elect a leader; otherwise jobs live in memory.
    pub durable: Option<Durable>,
    /// Receives the scheduler's events line by line, as `cluster::journal` replays them. The journal ends if the channel is full.
    pub journal: Option<mpsc::Sender<String>>,
    /// TLS and authentication, required beyond the loopback.
    pub security: Security,
    /// The coordinator's metrics.
    pub metrics: Arc<Metrics>,
    /// Milliseconds since 1970: the age of log lines that an earlier leader wrote. Nothing else depends on it.
    pub wall_clock: fn() -> u64,
}

impl Options {
    /// The defaults: 30 s leases, 200 ms waits, no draining, jobs in memory, no journal, loopback only, and a wall clock that stands still.
    pub fn new(store: Store) -> Self {
        Self {
            store,
            settings: Settings::default(),
            wait_millis: 200,
            drain: false,
            epoch: 1,
            durable: None,
            journal: None,
            security: Security::default(),
            metrics: Arc::default(),
            wall_clock: || 0,
        }
    }
}

/// Leader election among the coordinators on one store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Durable {
    /// The address of this coordinator in its lease: `http://host:port` or `https://host:port`.
    pub address: String,
    /// Interval at which the leader renews its lease and standbys read it.
    pub beat: Duration,
    /// A standby takes over from a leader that has not renewed its lease for this long.
    pub patience: Duration,
}

impl Durable {
    /// The defaults: a beat each second, takeover after four seconds without one.
    ///
    /// # Errors
    /// An address that is not an HTTP URL.
    pub fn new(address: &str) -> Result<Self, BadInput> {
        let plain = address.bytes().all(|byte| byte.is_ascii_graphic()) && address.len() <= 512;
        if !plain || !(address.starts_with("http://") || address.starts_with("https://")) {
            let problem = "is not an address that workers can reach";
            return Err(BadInput::new(address.escape_default().to_string(), problem, "give it as http://host:port"));
        }
        Ok(Self { address: address.into(), beat: Duration::from_secs(1), patience: Duration::from_secs(4) })
    }
}

/// Why the coordinator ended with an error.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The listen address or the certificates are not acceptable.
    #[error(transparent)]
    Input(#[from] BadInput),
    /// The listener failed.
    #[error("the coordinator cannot listen: {0}")]
    Listen(#[from] std::io::Error),
    /// The server failed.
    #[error("the coordinator's server failed: {0}")]
    Server(#[from] tonic::transport::Error),
    /// The durable state failed. Its content is then unknown to this process; a new coordinator reads it.
    #[error(transparent)]
    State(#[from] StateError),
}
