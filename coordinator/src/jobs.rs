//! The state of all jobs, without I/O: translates between protocol messages and scheduler events, and holds what the scheduler does not
//! need (names of workers, plans, watchers). Collects the changes of each step, and the replies and updates that wait until those are
//! durable.

mod forget;
mod queries;

use std::collections::BTreeMap;
use std::sync::Arc;

use cluster::journal::{Line, digest, to_text};
use cluster::{
    Action, AttemptId, Changes, Event, Failure, Fence, JobId, JobSpec, Offer, Outcome, RestoreError, Scheduler,
    Settings, Snapshot, TaskIndex, WorkerId,
};
use proto::control_request::What;
use proto::lease_reply::Reply;
use proto::watch_event::Event as Update;
use scene::ArtefactId;
use telemetry::TraceParent;
use tokio::sync::mpsc;
use tonic::Status;

use crate::log::Log;
use crate::metrics::{LeaderMetrics, Metrics};
use crate::options::Options;
use crate::state::{Batch, Origin, Restored};
use crate::watchers::{Watchers, changed, finished};

/// Largest number of different worker names.
const WORKERS_LIMIT: usize = 100_000;
/// Debug builds check the invariants at each step up to this number of tasks.
const CHECKED_TASKS: usize = 1000;

/// All jobs.
pub(crate) struct Jobs {
    options: Options,
    workers: BTreeMap<String, WorkerId>,
    names: Vec<String>,
    scheduler: Scheduler,
    jobs: BTreeMap<JobId, Job>,
    next_job: u64,
    log: Log,
    journal: Option<mpsc::Sender<String>>,
    batch: Batch,
    due: Vec<Pending>,
    /// The job whose objects are being deleted.
    collecting: Option<JobId>,
}

/// What the scheduler does not need of a job.
struct Job {
    origin: Origin,
    watchers: Watchers,
}

/// Something that waits until all changes before it are durable.
pub(crate) enum Pending {
    /// The reply to a call.
    Reply(Box<dyn FnOnce() + Send>),
    /// An update for the job's watchers.
    Update(JobId, Update),
    /// The last update of a job.
    Finished(JobId, Outcome),
}

impl Jobs {
    /// No jobs, in memory.
    pub(crate) fn new(options: Options) -> Self {
        let epoch = options.epoch.max(1);
        let snapshot = Snapshot { epoch: epoch - 1, jobs: Vec::new() };
        let settings = Self::settings(&options);
        let mut jobs = Self::of(options, Scheduler::new(settings, epoch));
        jobs.write_journal(|| Line::Began { settings, snapshot, epoch, now_millis: 0 });
        jobs
    }

    /// The durable jobs, under a new epoch. `began` is the wall clock's time at time 0, milliseconds since 1970.
    ///
    /// # Errors
    /// A state that no coordinator could have written.
    pub(crate) fn restore(options: Options, restored: Restored, epoch: u64, began: u64) -> Result<Self, RestoreError> {
        let settings = Self::settings(&options);
        let Restored { snapshot, origins, workers, next_job, lines } = restored;
        let replayed = options.journal.is_some().then(|| snapshot.clone());
        let mut jobs = Self::of(options, Scheduler::restore(snapshot, settings, epoch, 0)?);
        jobs.workers = workers.iter().cloned().zip((0..).map(WorkerId)).collect();
        jobs.names = workers;
        let job = |(id, origin)| (id, Job { origin, watchers: Watchers::default() });
        jobs.jobs = origins.into_iter().map(job).collect();
        jobs.next_job = next_job;
        jobs.log = Log::restore(lines, began);
        let running: Vec<JobId> =
            jobs.jobs.keys().filter(|id| jobs.scheduler.finished(**id).is_none()).copied().collect();
        for id in running {
            jobs.log.job(0, id, format!("another coordinator leads, epoch {epoch}"));
        }
        jobs.write_journal(|| Line::Began { settings, snapshot: replayed.unwrap_or_default(), epoch, now_millis: 0 });
        Ok(jobs)
    }

    fn of(options: Options, scheduler: Scheduler) -> Self {
        Self {
            workers: BTreeMap::new(),
            names: Vec::new(),
            scheduler,
            jobs: BTreeMap::new(),
            next_job: 1,
            log: Log::default(),
            journal: options.journal.clone(),
            batch: Batch::default(),
            due: Vec::new(),
            collecting: None,
            options,
        }
    }

    fn settings(options: &Options) -> Settings {
        Settings { poll_millis: options.wait_millis.into(), ..options.settings }
    }

    /// The epoch of this coordinator's grants.
    pub(crate) fn epoch(&self) -> u64 {
        self.scheduler.epoch()
    }

    pub(crate) fn metrics(&self) -> Arc<Metrics> {
        self.options.metrics.clone()
    }

    /// Updates the metrics.
    pub(crate) fn update_metrics(&self, leading: &mut LeaderMetrics<'_>) {
        leading.update(&self.scheduler);
    }

    /// Number of jobs.
    pub(crate) fn len(&self) -> usize {
        self.jobs.len()
    }

    /// Calls `reply` once all changes up to now are durable.
    pub(crate) fn after_durable(&mut self, reply: impl FnOnce() + Send + 'static) {
        self.due.push(Pending::Reply(Box::new(reply)));
    }

    /// Takes the changes to make durable, and what waits for them.
    pub(crate) fn take_batch(&mut self) -> (Batch, Vec<Pending>) {
        let batch = Batch { log: self.log.take_changes(), ..std::mem::take(&mut self.batch) };
        (batch, std::mem::take(&mut self.due))
    }

    /// Sends replies and updates that are durable now.
    pub(crate) fn release(&mut self, due: Vec<Pending>) {
        for due in due {
            match due {
                Pending::Reply(reply) => reply(),
                Pending::Update(id, update) => {
                    if let Some(job) = self.jobs.get_mut(&id) {
                        job.watchers.send(update);
                    }
                }
                Pending::Finished(id, outcome) => {
                    if let Some(job) = self.jobs.get_mut(&id) {
                        job.watchers.send(finished(outcome));
                        job.watchers = Watchers::default();
                    }
                }
            }
        }
    }

    /// Submits a plan as a job; `traced` is the parent span of its tasks.
    pub(crate) fn submit(
        &mut self,
        now: u64,
        plan: ArtefactId,
        spec: JobSpec,
        traced: Option<TraceParent>,
    ) -> Result<u64, Status> {
        self.check_no_collection()?;
        if self.jobs.len() >= self.options.settings.jobs_limit as usize {
            // The oldest finished job is forgotten.
            let oldest = self.jobs.keys().find(|id| self.scheduler.finished(**id).is_some()).copied();
            let oldest =
                oldest.ok_or_else(|| Status::resource_exhausted(format!("{} jobs are running", self.jobs.len())))?;
            self.step(now, Event::ForgetRequested { job: oldest });
            self.jobs.remove(&oldest);
            self.log.forget(oldest);
        }
        let id = JobId(self.next_job);
        self.jobs.insert(id, Job { origin: Origin { plan, traced }, watchers: Watchers::default() });
        let actions = self.step(now, Event::Submitted { job: id, spec });
        if let Err(status) = declined(&actions, Status::invalid_argument) {
            self.jobs.remove(&id);
            return Err(Status::invalid_argument(format!("plan {plan}: {}", status.message())));
        }
        self.next_job += 1;
        self.log.job(now, id, format!("submitted: plan {plan}, {} tasks", self.scheduler.len(id)));
        self.batch.next_job = Some(self.next_job);
        Ok(id.0)
    }

    /// Answers a worker's lease request; `seen` is the highest epoch that it knows.
    pub(crate) fn lease(&mut self, now: u64, name: &str, offer: Offer, seen: u64) -> Result<Reply, Status> {
        self.check_epoch(seen)?;
        let worker = self.worker(name)?;
        if self.scheduler.offer(worker) != Some(&offer) {
            self.step(now, Event::Joined { worker, offer });
        }
        let actions = self.step(now, Event::LeaseRequested { worker });
        for action in &actions {
            match action {
                Action::Grant { attempt, .. } => return Ok(Reply::Grant(self.grant(*attempt)?)),
                Action::NothingYet { .. } if self.options.drain && self.scheduler.is_drained() => {
                    return Ok(Reply::Drained(proto::Drained {}));
                }
                Action::NothingYet { wait_millis, .. } => {
                    return Ok(Reply::WaitMillis(u32::try_from(*wait_millis).unwrap_or(u32::MAX)));
                }
                _ => {}
            }
        }
        Err(Status::internal("the scheduler did not answer a lease request"))
    }

    pub(crate) fn report(&mut self, now: u64, of: proto::Attempt, reports: Vec<proto::Report>) -> Result<bool, Status> {
        let attempt = self.attempt(of)?;
        let done = |report: &proto::Report| report.step.saturating_mul(1000).checked_div(report.steps);
        let done_permille = reports.iter().filter_map(done).next_back().map(|done| done.min(1000) as u16);
        let accepted = accepted(&self.step(now, Event::Progressed { attempt, done_permille }));
        if accepted && let Some(job) = self.jobs.get_mut(&attempt.job) {
            for report in reports {
                let report = proto::TaskReported { task: of.task, attempt: of.number, report: Some(report) };
                job.watchers.send(Update::Reported(report));
            }
        }
        Ok(accepted)
    }

    pub(crate) fn complete(&mut self, now: u64, of: proto::Attempt, artefact: ArtefactId) -> Result<bool, Status> {
        // A submitted plan has all its tasks: the protocol has no tasks that follow from a result.
        let event = Event::Completed { attempt: self.attempt(of)?, artefact, follow_ups: Vec::new() };
        Ok(accepted(&self.step(now, event)))
    }

    pub(crate) fn fail(&mut self, now: u64, of: proto::Attempt, failure: Failure) -> Result<bool, Status> {
        let attempt = self.attempt(of)?;
        let (kind, message) = (failure.kind, &failure.message);
        if self.scheduler.holds(attempt) {
            self.log.failure(now, attempt, format!("ended without a result, {kind:?}: {message}"));
        }
        Ok(accepted(&self.step(now, Event::Failed { attempt, failure })))
    }

    pub(crate) fn cancel(&mut self, now: u64, id: u64) -> Result<(), Status> {
        let job = JobId(id);
        self.job(job)?;
        self.log.job(now, job, "requested: cancel");
        declined(&self.step(now, Event::CancelRequested { job }), Status::failed_precondition)
    }

    /// A worker shuts down. An unknown one has no lease.
    pub(crate) fn leave(&mut self, now: u64, name: &str) {
        if let Some(worker) = self.workers.get(name).copied() {
            tracing::info!(worker = name, "left");
            self.step(now, Event::Left { worker });
        }
    }

    pub(crate) fn control(&mut self, now: u64, id: u64, what: What) -> Result<(), Status> {
        let job = JobId(id);
        self.job(job)?;
        self.check_no_collection()?;
        self.log.job(now, job, format!("requested: {}", request_text(&what)));
        let event = match what {
            What::Pause(_) => Event::PauseRequested { job },
            What::Resume(_) => Event::ResumeRequested { job },
            What::RetryTask(task) => Event::RetryRequested { job, task: TaskIndex(task) },
            What::Forget(_) => Event::ForgetRequested { job },
            What::Reprioritise(proto::Reprioritise { priority, weight }) => {
                let priority = u8::try_from(priority)
                    .map_err(|_| Status::invalid_argument(format!("priority {priority} is above 255")))?;
                Event::ReprioritiseRequested { job, priority, weight }
            }
        };
        declined(&self.step(now, event), Status::failed_precondition)
    }

    /// Refuses to start tasks during garbage collection: they could find objects that are about to be deleted.
    fn check_no_collection(&self) -> Result<(), Status> {
        match self.collecting {
            Some(JobId(job)) => {
                Err(Status::unavailable(format!("the objects of job {job} are being deleted; retry later")))
            }
            None => Ok(()),
        }
    }

    pub(crate) fn tick(&mut self, now: u64) {
        self.step(now, Event::Ticked);
    }

    /// Steps the scheduler and collects the changes for the durable state and for watchers.
    fn step(&mut self, now: u64, event: Event) -> Vec<Action> {
        let small = cfg!(debug_assertions) && self.scheduler.total() <= CHECKED_TASKS;
        let before = small.then(|| self.scheduler.clone());
        let actions = self.scheduler.step(now, event.clone());
        self.write_journal(|| Line::Step { now_millis: now, event: event.clone(), answer: digest(&actions) });
        if let Some(before) = before {
            let held = cluster::check(&self.scheduler);
            let held = held.and_then(|()| cluster::check_step(&before, &self.scheduler, &event, &actions));
            held.unwrap_or_else(|violation| panic!("{violation}"));
        }
        self.log.step(now, &self.scheduler, &actions, &self.names);
        for action in &actions {
            match action {
                Action::Changed { job, task } => {
                    if let Some(record) = self.scheduler.record(*job, *task) {
                        let update = Update::Changed(changed(*task, &record.state, &self.names));
                        self.due.push(Pending::Update(*job, update));
                    }
                }
                Action::JobFinished { job, outcome } => self.due.push(Pending::Finished(*job, *outcome)),
                _ => {}
            }
        }
        if self.options.durable.is_some() {
            self.add_to_batch(&event, &actions);
        }
        actions
    }

    /// Adds a step's changes to the batch.
    fn add_to_batch(&mut self, event: &Event, actions: &[Action]) {
        let changes = Changes::of(&self.scheduler, event, actions);
        for id in changes.headers.keys() {
            if let Some(job) = self.jobs.get(id) {
                self.batch.origins.insert(*id, job.origin.clone());
            }
        }
        self.batch.changes.absorb(changes);
    }

    /// Sends a line to the journal. A journal with a gap cannot be replayed, so it ends if its reader lags behind.
    fn write_journal(&mut self, line: impl FnOnce() -> Line) {
        if let Some(journal) = &self.journal
            && journal.try_send(to_text(&line())).is_err()
        {
            tracing::warn!("the scheduler's journal ends here: its writer lags behind or has ended");
            self.journal = None;
        }
    }

    fn grant(&mut self, attempt: AttemptId) -> Result<proto::Grant, Status> {
        let lease_millis = u32::try_from(self.options.settings.lease_millis).unwrap_or(u32::MAX);
        let input =
            |(task, artefact): (TaskIndex, ArtefactId)| proto::Input { task: task.0, artefact: artefact.0.to_vec() };
        let AttemptId { job, task, fence: Fence { epoch, number } } = attempt;
        let Origin { plan, traced } = &self.job(job)?.origin;
        Ok(proto::Grant {
            attempt: Some(proto::Attempt { job: job.0, task: task.0, number, epoch }),
            plan: plan.0.to_vec(),
            lease_millis,
            rate_permille: self.scheduler.record(job, task).map_or(0, |record| record.rate_permille().into()),
            inputs: self.scheduler.inputs(job, task).into_iter().map(input).collect(),
            traceparent: traced.as_ref().map(|parent| parent.as_str().into()).unwrap_or_default(),
        })
    }

    fn worker(&mut self, name: &str) -> Result<WorkerId, Status> {
        if let Some(worker) = self.workers.get(name) {
            return Ok(*worker);
        }
        if self.names.len() >= WORKERS_LIMIT {
            return Err(Status::resource_exhausted(format!("{WORKERS_LIMIT} workers have been seen")));
        }
        let worker = WorkerId(self.names.len() as u32);
        self.names.push(name.into());
        self.workers.insert(name.into(), worker);
        if self.options.durable.is_some() {
            self.batch.workers.insert(worker.0, name.into());
        }
        tracing::info!(worker = name, "joined");
        Ok(worker)
    }

    fn job(&self, id: JobId) -> Result<&Job, Status> {
        self.jobs.get(&id).ok_or_else(|| no_job(id))
    }

    /// Refuses a caller that has seen a higher epoch: this coordinator no longer leads.
    fn check_epoch(&self, seen: u64) -> Result<(), Status> {
        let epoch = self.scheduler.epoch();
        if seen > epoch {
            let line = format!("this coordinator no longer leads: its epoch is {epoch}, there is one of epoch {seen}");
            return Err(Status::unavailable(line));
        }
        Ok(())
    }

    fn attempt(&self, of: proto::Attempt) -> Result<AttemptId, Status> {
        self.check_epoch(of.epoch)?;
        let fence = Fence { epoch: of.epoch, number: of.number };
        let attempt = AttemptId { job: JobId(of.job), task: TaskIndex(of.task), fence };
        self.job(attempt.job).map(|_| attempt)
    }
}

fn accepted(actions: &[Action]) -> bool {
    actions.iter().any(|action| matches!(action, Action::Accepted { .. }))
}

/// The scheduler's refusal of a request, if it refused.
fn declined(actions: &[Action], refuse: impl Fn(String) -> Status) -> Result<(), Status> {
    let reason = actions.iter().find_map(|action| match action {
        Action::Declined { reason, .. } => Some(reason.clone()),
        _ => None,
    });
    reason.map_or(Ok(()), |reason| Err(refuse(reason)))
}

/// A request, for the log.
fn request_text(what: &What) -> String {
    match what {
        What::Pause(_) => "pause".into(),
        What::Resume(_) => "resume".into(),
        What::RetryTask(task) => format!("retry task {task}"),
        What::Forget(_) => "forget".into(),
        What::Reprioritise(proto::Reprioritise { priority, weight }) => format!("priority {priority}, weight {weight}"),
    }
}

fn no_job(id: JobId) -> Status {
    Status::not_found(format!("there is no job {}", id.0))
}
