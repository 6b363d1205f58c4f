//! The scheduler's words: tasks and their states, what happens to them, what is to be done.

use std::fmt;
use std::sync::Arc;

use scene::ArtefactId;

/// A task of the job: its place in the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskIndex(pub u32);

/// A worker, numbered by whoever feeds the events. It holds at most one lease at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WorkerId(pub u32);

impl fmt::Display for TaskIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// One task as the scheduler sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TaskNode {
    /// The tasks that must be done before this one starts, in any order; repetitions count once.
    pub dependencies: Vec<TaskIndex>,
}

/// The limits of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// A lease without a sign of life for this long is taken back.
    pub lease_millis: u64,
    /// A task whose work failed in this many attempts is quarantined.
    pub failures_limit: u32,
    /// A task whose worker vanished in this many attempts is quarantined: it may be what kills them. Higher than
    /// `failures_limit`, as machines that come and go are no fault of the task.
    pub losses_limit: u32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { lease_millis: 30_000, failures_limit: 3, losses_limit: 6 }
    }
}

/// Where a task stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TaskState {
    /// Some dependencies are not done.
    Waiting {
        /// How many.
        missing: u32,
    },
    /// May be granted to the next worker that asks.
    Ready,
    /// A worker is at it.
    Leased {
        /// The one attempt that may complete the task.
        attempt: u32,
        /// Who holds it.
        worker: WorkerId,
        /// When the lease ends without a further sign of life.
        until_millis: u64,
    },
    /// Final: the artefact is the task's result.
    Done {
        /// The attempt that made it.
        attempt: u32,
        /// What it made.
        artefact: ArtefactId,
    },
    /// Final: its input is wrong, and would be wrong for any worker.
    Failed {
        /// The attempt that said so.
        attempt: u32,
        /// What is wrong.
        message: Arc<str>,
    },
    /// Final: too many attempts failed or vanished.
    Quarantined {
        /// The last attempt.
        attempt: u32,
        /// What the last attempt said.
        message: Arc<str>,
    },
}

impl TaskState {
    /// Whether the task will never change again.
    pub fn is_final(&self) -> bool {
        matches!(self, Self::Done { .. } | Self::Failed { .. } | Self::Quarantined { .. })
    }
}

/// Whose fault a failure is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// The input's: no other worker would fare better, the task fails at once.
    Input,
    /// The work's (a panic, a full disk, a store that is away): another attempt may succeed.
    Work,
    /// Nobody's: the worker is leaving and gives the task back.
    GivenBack,
}

/// Why an attempt ended without a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// Whose fault it is.
    pub kind: FailureKind,
    /// One line for a person.
    pub message: Arc<str>,
}

/// What happened outside.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// This worker is idle and wants a task; a lease it still held is lost (it restarted, or never heard of the grant).
    LeaseRequested {
        /// Who asks.
        worker: WorkerId,
    },
    /// This worker holds nothing of this job (it took a task of another): a lease it held here is lost.
    WorkerIdle {
        /// Who is idle.
        worker: WorkerId,
    },
    /// A sign of life, which extends the lease.
    Progressed {
        /// The task.
        task: TaskIndex,
        /// Its attempt.
        attempt: u32,
    },
    /// The attempt has its result in the store.
    Completed {
        /// The task.
        task: TaskIndex,
        /// Its attempt.
        attempt: u32,
        /// The result.
        artefact: ArtefactId,
    },
    /// The attempt ended without a result.
    Failed {
        /// The task.
        task: TaskIndex,
        /// Its attempt.
        attempt: u32,
        /// Why.
        failure: Failure,
    },
    /// A person wants the job to stop.
    CancelRequested,
    /// Nothing but time went by. (Every event looks at the clock; ticks are for when nothing else comes.)
    Ticked,
}

/// What is to be done outside. Of each event about a worker or an attempt, exactly one action is the answer to its
/// sender: `Grant`, `NothingYet` or `Drained` to a request; `Accepted` or `Refused` to the rest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// The worker may start.
    Grant {
        /// Who.
        worker: WorkerId,
        /// What.
        task: TaskIndex,
        /// Under which number.
        attempt: u32,
        /// Until when, without a sign of life.
        until_millis: u64,
    },
    /// Nothing is ready now; ask again later.
    NothingYet {
        /// Who asked.
        worker: WorkerId,
    },
    /// The job is over; nothing will become ready.
    Drained {
        /// Who asked.
        worker: WorkerId,
    },
    /// The attempt holds the lease: the news counts, go on.
    Accepted {
        /// The task.
        task: TaskIndex,
        /// Its attempt.
        attempt: u32,
    },
    /// The attempt does not hold the lease (any more): the news is void, stop.
    Refused {
        /// The task.
        task: TaskIndex,
        /// Its attempt.
        attempt: u32,
    },
    /// The task now stands as [`Scheduler::state`](crate::Scheduler::state) says: for whoever watches.
    Changed {
        /// The task.
        task: TaskIndex,
    },
    /// The job is over. Said once.
    JobFinished {
        /// How.
        outcome: Outcome,
    },
}

/// How a job ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Every task is done.
    Done,
    /// Tasks failed or were quarantined, and what depends on them was not started.
    Incomplete,
    /// A person stopped it.
    Cancelled,
}

/// Why a list of tasks is not a directed acyclic graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DagError {
    /// A dependency that the list does not hold.
    #[error("task {task} depends on task {dependency}, but there are only {tasks} tasks")]
    OutOfRange {
        /// The task.
        task: u32,
        /// What it names.
        dependency: u32,
        /// How many tasks there are.
        tasks: usize,
    },
    /// A task that waits for itself.
    #[error("task {task} depends on itself, directly or through others")]
    Cycle {
        /// A task on or behind the cycle.
        task: u32,
    },
    /// More tasks than indices.
    #[error("{tasks} tasks are more than 2^32 - 1")]
    TooMany {
        /// How many.
        tasks: usize,
    },
}
