//! The scheduler's nouns: jobs, tasks and their states, attempts, workers, limits.

use std::fmt;

use scene::ArtefactId;
use serde::{Deserialize, Serialize};

/// A job, numbered by whoever feeds the events; never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct JobId(pub u64);

/// A task of a job: its place in the plan, then in the order in which further ones appeared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TaskIndex(pub u32);

/// A worker, numbered by whoever feeds the events. It holds at most one lease at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct WorkerId(pub u32);

impl fmt::Display for TaskIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// What tells one attempt at a task from every other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Fence {
    /// Of the scheduler that granted it: grows with every restart, so that a number which was granted and then forgotten
    /// is not mistaken for the same number granted anew.
    pub epoch: u64,
    /// From 1, per task.
    pub number: u32,
}

/// One run of a task by one worker. All that a worker says is about an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct AttemptId {
    /// The job.
    pub job: JobId,
    /// The task.
    pub task: TaskIndex,
    /// Which of its attempts.
    pub fence: Fence,
}

impl fmt::Display for AttemptId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}#{}.{}", self.job.0, self.task, self.fence.epoch, self.fence.number)
    }
}

/// One task as the scheduler sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskNode {
    /// The tasks that must be done before this one starts, in any order; repetitions count once.
    pub dependencies: Vec<TaskIndex>,
    /// An estimate of what it takes: milliseconds on a worker of unit speed; 0 counts as 1. Only ratios matter, as speeds are
    /// learnt in the same measure.
    pub work: u64,
    /// An estimate of the memory it takes, bytes.
    pub memory_bytes: u64,
}

/// A plan as the scheduler sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobSpec {
    /// Only workers of this backend get its tasks.
    pub backend: String,
    /// Jobs of a higher class go first, whatever their shares.
    pub priority: u8,
    /// Share among the jobs of its class; 0 counts as 1.
    pub weight: u32,
    /// What is to be done, in an order of preference among equals.
    pub tasks: Vec<TaskNode>,
}

/// Cached artefacts of a worker that count; further ones are left out.
pub const CACHED_LIMIT: usize = 64;

/// What a worker says of itself.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Offer {
    /// What it computes with.
    pub backend: String,
    /// Memory that a task may take, bytes; 0 = not said, any task fits.
    pub memory_bytes: u64,
    /// Artefacts that it need not download, at most [`CACHED_LIMIT`].
    pub cached: Vec<ArtefactId>,
}

/// The limits of all jobs. Times are milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// A lease without a sign of life for this long is taken back.
    pub lease_millis: u64,
    /// An attempt whose signs of life tell of no progress for this long is taken back: its worker hangs.
    pub stall_millis: u64,
    /// A worker that is silent and holds nothing for this long is forgotten.
    pub silence_millis: u64,
    /// A ready task that fits no worker of its backend, when all else of its job has ended, is quarantined after this long.
    pub strand_millis: u64,
    /// For this long a task that failed on a worker waits for another one, if there is one.
    pub patience_millis: u64,
    /// First pause after trouble that may pass; each further one is twice as long.
    pub backoff_millis: u64,
    /// Longest such pause.
    pub backoff_limit_millis: u64,
    /// An idle worker asks again after this long, or longer where there are many.
    pub ask_millis: u64,
    /// A task whose work failed in this many attempts is quarantined.
    pub failures_limit: u32,
    /// A task whose worker vanished in this many attempts is quarantined. Higher than `failures_limit`, as machines that come
    /// and go are no fault of the task.
    pub losses_limit: u32,
    /// A task that met trouble of the infrastructure in this many attempts is quarantined.
    pub troubles_limit: u32,
    /// A task that failed on, or vanished with, this many different workers is quarantined: it may be what kills them.
    pub culprits_limit: u32,
    /// Tasks of a job, those that appear while it runs included.
    pub tasks_limit: u32,
    /// Jobs.
    pub jobs_limit: u32,
    /// Whether stragglers get a second attempt on an idle worker.
    pub duplicates: bool,
    /// Whether tasks are granted strictly in the plan's order; otherwise those first that the longest chains wait for.
    pub plan_order: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            lease_millis: 30_000,
            stall_millis: 3_600_000,
            silence_millis: 120_000,
            strand_millis: 600_000,
            patience_millis: 10_000,
            backoff_millis: 1000,
            backoff_limit_millis: 60_000,
            ask_millis: 200,
            failures_limit: 3,
            losses_limit: 6,
            troubles_limit: 12,
            culprits_limit: 3,
            tasks_limit: 1_000_000,
            jobs_limit: 1000,
            duplicates: true,
            plan_order: false,
        }
    }
}

impl Settings {
    /// For workers that share one machine: a second attempt would slow the first down, none is faster than another, and what
    /// failed on one need not wait for the other.
    pub fn one_machine(self) -> Self {
        Self { duplicates: false, plan_order: true, patience_millis: 0, ..self }
    }
}

/// The learning rate's factor of a task that never diverged, in thousandths.
pub const FULL_RATE: u16 = 1000;

/// What one attempt holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lease {
    /// Which attempt.
    pub fence: Fence,
    /// Who holds it.
    pub worker: WorkerId,
    /// When it was granted.
    pub began_millis: u64,
    /// When it ends without a further sign of life.
    pub until_millis: u64,
    /// When its result is expected.
    pub expected_millis: u64,
    /// When it last told of progress.
    pub advanced_millis: u64,
    /// How much of the task it said to have done, in thousandths.
    pub done_permille: u16,
    /// Whether its worker was ever heard of since the grant.
    pub heard: bool,
    /// Whether `began_millis` is of this scheduler's own clock; after a restart it is not, and teaches no speed.
    pub timed: bool,
    /// What the job's share was charged for it.
    pub charged: u64,
}

/// Where a task stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum TaskState {
    /// Some dependencies are not done.
    Waiting {
        /// How many.
        missing: u32,
    },
    /// May be granted.
    Ready {
        /// Since when.
        since_millis: u64,
    },
    /// Ready again after a pause.
    Delayed {
        /// When.
        until_millis: u64,
    },
    /// One worker is at it, or two are: the second where the first is late.
    Leased {
        /// One or two.
        leases: Vec<Lease>,
    },
    /// Final: the artefact is the task's result.
    Done {
        /// The attempt that made it.
        fence: Fence,
        /// What it made.
        artefact: ArtefactId,
    },
    /// Final until a person retries it: its input is wrong, and would be wrong for any worker.
    Failed {
        /// The attempt that said so.
        fence: Fence,
        /// What is wrong.
        message: String,
    },
    /// Final until a person retries it: a limit was reached, or nothing fits it.
    Quarantined {
        /// The last attempt; number 0 if there was none.
        fence: Fence,
        /// What the last attempt said, or what no worker has.
        message: String,
    },
}

impl TaskState {
    /// Whether the task will not change again by itself.
    pub fn is_final(&self) -> bool {
        matches!(self, Self::Done { .. } | Self::Failed { .. } | Self::Quarantined { .. })
    }

    /// The attempts under way.
    pub fn leases(&self) -> &[Lease] {
        if let Self::Leased { leases } = self { leases } else { &[] }
    }
}

/// All that must be remembered of a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskRecord {
    /// What it is; its dependencies are sorted.
    pub node: TaskNode,
    /// Its memory as it is now believed, bytes: grows when an attempt ran out.
    pub memory_bytes: u64,
    /// Where it stands.
    pub state: TaskState,
    /// Attempts granted so far; the next is one more.
    pub attempts: u32,
    /// Attempts whose work failed.
    pub failures: u32,
    /// Attempts whose worker vanished.
    pub losses: u32,
    /// Attempts that met trouble of the infrastructure.
    pub troubles: u32,
    /// Attempts that ran out of memory.
    pub overflows: u32,
    /// Attempts that diverged.
    pub divergences: u32,
    /// The different workers that it failed on or vanished with.
    pub culprits: Vec<WorkerId>,
}

impl TaskRecord {
    /// The learning rate's factor of its next attempt, in thousandths.
    pub fn rate_permille(&self) -> u16 {
        if self.divergences == 0 { FULL_RATE } else { FULL_RATE / 2 }
    }

    /// The work it counts for.
    pub(crate) fn work(&self) -> u64 {
        self.node.work.max(1)
    }

    /// The attempt that holds a lease under this fence.
    pub(crate) fn lease(&self, fence: Fence) -> Option<&Lease> {
        self.state.leases().iter().find(|lease| lease.fence == fence)
    }
}
