//! The job log: a bounded list of lines for people. Each line is also an event of the process's log. Nothing depends on it.

use std::collections::VecDeque;

use cluster::{Action, AttemptId, JobId, Scheduler, TaskIndex, TaskState, WorkerId};
use proto::{LogKind, LogLine};

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
}

#[derive(Debug)]
struct Line {
    number: u64,
    now: u64,
    job: JobId,
    task: Option<TaskIndex>,
    /// 0 if the line is about no attempt.
    attempt: u32,
    /// The worker's number.
    worker: Option<u32>,
    kind: LogKind,
    message: String,
}

impl Line {
    /// A line about an attempt.
    fn of(now: u64, of: AttemptId, kind: LogKind, message: String) -> Self {
        let AttemptId { job, task, fence } = of;
        Self { number: 0, now, job, task: Some(task), attempt: fence.number, worker: None, kind, message }
    }
}

impl Log {
    /// Adds a line about a whole job.
    pub(crate) fn job(&mut self, now: u64, job: JobId, message: impl Into<String>) {
        let message = message.into();
        tracing::info!(job = job.0, "{message}");
        let kind = LogKind::Other;
        self.keep(Line { number: 0, now, job, task: None, attempt: 0, worker: None, kind, message });
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
                    let (job, task) = (*job, Some(*task));
                    self.keep(Line { number: 0, now, job, task, attempt, worker: None, kind, message });
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
            millis_ago: now.saturating_sub(line.now),
            task: line.task.map(|task| task.0),
            attempt: line.attempt,
            worker: worker(line).unwrap_or_default(),
            what: line.message.clone(),
            kind: line.kind.into(),
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
        if self.lines.len() >= LINES_LIMIT {
            self.lines.pop_front();
        }
        self.next += 1;
        line.number = self.next;
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
