//! The ladder of a task:
//!
//! ```text
//!                               pause over
//!                            ┌──────────────── Delayed ◀─┐ trouble that may pass
//!                            ▼                           │
//! Waiting ──all done──▶ Ready ──────granted──────▶ Leased ──completed──▶ Done
//!    ▲                   ▲ │                      │ │ ▲ │
//!    │                   │ │ fits no worker       │ │ └─┘ late: a second attempt elsewhere, the first result wins
//!  tasks that follow     │ ▼                      │ └──the input's fault──▶ Failed ─────┐
//!  from a result         │ Quarantined ◀──────────┘ a limit is reached                  │
//!                        ├──────┴──────────────────a person retries it─────────────────┘
//!                        └──given back, failed or lost below the limits── (Leased)
//! ```
//!
//! Each grant is a new **attempt**, fenced by the scheduler's epoch and a number that grows per task. Whatever a worker
//! says about an attempt that holds no lease is refused, so a zombie can waste work and never corrupt it. What depends on
//! a task that failed stays `Waiting` (its branch is a hole, all other branches go on), and a job is over when nothing is
//! ready, delayed or leased.
//!
//! A restarted scheduler ([`Scheduler::restore`]) has a higher epoch. Attempts that the snapshot holds go on under the epoch
//! that granted them, each with a whole new lease; attempts that it does not hold were never durable, so they were never
//! announced, and are refused whatever their number.
//!
//! Costs: `O(log)` of tasks and workers per event, plus the dependents of a task when it is done and the tasks of a job
//! when it is submitted, cancelled or stranded.

use std::collections::{BTreeMap, BTreeSet};

use scene::ArtefactId;

use crate::events::{Action, Event, Outcome};
use crate::job::{Counts, Indices, Job};
use crate::lanes::{Lane, Worker};
use crate::tally::Tally;
use crate::words::{AttemptId, JobId, Offer, Settings, TaskIndex, TaskRecord, WorkerId};

/// The scheduler of all jobs.
#[derive(Debug, Clone)]
pub struct Scheduler {
    pub(crate) settings: Settings,
    pub(crate) epoch: u64,
    pub(crate) now_millis: u64,
    pub(crate) jobs: BTreeMap<JobId, Job>,
    pub(crate) workers: BTreeMap<WorkerId, Worker>,
    pub(crate) lanes: BTreeMap<String, Lane>,
    pub(crate) indices: Indices,
    /// When to look whether a worker is silent.
    pub(crate) silences: BTreeSet<(u64, WorkerId)>,
    /// When to look whether a job's ready tasks fit anyone.
    pub(crate) strands: BTreeSet<(u64, JobId)>,
    /// Jobs whose end was not announced.
    pub(crate) unfinished: usize,
    /// Jobs that this step changed.
    pub(crate) touched: BTreeSet<JobId>,
    pub(crate) tally: Tally,
}

impl Scheduler {
    /// Followers count their siblings from here: see [`Event::Completed`].
    pub const FOLLOWER: u32 = 1 << 31;

    /// A scheduler without jobs. The epoch is higher than that of any scheduler of these workers before.
    pub fn new(settings: Settings, epoch: u64) -> Self {
        Self {
            settings,
            epoch,
            now_millis: 0,
            jobs: BTreeMap::new(),
            workers: BTreeMap::new(),
            lanes: BTreeMap::new(),
            indices: Indices::default(),
            silences: BTreeSet::new(),
            strands: BTreeSet::new(),
            unfinished: 0,
            touched: BTreeSet::new(),
            tally: Tally::default(),
        }
    }

    /// Takes in one event at this time and says what is to be done, in order. A clock that steps back stands still.
    pub fn step(&mut self, now_millis: u64, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        self.now_millis = self.now_millis.max(now_millis);
        self.pass_time(&mut actions);
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
            Event::Completed { attempt, artefact, followers } => {
                self.complete(attempt, artefact, followers, &mut actions);
            }
            Event::Failed { attempt, failure } => self.fail(attempt, failure, &mut actions),
            Event::Ticked => {}
        }
        self.settle(&mut actions);
        self.tally.note(&actions);
        actions
    }

    /// Under which epoch it grants.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// All jobs, oldest number first.
    pub fn jobs(&self) -> impl Iterator<Item = JobId> + '_ {
        self.jobs.keys().copied()
    }

    /// Whether there are jobs, and all are over.
    pub fn is_drained(&self) -> bool {
        !self.jobs.is_empty() && self.unfinished == 0
    }

    /// What a worker said of itself, if it is known.
    pub fn offer(&self, worker: WorkerId) -> Option<&Offer> {
        self.workers.get(&worker).map(|worker| &worker.offer)
    }

    /// How many workers there are of each backend that has any.
    pub fn backends(&self) -> impl Iterator<Item = (&str, usize)> {
        let lanes = self.lanes.iter().map(|(backend, lane)| (backend.as_str(), lane.memories.len()));
        lanes.filter(|(_, workers)| *workers > 0)
    }

    /// What it did since it began.
    pub fn tally(&self) -> Tally {
        self.tally
    }

    /// How many tasks of a job are where; none if there is no such job.
    pub fn counts(&self, job: JobId) -> Counts {
        self.jobs.get(&job).map(|job| job.counts).unwrap_or_default()
    }

    /// Whether a person paused the job.
    pub fn is_paused(&self, job: JobId) -> bool {
        self.jobs.get(&job).is_some_and(|job| job.paused)
    }

    /// Number of tasks of a job; 0 if there is no such job.
    pub fn len(&self, job: JobId) -> usize {
        self.jobs.get(&job).map_or(0, |job| job.tasks.len())
    }

    /// Number of tasks of all jobs.
    pub fn total(&self) -> usize {
        self.jobs.values().map(|job| job.tasks.len()).sum()
    }

    /// What is remembered of a task; `None` if there is no such.
    pub fn record(&self, job: JobId, task: TaskIndex) -> Option<&TaskRecord> {
        self.jobs.get(&job)?.task(task).map(|task| &task.record)
    }

    /// Whether an attempt holds its lease, so that what it says counts.
    pub fn holds(&self, attempt: AttemptId) -> bool {
        self.holder(attempt).is_some()
    }

    /// What is remembered of all tasks of a job, in their order.
    pub fn records(&self, job: JobId) -> impl Iterator<Item = (TaskIndex, &TaskRecord)> {
        let tasks = self.jobs.get(&job).map_or(&[][..], |job| &job.tasks);
        (0..).map(TaskIndex).zip(tasks.iter().map(|task| &task.record))
    }

    /// The results that this task builds on, by task: complete once the task is ready.
    pub fn inputs(&self, job: JobId, task: TaskIndex) -> BTreeMap<TaskIndex, ArtefactId> {
        let job = self.jobs.get(&job).filter(|job| job.task(task).is_some());
        job.map(|job| job.inputs(task).collect()).unwrap_or_default()
    }

    /// How the job ended, `None` while it runs or if there is none.
    pub fn finished(&self, job: JobId) -> Option<Outcome> {
        self.jobs.get(&job).filter(|job| job.is_over()).map(Job::outcome)
    }

    /// Marks a job whose place and end this step has to look at.
    pub(crate) fn touch(&mut self, job: JobId) {
        self.touched.insert(job);
    }
}
