//! The job log: a bounded list of lines for people. Each line is also an event of the process's log. Where jobs are durable, so are its
//! lines, and their numbers go on under the next leader. Nothing else depends on it.

use std::collections::VecDeque;

use cluster::{Action, AttemptId, JobId, Scheduler, TaskIndex, TaskState, WorkerId};
use proto::{LogKind, LogLine};
use serde::{Deserialize, Serialize};

/// Lines of all jobs that are kept; the oldest are dropped.
const LINES_LIMIT: usize = 100_000;
/// Bytes of a message; longer ones are truncated.
const MESSAGE_LIMIT: usize = 500;
/// Lines of one reply.
const PAGE: usize = 1000;

/// The lines of all jobs.
#[derive(Debug, Default)]
pub(crate) struct Log {
    lines: VecDeque<Line>,
    next: u64,
    /// The wall clock's time at the coordinator's time 0, milliseconds since 1970.
    began: u64,
    /// What is not in the state yet; `None` if nothing is durable.
    changes: Option<LogChanges>,
}

/// Changes of the log for the durable state.
#[derive(Debug, Default)]
pub(crate) struct LogChanges {
    pub(crate) added: Vec<Line>,
    /// Lines that are no longer kept.
    pub(crate) dropped: Vec<(JobId, u64)>,
}

/// One line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Line {
    /// Of all jobs' lines, from 1.
    pub(crate) number: u64,
    pub(crate) job: JobId,
    /// Milliseconds since 1970.
    at: u64,
    task: Option<TaskIndex>,
    /// 0 if the line is about no attempt.
    attempt: u32,
    /// The worker's number.
    worker: Option<u32>,
    /// A [`LogKind`], as it is on the wire.
    kind: i32,
    message: String,
}

impl Line {
    /// A line about a job. [`Log::keep`] gives it its number.
    fn new(now: u64, job: JobId, kind: LogKind, message: String) -> Self {
        Self { number: 0, job, at: now, task: None, attempt: 0, worker: None, kind: kind.into(), message }
    }

    /// A line about an attempt.
    fn of(now: u64, of: AttemptId, kind: LogKind, message: String) -> Self {
        let AttemptId { job, task, fence } = of;
        Self { task: Some(task), attempt: fence.number, ..Self::new(now, job, kind, message) }
    }
}

impl LogChanges {
    pub(crate) fn is_empty(&self) -> bool {
        self.added.is_empty() && self.dropped.is_empty()
    }
}

impl Log {
    /// The log with the lines of earlier leaders. `began` is the wall clock's time at the coordinator's time 0, milliseconds since 1970.
    pub(crate) fn restore(mut lines: Vec<Line>, began: u64) -> Self {
        lines.sort_unstable_by_key(|line| line.number);
        let next = lines.last().map_or(0, |line| line.number);
        Self { lines: lines.into(), next, began, changes: Some(LogChanges::default()) }
    }

    /// Takes the changes that are to be made durable.
    pub(crate) fn take_changes(&mut self) -> LogChanges {
        self.changes.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Drops the lines of a job that is forgotten; the state drops its rows with the job's.
    pub(crate) fn forget(&mut self, job: JobId) {
        self.lines.retain(|line| line.job != job);
    }

    /// Adds a line about a whole job.
    pub(crate) fn job(&mut self, now: u64, job: JobId, message: impl Into<String>) {
        let message = message.into();
        tracing::info!(job = job.0, "{message}");
        self.keep(Line::new(now, job, LogKind::Other, message));
    }

    /// Adds a line about a failed attempt.
    pub(crate) fn failure(&mut self, now: u64, of: AttemptId, message: impl Into<String>) {
        let AttemptId { job, task, fence } = of;
        let (attempt, message) = (fence.number, message.into());
        tracing::warn!(job = job.0, task = task.0, attempt, "{message}");
        self.keep(Line::of(now, of, LogKind::Ended, message));
    }

    /// Adds the lines about a step. `scheduler` is in the state after the step; `names` are the workers' names by number.
    pub(crate) fn step(&mut self, now: u64, scheduler: &Scheduler, actions: &[Action], names: &[String]) {
        for action in actions {
            match action {
                Action::Grant { worker, attempt, .. } => {
                    let name = names.get(worker.0 as usize);
                    self.of_worker(now, *attempt, *worker, name, (LogKind::Granted, "granted"));
                }
                Action::Stop { worker, attempt } => {
                    let name = names.get(worker.0 as usize);
                    self.of_worker(now, *attempt, *worker, name, (LogKind::Stopped, "stopped: no longer needed"));
                }
                Action::Changed { job, task } => {
                    let Some(record) = scheduler.record(*job, *task) else { continue };
                    let (kind, attempt, message) = match &record.state {
                        TaskState::Done { fence, artefact } => {
                            (LogKind::Done, fence.number, format!("done: {artefact}"))
                        }
                        TaskState::Failed { fence, message } => {
                            (LogKind::Failed, fence.number, format!("failed for good: {message}"))
                        }
                        TaskState::Quarantined { fence, message } => {
                            (LogKind::Quarantined, fence.number, format!("quarantined: {message}"))
                        }
                        TaskState::Delayed { .. } => {
                            (LogKind::Delayed, record.attempts, "waits before its next attempt".into())
                        }
                        TaskState::Ready { .. } if record.attempts > 0 => {
                            (LogKind::Ready, record.attempts, "waits for a worker again".into())
                        }
                        TaskState::Waiting { .. } | TaskState::Ready { .. } | TaskState::Leased { .. } => continue,
                    };
                    match record.state {
                        TaskState::Failed { .. } | TaskState::Quarantined { .. } => {
                            tracing::error!(job = job.0, task = task.0, attempt, "{message}");
                        }
                        _ => tracing::info!(job = job.0, task = task.0, attempt, "{message}"),
                    }
                    self.keep(Line { task: Some(*task), attempt, ..Line::new(now, *job, kind, message) });
                }
                Action::JobFinished { job, outcome } => self.job(now, *job, format!("finished: {outcome:?}")),
                _ => {}
            }
        }
    }

    /// The next lines of a job with numbers above `after`.
    pub(crate) fn page(&self, now: u64, job: JobId, after: u64, names: &[String]) -> Vec<LogLine> {
        let first = self.lines.partition_point(|line| line.number <= after);
        let lines = self.lines.range(first..).filter(|line| line.job == job).take(PAGE);
        let worker = |line: &Line| line.worker.and_then(|worker| names.get(worker as usize).cloned());
        let to_wire = |line: &Line| LogLine {
            number: line.number,
            millis_ago: (self.began + now).saturating_sub(line.at),
            task: line.task.map(|task| task.0),
            attempt: line.attempt,
            worker: worker(line).unwrap_or_default(),
            what: line.message.clone(),
            kind: line.kind,
        };
        lines.map(to_wire).collect()
    }

    fn of_worker(
        &mut self,
        now: u64,
        of: AttemptId,
        worker: WorkerId,
        name: Option<&String>,
        (kind, message): (LogKind, &str),
    ) {
        let AttemptId { job, task, fence } = of;
        tracing::info!(job = job.0, task = task.0, attempt = fence.number, worker = name, "{message}");
        self.keep(Line { worker: Some(worker.0), ..Line::of(now, of, kind, message.into()) });
    }

    fn keep(&mut self, mut line: Line) {
        if line.message.len() > MESSAGE_LIMIT {
            let end = (0..=MESSAGE_LIMIT).rev().find(|&end| line.message.is_char_boundary(end));
            line.message.truncate(end.unwrap_or(0));
        }
        self.next += 1;
        (line.number, line.at) = (self.next, self.began + line.at);
        let oldest = if self.lines.len() >= LINES_LIMIT { self.lines.pop_front() } else { None };
        if let Some(changes) = &mut self.changes {
            changes.dropped.extend(oldest.map(|line| (line.job, line.number)));
            changes.added.push(line.clone());
        }
        self.lines.push_back(line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_lines_are_kept_and_paged() {
        let mut log = Log::default();
        for i in 0..LINES_LIMIT as u64 + 10 {
            log.job(i, JobId(i % 2), "é".repeat(400));
        }
        let (mut after, mut count) = (0, 0);
        loop {
            let page = log.page(LINES_LIMIT as u64 + 10, JobId(1), after, &[]);
            let Some(last) = page.last() else { break };
            assert!(
                page.len() <= PAGE && page.iter().all(|line| line.number > after && line.what.len() <= MESSAGE_LIMIT)
            );
            (after, count) = (last.number, count + page.len());
        }
        assert_eq!((after, count), (LINES_LIMIT as u64 + 10, LINES_LIMIT / 2));
    }
}
