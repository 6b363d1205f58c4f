//! The state of all jobs, without I/O: it translates between the wire's words and the scheduler's, and remembers what
//! the scheduler does not care for (names of workers, plans, who watches). What a step changes gathers here, and so do the answers
//! and the news that must not go out before that is durable.

use std::collections::BTreeMap;
use std::sync::Arc;

use cluster::journal::{Line, digest, to_text};
use cluster::{
    Action, AttemptId, Changes, Event, Failure, Fence, JobId, JobSpec, Offer, Outcome, RestoreError, Scheduler,
    Settings, Snapshot, TaskIndex, TaskState, WorkerId,
};
use proto::WatchEvent;
use proto::control_request::What;
use proto::lease_reply::Reply;
use proto::watch_event::Event as News;
use scene::ArtefactId;
use telemetry::TraceParent;
use tokio::sync::mpsc;
use tonic::Status;

use crate::Options;
use crate::collect::Leftovers;
use crate::log::Log;
use crate::metrics::{Leads, Metrics};
use crate::news::{Watched, Watchers, changed, finished, to_wire};
use crate::state::{Batch, Origin, Restored};

/// Different names of workers.
const WORKERS_LIMIT: usize = 100_000;
/// Failures that a status lists, and tasks under way.
const TASKS_LISTED: usize = 100;
/// Debug builds check the invariants at each step while there are no more tasks than this.
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
    due: Vec<Due>,
    /// The job whose leftovers are being deleted.
    collecting: Option<JobId>,
}

/// What the scheduler does not care for.
struct Job {
    origin: Origin,
    watchers: Watchers,
}

/// What must not go out before all that was changed up to then is durable.
pub(crate) enum Due {
    /// The answer to a call.
    Answer(Box<dyn FnOnce() + Send>),
    /// For whoever watches the job.
    News(JobId, News),
    /// The last news.
    Over(JobId, Outcome),
}

impl Jobs {
    /// None yet, in memory.
    pub(crate) fn new(options: Options) -> Self {
        let epoch = options.epoch.max(1);
        let snapshot = Snapshot { epoch: epoch - 1, jobs: Vec::new() };
        let settings = Self::settings(&options);
        let mut jobs = Self::of(options, Scheduler::new(settings, epoch));
        jobs.write(|| Line::Began { settings, snapshot, epoch, now_millis: 0 });
        jobs
    }

    /// Those that were durable, under an epoch of their own.
    ///
    /// # Errors
    /// A state that no coordinator could have written.
    pub(crate) fn restore(options: Options, restored: Restored, epoch: u64) -> Result<Self, RestoreError> {
        let settings = Self::settings(&options);
        let Restored { snapshot, origins, workers, next_job } = restored;
        let began = options.journal.is_some().then(|| snapshot.clone());
        let mut jobs = Self::of(options, Scheduler::restore(snapshot, settings, epoch, 0)?);
        jobs.workers = workers.iter().cloned().zip((0..).map(WorkerId)).collect();
        jobs.names = workers;
        let job = |(id, origin)| (id, Job { origin, watchers: Watchers::default() });
        jobs.jobs = origins.into_iter().map(job).collect();
        jobs.next_job = next_job;
        jobs.write(|| Line::Began { settings, snapshot: began.unwrap_or_default(), epoch, now_millis: 0 });
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

    /// Under which epoch they are handed out.
    pub(crate) fn epoch(&self) -> u64 {
        self.scheduler.epoch()
    }

    pub(crate) fn metrics(&self) -> Arc<Metrics> {
        self.options.metrics.clone()
    }

    /// Tells how they stand.
    pub(crate) fn measure(&self, leads: &mut Leads<'_>) {
        leads.measure(&self.scheduler);
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.jobs.len()
    }

    /// Does this once all that was changed up to now is durable.
    pub(crate) fn once_durable(&mut self, answer: impl FnOnce() + Send + 'static) {
        self.due.push(Due::Answer(Box::new(answer)));
    }

    /// What is to be made durable, and what waits for that.
    pub(crate) fn take_gathered(&mut self) -> (Batch, Vec<Due>) {
        (std::mem::take(&mut self.batch), std::mem::take(&mut self.due))
    }

    /// Lets out what waited.
    pub(crate) fn deliver(&mut self, due: Vec<Due>) {
        for due in due {
            match due {
                Due::Answer(answer) => answer(),
                Due::News(id, news) => {
                    if let Some(job) = self.jobs.get_mut(&id) {
                        job.watchers.tell(news);
                    }
                }
                Due::Over(id, outcome) => {
                    if let Some(job) = self.jobs.get_mut(&id) {
                        job.watchers.tell(finished(outcome));
                        job.watchers = Watchers::default();
                    }
                }
            }
        }
    }

    /// `traced` is the span that its tasks are part of.
    pub(crate) fn submit(
        &mut self,
        now: u64,
        plan: ArtefactId,
        spec: JobSpec,
        traced: Option<TraceParent>,
    ) -> Result<u64, Status> {
        self.check_collecting()?;
        if self.jobs.len() >= self.options.settings.jobs_limit as usize {
            // The oldest that is over makes room.
            let over = self.jobs.keys().find(|id| self.scheduler.finished(**id).is_some()).copied();
            let over =
                over.ok_or_else(|| Status::resource_exhausted(format!("{} jobs are running", self.jobs.len())))?;
            self.step(now, Event::ForgetRequested { job: over });
            self.jobs.remove(&over);
        }
        let id = JobId(self.next_job);
        self.jobs.insert(id, Job { origin: Origin { plan, traced }, watchers: Watchers::default() });
        let actions = self.step(now, Event::Submitted { job: id, spec });
        if let Err(status) = agreed(&actions, Status::invalid_argument) {
            self.jobs.remove(&id);
            return Err(Status::invalid_argument(format!("plan {plan}: {}", status.message())));
        }
        self.next_job += 1;
        self.log.job(now, id, format!("submitted: plan {plan}, {} tasks", self.scheduler.len(id)));
        self.batch.next_job = Some(self.next_job);
        Ok(id.0)
    }

    /// `seen` is the highest epoch that the worker knows of.
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
        Err(Status::internal("the scheduler has no answer to a worker that asks"))
    }

    pub(crate) fn report(&mut self, now: u64, of: proto::Attempt, reports: Vec<proto::Report>) -> Result<bool, Status> {
        let attempt = self.attempt(of)?;
        let done = |report: &proto::Report| report.step.saturating_mul(1000).checked_div(report.steps);
        let done_permille = reports.iter().filter_map(done).next_back().map(|done| done.min(1000) as u16);
        let accepted = accepted(&self.step(now, Event::Progressed { attempt, done_permille }));
        if accepted && let Some(job) = self.jobs.get_mut(&attempt.job) {
            for report in reports {
                let report = proto::TaskReported { task: of.task, attempt: of.number, report: Some(report) };
                job.watchers.tell(News::Reported(report));
            }
        }
        Ok(accepted)
    }

    pub(crate) fn complete(&mut self, now: u64, of: proto::Attempt, artefact: ArtefactId) -> Result<bool, Status> {
        // Plans are whole when they are submitted: the wire has no tasks that follow from a result.
        let event = Event::Completed { attempt: self.attempt(of)?, artefact, follow_ups: Vec::new() };
        Ok(accepted(&self.step(now, event)))
    }

    pub(crate) fn fail(&mut self, now: u64, of: proto::Attempt, failure: Failure) -> Result<bool, Status> {
        let attempt = self.attempt(of)?;
        let (kind, message) = (failure.kind, &failure.message);
        if self.scheduler.holds(attempt) {
            self.log.trouble(now, attempt, format!("ended without a result, {kind:?}: {message}"));
        }
        Ok(accepted(&self.step(now, Event::Failed { attempt, failure })))
    }

    pub(crate) fn cancel(&mut self, now: u64, id: u64) -> Result<(), Status> {
        let job = JobId(id);
        self.job(job)?;
        self.log.job(now, job, "asked: cancel");
        agreed(&self.step(now, Event::CancelRequested { job }), Status::failed_precondition)
    }

    /// A worker goes; one that was never seen has nothing to give back.
    pub(crate) fn leave(&mut self, now: u64, name: &str) {
        if let Some(worker) = self.workers.get(name).copied() {
            tracing::info!(worker = name, "left");
            self.step(now, Event::Left { worker });
        }
    }

    pub(crate) fn control(&mut self, now: u64, id: u64, what: What) -> Result<(), Status> {
        let job = JobId(id);
        self.job(job)?;
        self.check_collecting()?;
        self.log.job(now, job, format!("asked: {}", words_of(&what)));
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
        agreed(&self.step(now, event), Status::failed_precondition)
    }

    /// What a job that is over leaves in the store, to be deleted before it is forgotten. No other may run: what a task builds on
    /// is known here only once it is done.
    pub(crate) fn collect(&mut self, id: u64) -> Result<Leftovers, Status> {
        let of = JobId(id);
        let plan = self.job(of)?.origin.plan;
        if let Some(other) = self.jobs.keys().find(|other| self.scheduler.finished(**other).is_none()) {
            return Err(Status::failed_precondition(format!("job {} runs; forget job {id} when none does", other.0)));
        }
        self.check_collecting()?;
        let mut left = Leftovers { artefacts: self.results(of).chain([plan]).collect(), ..Leftovers::default() };
        for (task, _) in self.scheduler.records(of) {
            let inputs = self.scheduler.inputs(of, task).into_iter().map(|(task, id)| (task.0, id)).collect();
            left.keys.insert(proto::result_key(plan, task.0, &inputs));
        }
        for (other, job) in self.jobs.iter().filter(|(other, _)| **other != of) {
            for id in self.results(*other).chain([job.origin.plan]) {
                left.artefacts.remove(&id);
            }
        }
        self.collecting = Some(of);
        Ok(left)
    }

    /// No task may begin while leftovers are being deleted: it might find what is about to go.
    fn check_collecting(&self) -> Result<(), Status> {
        match self.collecting {
            Some(JobId(job)) => {
                Err(Status::unavailable(format!("what job {job} left is being deleted; ask again in a while")))
            }
            None => Ok(()),
        }
    }

    /// What it left is deleted, or could not be: then it is still there, and may be forgotten another time.
    pub(crate) fn collected(&mut self, now: u64, id: u64, deleted: bool) -> Result<(), Status> {
        self.collecting = None;
        if deleted {
            self.control(now, id, What::Forget(proto::Forget {}))?;
            self.jobs.remove(&JobId(id));
        }
        Ok(())
    }

    fn results(&self, job: JobId) -> impl Iterator<Item = ArtefactId> + '_ {
        self.scheduler.records(job).filter_map(|(_, record)| match record.state {
            TaskState::Done { artefact, .. } => Some(artefact),
            _ => None,
        })
    }

    pub(crate) fn watch(&mut self, id: u64) -> Result<Watched, Status> {
        let id = JobId(id);
        let job = self.jobs.get_mut(&id).ok_or_else(|| no_job(id))?;
        let event = |news| WatchEvent { event: Some(news) };
        let records = self.scheduler.records(id);
        let mut snapshot: Vec<_> =
            records.map(|(task, record)| event(News::Changed(changed(task, &record.state, &self.names)))).collect();
        let rest = if let Some(outcome) = self.scheduler.finished(id) {
            snapshot.push(event(finished(outcome)));
            None
        } else {
            Some(job.watchers.add()?)
        };
        Ok(Watched { snapshot, rest })
    }

    pub(crate) fn status(&self, id: u64) -> Result<proto::StatusReply, Status> {
        let id = JobId(id);
        let job = self.job(id)?;
        let outcome = self.scheduler.finished(id).map(|outcome| to_wire(outcome).into());
        let mut reply =
            proto::StatusReply { job: id.0, plan: job.origin.plan.0.to_vec(), outcome, ..Default::default() };
        if let Some(header) = self.scheduler.header(id) {
            (reply.paused, reply.priority, reply.weight) = (header.paused, header.priority.into(), header.weight);
        }
        for (task, record) in self.scheduler.records(id) {
            match &record.state {
                TaskState::Waiting { .. } => reply.waiting += 1,
                TaskState::Ready { .. } | TaskState::Delayed { .. } => reply.ready += 1,
                TaskState::Leased { .. } => reply.leased += 1,
                TaskState::Done { .. } => reply.done += 1,
                TaskState::Failed { .. } => reply.failed += 1,
                TaskState::Quarantined { .. } => reply.quarantined += 1,
            }
            let failed = matches!(record.state, TaskState::Failed { .. } | TaskState::Quarantined { .. });
            if failed && reply.failures.len() < TASKS_LISTED {
                reply.failures.push(changed(task, &record.state, &self.names));
            }
            if matches!(record.state, TaskState::Leased { .. }) && reply.running.len() < TASKS_LISTED {
                reply.running.push(changed(task, &record.state, &self.names));
            }
        }
        Ok(reply)
    }

    /// Every job's status, without its tasks.
    pub(crate) fn list(&self) -> proto::JobsReply {
        let brief = |status| proto::StatusReply { failures: Vec::new(), running: Vec::new(), ..status };
        let jobs = self.jobs.keys().filter_map(|id| self.status(id.0).ok());
        proto::JobsReply { jobs: jobs.map(brief).collect() }
    }

    /// The plan of a job.
    pub(crate) fn plan(&self, id: u64) -> Result<ArtefactId, Status> {
        self.job(JobId(id)).map(|job| job.origin.plan)
    }

    /// What happened in a job after a line.
    pub(crate) fn logs(&self, now: u64, id: u64, after: u64) -> Result<proto::LogsReply, Status> {
        self.job(JobId(id))?;
        Ok(proto::LogsReply { lines: self.log.page(now, JobId(id), after, &self.names) })
    }

    /// How many of the workers that are there compute with what.
    pub(crate) fn backends(&self) -> Vec<proto::BackendCount> {
        let count = |(backend, workers): (&str, usize)| proto::BackendCount {
            backend: backend.into(),
            workers: workers as u32,
        };
        self.scheduler.backends().map(count).collect()
    }

    pub(crate) fn tick(&mut self, now: u64) {
        self.step(now, Event::Ticked);
    }

    /// Steps the scheduler; what changed gathers, for the durable state and for watchers.
    fn step(&mut self, now: u64, event: Event) -> Vec<Action> {
        let small = cfg!(debug_assertions) && self.scheduler.total() <= CHECKED_TASKS;
        let before = small.then(|| self.scheduler.clone());
        let actions = self.scheduler.step(now, event.clone());
        self.write(|| Line::Step { now_millis: now, event: event.clone(), answer: digest(&actions) });
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
                        let news = News::Changed(changed(*task, &record.state, &self.names));
                        self.due.push(Due::News(*job, news));
                    }
                }
                Action::JobFinished { job, outcome } => self.due.push(Due::Over(*job, *outcome)),
                _ => {}
            }
        }
        if self.options.durable.is_some() {
            self.gather(&event, &actions);
        }
        actions
    }

    /// Adds what a step changed to what is to be made durable.
    fn gather(&mut self, event: &Event, actions: &[Action]) {
        let changes = Changes::of(&self.scheduler, event, actions);
        for id in changes.headers.keys() {
            if let Some(job) = self.jobs.get(id) {
                self.batch.origins.insert(*id, job.origin.clone());
            }
        }
        self.batch.changes.absorb(changes);
    }

    /// Hands a line to whoever keeps the journal. A journal with a gap is worthless, so one that lags behind ends.
    fn write(&mut self, line: impl FnOnce() -> Line) {
        if let Some(journal) = &self.journal
            && journal.try_send(to_text(&line())).is_err()
        {
            tracing::warn!("the journal of the scheduler ends here: whoever writes it lags behind or is gone");
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

    /// Whoever knows of a higher epoch talks to a coordinator that no longer leads, and is not to believe what it says.
    fn check_epoch(&self, seen: u64) -> Result<(), Status> {
        let epoch = self.scheduler.epoch();
        if seen > epoch {
            let line = format!("this coordinator leads no more: it is of epoch {epoch}, there is one of epoch {seen}");
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

/// The answer to a person.
fn agreed(actions: &[Action], refuse: impl Fn(String) -> Status) -> Result<(), Status> {
    let reason = actions.iter().find_map(|action| match action {
        Action::Declined { reason, .. } => Some(reason.clone()),
        _ => None,
    });
    reason.map_or(Ok(()), |reason| Err(refuse(reason)))
}

/// What a person asked for, for the log.
fn words_of(what: &What) -> String {
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
