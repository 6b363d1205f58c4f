//! Pulls tasks from a coordinator and carries them out, one at a time.
//!
//! ```text
//! ask ──wait──▶ ask ──grant──▶ execute (blocking thread) ──▶ complete | fail | give back ──▶ ask … drained ──▶ home
//!                               │ reports ▼   ▲ stop
//!                              heartbeat (async, several per lease)
//! ```
//!
//! Architecture invariant: a worker keeps no state between tasks and decides nothing. Whatever it says is about an
//! attempt, and the coordinator may refuse it. The heartbeat and the news travel beside the compute and never hold it up.

mod attempt;
mod block;
pub mod cap;
pub mod clock;
pub mod estimate;
pub mod execute;
mod memory;
pub mod merged;
mod refine;
mod start;
pub mod whole;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use proto::lease_reply::Reply;
use scene::{ArtefactId, BadInput};
use tokio_util::sync::CancellationToken;
use tonic::transport::Endpoint;
use tonic::{Code, Status};

pub use merged::Finished;

/// Longest pause between two tries to reach a coordinator that is away.
const BACKOFF_LIMIT: Duration = Duration::from_secs(5);
/// A call without an answer for this long has failed.
const CALL_TIMEOUT: Duration = Duration::from_secs(20);

/// What a task needs to be carried out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskOrder {
    /// The job, as the coordinator numbers it.
    pub job: u64,
    /// The plan's artefact.
    pub plan: ArtefactId,
    /// The task's place in the plan.
    pub task: u32,
    /// The attempt's number, from 1: 1 + what earlier attempts used up. No result may depend on it.
    pub attempt: u32,
    /// The results of the tasks it depends on (parent and context), by their place in the plan.
    pub inputs: BTreeMap<u32, ArtefactId>,
}

/// How far a task is: one line of metrics.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Report {
    /// Optimiser steps done.
    pub step: u64,
    /// Optimiser steps in all.
    pub steps: u64,
    /// The loss at this step; not finite = left out.
    pub loss: f64,
    /// Splats now.
    pub splats: u64,
    /// CPU seconds the task has taken, evaluation left out.
    pub cpu_seconds: f64,
    /// Wall seconds the task has taken, evaluation left out.
    pub wall_seconds: f64,
    /// Mean PSNR of the merged model so far over the job's test views in dB, where it was measured at this step.
    pub psnr: Option<f64>,
    /// Splats of what was measured.
    pub merged_splats: Option<u64>,
}

/// The answer to a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// Go on.
    Continue,
    /// The attempt is void or the worker is leaving: return soon, with any error unless the task is finished anyway.
    Stop,
}

/// Why a task has no result.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct ExecuteError {
    /// One line for a person.
    pub message: String,
    /// Whether the input is at fault, so that no other attempt would fare better.
    pub is_input: bool,
}

/// Carries out tasks. Blocking, on a thread of its own; a panic is a failed attempt.
pub trait Execute: Send + Sync + 'static {
    /// Carries out the task, puts its result into the store and returns its name. Calls `report` now and then, which
    /// never blocks, and heeds its answer.
    ///
    /// # Errors
    /// [`ExecuteError`], also when it stopped because it was told to.
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError>;
}

/// Who works for whom.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// `http://host:port`.
    pub coordinator_url: String,
    /// Unique among the workers that run at the same time; printable ASCII without spaces.
    pub worker_id: String,
    /// The backend's full name; only jobs whose plan names the same are granted.
    pub backend: String,
}

/// Why a worker gave up.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WorkerError {
    /// Its options are wrong.
    #[error(transparent)]
    Input(#[from] BadInput),
    /// The coordinator does not take it.
    #[error("the coordinator refuses this worker: {0}")]
    Refused(String),
}

/// Works until the coordinator has nothing left (`Ok`) or `shutdown` is cancelled (`Ok`; the task in hand is given
/// back). Waits for a coordinator that is away for as long as it takes.
///
/// # Errors
/// [`WorkerError`].
pub async fn run(options: Options, executor: Arc<dyn Execute>, shutdown: CancellationToken) -> Result<(), WorkerError> {
    let url = &options.coordinator_url;
    let endpoint = Endpoint::from_shared(url.clone()).map_err(|error| {
        BadInput::new("--coordinator", format!("'{url}' is not a URL ({error})"), "give it as http://host:port")
    })?;
    let channel = endpoint.connect_timeout(BACKOFF_LIMIT).timeout(CALL_TIMEOUT).tcp_nodelay(true).connect_lazy();
    let mut client = proto::client(channel);
    let mut backoff = Backoff::default();
    loop {
        let (worker, backend) = (options.worker_id.clone(), options.backend.clone());
        let request = proto::LeaseRequest { worker, backend, ..Default::default() };
        let answer = tokio::select! {
            biased;
            () = shutdown.cancelled() => return Ok(()),
            answer = client.lease(request) => answer,
        };
        let pause = match answer.map(|reply| reply.into_inner().reply) {
            Ok(Some(Reply::Grant(grant))) => {
                backoff = Backoff::default();
                attempt::run(&mut client, grant, executor.clone(), &shutdown).await;
                continue;
            }
            Ok(Some(Reply::WaitMillis(millis))) => {
                backoff = Backoff::default();
                Duration::from_millis(millis.into())
            }
            Ok(Some(Reply::Drained(_))) => return Ok(()),
            Ok(None) => return Err(WorkerError::Refused("it answers in a newer language".into())),
            Err(status) if is_passing(&status) => {
                tracing::warn!(coordinator = url, "waiting for the coordinator: {}", status.message());
                backoff.next()
            }
            Err(status) => return Err(WorkerError::Refused(status.message().into())),
        };
        tokio::select! {
            () = shutdown.cancelled() => return Ok(()),
            () = tokio::time::sleep(pause) => {}
        }
    }
}

/// Whether the same call may succeed later.
fn is_passing(status: &Status) -> bool {
    matches!(
        status.code(),
        Code::Unavailable
            | Code::DeadlineExceeded
            | Code::Cancelled
            | Code::Unknown
            | Code::Internal
            | Code::ResourceExhausted
    )
}

/// Pauses that double from 0.1 s to [`BACKOFF_LIMIT`].
#[derive(Debug, Default)]
struct Backoff {
    tries: u32,
}

impl Backoff {
    fn next(&mut self) -> Duration {
        let pause = Duration::from_millis(100) * 2u32.pow(self.tries.min(10));
        self.tries += 1;
        pause.min(BACKOFF_LIMIT)
    }
}
