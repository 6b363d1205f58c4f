//! The state of all jobs, without I/O: it translates between the wire's words and the scheduler's, and remembers what
//! the scheduler does not care for (names of workers, plans, who watches).

use std::collections::BTreeMap;

use cluster::journal::{Line, digest, to_text};
use cluster::{
    Action, AttemptId, Event, Failure, Fence, JobId, JobSpec, Offer, Scheduler, Settings, Snapshot, TaskIndex,
    TaskState, WorkerId,
};
use proto::WatchEvent;
use proto::control_request::What;
use proto::lease_reply::Reply;
use proto::watch_event::Event as News;
use scene::ArtefactId;
use tokio::sync::mpsc;
use tonic::Status;

use crate::Options;
use crate::news::{Watched, Watchers, changed, finished, to_wire};

/// Different names of workers.
const WORKERS_LIMIT: usize = 100_000;
/// Failures that a status lists.
const FAILURES_LISTED: usize = 100;
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
    journal: Option<mpsc::Sender<String>>,
}

/// What the scheduler does not care for.
struct Job {
    plan: ArtefactId,
    watchers: Watchers,
}

impl Jobs {
    pub(crate) fn new(options: Options) -> Self {
        let settings = Settings { ask_millis: options.wait_millis.into(), ..options.settings };
        let epoch = options.epoch.max(1);
        let snapshot = Snapshot { epoch: epoch - 1, jobs: Vec::new() };
        let mut jobs = Self {
            workers: BTreeMap::new(),
            names: Vec::new(),
            scheduler: Scheduler::new(settings, epoch),
            jobs: BTreeMap::new(),
            next_job: 1,
            journal: options.journal.clone(),
            options,
        };
        jobs.write(|| Line::Began { settings, snapshot, epoch, now_millis: 0 });
        jobs
    }

    pub(crate) fn submit(&mut self, now: u64, plan: ArtefactId, spec: JobSpec) -> Result<u64, Status> {
        if self.jobs.len() >= self.options.settings.jobs_limit as usize {
            // The oldest that is over makes room.
            let over = self.jobs.keys().find(|id| self.scheduler.finished(**id).is_some()).copied();
            let over =
                over.ok_or_else(|| Status::resource_exhausted(format!("{} jobs are running", self.jobs.len())))?;
            self.step(now, Event::ForgetRequested { job: over });
            self.jobs.remove(&over);
        }
        let id = JobId(self.next_job);
        self.jobs.insert(id, Job { plan, watchers: Watchers::default() });
        let actions = self.step(now, Event::Submitted { job: id, spec });
        if let Err(status) = agreed(&actions, Status::invalid_argument) {
            self.jobs.remove(&id);
            return Err(Status::invalid_argument(format!("plan {plan}: {}", status.message())));
        }
        self.next_job += 1;
        tracing::info!(job = id.0, %plan, "submitted");
        Ok(id.0)
    }

    pub(crate) fn lease(&mut self, now: u64, name: &str, offer: Offer) -> Result<Reply, Status> {
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
        let event = Event::Completed { attempt: self.attempt(of)?, artefact, followers: Vec::new() };
        Ok(accepted(&self.step(now, event)))
    }

    pub(crate) fn fail(&mut self, now: u64, of: proto::Attempt, failure: Failure) -> Result<bool, Status> {
        let attempt = self.attempt(of)?;
        let (kind, message) = (failure.kind, &failure.message);
        tracing::warn!(job = of.job, task = of.task, attempt = of.number, ?kind, "attempt failed: {message}");
        Ok(accepted(&self.step(now, Event::Failed { attempt, failure })))
    }

    pub(crate) fn cancel(&mut self, now: u64, id: u64) -> Result<(), Status> {
        self.job(JobId(id))?;
        agreed(&self.step(now, Event::CancelRequested { job: JobId(id) }), Status::failed_precondition)
    }

    pub(crate) fn control(&mut self, now: u64, id: u64, what: What) -> Result<(), Status> {
        let job = JobId(id);
        self.job(job)?;
        let event = match what {
            What::Pause(_) => Event::PauseRequested { job },
            What::Resume(_) => Event::ResumeRequested { job },
            What::RetryTask(task) => Event::RetryRequested { job, task: TaskIndex(task) },
            What::Reprioritise(proto::Reprioritise { priority, weight }) => {
                let priority = u8::try_from(priority)
                    .map_err(|_| Status::invalid_argument(format!("priority {priority} is above 255")))?;
                Event::ReprioritiseRequested { job, priority, weight }
            }
        };
        agreed(&self.step(now, event), Status::failed_precondition)
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
        let mut reply = proto::StatusReply { plan: job.plan.0.to_vec(), outcome, ..Default::default() };
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
            if failed && reply.failures.len() < FAILURES_LISTED {
                reply.failures.push(changed(task, &record.state, &self.names));
            }
        }
        Ok(reply)
    }

    pub(crate) fn tick(&mut self, now: u64) {
        self.step(now, Event::Ticked);
    }

    /// Steps the scheduler, and tells watchers what changed.
    fn step(&mut self, now: u64, event: Event) -> Vec<Action> {
        let small = cfg!(debug_assertions) && self.scheduler.total() <= CHECKED_TASKS;
        let before = small.then(|| self.scheduler.clone());
        let heard = self.journal.is_some().then(|| event.clone());
        let actions = self.scheduler.step(now, event);
        if let Some(event) = heard {
            self.write(|| Line::Step { now_millis: now, event, said: digest(&actions) });
        }
        if let Some(before) = before {
            let held = cluster::check(&self.scheduler);
            let held = held.and_then(|()| cluster::check_step(&before, &self.scheduler, &actions));
            held.unwrap_or_else(|violation| panic!("{violation}"));
        }
        for action in &actions {
            match action {
                Action::Changed { job: id, task } => {
                    if let (Some(job), Some(record)) = (self.jobs.get_mut(id), self.scheduler.record(*id, *task)) {
                        job.watchers.tell(News::Changed(changed(*task, &record.state, &self.names)));
                    }
                }
                Action::JobFinished { job: id, outcome } => {
                    tracing::info!(job = id.0, ?outcome, "finished");
                    if let Some(job) = self.jobs.get_mut(id) {
                        job.watchers.tell(finished(*outcome));
                        job.watchers = Watchers::default();
                    }
                }
                _ => {}
            }
        }
        actions
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
        Ok(proto::Grant {
            attempt: Some(proto::Attempt { job: job.0, task: task.0, number, epoch }),
            plan: self.job(job)?.plan.0.to_vec(),
            lease_millis,
            inputs: self.scheduler.inputs(job, task).into_iter().map(input).collect(),
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
        tracing::info!(worker = name, "joined");
        Ok(worker)
    }

    fn job(&self, id: JobId) -> Result<&Job, Status> {
        self.jobs.get(&id).ok_or_else(|| no_job(id))
    }

    fn attempt(&self, of: proto::Attempt) -> Result<AttemptId, Status> {
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
    let why = actions.iter().find_map(|action| match action {
        Action::Declined { why, .. } => Some(why.clone()),
        _ => None,
    });
    why.map_or(Ok(()), |why| Err(refuse(why)))
}

fn no_job(id: JobId) -> Status {
    Status::not_found(format!("there is no job {}", id.0))
}
