//! The state of all jobs, without I/O: it translates between the wire's words and the scheduler's, and remembers what
//! the scheduler does not care for (names of workers, plans, who watches).

use std::collections::BTreeMap;

use cluster::{Action, Event, Failure, FailureKind, Outcome, Scheduler, TaskIndex, TaskNode, TaskState, WorkerId};
use proto::lease_reply::Reply;
use proto::watch_event::Event as News;
use proto::{TaskChanged, WatchEvent};
use scene::ArtefactId;
use tokio::sync::mpsc;
use tonic::Status;

use crate::Options;

/// Jobs kept in memory; the oldest that is over makes room for a new one.
const JOBS_LIMIT: usize = 1000;
/// Different names of workers.
const WORKERS_LIMIT: usize = 100_000;
/// Watchers of one job.
const WATCHERS_LIMIT: usize = 64;
/// News that a watcher may lag behind before it is cut off.
const WATCHER_LAG_LIMIT: usize = 8192;
/// Failures that a status lists.
const FAILURES_LISTED: usize = 100;
/// Debug builds check the invariants of jobs up to this size at each step.
const CHECKED_TASKS: usize = 1000;

/// What a watcher gets at once, and what follows while the job runs.
pub(crate) struct Watched {
    pub(crate) snapshot: Vec<WatchEvent>,
    pub(crate) rest: Option<mpsc::Receiver<WatchEvent>>,
}

/// All jobs.
pub(crate) struct Jobs {
    options: Options,
    workers: BTreeMap<String, WorkerId>,
    names: Vec<String>,
    jobs: BTreeMap<u64, Job>,
    next_job: u64,
}

struct Job {
    plan: ArtefactId,
    backend: String,
    scheduler: Scheduler,
    watchers: Vec<mpsc::Sender<WatchEvent>>,
}

impl Jobs {
    pub(crate) fn new(options: Options) -> Self {
        Self { options, workers: BTreeMap::new(), names: Vec::new(), jobs: BTreeMap::new(), next_job: 1 }
    }

    pub(crate) fn submit(
        &mut self,
        now: u64,
        plan: ArtefactId,
        backend: String,
        dag: Vec<TaskNode>,
    ) -> Result<u64, Status> {
        if self.jobs.len() >= JOBS_LIMIT {
            let over = self.jobs.iter().find(|(_, job)| job.scheduler.finished().is_some()).map(|(id, _)| *id);
            let over = over.ok_or_else(|| Status::resource_exhausted(format!("{JOBS_LIMIT} jobs are running")))?;
            self.jobs.remove(&over);
        }
        let scheduler = Scheduler::new(dag, self.options.settings)
            .map_err(|error| Status::invalid_argument(format!("plan {plan}: {error}")))?;
        let id = self.next_job;
        self.next_job += 1;
        self.jobs.insert(id, Job { plan, backend, scheduler, watchers: Vec::new() });
        self.step(now, id, Event::Ticked)?;
        tracing::info!(job = id, %plan, "submitted");
        Ok(id)
    }

    pub(crate) fn lease(&mut self, now: u64, name: &str, backend: &str) -> Result<Reply, Status> {
        let worker = self.worker(name)?;
        let mut grant = None;
        let running = self.jobs.iter().filter(|(_, job)| job.scheduler.finished().is_none());
        let running: Vec<(u64, bool)> = running.map(|(id, job)| (*id, job.backend == backend)).collect();
        for (id, fits) in running {
            let asks = fits && grant.is_none();
            let event = if asks { Event::LeaseRequested { worker } } else { Event::WorkerIdle { worker } };
            let actions = self.step(now, id, event)?;
            for action in actions {
                if let Action::Grant { task, attempt, .. } = action {
                    grant = Some(self.grant(id, task, attempt)?);
                }
            }
        }
        let over = !self.jobs.is_empty() && self.jobs.values().all(|job| job.scheduler.finished().is_some());
        Ok(match grant {
            Some(grant) => Reply::Grant(grant),
            None if over && self.options.drain => Reply::Drained(proto::Drained {}),
            None => Reply::WaitMillis(self.options.wait_millis),
        })
    }

    pub(crate) fn report(&mut self, now: u64, of: proto::Attempt, reports: Vec<proto::Report>) -> Result<bool, Status> {
        let (task, attempt) = (TaskIndex(of.task), of.number);
        let accepted = accepted(&self.step(now, of.job, Event::Progressed { task, attempt })?);
        if accepted {
            let job = self.job(of.job)?;
            for report in reports {
                job.tell(News::Reported(proto::TaskReported { task: task.0, attempt, report: Some(report) }));
            }
        }
        Ok(accepted)
    }

    pub(crate) fn complete(&mut self, now: u64, of: proto::Attempt, artefact: ArtefactId) -> Result<bool, Status> {
        let event = Event::Completed { task: TaskIndex(of.task), attempt: of.number, artefact };
        Ok(accepted(&self.step(now, of.job, event)?))
    }

    pub(crate) fn fail(
        &mut self,
        now: u64,
        of: proto::Attempt,
        kind: FailureKind,
        message: String,
    ) -> Result<bool, Status> {
        tracing::warn!(job = of.job, task = of.task, attempt = of.number, ?kind, "attempt failed: {message}");
        let failure = Failure { kind, message: message.into() };
        let event = Event::Failed { task: TaskIndex(of.task), attempt: of.number, failure };
        Ok(accepted(&self.step(now, of.job, event)?))
    }

    pub(crate) fn cancel(&mut self, now: u64, id: u64) -> Result<(), Status> {
        self.step(now, id, Event::CancelRequested).map(|_| ())
    }

    pub(crate) fn watch(&mut self, id: u64) -> Result<Watched, Status> {
        let names = std::mem::take(&mut self.names);
        let watched = self.job(id).and_then(|job| job.watch(&names));
        self.names = names;
        watched
    }

    pub(crate) fn status(&self, id: u64) -> Result<proto::StatusReply, Status> {
        let job = self.jobs.get(&id).ok_or_else(|| no_job(id))?;
        let outcome = job.scheduler.finished().map(|outcome| to_wire(outcome).into());
        let mut reply = proto::StatusReply { plan: job.plan.0.to_vec(), outcome, ..Default::default() };
        for (task, state) in job.scheduler.states() {
            match state {
                TaskState::Waiting { .. } => reply.waiting += 1,
                TaskState::Ready => reply.ready += 1,
                TaskState::Leased { .. } => reply.leased += 1,
                TaskState::Done { .. } => reply.done += 1,
                TaskState::Failed { .. } => reply.failed += 1,
                TaskState::Quarantined { .. } => reply.quarantined += 1,
            }
            let failed = matches!(state, TaskState::Failed { .. } | TaskState::Quarantined { .. });
            if failed && reply.failures.len() < FAILURES_LISTED {
                reply.failures.push(changed(task, state, &self.names));
            }
        }
        Ok(reply)
    }

    pub(crate) fn tick(&mut self, now: u64) {
        let running = self.jobs.iter().filter(|(_, job)| job.scheduler.finished().is_none());
        let running: Vec<u64> = running.map(|(id, _)| *id).collect();
        for id in running {
            if let Err(error) = self.step(now, id, Event::Ticked) {
                tracing::error!(job = id, "tick: {}", error.message());
            }
        }
    }

    /// Steps one job and tells its watchers what changed.
    fn step(&mut self, now: u64, id: u64, event: Event) -> Result<Vec<Action>, Status> {
        let job = self.jobs.get_mut(&id).ok_or_else(|| no_job(id))?;
        let actions = job.scheduler.step(now, event);
        if cfg!(debug_assertions) && job.scheduler.len() <= CHECKED_TASKS {
            cluster::check(&job.scheduler).unwrap_or_else(|violation| panic!("job {id}: {violation}"));
        }
        for action in &actions {
            match action {
                Action::Changed { task } => {
                    let state = job.scheduler.state(*task).map(|state| changed(*task, state, &self.names));
                    state.into_iter().for_each(|state| job.tell(News::Changed(state)));
                }
                Action::JobFinished { outcome } => {
                    tracing::info!(job = id, ?outcome, "finished");
                    job.tell(finished(*outcome));
                    job.watchers.clear();
                }
                _ => {}
            }
        }
        Ok(actions)
    }

    fn grant(&mut self, id: u64, task: TaskIndex, attempt: u32) -> Result<proto::Grant, Status> {
        let lease_millis = u32::try_from(self.options.settings.lease_millis).unwrap_or(u32::MAX);
        let job = self.job(id)?;
        let input =
            |(task, artefact): (TaskIndex, ArtefactId)| proto::Input { task: task.0, artefact: artefact.0.to_vec() };
        Ok(proto::Grant {
            attempt: Some(proto::Attempt { job: id, task: task.0, number: attempt }),
            plan: job.plan.0.to_vec(),
            lease_millis,
            inputs: job.scheduler.inputs(task).into_iter().map(input).collect(),
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

    fn job(&mut self, id: u64) -> Result<&mut Job, Status> {
        self.jobs.get_mut(&id).ok_or_else(|| no_job(id))
    }
}

impl Job {
    /// Tells all watchers; one that is gone or lags too far behind is dropped, and its stream ends early.
    fn tell(&mut self, news: News) {
        let event = WatchEvent { event: Some(news) };
        self.watchers.retain(|watcher| watcher.try_send(event.clone()).is_ok());
    }

    fn watch(&mut self, names: &[String]) -> Result<Watched, Status> {
        self.watchers.retain(|watcher| !watcher.is_closed());
        if self.watchers.len() >= WATCHERS_LIMIT {
            return Err(Status::resource_exhausted(format!("{WATCHERS_LIMIT} watch this job already")));
        }
        let event = |news| WatchEvent { event: Some(news) };
        let states = self.scheduler.states();
        let mut snapshot: Vec<_> =
            states.map(|(task, state)| event(News::Changed(changed(task, state, names)))).collect();
        let rest = if let Some(outcome) = self.scheduler.finished() {
            snapshot.push(event(finished(outcome)));
            None
        } else {
            let (sender, receiver) = mpsc::channel(WATCHER_LAG_LIMIT);
            self.watchers.push(sender);
            Some(receiver)
        };
        Ok(Watched { snapshot, rest })
    }
}

fn accepted(actions: &[Action]) -> bool {
    actions.iter().any(|action| matches!(action, Action::Accepted { .. }))
}

fn no_job(id: u64) -> Status {
    Status::not_found(format!("there is no job {id}"))
}

fn finished(outcome: Outcome) -> News {
    News::Finished(proto::JobFinished { outcome: to_wire(outcome).into() })
}

fn to_wire(outcome: Outcome) -> proto::Outcome {
    match outcome {
        Outcome::Done => proto::Outcome::Done,
        Outcome::Incomplete => proto::Outcome::Incomplete,
        Outcome::Cancelled => proto::Outcome::Cancelled,
    }
}

fn changed(task: TaskIndex, state: &TaskState, names: &[String]) -> TaskChanged {
    let mut news = TaskChanged { task: task.0, ..Default::default() };
    let state = match state {
        TaskState::Waiting { .. } => proto::TaskState::Waiting,
        TaskState::Ready => proto::TaskState::Ready,
        TaskState::Leased { attempt, worker, .. } => {
            news.attempt = *attempt;
            news.worker = names.get(worker.0 as usize).cloned().unwrap_or_default();
            proto::TaskState::Leased
        }
        TaskState::Done { attempt, artefact } => {
            news.attempt = *attempt;
            news.artefact = artefact.0.to_vec();
            proto::TaskState::Done
        }
        TaskState::Failed { attempt, message } => {
            news.attempt = *attempt;
            news.message = message.to_string();
            proto::TaskState::Failed
        }
        TaskState::Quarantined { attempt, message } => {
            news.attempt = *attempt;
            news.message = message.to_string();
            proto::TaskState::Quarantined
        }
    };
    news.set_state(state);
    news
}
