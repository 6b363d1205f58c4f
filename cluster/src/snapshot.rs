//! What must outlive a coordinator, as plain values, and a scheduler made of it again.
//!
//! Durable are jobs' headers and tasks' records; they may be kept one by one, as [`Action::Changed`](crate::Action) and
//! [`Action::Agreed`](crate::Action) name what to write. Workers, speeds and shares' floors are not: workers join again.
//! Every time in a snapshot is of a clock that may have been another one, so a restored scheduler begins all spans anew:
//! leases have their whole length from now on (a living worker's next sign of life finds its attempt, a dead one's lease
//! ends once), and pauses are at most the longest one.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::dag::Addition;
use crate::job::{Job, Task};
use crate::retry;
use crate::scheduler::Scheduler;
use crate::words::{Fence, JobId, Lease, Settings, TaskIndex, TaskRecord, TaskState, WorkerId};

/// What is remembered of a job beside its tasks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobHeader {
    /// Its number.
    pub id: JobId,
    /// As submitted.
    pub backend: String,
    /// As submitted, or as a person changed it.
    pub priority: u8,
    /// As submitted, or as a person changed it.
    pub weight: u32,
    /// Whether a person paused it.
    pub paused: bool,
    /// Whether a person cancelled it.
    pub cancelled: bool,
    /// What it had of its share, worker milliseconds by weight; may be stale.
    pub served: u64,
}

/// A job and its tasks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobSnapshot {
    /// The job.
    pub header: JobHeader,
    /// In the order of their indices.
    pub tasks: Vec<TaskRecord>,
}

/// All that is durable of a scheduler.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Of the scheduler that it was taken of.
    pub epoch: u64,
    /// All jobs, oldest number first.
    pub jobs: Vec<JobSnapshot>,
}

/// Why a snapshot is not one of a scheduler.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    /// The epoch is not a new one.
    #[error("epoch {epoch} is not above {seen}, which the snapshot has seen: a scheduler needs an epoch of its own")]
    Epoch {
        /// The epoch that was given.
        epoch: u64,
        /// The highest one in the snapshot.
        seen: u64,
    },
    /// A job that cannot be.
    #[error("job {} of the snapshot cannot be: {what}", job.0)]
    Job {
        /// Which.
        job: JobId,
        /// What is wrong with it.
        what: String,
    },
}

impl Scheduler {
    /// What is remembered of a job beside its tasks.
    pub fn header(&self, id: JobId) -> Option<JobHeader> {
        self.jobs.get(&id).map(|job| JobHeader {
            id,
            backend: job.backend.clone(),
            priority: job.priority,
            weight: job.weight,
            paused: job.paused,
            cancelled: job.cancelled,
            served: job.served,
        })
    }

    /// All that is durable, in `O(tasks)`.
    pub fn snapshot(&self) -> Snapshot {
        let tasks = |id| self.records(id).map(|(_, record)| record.clone()).collect();
        let jobs = self.jobs().filter_map(|id| Some(JobSnapshot { header: self.header(id)?, tasks: tasks(id) }));
        Snapshot { epoch: self.epoch, jobs: jobs.collect() }
    }

    /// A scheduler that goes on where the snapshot was taken. Its epoch must be above all that ever granted.
    ///
    /// # Errors
    /// [`RestoreError`] for a snapshot that no scheduler could have made.
    pub fn restore(snapshot: Snapshot, settings: Settings, epoch: u64, now_millis: u64) -> Result<Self, RestoreError> {
        if epoch <= snapshot.epoch {
            return Err(RestoreError::Epoch { epoch, seen: snapshot.epoch });
        }
        let mut scheduler = Self::new(settings, epoch);
        scheduler.now_millis = now_millis;
        let mut holders = BTreeSet::new();
        for JobSnapshot { header, tasks } in snapshot.jobs {
            let id = header.id;
            let wrong = |what: String| RestoreError::Job { job: id, what };
            if scheduler.jobs.contains_key(&id) {
                return Err(wrong("it is there twice".into()));
            }
            let nodes = tasks.iter().map(|record| record.node.clone()).collect();
            let addition = Addition::new(nodes, 0, settings.tasks_limit).map_err(|error| wrong(error.to_string()))?;
            let mut job = Job::new(id, header.backend, header.priority, header.weight, &settings);
            (job.paused, job.cancelled, job.served) = (header.paused, header.cancelled, header.served);
            let done: Vec<bool> = tasks.iter().map(|task| matches!(task.state, TaskState::Done { .. })).collect();
            for (index, (mut record, node)) in tasks.into_iter().zip(addition.nodes).enumerate() {
                record.node = node;
                let missing = record.node.dependencies.iter().filter(|task| !done[task.0 as usize]).count() as u32;
                let revived = Revival { settings: &settings, now_millis, missing, cancelled: job.cancelled };
                revived.of(&mut record, epoch, &mut holders).map_err(|what| wrong(format!("task {index} {what}")))?;
                job.tasks.push(Task { chain: record.work(), record, dependents: Vec::new() });
            }
            for task in 0..job.tasks.len() {
                for dependency in job.tasks[task].record.node.dependencies.clone() {
                    job.tasks[dependency.0 as usize].dependents.push(TaskIndex(task as u32));
                }
            }
            job.index_from(0, &addition.order, &mut scheduler.indices);
            job.said_finished = job.is_over();
            scheduler.unfinished += usize::from(!job.is_over());
            scheduler.jobs.insert(id, job);
            scheduler.touch(id);
        }
        scheduler.settle(&mut Vec::new());
        Ok(scheduler)
    }
}

/// What decides how a record goes on.
struct Revival<'a> {
    settings: &'a Settings,
    now_millis: u64,
    missing: u32,
    cancelled: bool,
}

impl Revival<'_> {
    /// Checks a record and begins its spans anew.
    fn of(&self, record: &mut TaskRecord, epoch: u64, holders: &mut BTreeSet<WorkerId>) -> Result<(), String> {
        let now = self.now_millis;
        let fresh = match self.missing {
            0 => TaskState::Ready { since_millis: now },
            missing => TaskState::Waiting { missing },
        };
        let attempts = record.attempts;
        let known = |fence: Fence| {
            let known = fence.epoch < epoch && fence.number <= attempts;
            if known { Ok(()) } else { Err(format!("knows of attempt {fence:?}, which cannot be")) }
        };
        let started =
            !matches!(record.state, TaskState::Waiting { .. } | TaskState::Ready { .. } | TaskState::Delayed { .. });
        if started && self.missing > 0 {
            return Err(format!("was granted, but {} of its dependencies are not done", self.missing));
        }
        match &mut record.state {
            TaskState::Waiting { .. } | TaskState::Ready { .. } => record.state = fresh,
            TaskState::Delayed { .. } if self.missing > 0 => record.state = fresh,
            TaskState::Delayed { until_millis } => {
                *until_millis = (*until_millis).min(now.saturating_add(self.settings.backoff_limit_millis));
            }
            TaskState::Leased { leases } => {
                if leases.is_empty() || leases.len() > 2 {
                    return Err(format!("has {} attempts under way", leases.len()));
                }
                for lease in leases.iter_mut() {
                    known(lease.fence)?;
                    if !holders.insert(lease.worker) {
                        return Err(format!("is held by worker {}, who holds another", lease.worker.0));
                    }
                    self.renew(lease);
                }
                if self.cancelled {
                    record.state = fresh;
                }
            }
            TaskState::Done { fence, .. } | TaskState::Failed { fence, .. } => known(*fence)?,
            TaskState::Quarantined { .. } => {}
        }
        if !record.state.is_final() && retry::is_poison(record, self.settings) {
            let fence = Fence { epoch, number: attempts };
            record.state = TaskState::Quarantined { fence, message: "it reached the limit of attempts".into() };
        }
        Ok(())
    }

    fn renew(&self, lease: &mut Lease) {
        let now = self.now_millis;
        let span = lease.expected_millis.saturating_sub(lease.began_millis).min(1 << 40);
        lease.began_millis = now;
        lease.advanced_millis = now;
        lease.until_millis = now.saturating_add(self.settings.lease_millis);
        lease.expected_millis = now.saturating_add(span);
        lease.timed = false;
    }
}
