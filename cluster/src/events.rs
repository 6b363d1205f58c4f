//! The scheduler's inputs (events) and outputs (actions). Both are serialisable values, so that a journal of events can
//! be replayed.

use scene::ArtefactId;
use serde::{Deserialize, Serialize};

use crate::types::{AttemptId, JobId, JobSpec, Offer, TaskIndex, TaskNode, WorkerId};

/// The cause of a failure. It determines the retry policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FailureKind {
    /// The input is invalid for every worker. The task fails at once.
    Input,
    /// The work failed (a panic, a full disk). Retried a few times.
    Work,
    /// The infrastructure failed (the store is unreachable). Retried after a backoff.
    Infrastructure,
    /// The worker ran out of memory. Retried on a worker with more memory.
    OutOfMemory,
    /// Training diverged. Retried once, with a lower learning rate.
    Numeric,
    /// No failure: the worker leaves and returns the task.
    GivenBack,
}

/// Why an attempt ended without a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// The cause.
    pub kind: FailureKind,
    /// One line for the user.
    pub message: String,
}

/// An input of the scheduler.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// A new job.
    Submitted {
        /// Its number, not used before.
        job: JobId,
        /// Its tasks and settings.
        spec: JobSpec,
    },
    /// A user cancels the job. Completed tasks keep their results.
    CancelRequested {
        /// The job.
        job: JobId,
    },
    /// A user pauses the job: no further grants. Running attempts continue.
    PauseRequested {
        /// The job.
        job: JobId,
    },
    /// A user resumes a paused job.
    ResumeRequested {
        /// The job.
        job: JobId,
    },
    /// A user changes the priority or weight of the job.
    ReprioritiseRequested {
        /// The job.
        job: JobId,
        /// As in [`JobSpec`].
        priority: u8,
        /// As in [`JobSpec`].
        weight: u32,
    },
    /// A user retries a failed or quarantined task. Its failure counters are reset.
    RetryRequested {
        /// The job.
        job: JobId,
        /// The task.
        task: TaskIndex,
    },
    /// A user deletes a job that is over.
    ForgetRequested {
        /// The job.
        job: JobId,
    },
    /// A worker registers or updates its offer. Not answered.
    Joined {
        /// The worker.
        worker: WorkerId,
        /// Its backend, memory and cache.
        offer: Offer,
    },
    /// A worker leaves and returns its task. Not answered.
    Left {
        /// The worker.
        worker: WorkerId,
    },
    /// An idle worker asks for a task. A lease that it still holds is lost (it restarted, or did not receive the
    /// grant).
    LeaseRequested {
        /// The worker.
        worker: WorkerId,
    },
    /// A heartbeat. It extends the lease.
    Progressed {
        /// The attempt.
        attempt: AttemptId,
        /// Progress in thousandths, if reported.
        done_permille: Option<u16>,
    },
    /// The attempt completed; its result is in the store.
    Completed {
        /// The attempt.
        attempt: AttemptId,
        /// The result.
        artefact: ArtefactId,
        /// Follow-up tasks that the result adds to the job. They may depend on any task of the job, and on each other
        /// by [`SIBLING_BASE`](crate::SIBLING_BASE) plus their position in this list.
        #[serde(rename = "followers")]
        follow_ups: Vec<TaskNode>,
    },
    /// The attempt ended without a result.
    Failed {
        /// The attempt.
        attempt: AttemptId,
        /// The failure.
        failure: Failure,
    },
    /// Time passed without another event.
    Ticked,
}

/// An output of the scheduler, to be carried out by the caller.
///
/// Each request gets exactly one answer: a user's command `Agreed` or `Declined`; a worker's request for a task
/// `Grant`, `NothingYet` or `Unknown`; a report about an attempt `Accepted` or `Refused`.
///
/// The records and headers that `Changed` and `Agreed` name must be durable before any action of the same step is
/// carried out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Action {
    /// Grants a task to a worker.
    Grant {
        /// The worker.
        worker: WorkerId,
        /// The attempt, with its fencing token.
        attempt: AttemptId,
        /// Expiry of the lease without a heartbeat.
        until_millis: u64,
        /// Learning-rate factor, in thousandths.
        rate_permille: u16,
    },
    /// No task is available for this worker.
    NothingYet {
        /// The worker.
        worker: WorkerId,
        /// Time until the next request, milliseconds.
        wait_millis: u64,
    },
    /// The worker must join first: it timed out, or the scheduler was restarted.
    Unknown {
        /// The worker.
        worker: WorkerId,
    },
    /// The report is accepted: the attempt holds its lease and may continue.
    Accepted {
        /// The attempt.
        attempt: AttemptId,
    },
    /// The report is refused: the attempt holds no lease and must stop.
    Refused {
        /// The attempt.
        attempt: AttemptId,
    },
    /// The attempt must stop. Delivery is optional, because its next heartbeat is refused.
    Stop {
        /// The worker.
        worker: WorkerId,
        /// The attempt.
        attempt: AttemptId,
    },
    /// The user's command is carried out.
    Agreed {
        /// The job.
        job: JobId,
    },
    /// The user's command is rejected.
    Declined {
        /// The job.
        job: JobId,
        /// The reason, one line.
        #[serde(rename = "why")]
        reason: String,
    },
    /// The task's record changed and must be made durable and published.
    Changed {
        /// The job.
        job: JobId,
        /// The task.
        task: TaskIndex,
    },
    /// The job is over. Emitted once, and again after a retry.
    JobFinished {
        /// The job.
        job: JobId,
        /// The outcome.
        outcome: Outcome,
    },
}

/// The outcome of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Outcome {
    /// Every task is done.
    Done,
    /// Some tasks failed or were quarantined; their dependents were not started.
    Incomplete,
    /// A user cancelled it.
    Cancelled,
}
