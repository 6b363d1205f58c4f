//! The scheduler's state and its entry point [`Scheduler::step`].
//!
//! The states of a task:
//!
//! ```text
//!                              backoff over
//!                            ┌──────────────── Delayed ◀─┐ infrastructure failure, lost worker
//!                            ▼                           │
//! Waiting ──all done──▶ Ready ──────granted──────▶ Leased ──completed──▶ Done
//!    ▲                   ▲ │                      │ │ ▲ │
//!    │                   │ │ fits no worker       │ │ └─┘ straggler: a speculative attempt, the first result wins
//!  follow-up tasks       │ ▼                      │ └──invalid input────▶ Failed ───────┐
//!  of a result           │ Quarantined ◀──────────┘ a limit is reached                  │
//!                        ├──────┴──────────────────retried by a user───────────────────┘
//!                        └──given back, failed or lost below the limits── (Leased)
//! ```
//!
//! Each grant is a new **attempt**, fenced by the scheduler's epoch and a number that grows per task. Reports about an
//! attempt that holds no lease are refused, so a zombie worker can waste work but not corrupt results. Dependents of a
//! failed task stay `Waiting`, all other branches continue. A job is over when no task is ready, delayed or leased.
//!
//! A restarted scheduler ([`Scheduler::restore`]) has a higher epoch. Attempts in the snapshot continue under the epoch
//! that granted them, with a renewed lease. Attempts that are not in the snapshot were never durable, so their grants
//! were never sent. Reports about them are refused.
//!
//! Cost per event: `O(log)` of tasks and workers, plus the dependents of a task that completes, plus the tasks of a job
//! that is submitted, cancelled or unschedulable.

use std::collections::{BTreeMap, BTreeSet};

use scene::ArtefactId;

use crate::events::{Action, Event, Outcome};
use crate::job::{Counts, Indices, Job};
use crate::pools::{Pool, Worker};
use crate::tally::Tally;
use crate::types::{AttemptId, JobId, Offer, Settings, TaskIndex, TaskRecord, WorkerId};

/// The scheduler of all jobs.
#[derive(Debug, Clone)]
pub struct Scheduler {
    pub(crate) settings: Settings,
    pub(crate) epoch: u64,
    pub(crate) now_millis: u64,
    pub(crate) jobs: BTreeMap<JobId, Job>,
    pub(crate) workers: BTreeMap<WorkerId, Worker>,
    pub(crate) pools: BTreeMap<String, Pool>,
    pub(crate) indices: Indices,
    /// When to check workers for a timeout.
    pub(crate) worker_timeouts: BTreeSet<(u64, WorkerId)>,
    /// When to check jobs for ready tasks that fit no worker.
    pub(crate) unschedulable_timeouts: BTreeSet<(u64, JobId)>,
    /// Number of jobs that are not over.
    pub(crate) unfinished: usize,
    /// Jobs that the current step changed.
    pub(crate) changed_jobs: BTreeSet<JobId>,
    pub(crate) tally: Tally,
}

/// A connected worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerView<'a> {
    /// What it offers.
    pub offer: &'a Offer,
    /// Time of its last message.
    pub seen_millis: u64,
    /// The attempt that it executes.
    pub attempt: Option<AttemptId>,
}

impl Scheduler {
    /// A scheduler without jobs. The epoch must be higher than that of every earlier scheduler of these workers.
    pub fn new(settings: Settings, epoch: u64) -> Self {
        Self {
            settings,
            epoch,
            now_millis: 0,
            jobs: BTreeMap::new(),
            workers: BTreeMap::new(),
            pools: BTreeMap::new(),
            indices: Indices::default(),
            worker_timeouts: BTreeSet::new(),
            unschedulable_timeouts: BTreeSet::new(),
            unfinished: 0,
            changed_jobs: BTreeSet::new(),
            tally: Tally::default(),
        }
    }

    /// Processes one event at this time and returns the actions to carry out, in order. A time before the last one
    /// counts as the last one.
    pub fn step(&mut self, now_millis: u64, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        self.now_millis = self.now_millis.max(now_millis);
        self.expire_timers(&mut actions);
        match event {
            Event::Submitted { job, spec } => self.submit(job, spec, &mut actions),
            Event::CancelRequested { job } => self.cancel(job, &mut actions),
            Event::PauseRequested { job } => self.control(job, &mut actions, |job| job.paused = true),
            Event::ResumeRequested { job } => self.control(job, &mut actions, |job| job.paused = false),
            Event::ReprioritiseRequested { job, priority, weight } => self.control(job, &mut actions, |job| {
                (job.priority, job.weight) = (priority, weight.max(1));
            }),
            Event::RetryRequested { job, task } => self.retry(job, task, &mut actions),
            Event::ForgetRequested { job } => self.forget(job, &mut actions),
            Event::Joined { worker, offer } => self.join(worker, offer),
            Event::Left { worker } => self.leave(worker, &mut actions),
            Event::LeaseRequested { worker } => self.lease(worker, &mut actions),
            Event::Progressed { attempt, done_permille } => self.progress(attempt, done_permille, &mut actions),
            Event::Completed { attempt, artefact, follow_ups } => {
                self.complete(attempt, artefact, follow_ups, &mut actions);
            }
            Event::Failed { attempt, failure } => self.fail(attempt, failure, &mut actions),
            Event::Ticked => {}
        }
        self.finish_step(&mut actions);
        self.tally.record_step(&actions);
        actions
    }

    /// The epoch of its grants.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// All jobs in ascending order.
    pub fn jobs(&self) -> impl Iterator<Item = JobId> + '_ {
        self.jobs.keys().copied()
    }

    /// Whether there is at least one job and all jobs are over.
    pub fn is_drained(&self) -> bool {
        !self.jobs.is_empty() && self.unfinished == 0
    }

    /// The offer of a worker, if the worker is known.
    pub fn offer(&self, worker: WorkerId) -> Option<&Offer> {
        self.workers.get(&worker).map(|worker| &worker.offer)
    }

    /// All connected workers, ascending, each with the attempt that it executes.
    pub fn workers(&self) -> impl Iterator<Item = (WorkerId, WorkerView<'_>)> {
        self.workers.iter().map(|(id, worker)| {
            let attempt = self.indices.lease_of.get(id).copied();
            (*id, WorkerView { offer: &worker.offer, seen_millis: worker.seen_millis, attempt })
        })
    }

    /// The number of workers of each backend that has any.
    pub fn backends(&self) -> impl Iterator<Item = (&str, usize)> {
        let pools = self.pools.iter().map(|(backend, pool)| (backend.as_str(), pool.memories.len()));
        pools.filter(|(_, workers)| *workers > 0)
    }

    /// Activity counters since the start.
    pub fn tally(&self) -> Tally {
        self.tally
    }

    /// The number of a job's tasks in each state; all zero for an unknown job.
    pub fn counts(&self, job: JobId) -> Counts {
        self.jobs.get(&job).map(|job| job.counts).unwrap_or_default()
    }

    /// Whether a user paused the job.
    pub fn is_paused(&self, job: JobId) -> bool {
        self.jobs.get(&job).is_some_and(|job| job.paused)
    }

    /// The number of tasks of a job; 0 for an unknown job.
    pub fn len(&self, job: JobId) -> usize {
        self.jobs.get(&job).map_or(0, |job| job.tasks.len())
    }

    /// The number of tasks of all jobs.
    pub fn total(&self) -> usize {
        self.jobs.values().map(|job| job.tasks.len()).sum()
    }

    /// The record of a task; `None` if it does not exist.
    pub fn record(&self, job: JobId, task: TaskIndex) -> Option<&TaskRecord> {
        self.jobs.get(&job)?.task(task).map(|task| &task.record)
    }

    /// Whether an attempt holds its lease, so that its reports are accepted.
    pub fn holds(&self, attempt: AttemptId) -> bool {
        self.find_lease(attempt).is_some()
    }

    /// The records of all tasks of a job, in order.
    pub fn records(&self, job: JobId) -> impl Iterator<Item = (TaskIndex, &TaskRecord)> {
        let tasks = self.jobs.get(&job).map_or(&[][..], |job| &job.tasks);
        (0..).map(TaskIndex).zip(tasks.iter().map(|task| &task.record))
    }

    /// The results of the task's dependencies, by task. Complete once the task is ready.
    pub fn inputs(&self, job: JobId, task: TaskIndex) -> BTreeMap<TaskIndex, ArtefactId> {
        let job = self.jobs.get(&job).filter(|job| job.task(task).is_some());
        job.map(|job| job.inputs(task).collect()).unwrap_or_default()
    }

    /// The outcome of a job; `None` while it runs or if it is unknown.
    pub fn finished(&self, job: JobId) -> Option<Outcome> {
        self.jobs.get(&job).filter(|job| job.is_over()).map(Job::outcome)
    }

    /// Marks a job for [`Scheduler::finish_step`].
    pub(crate) fn mark_changed(&mut self, job: JobId) {
        self.changed_jobs.insert(job);
    }
}
