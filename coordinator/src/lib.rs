//! Hosts the scheduler on the wire: takes jobs in, hands tasks out, commits results, tells whoever watches.
//!
//! ```text
//! gRPC calls (service) ──▶ one channel ──▶ the owner task (jobs: one cluster::Scheduler) ──▶ replies, watch streams (news)
//! ```
//!
//! Architecture invariant: it links no GPU and no trainer and never touches splat bytes; the only artefact that it reads
//! is the plan. All state has one owner, and the time is read in one place: `own`. Jobs live in memory.

mod jobs;
mod local;
mod news;
mod service;

use std::future::Future;
use std::time::Duration;

use cluster::Settings;
use scene::BadInput;
use store::Store;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;

use jobs::Jobs;
pub use local::{LocalError, run_local};

/// Calls that may wait for the owner; further ones wait at the wire.
const CALLS_LIMIT: usize = 1024;
/// Open calls of one connection.
const STREAMS_LIMIT: u32 = 256;
/// How often time goes by for the scheduler when nothing else happens.
const TICK: Duration = Duration::from_millis(100);
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
    /// What tells its grants from those of any earlier coordinator of the same workers: higher than theirs, at least 1.
    pub epoch: u64,
    /// Gets what the scheduler hears, line by line, as `cluster::journal` replays it. It ends where the channel is full.
    pub journal: Option<mpsc::Sender<String>>,
}

impl Options {
    /// The defaults: 30 s leases, 200 ms waits, workers stay, no journal.
    pub fn new(store: Store) -> Self {
        Self { store, settings: Settings::default(), wait_millis: 200, drain: false, epoch: 1, journal: None }
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
}

/// Serves until `shutdown` ends. Jobs that still run are forgotten then, and their watchers' streams end.
///
/// # Errors
/// An address beyond this machine (the wire has no encryption and no token yet), or a listener that fails.
pub async fn serve(
    listener: TcpListener,
    options: Options,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ServeError> {
    let address = listener.local_addr()?;
    if !address.ip().is_loopback() {
        let problem = "is reachable from other machines, and the wire is neither encrypted nor authenticated";
        return Err(BadInput::new(address.to_string(), problem, "listen on 127.0.0.1 or [::1]").into());
    }
    let (calls, inbox) = mpsc::channel(CALLS_LIMIT);
    let stop = CancellationToken::new();
    let store = options.store.clone();
    let owner = tokio::spawn(own(Jobs::new(options), inbox, stop.clone()));
    let server = tonic::transport::Server::builder()
        .max_concurrent_streams(STREAMS_LIMIT)
        .add_service(proto::server(service::Service::new(store, calls)))
        .serve_with_incoming_shutdown(
            TcpIncoming::from(listener).with_nodelay(Some(true)),
            stop.clone().cancelled_owned(),
        );
    tokio::pin!(server);
    let result = tokio::select! {
        result = &mut server => result,
        () = shutdown => {
            stop.cancel();
            tokio::time::timeout(GRACE, server).await.unwrap_or(Ok(()))
        }
    };
    stop.cancel();
    let _ = owner.await;
    Ok(result?)
}

/// A call to the owner of the state: what to do with it, at this many milliseconds since it began.
type Call = Box<dyn FnOnce(&mut Jobs, u64) + Send>;

/// Owns the state: carries out one call after the other. The only place that reads a clock.
async fn own(mut jobs: Jobs, mut inbox: mpsc::Receiver<Call>, stop: CancellationToken) {
    let began = Instant::now();
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        let call = tokio::select! {
            biased;
            () = stop.cancelled() => return,
            call = inbox.recv() => call,
            _ = tick.tick() => Some(Box::new(|jobs: &mut Jobs, now| jobs.tick(now)) as Call),
        };
        let Some(call) = call else { return };
        call(&mut jobs, began.elapsed().as_millis() as u64);
    }
}
