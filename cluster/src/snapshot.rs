//! The durable state of a scheduler, and the restore from it.
//!
//! Job headers and task records are durable. They can be stored individually, as [`Action::Changed`](crate::Action) and
//! [`Action::Agreed`](crate::Action) name them. Workers, speeds and fair-share floors are not durable; workers join
//! again.
//!
//! Times in a snapshot may come from another clock, so a restored scheduler restarts all time spans. Leases get their
//! full length from now, and a backoff is at most the maximum backoff.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::dag::Addition;
use crate::job::{Job, Task};
use crate::retry;
use crate::scheduler::Scheduler;
use crate::types::{Fence, JobId, Lease, Settings, TaskIndex, TaskRecord, TaskState, WorkerId};

/// The durable state of a job without its tasks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobHeader {
    /// Its number.
    pub id: JobId,
    /// As submitted.
    pub backend: String,
    /// As submitted, or as changed by a user.
    pub priority: u8,
    /// As submitted, or as changed by a user.
    pub weight: u32,
    /// Whether a user paused it.
    pub paused: bool,
    /// Whether a user cancelled it.
    pub cancelled: bool,
    /// Service received: worker milliseconds divided by weight. May be stale.
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

/// The durable state of a scheduler.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The epoch of the scheduler that it was taken from.
    pub epoch: u64,
    /// All jobs in ascending order.
    pub jobs: Vec<JobSnapshot>,
}

/// Why a snapshot cannot be restored.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    /// The epoch is not new.
    #[error("epoch {epoch} is not above epoch {seen} of the snapshot; a scheduler needs a new epoch")]
    Epoch {
        /// The given epoch.
        epoch: u64,
        /// The epoch of the snapshot.
        seen: u64,
    },
    /// A job is inconsistent.
    #[error("job {} of the snapshot is invalid: {problem}", job.0)]
    Job {
        /// The job.
        job: JobId,
        /// The problem.
        problem: String,
    },
}

impl Scheduler {
    /// The header of a job; `None` for an unknown job.
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

    /// The durable state, in `O(tasks)`.
    pub fn snapshot(&self) -> Snapshot {
        let tasks = |id| self.records(id).map(|(_, record)| record.clone()).collect();
        let jobs = self.jobs().filter_map(|id| Some(JobSnapshot { header: self.header(id)?, tasks: tasks(id) }));
        Snapshot { epoch: self.epoch, jobs: jobs.collect() }
    }

    /// Restores a scheduler from a snapshot. Its epoch must be above all earlier epochs.
    ///
    /// # Errors
    /// [`RestoreError`] for an epoch that is not new or an inconsistent snapshot.
    pub fn restore(snapshot: Snapshot, settings: Settings, epoch: u64, now_millis: u64) -> Result<Self, RestoreError> {
        if epoch <= snapshot.epoch {
            return Err(RestoreError::Epoch { epoch, seen: snapshot.epoch });
        }
        let mut scheduler = Self::new(settings, epoch);
        scheduler.now_millis = now_millis;
        let mut holders = BTreeSet::new();
        for JobSnapshot { header, tasks } in snapshot.jobs {
            let id = header.id;
            let invalid = |problem: String| RestoreError::Job { job: id, problem };
            if scheduler.jobs.contains_key(&id) {
                return Err(invalid("it appears twice".into()));
            }
            let nodes = tasks.iter().map(|record| record.node.clone()).collect();
            let addition = Addition::new(nodes, 0, settings.tasks_limit).map_err(|error| invalid(error.to_string()))?;
            let mut job = Job::new(id, header.backend, header.priority, header.weight, &settings);
            (job.paused, job.cancelled, job.served) = (header.paused, header.cancelled, header.served);
            let done: Vec<bool> = tasks.iter().map(|task| matches!(task.state, TaskState::Done { .. })).collect();
            for (index, (mut record, node)) in tasks.into_iter().zip(addition.nodes).enumerate() {
                record.node = node;
                let missing = record.node.dependencies.iter().filter(|task| !done[task.0 as usize]).count() as u32;
                let restorer = RecordRestorer { settings: &settings, now_millis, missing, cancelled: job.cancelled };
                restorer
                    .restore(&mut record, epoch, &mut holders)
                    .map_err(|problem| invalid(format!("task {index} {problem}")))?;
                job.tasks.push(Task { critical_path: record.work(), record, dependents: Vec::new() });
            }
            for task in 0..job.tasks.len() {
                for dependency in job.tasks[task].record.node.dependencies.clone() {
                    job.tasks[dependency.0 as usize].dependents.push(TaskIndex(task as u32));
                }
            }
            job.index_from(0, &addition.order, &mut scheduler.indices);
            job.end_announced = job.is_over();
            scheduler.unfinished += usize::from(!job.is_over());
            scheduler.jobs.insert(id, job);
            scheduler.mark_changed(id);
        }
        scheduler.finish_step(&mut Vec::new());
        Ok(scheduler)
    }
}

/// Restores the records of one job.
struct RecordRestorer<'a> {
    settings: &'a Settings,
    now_millis: u64,
    missing: u32,
    cancelled: bool,
}

impl RecordRestorer<'_> {
    /// Checks a record and restarts its time spans.
    fn restore(&self, record: &mut TaskRecord, epoch: u64, holders: &mut BTreeSet<WorkerId>) -> Result<(), String> {
        let now = self.now_millis;
        let fresh = match self.missing {
            0 => TaskState::Ready { since_millis: now },
            missing => TaskState::Waiting { missing },
        };
        let attempts = record.attempts;
        let known = |fence: Fence| {
            let known = fence.epoch < epoch && fence.number <= attempts;
            if known { Ok(()) } else { Err(format!("has attempt {fence:?}, which cannot exist")) }
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
                    return Err(format!("has {} running attempts", leases.len()));
                }
                for lease in leases.iter_mut() {
                    known(lease.fence)?;
                    if !holders.insert(lease.worker) {
                        return Err(format!("is leased to worker {}, which holds another lease", lease.worker.0));
                    }
                    self.renew_lease(lease);
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
            record.state = TaskState::Quarantined { fence, message: "the limit of attempts is reached".into() };
        }
        Ok(())
    }

    fn renew_lease(&self, lease: &mut Lease) {
        let now = self.now_millis;
        let span = lease.expected_millis.saturating_sub(lease.began_millis).min(1 << 40);
        lease.began_millis = now;
        lease.progressed_millis = now;
        lease.until_millis = now.saturating_add(self.settings.lease_millis);
        lease.expected_millis = now.saturating_add(span);
        lease.is_timed = false;
    }
}
