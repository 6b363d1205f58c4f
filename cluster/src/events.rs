//! What happens to the scheduler, and what it asks for. Both are plain values with a serde form: a journal of events is a
//! file that the simulator replays.

use scene::ArtefactId;
use serde::{Deserialize, Serialize};

use crate::words::{AttemptId, JobId, JobSpec, Offer, TaskIndex, TaskNode, WorkerId};

/// Whose fault a failure is, which decides what comes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FailureKind {
    /// The input's: no other worker would fare better, the task fails at once.
    Input,
    /// The work's (a panic, a full disk): another attempt may succeed, a few times.
    Work,
    /// What is around it (the store is away): again after a pause.
    Infrastructure,
    /// It took more memory than the worker has: again where there is more.
    OutOfMemory,
    /// It diverged: once again, with a lower rate.
    Numeric,
    /// Nobody's: the worker is leaving and gives the task back.
    GivenBack,
}

/// Why an attempt ended without a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Whose fault it is.
    pub kind: FailureKind,
    /// One line for a person.
    pub message: String,
}

/// What happened outside.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// A new job.
    Submitted {
        /// Its number, not used before.
        job: JobId,
        /// What is to be done.
        spec: JobSpec,
    },
    /// A person wants the job to stop for good; what is done stays done.
    CancelRequested {
        /// The job.
        job: JobId,
    },
    /// A person wants no further grants of this job; attempts under way go on.
    PauseRequested {
        /// The job.
        job: JobId,
    },
    /// A person wants a paused job to go on.
    ResumeRequested {
        /// The job.
        job: JobId,
    },
    /// A person wants the job to go sooner or later than others.
    ReprioritiseRequested {
        /// The job.
        job: JobId,
        /// As in [`JobSpec`].
        priority: u8,
        /// As in [`JobSpec`].
        weight: u32,
    },
    /// A person wants a task that failed or was quarantined to be tried again, its past forgiven.
    RetryRequested {
        /// The job.
        job: JobId,
        /// The task.
        task: TaskIndex,
    },
    /// A job that is over need not be remembered.
    ForgetRequested {
        /// The job.
        job: JobId,
    },
    /// A worker is there, and this is what it can do now. Not answered.
    Joined {
        /// Who.
        worker: WorkerId,
        /// What it can do.
        offer: Offer,
    },
    /// A worker leaves: what it holds is given back. Not answered.
    Left {
        /// Who.
        worker: WorkerId,
    },
    /// This worker is idle and wants a task; a lease it still held is lost (it restarted, or never heard of the grant).
    LeaseRequested {
        /// Who asks.
        worker: WorkerId,
    },
    /// A sign of life, which extends the lease.
    Progressed {
        /// Of which attempt.
        attempt: AttemptId,
        /// How much of the task is done in thousandths, where it says.
        done_permille: Option<u16>,
    },
    /// The attempt has its result in the store.
    Completed {
        /// Which attempt.
        attempt: AttemptId,
        /// The result.
        artefact: ArtefactId,
        /// Tasks that follow from it. Their dependencies may be any task of the job and each other; the first of them has
        /// the index that is the number of tasks when the scheduler takes this in, so among themselves they are counted
        /// from [`Scheduler::FOLLOWER`](crate::Scheduler::FOLLOWER).
        followers: Vec<TaskNode>,
    },
    /// The attempt ended without a result.
    Failed {
        /// Which attempt.
        attempt: AttemptId,
        /// Why.
        failure: Failure,
    },
    /// Nothing but time went by. (Every event looks at the clock; ticks are for when nothing else comes.)
    Ticked,
}

/// What is to be done outside. Of each event that a person, a worker or an attempt sent, exactly one action is the
/// answer: `Agreed` or `Declined` to a person; `Grant`, `NothingYet` or `Unknown` to a worker that asks; `Accepted` or
/// `Refused` to an attempt.
///
/// What `Changed` and `Agreed` name must be durable before any action of the same step is carried out; nothing else need be.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Action {
    /// The worker may start.
    Grant {
        /// Who.
        worker: WorkerId,
        /// What, under which fence.
        attempt: AttemptId,
        /// Until when, without a sign of life.
        until_millis: u64,
        /// The learning rate's factor, in thousandths.
        rate_permille: u16,
    },
    /// Nothing is ready for this worker.
    NothingYet {
        /// Who asked.
        worker: WorkerId,
        /// When to ask again.
        wait_millis: u64,
    },
    /// The worker has to join before it asks: it was forgotten, or the scheduler is a new one.
    Unknown {
        /// Who asked.
        worker: WorkerId,
    },
    /// The attempt holds its lease: the news counts, go on.
    Accepted {
        /// Which attempt.
        attempt: AttemptId,
    },
    /// The attempt does not hold a lease (any more): the news is void, stop.
    Refused {
        /// Which attempt.
        attempt: AttemptId,
    },
    /// The attempt's work is no longer needed. It need not arrive: the next sign of life is refused.
    Stop {
        /// Whose.
        worker: WorkerId,
        /// Which attempt.
        attempt: AttemptId,
    },
    /// What a person asked for is so.
    Agreed {
        /// The job.
        job: JobId,
    },
    /// What a person asked for cannot be.
    Declined {
        /// The job.
        job: JobId,
        /// Why, one line.
        why: String,
    },
    /// The task's record changed: for the durable state and for whoever watches.
    Changed {
        /// The job.
        job: JobId,
        /// The task.
        task: TaskIndex,
    },
    /// The job is over. Said once, and again after each retry.
    JobFinished {
        /// The job.
        job: JobId,
        /// How.
        outcome: Outcome,
    },
}

/// How a job ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Outcome {
    /// Every task is done.
    Done,
    /// Tasks failed or were quarantined, and what depends on them was not started.
    Incomplete,
    /// A person stopped it.
    Cancelled,
}
