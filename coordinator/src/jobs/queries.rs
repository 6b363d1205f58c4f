//! Read-only requests about jobs: status, list, log, watch.

use cluster::{AttemptId, JobId, TaskState, WorkerId, WorkerView};
use proto::WatchEvent;
use proto::watch_event::Event as Update;
use scene::ArtefactId;
use tonic::Status;

use super::{Jobs, no_job};
use crate::watchers::{Subscription, changed, finished, outcome_to_wire};

/// Largest number of failures, and of running tasks, in a status.
const TASKS_LISTED: usize = 100;

impl Jobs {
    /// Subscribes to a job's updates.
    pub(crate) fn watch(&mut self, id: u64) -> Result<Subscription, Status> {
        let id = JobId(id);
        let job = self.jobs.get_mut(&id).ok_or_else(|| no_job(id))?;
        let event = |update| WatchEvent { event: Some(update) };
        let records = self.scheduler.records(id);
        let mut snapshot: Vec<_> =
            records.map(|(task, record)| event(Update::Changed(changed(task, &record.state, &self.names)))).collect();
        let updates = if let Some(outcome) = self.scheduler.finished(id) {
            snapshot.push(event(finished(outcome)));
            None
        } else {
            Some(job.watchers.add()?)
        };
        Ok(Subscription { snapshot, updates })
    }

    /// A job's task counts, failures and running tasks.
    pub(crate) fn status(&self, id: u64) -> Result<proto::StatusReply, Status> {
        let id = JobId(id);
        let job = self.job(id)?;
        let outcome = self.scheduler.finished(id).map(|outcome| outcome_to_wire(outcome).into());
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

    /// The lines of a job's log after line `after`.
    pub(crate) fn logs(&self, now: u64, id: u64, after: u64) -> Result<proto::LogsReply, Status> {
        self.job(JobId(id))?;
        Ok(proto::LogsReply { lines: self.log.page(now, JobId(id), after, &self.names) })
    }

    /// Number of connected workers by backend.
    pub(crate) fn backends(&self) -> Vec<proto::BackendCount> {
        let count = |(backend, workers): (&str, usize)| proto::BackendCount {
            backend: backend.into(),
            workers: workers as u32,
        };
        self.scheduler.backends().map(count).collect()
    }

    /// The connected workers.
    pub(crate) fn workers(&self, now: u64) -> proto::WorkersReply {
        let status = |(id, view): (WorkerId, WorkerView<'_>)| proto::WorkerStatus {
            name: self.names.get(id.0 as usize).cloned().unwrap_or_default(),
            backend: view.offer.backend.clone(),
            memory_bytes: view.offer.memory_bytes,
            silent_millis: now.saturating_sub(view.seen_millis),
            attempt: view.attempt.map(|AttemptId { job, task, fence }| proto::Attempt {
                job: job.0,
                task: task.0,
                number: fence.number,
                epoch: fence.epoch,
            }),
        };
        let lease_millis = self.options.settings.lease_millis;
        proto::WorkersReply { workers: self.scheduler.workers().map(status).collect(), lease_millis }
    }
}
