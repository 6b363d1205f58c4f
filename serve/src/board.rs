//! What is known of all jobs and workers, and what changed since the last delta. It knows no clock: time is an input.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use proto::watch_event::Event as Update;
use proto::{LogKind, LogLine, StatusReply, TaskState, WorkerStatus};

use crate::job::JobRecord;
use crate::project::Project;
use crate::views::{AttemptEnd, Delta, Event, EventKind, Kind, Level, Server, Snapshot, Worker, WorkerState};

/// Events that are kept for all jobs, and those of a snapshot.
const EVENTS_KEPT: usize = 20_000;
const EVENTS_SHOWN: usize = 200;
/// Workers that have gone and are still shown.
const GONE_SHOWN: usize = 200;

/// The state that the pages show.
#[derive(Debug)]
pub(crate) struct Board {
    pub(crate) server: Server,
    pub(crate) jobs: BTreeMap<u64, JobRecord>,
    workers: BTreeMap<String, Worker>,
    events: VecDeque<Event>,
    next_event: u64,
    changed: Changed,
}

#[derive(Debug, Default)]
struct Changed {
    server: bool,
    jobs: BTreeSet<u64>,
    workers: BTreeSet<String>,
    events: Vec<Event>,
    tasks: BTreeMap<u64, BTreeSet<u32>>,
}

impl Board {
    pub(crate) fn new(server: Server) -> Self {
        Self {
            server,
            jobs: BTreeMap::new(),
            workers: BTreeMap::new(),
            events: VecDeque::new(),
            next_event: 1,
            changed: Changed::default(),
        }
    }

    /// Adds a job.
    pub(crate) fn add(&mut self, id: u64, project: Arc<Project>) {
        self.jobs.insert(id, JobRecord::new(id, project));
        self.changed.jobs.insert(id);
    }

    /// Forgets the jobs that are not among these.
    pub(crate) fn retain(&mut self, known: &BTreeSet<u64>) {
        self.jobs.retain(|id, _| known.contains(id));
    }

    /// A job and all its tasks have new figures.
    pub(crate) fn remeasured(&mut self, id: u64) -> Option<&mut JobRecord> {
        let tasks = self.jobs.get(&id)?.project.blocks() as u32;
        self.changed.tasks.entry(id).or_default().extend(0..tasks);
        self.job_mut(id)
    }

    /// Marks a job as changed; `None` if it is not known.
    pub(crate) fn job_mut(&mut self, id: u64) -> Option<&mut JobRecord> {
        let job = self.jobs.get_mut(&id)?;
        self.changed.jobs.insert(id);
        Some(job)
    }

    /// Applies a job's status.
    pub(crate) fn status(&mut self, now: u64, status: &StatusReply) {
        if let Some(job) = self.jobs.get_mut(&status.job)
            && job.set_status(now, status)
        {
            self.changed.jobs.insert(status.job);
        }
    }

    /// Applies an update of a job.
    pub(crate) fn update(&mut self, now: u64, id: u64, update: &Update) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        self.changed.jobs.insert(id);
        match update {
            Update::Changed(changed) => {
                job.change(now, changed);
                self.changed.tasks.entry(id).or_default().insert(changed.task);
                if let Some(worker) = self.workers.get_mut(&changed.worker)
                    && changed.state() == TaskState::Leased
                {
                    (worker.job, worker.task, worker.attempt) = (Some(id), Some(changed.task), changed.attempt);
                    set_worker_state(worker, now, WorkerState::Busy);
                    self.changed.workers.insert(changed.worker.clone());
                }
            }
            Update::Reported(reported) => {
                if let Some(report) = &reported.report {
                    job.report(now, reported.task, reported.attempt, report);
                    self.changed.tasks.entry(id).or_default().insert(reported.task);
                    let change = job.task_change(reported.task);
                    if let Some(change) = change
                        && let Some(worker) = self.workers.get_mut(&change.worker)
                    {
                        (worker.heard_unix_ms, worker.steps_per_second) = (now, change.speed);
                        self.changed.workers.insert(change.worker);
                    }
                }
            }
            Update::Finished(finished) => {
                job.outcome = Some(finished.outcome());
                job.merging = self.server.kind == Kind::Train;
                job.ended_unix_ms.get_or_insert(now);
            }
        }
    }

    /// Applies a page of a job's log.
    pub(crate) fn log(&mut self, now: u64, id: u64, lines: &[LogLine]) {
        for line in lines {
            let Some(job) = self.jobs.get_mut(&id) else { return };
            let unix_ms = now.saturating_sub(line.millis_ago);
            job.log(unix_ms, line);
            if line.what.starts_with("finished: ") {
                job.ended_unix_ms = Some(unix_ms);
            }
            if let Some(task) = line.task {
                self.changed.tasks.entry(id).or_default().insert(task);
            }
            let worker = match line.worker.is_empty() {
                false => line.worker.clone(),
                true => worker_of(job, line).unwrap_or_default(),
            };
            if let Some(of) = self.workers.get_mut(&worker) {
                match line.kind() {
                    LogKind::Done => of.done += 1,
                    LogKind::Ended | LogKind::Delayed => of.failed += 1,
                    _ => {}
                }
                self.changed.workers.insert(worker.clone());
            }
            let level = match line.kind() {
                LogKind::Failed | LogKind::Quarantined => Level::Error,
                LogKind::Ended | LogKind::Delayed => Level::Warn,
                _ => Level::Info,
            };
            let kind = match line.kind() {
                LogKind::Granted => EventKind::Began,
                LogKind::Done => EventKind::Done,
                LogKind::Ended => EventKind::Failed,
                LogKind::Delayed => EventKind::Lost,
                LogKind::Stopped => EventKind::Revoked,
                LogKind::Ready | LogKind::Failed | LogKind::Quarantined | LogKind::Other => EventKind::Other,
            };
            let (task, attempt, what) = (line.task, line.attempt, line.what.clone());
            self.event(Event { number: 0, unix_ms, job: Some(id), task, attempt, worker, level, kind, what });
        }
        self.changed.jobs.insert(id);
    }

    /// Adds an event; its number is given here.
    pub(crate) fn event(&mut self, mut event: Event) {
        event.number = self.next_event;
        self.next_event += 1;
        if self.events.len() >= EVENTS_KEPT {
            self.events.pop_front();
        }
        self.events.push_back(event.clone());
        self.changed.events.push(event);
    }

    /// Applies the list of connected workers. One that is silent for longer than a lease is lost; one that is missing was lost if it had a
    /// task, else it left.
    pub(crate) fn set_workers(&mut self, now: u64, statuses: &[WorkerStatus], lease_millis: u64) {
        let is_paused = self.jobs.values().all(|job| job.outcome.is_some());
        for status in statuses {
            let worker = self.workers.entry(status.name.clone()).or_insert_with(|| Worker {
                name: status.name.clone(),
                backend: String::new(),
                state: WorkerState::Idle,
                job: None,
                task: None,
                attempt: 0,
                heard_unix_ms: now,
                since_unix_ms: now,
                idle_reason: String::new(),
                memory_bytes: 0,
                done: 0,
                failed: 0,
                steps_per_second: None,
            });
            let before = worker.clone();
            (worker.backend, worker.memory_bytes) = (status.backend.clone(), status.memory_bytes);
            worker.heard_unix_ms = worker.heard_unix_ms.max(now.saturating_sub(status.silent_millis));
            let state = match &status.attempt {
                _ if status.silent_millis > lease_millis => WorkerState::Lost,
                Some(attempt) => {
                    (worker.job, worker.task, worker.attempt) = (Some(attempt.job), Some(attempt.task), attempt.number);
                    WorkerState::Busy
                }
                None => {
                    (worker.job, worker.task, worker.steps_per_second) = (None, None, None);
                    WorkerState::Idle
                }
            };
            set_worker_state(worker, now, state);
            worker.idle_reason = match state {
                WorkerState::Idle if is_paused => "no job is running".into(),
                WorkerState::Idle => "no task is ready that fits it".into(),
                _ => String::new(),
            };
            // A heartbeat alone is no news more often than each two seconds.
            let told = Worker { heard_unix_ms: before.heard_unix_ms, ..worker.clone() };
            if told != before || worker.heard_unix_ms > before.heard_unix_ms + 2000 {
                self.changed.workers.insert(status.name.clone());
            } else {
                worker.heard_unix_ms = before.heard_unix_ms;
            }
        }
        let present: BTreeSet<&str> = statuses.iter().map(|status| status.name.as_str()).collect();
        for (name, worker) in &mut self.workers {
            if !present.contains(name.as_str()) && !matches!(worker.state, WorkerState::Lost | WorkerState::Left) {
                let task = worker.job.zip(worker.task);
                let is_held = |(job, task): (u64, u32)| {
                    let record = self.jobs.get(&job).and_then(|job| job.tasks.get(task as usize));
                    record.is_some_and(|record| record.state == TaskState::Leased)
                };
                let state = if task.is_some_and(is_held) { WorkerState::Lost } else { WorkerState::Left };
                set_worker_state(worker, now, state);
                worker.steps_per_second = None;
                self.changed.workers.insert(name.clone());
            }
        }
        let gone = |worker: &Worker| matches!(worker.state, WorkerState::Lost | WorkerState::Left);
        while self.workers.values().filter(|worker| gone(worker)).count() > GONE_SHOWN {
            let oldest = self.workers.values().filter(|worker| gone(worker)).min_by_key(|worker| worker.since_unix_ms);
            let Some(name) = oldest.map(|worker| worker.name.clone()) else { break };
            self.workers.remove(&name);
        }
    }

    /// The coordinator has ended in order, and with it its log: counts what its workers did from the attempts.
    pub(crate) fn coordinator_ended(&mut self, now: u64) {
        self.set_workers(now, &[], 0);
        for (name, worker) in &mut self.workers {
            let attempts = self.jobs.values().flat_map(|job| &job.tasks).flat_map(|task| &task.attempts);
            let done = attempts.filter(|attempt| attempt.worker == *name && attempt.end == AttemptEnd::Done).count();
            worker.done = done as u32;
        }
    }

    /// Changes what is said of the server.
    pub(crate) fn set_server(&mut self, server: Server) {
        if server != self.server {
            self.server = server;
            self.changed.server = true;
        }
    }

    /// Jobs whose expected end moves as time passes.
    fn running(&self) -> impl Iterator<Item = u64> {
        self.jobs.values().filter(|job| job.outcome.is_none()).map(|job| job.id)
    }

    /// What changed since the last call; `None` if nothing did.
    pub(crate) fn take_delta(&mut self, now: u64) -> Option<Delta> {
        let changed = std::mem::take(&mut self.changed);
        if !changed.server
            && changed.jobs.is_empty()
            && changed.workers.is_empty()
            && changed.events.is_empty()
            && changed.tasks.is_empty()
        {
            return None;
        }
        let of_job = |(id, tasks): (u64, BTreeSet<u32>)| {
            let job = self.jobs.get(&id)?;
            Some((id, tasks.into_iter().filter_map(|task| job.task_change(task)).collect()))
        };
        let shown: BTreeSet<u64> = changed.jobs.into_iter().chain(self.running()).collect();
        Some(Delta {
            now_unix_ms: now,
            server: changed.server.then(|| self.server.clone()),
            jobs: shown.iter().filter_map(|id| Some(self.jobs.get(id)?.view(now))).collect(),
            workers: changed.workers.iter().filter_map(|name| self.workers.get(name).cloned()).collect(),
            events: changed.events,
            tasks: changed.tasks.into_iter().filter_map(of_job).collect(),
        })
    }

    pub(crate) fn snapshot(&self, seq: u64, now: u64) -> Snapshot<'_> {
        let shown = self.events.len().saturating_sub(EVENTS_SHOWN);
        Snapshot {
            seq,
            now_unix_ms: now,
            server: &self.server,
            jobs: self.jobs.values().map(|job| job.view(now)).collect(),
            workers: self.workers.values().cloned().collect(),
            events: self.events.range(shown..).cloned().collect(),
        }
    }

    /// At most `limit` events of a job, and of one of its tasks if given, with higher numbers than `after`.
    pub(crate) fn events(&self, job: u64, task: Option<u32>, after: u64, limit: usize) -> Vec<Event> {
        let of = |event: &&Event| event.job == Some(job) && (task.is_none() || event.task == task);
        self.events.iter().filter(|event| event.number > after).filter(of).take(limit).cloned().collect()
    }
}

fn set_worker_state(worker: &mut Worker, now: u64, state: WorkerState) {
    if worker.state != state {
        (worker.state, worker.since_unix_ms) = (state, now);
    }
}

/// The worker of the attempt that a line is about.
fn worker_of(job: &JobRecord, line: &LogLine) -> Option<String> {
    let attempts = &job.tasks.get(line.task? as usize)?.attempts;
    let attempt = attempts.iter().find(|attempt| attempt.number == line.attempt)?;
    Some(attempt.worker.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::server;

    #[test]
    fn workers_are_busy_idle_lost_or_gone() {
        let mut board = Board::new(server());
        let status = |name: &str, silent_millis, attempt: Option<u32>| WorkerStatus {
            name: name.into(),
            silent_millis,
            attempt: attempt.map(|task| proto::Attempt { job: 1, task, number: 1, epoch: 1 }),
            ..WorkerStatus::default()
        };
        let states = |board: &Board| {
            let snapshot = board.snapshot(0, 0);
            snapshot.workers.iter().map(|worker| (worker.name.clone(), worker.state)).collect::<Vec<_>>()
        };
        let of = |name: &str, state| (name.to_owned(), state);
        board.set_workers(10_000, &[status("a", 50, Some(3)), status("b", 900, None)], 3000);
        assert_eq!(states(&board), [of("a", WorkerState::Busy), of("b", WorkerState::Idle)]);
        assert_eq!(board.snapshot(0, 0).workers[1].idle_reason, "no job is running");
        // A job was cancelled: its worker has no task and has not spoken since, but for no longer than a lease.
        board.set_workers(12_000, &[status("a", 2050, None), status("b", 10, None)], 3000);
        assert_eq!(states(&board)[0], of("a", WorkerState::Idle));
        board.set_workers(13_500, &[status("a", 3550, None)], 3000);
        assert_eq!(states(&board), [of("a", WorkerState::Lost), of("b", WorkerState::Left)]);
        board.set_workers(14_000, &[status("a", 10, Some(4))], 3000);
        assert_eq!(states(&board)[0], of("a", WorkerState::Busy));
        // A heartbeat alone is told every two seconds.
        assert!(board.take_delta(14_000).is_some());
        board.set_workers(15_000, &[status("a", 10, Some(4))], 3000);
        assert!(board.take_delta(15_000).is_none());
        board.set_workers(16_500, &[status("a", 10, Some(4))], 3000);
        assert_eq!(board.take_delta(16_500).unwrap().workers.len(), 1);
    }
}
