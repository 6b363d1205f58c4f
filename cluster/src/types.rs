//! The scheduler's data types: jobs, tasks and their states, attempts, leases, workers and settings.
//!
//! The serde names are part of the journal and snapshot formats.

use std::fmt;

use scene::ArtefactId;
use serde::{Deserialize, Serialize};

/// The number of a job, assigned by the caller of the scheduler and never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct JobId(pub u64);

/// The index of a task within its job: first the tasks of the plan in order, then follow-up tasks in order of
/// appearance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TaskIndex(pub u32);

/// The number of a worker, assigned by the caller of the scheduler. A worker holds at most one lease at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct WorkerId(pub u32);

impl fmt::Display for TaskIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The fencing token of an attempt: unique among all attempts of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Fence {
    /// The epoch of the scheduler that granted the attempt. It grows with every restart, so that a number that was
    /// granted but not durable cannot be confused with the same number granted again.
    pub epoch: u64,
    /// The number of the attempt, from 1 per task.
    pub number: u32,
}

/// One run of a task by one worker. Every report of a worker names its attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct AttemptId {
    /// The job.
    pub job: JobId,
    /// The task.
    pub task: TaskIndex,
    /// The attempt's fencing token.
    pub fence: Fence,
}

impl fmt::Display for AttemptId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}#{}.{}", self.job.0, self.task, self.fence.epoch, self.fence.number)
    }
}

/// The scheduler's view of a task.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskNode {
    /// The tasks that must be done before this one starts, in any order. Duplicates are ignored.
    pub dependencies: Vec<TaskIndex>,
    /// Estimated duration on a worker of unit speed, milliseconds; 0 counts as 1. Only ratios matter, because worker
    /// speeds are measured in the same unit.
    pub work: u64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

/// The scheduler's view of a job.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobSpec {
    /// The backend. Only workers of this backend run its tasks.
    pub backend: String,
    /// Priority class. Jobs of a higher class go first, independent of fair share.
    pub priority: u8,
    /// Fair-share weight within the class; 0 counts as 1.
    pub weight: u32,
    /// The tasks. The order breaks ties.
    pub tasks: Vec<TaskNode>,
}

/// Base of sibling indices in [`Event::Completed`](crate::Event::Completed): a follow-up task refers to the n-th
/// follow-up task of the same result as `SIBLING_BASE + n`, because the final indices are not known in advance.
pub const SIBLING_BASE: u32 = 1 << 31;

/// Maximum number of cached artefacts of a worker that are considered.
pub const CACHED_LIMIT: usize = 64;

/// What a worker offers: its backend, memory and cached artefacts.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Offer {
    /// The worker's backend.
    pub backend: String,
    /// Memory available to a task, bytes; 0: unknown, any task fits.
    pub memory_bytes: u64,
    /// Artefacts in its cache, at most [`CACHED_LIMIT`].
    pub cached: Vec<ArtefactId>,
}

/// Settings of the scheduler. Times are milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// A lease expires without a heartbeat for this long.
    pub lease_millis: u64,
    /// An attempt whose heartbeats report no progress for this long is ended, because its worker hangs.
    pub stall_millis: u64,
    /// A worker without a lease that sends nothing for this long is removed.
    #[serde(rename = "silence_millis")]
    pub worker_timeout_millis: u64,
    /// A ready task that fits no worker of its backend is quarantined after this long, once nothing else of its job is
    /// running.
    #[serde(rename = "strand_millis")]
    pub unschedulable_millis: u64,
    /// For this long a task that failed on a worker is not granted to it again, if another worker can run the task.
    #[serde(rename = "patience_millis")]
    pub exclusion_millis: u64,
    /// Initial backoff after an infrastructure failure or a lost worker. It doubles with every further one.
    pub backoff_millis: u64,
    /// Maximum backoff.
    pub backoff_limit_millis: u64,
    /// Poll interval of an idle worker. It is longer when many workers are idle.
    #[serde(rename = "ask_millis")]
    pub poll_millis: u64,
    /// A task is quarantined after this many attempts whose work failed.
    pub failures_limit: u32,
    /// A task is quarantined after this many attempts whose worker was lost. Higher than `failures_limit`, because
    /// preemption of machines is not caused by the task.
    pub losses_limit: u32,
    /// A task is quarantined after this many attempts with an infrastructure failure.
    #[serde(rename = "troubles_limit")]
    pub infrastructure_failures_limit: u32,
    /// A task is quarantined after it failed on, or was lost with, this many different workers: it may be what crashes
    /// them.
    #[serde(rename = "culprits_limit")]
    pub failed_workers_limit: u32,
    /// Maximum number of tasks of a job, including follow-up tasks.
    pub tasks_limit: u32,
    /// Maximum number of jobs.
    pub jobs_limit: u32,
    /// Whether stragglers get a speculative second attempt on an idle worker.
    #[serde(rename = "duplicates")]
    pub speculation: bool,
    /// Whether tasks are granted strictly in the plan's order. Otherwise the longest critical path goes first.
    pub plan_order: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            lease_millis: 30_000,
            stall_millis: 3_600_000,
            worker_timeout_millis: 120_000,
            unschedulable_millis: 600_000,
            exclusion_millis: 10_000,
            backoff_millis: 1000,
            backoff_limit_millis: 60_000,
            poll_millis: 200,
            failures_limit: 3,
            losses_limit: 6,
            infrastructure_failures_limit: 12,
            failed_workers_limit: 3,
            tasks_limit: 1_000_000,
            jobs_limit: 1000,
            speculation: true,
            plan_order: false,
        }
    }
}

impl Settings {
    /// Settings for workers that share one machine. A speculative attempt would slow down the first one, all workers
    /// are equally fast, and another worker is no better after a failure.
    pub fn one_machine(self) -> Self {
        Self { speculation: false, plan_order: true, exclusion_millis: 0, ..self }
    }
}

/// Learning-rate factor of a task that never diverged, in thousandths.
pub const FULL_RATE: u16 = 1000;

/// The lease of one running attempt.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lease {
    /// The attempt's fencing token.
    pub fence: Fence,
    /// The worker that holds it.
    pub worker: WorkerId,
    /// Time of the grant.
    pub began_millis: u64,
    /// Time of expiry without a further heartbeat.
    pub until_millis: u64,
    /// Time at which the result is expected.
    pub expected_millis: u64,
    /// Time of the last heartbeat that reported progress.
    #[serde(rename = "advanced_millis")]
    pub progressed_millis: u64,
    /// Reported progress, in thousandths.
    pub done_permille: u16,
    /// Whether the worker sent any heartbeat since the grant.
    #[serde(rename = "heard")]
    pub has_heartbeat: bool,
    /// Whether `began_millis` comes from this scheduler's clock. After a restart it does not, and the attempt gives no
    /// speed measurement.
    #[serde(rename = "timed")]
    pub is_timed: bool,
    /// Fair-share charge to the job for this attempt.
    pub charged: u64,
}

/// The state of a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum TaskState {
    /// Some dependencies are not done yet.
    Waiting {
        /// Number of dependencies that are not done.
        missing: u32,
    },
    /// The task can be granted.
    Ready {
        /// Time since it is ready.
        since_millis: u64,
    },
    /// The task becomes ready again after a backoff.
    Delayed {
        /// End of the backoff.
        until_millis: u64,
    },
    /// One attempt is running, or two: the second is a speculative attempt.
    Leased {
        /// One or two leases.
        leases: Vec<Lease>,
    },
    /// Final: the artefact is the task's result.
    Done {
        /// The attempt that produced it.
        fence: Fence,
        /// The result.
        artefact: ArtefactId,
    },
    /// Final until a user retries it: the input is invalid for every worker.
    Failed {
        /// The attempt that reported it.
        fence: Fence,
        /// The error message.
        message: String,
    },
    /// Final until a user retries it: a limit was reached, or the task fits no worker.
    Quarantined {
        /// The last attempt; number 0 if there was none.
        fence: Fence,
        /// The message of the last attempt, or the resource that no worker has.
        message: String,
    },
}

impl TaskState {
    /// Whether the state changes only by a user's retry.
    pub fn is_final(&self) -> bool {
        matches!(self, Self::Done { .. } | Self::Failed { .. } | Self::Quarantined { .. })
    }

    /// The leases of the running attempts.
    pub fn leases(&self) -> &[Lease] {
        if let Self::Leased { leases } = self { leases } else { &[] }
    }
}

/// The durable record of a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskRecord {
    /// The task, with sorted dependencies.
    pub node: TaskNode,
    /// Current memory estimate, bytes. It grows when an attempt runs out of memory.
    pub memory_bytes: u64,
    /// The state.
    pub state: TaskState,
    /// Number of attempts granted so far.
    pub attempts: u32,
    /// Number of attempts whose work failed.
    pub failures: u32,
    /// Number of attempts whose worker was lost.
    pub losses: u32,
    /// Number of attempts with an infrastructure failure.
    #[serde(rename = "troubles")]
    pub infrastructure_failures: u32,
    /// Number of attempts that ran out of memory.
    #[serde(rename = "overflows")]
    pub memory_failures: u32,
    /// Number of attempts that diverged.
    pub divergences: u32,
    /// The different workers that it failed on or was lost with.
    #[serde(rename = "culprits")]
    pub failed_workers: Vec<WorkerId>,
}

impl TaskRecord {
    /// Learning-rate factor of the next attempt, in thousandths.
    pub fn rate_permille(&self) -> u16 {
        if self.divergences == 0 { FULL_RATE } else { FULL_RATE / 2 }
    }

    /// The work in the scheduler's accounting, at least 1.
    pub(crate) fn work(&self) -> u64 {
        self.node.work.max(1)
    }

    /// The lease with this fencing token.
    pub(crate) fn lease(&self, fence: Fence) -> Option<&Lease> {
        self.state.leases().iter().find(|lease| lease.fence == fence)
    }
}
