//! Hosts the scheduler on the wire: takes jobs in, hands tasks out, commits results, tells whoever watches.
//!
//! ```text
//! gRPC calls (service) ──▶ one channel ──▶ the owner (jobs: one cluster::Scheduler) ──▶ replies, watch streams (news)
//!                          leader: who owns │   ▲
//!                                           ▼   │ once durable
//!                                           state (slatedb on the job's store)
//! ```
//!
//! Architecture invariant: it links no GPU and no trainer and never touches splat bytes; the only artefact that it reads
//! is the plan. All state has one owner, and the scheduler's time is read in one place: `own`. Jobs live in memory, and with
//! [`Options::durable`] in the store before anything is said that depends on them; the last lines of what happened in them (`log`)
//! live in memory alone. Beyond this machine it listens only with a certificate and a token (`security`).

mod collect;
mod jobs;
mod leader;
mod local;
mod log;
mod metrics;
mod news;
mod owner;
mod results;
mod security;
mod service;
mod state;

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use cluster::Settings;
use scene::BadInput;
use store::Store;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;

use jobs::Jobs;
pub use local::run_local;
pub use metrics::Metrics;
use owner::{Inbox, own};
pub use results::{LocalError, Results, of_status};
pub use security::Security;
pub use state::StateError;

/// Calls that may wait for the owner; further ones wait at the wire.
const CALLS_LIMIT: usize = 1024;
/// Open calls of one connection.
const STREAMS_LIMIT: u32 = 256;
/// A call that has no answer after this long is given up: the longest reads a plan of a hundred thousand tasks.
const CALL_LIMIT: Duration = Duration::from_secs(60);
/// The largest header of a call, in bytes.
const HEADER_BYTES_LIMIT: u32 = 16 << 10;
/// After a shutdown, open connections have this long to end.
const GRACE: Duration = Duration::from_secs(2);

/// How to host jobs.
#[derive(Debug, Clone)]
pub struct Options {
    /// Where plans are read from; jobs name its URL.
    pub store: Store,
    /// Leases and retries.
    pub settings: Settings,
    /// How long a worker waits before it asks again.
    pub wait_millis: u32,
    /// Whether workers may go home once all jobs are over; otherwise they wait for the next job.
    pub drain: bool,
    /// What tells its grants from those of any earlier coordinator of the same workers: higher than theirs, at least 1. A
    /// durable coordinator finds its own.
    pub epoch: u64,
    /// Keeps jobs in the store and shares it with other coordinators, one of which leads; otherwise they live in memory.
    pub durable: Option<Durable>,
    /// Gets what the scheduler hears, line by line, as `cluster::journal` replays it. It ends where the channel is full.
    pub journal: Option<mpsc::Sender<String>>,
    /// Encryption and proofs: needed beyond this machine.
    pub security: Security,
    /// What it tells of itself.
    pub metrics: Arc<Metrics>,
}

impl Options {
    /// The defaults: 30 s leases, 200 ms waits, workers stay, jobs in memory, no journal, for this machine alone.
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
        }
    }
}

/// How a coordinator keeps its jobs in the store, beside others on the same store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Durable {
    /// How workers reach this coordinator, as the lease says it to them: `http://host:port` or `https://host:port`.
    pub address: String,
    /// The leader shows this often that it lives, and others look this often.
    pub beat: Duration,
    /// A leader that is silent for this long is followed by another.
    pub patience: Duration,
}

impl Durable {
    /// The defaults: a beat each second, followed after four of silence.
    ///
    /// # Errors
    /// An address that is no URL of a host and a port.
    pub fn new(address: &str) -> Result<Self, BadInput> {
        let plain = address.bytes().all(|byte| byte.is_ascii_graphic()) && address.len() <= 512;
        if !plain || !(address.starts_with("http://") || address.starts_with("https://")) {
            let problem = "is not where a worker could reach a coordinator";
            return Err(BadInput::new(address.escape_default().to_string(), problem, "give it as http://host:port"));
        }
        Ok(Self { address: address.into(), beat: Duration::from_secs(1), patience: Duration::from_secs(4) })
    }
}

/// Why the coordinator stopped.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address is not one it may listen on.
    #[error(transparent)]
    Input(#[from] BadInput),
    /// The listener failed.
    #[error("the coordinator cannot listen: {0}")]
    Listen(#[from] std::io::Error),
    /// The server failed.
    #[error("the coordinator's server failed: {0}")]
    Server(#[from] tonic::transport::Error),
    /// The durable state failed: what it holds is not known to this process any more, and a new one reads it.
    #[error(transparent)]
    State(#[from] StateError),
}

/// Serves until `shutdown` ends. Jobs in memory that still run are forgotten then, and their watchers' streams end; durable ones
/// go on under the next coordinator. Dropped before, it stops at once and says nothing more, as if it had been killed.
///
/// # Errors
/// An address beyond this machine without certificate and token, a certificate that is none, a listener that fails, a durable state
/// that cannot be read or written.
pub async fn serve(
    listener: TcpListener,
    options: Options,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ServeError> {
    let address = listener.local_addr()?;
    options.security.check(address)?;
    let guard = options.security.guard();
    let mut builder = tonic::transport::Server::builder()
        .max_concurrent_streams(STREAMS_LIMIT)
        .timeout(CALL_LIMIT)
        .http2_keepalive_interval(Some(proto::KEEP_ALIVE))
        .http2_keepalive_timeout(Some(proto::KEEP_ALIVE_TIMEOUT))
        .http2_max_header_list_size(HEADER_BYTES_LIMIT);
    if let Some(tls) = options.security.tls() {
        builder = builder.tls_config(tls).map_err(|error| security::unusable(&error))?;
    }
    let (calls, inbox) = mpsc::channel(CALLS_LIMIT);
    let stop = CancellationToken::new();
    let service = proto::server(service::Service::new(options.store.clone(), calls), guard);
    // Aborted when it is dropped.
    let mut owner = JoinSet::new();
    owner.spawn(host(options, inbox, stop.clone()));
    // Whoever asks for the health learns that this is alive and nothing else, so no token is asked for.
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_service_status(proto::SERVICE_NAME, tonic_health::ServingStatus::Serving).await;
    let server = builder.add_service(health_service).add_service(service).serve_with_incoming_shutdown(
        TcpIncoming::from(listener).with_nodelay(Some(true)),
        stop.clone().cancelled_owned(),
    );
    tokio::pin!(server);
    let (mut served, mut owned) = (None, None);
    tokio::select! {
        ended = &mut server => served = Some(ended),
        ended = owner.join_next() => owned = ended,
        () = shutdown => {}
    }
    stop.cancel();
    if served.is_none() {
        served = tokio::time::timeout(GRACE, server).await.ok();
    }
    if owned.is_none() {
        owned = owner.join_next().await;
    }
    owned.map_or(Ok(()), of_owner)?;
    Ok(served.unwrap_or(Ok(()))?)
}

async fn host(options: Options, mut inbox: Inbox, stop: CancellationToken) -> Result<(), ServeError> {
    match options.durable.clone() {
        Some(durable) => leader::host(options, durable, inbox, stop).await,
        None => {
            own(Jobs::new(options), None, &mut inbox, &stop, &CancellationToken::new()).await?;
            Ok(())
        }
    }
}

/// The owner panics only where an invariant of the scheduler does not hold, in debug builds.
fn of_owner(ended: Result<Result<(), ServeError>, JoinError>) -> Result<(), ServeError> {
    match ended {
        Ok(ended) => ended,
        Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
        Err(_) => Ok(()),
    }
}
