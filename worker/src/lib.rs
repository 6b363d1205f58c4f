//! Pulls tasks from a coordinator and carries them out, one at a time.
//!
//! ```text
//! ask ──wait──▶ ask ──grant──▶ execute (blocking thread) ──▶ complete and ask | fail | give back ──▶ ask … drained ──▶ home
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
mod heal;
mod link;
mod memory;
pub mod merged;
pub mod metrics;
mod refine;
pub mod room;
mod start;
pub mod whole;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use proto::Access;
pub use proto::FailureKind;
use proto::lease_reply::Reply;
use scene::{ArtefactId, BadInput};
use store::StoreError;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Response, Status};

use link::Link;
pub use link::leader_of;
pub use merged::Finished;

/// A coordinator that does not hear for this long that the worker leaves will notice by itself.
const GOODBYE: Duration = Duration::from_secs(2);

/// [`TaskOrder::rate_permille`] of a task that never diverged.
pub const FULL_RATE: u32 = 1000;

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
    /// The learning rate's factor in thousandths: less than [`FULL_RATE`] where an earlier attempt diverged.
    pub rate_permille: u32,
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
    /// Whose fault it is, which decides what the coordinator does next; never `GivenBack`, which is no failure.
    pub kind: FailureKind,
}

impl ExecuteError {
    pub(crate) fn of(kind: FailureKind, message: impl ToString) -> Self {
        Self { message: message.to_string(), kind }
    }
}

impl From<StoreError> for ExecuteError {
    /// A store that fails may be itself again later, or its disk have room; what it lacks or holds damaged, a person may put there.
    fn from(error: StoreError) -> Self {
        Self::of(FailureKind::Infrastructure, error)
    }
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
    /// `http://host:port`, `https://host:port`, or the URL of the store where whoever leads keeps its lease.
    pub coordinator_url: String,
    /// What proves the worker to the coordinator, and the coordinator to it.
    pub access: Access,
    /// Unique among the workers that run at the same time; printable ASCII without spaces.
    pub worker_id: String,
    /// The backend's full name; only jobs whose plan names the same are granted.
    pub backend: String,
    /// Only tasks that are thought to need no more memory than this are granted, bytes; 0 takes them all.
    pub memory_bytes: u64,
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

/// Asks the coordinator what it is, for as long as it takes to get an answer; `None` if `shutdown` is cancelled first.
///
/// # Errors
/// [`WorkerError`].
pub async fn greet(options: &Options, shutdown: &CancellationToken) -> Result<Option<proto::AboutReply>, WorkerError> {
    let mut link = Link::new(options)?;
    while !shutdown.is_cancelled() {
        let answer = tokio::select! {
            biased;
            () = shutdown.cancelled() => break,
            answer = async { link.client().await?.about(proto::AboutRequest {}).await } => answer,
        };
        match answer {
            Ok(about) => return Ok(Some(about.into_inner())),
            Err(status) => wait(&mut link, options, status, shutdown).await?,
        }
    }
    Ok(None)
}

/// Works until the coordinator has nothing left (`Ok`) or `shutdown` is cancelled (`Ok`; the task in hand is given
/// back). Waits for a coordinator that is away for as long as it takes, and meanwhile goes on with the task in hand.
///
/// # Errors
/// [`WorkerError`].
pub async fn run(options: Options, executor: Arc<dyn Execute>, shutdown: CancellationToken) -> Result<(), WorkerError> {
    let mut link = Link::new(&options)?;
    let mut said = None;
    while !shutdown.is_cancelled() {
        let request = asks(&options, &link);
        let answer = match said.take() {
            Some(reply) => Ok(reply),
            None => tokio::select! {
                biased;
                () = shutdown.cancelled() => break,
                answer = async { link.client().await?.lease(request).await } => answer.map(Response::into_inner),
            },
        };
        match answer.map(|answer| answer.reply) {
            Ok(Some(Reply::Grant(grant))) => {
                link.found();
                said = attempt::run(&mut link, &options, grant, executor.clone(), &shutdown).await;
            }
            Ok(Some(Reply::WaitMillis(millis))) => {
                link.found();
                pause(Duration::from_millis(millis.into()), &shutdown).await;
            }
            Ok(Some(Reply::Drained(_))) => return Ok(()),
            Ok(None) => return Err(WorkerError::Refused("it answers in a newer language".into())),
            Err(status) => wait(&mut link, &options, status, &shutdown).await?,
        }
    }
    leave(&mut link, options.worker_id).await;
    Ok(())
}

/// The call for a task.
fn asks(options: &Options, link: &Link) -> proto::LeaseRequest {
    let Options { worker_id: worker, backend, memory_bytes, .. } = options.clone();
    proto::LeaseRequest { worker, backend, memory_bytes, epoch: link.epoch(), ..Default::default() }
}

/// Waits before the same call is tried again.
///
/// # Errors
/// The coordinator does not take the worker: no later call will fare better.
async fn wait(
    link: &mut Link,
    options: &Options,
    status: Status,
    shutdown: &CancellationToken,
) -> Result<(), WorkerError> {
    if !is_passing(&status) {
        return Err(WorkerError::Refused(proto::explain(&status)));
    }
    tracing::warn!(coordinator = options.coordinator_url, "waiting for the coordinator: {}", proto::explain(&status));
    pause(link.lost(), shutdown).await;
    Ok(())
}

async fn pause(long: Duration, shutdown: &CancellationToken) {
    tokio::select! {
        () = shutdown.cancelled() => {}
        () = tokio::time::sleep(long) => {}
    }
}

/// Says that the worker goes: a grant whose answer it did not wait for is free at once, too.
async fn leave(link: &mut Link, worker: String) {
    let said = async { link.client().await?.leave(proto::LeaveRequest { worker }).await };
    if !matches!(tokio::time::timeout(GOODBYE, said).await, Ok(Ok(_))) {
        tracing::warn!("the coordinator does not hear that this worker leaves");
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
