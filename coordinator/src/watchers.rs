//! Watchers of a job: their streams, and updates as protocol messages.

use cluster::{Outcome, TaskIndex, TaskState};
use proto::watch_event::Event as Update;
use proto::{TaskChanged, WatchEvent};
use tokio::sync::mpsc;
use tonic::Status;

/// Largest number of watchers of one job.
const WATCHERS_LIMIT: usize = 64;
/// Updates that a watcher may lag behind before its stream ends.
const WATCHER_LAG_LIMIT: usize = 8192;

/// A watcher's stream: the current state, then the updates while the job runs.
pub(crate) struct Subscription {
    pub(crate) snapshot: Vec<WatchEvent>,
    /// `None` if the job is finished.
    pub(crate) updates: Option<mpsc::Receiver<WatchEvent>>,
}

/// The watchers of one job. Their streams end when this is dropped.
#[derive(Default)]
pub(crate) struct Watchers(Vec<mpsc::Sender<WatchEvent>>);

impl Watchers {
    /// Adds a watcher.
    pub(crate) fn add(&mut self) -> Result<mpsc::Receiver<WatchEvent>, Status> {
        self.0.retain(|watcher| !watcher.is_closed());
        if self.0.len() >= WATCHERS_LIMIT {
            return Err(Status::resource_exhausted(format!("this job has {WATCHERS_LIMIT} watchers already")));
        }
        let (sender, receiver) = mpsc::channel(WATCHER_LAG_LIMIT);
        self.0.push(sender);
        Ok(receiver)
    }

    /// Sends an update to all watchers. The stream of one that has gone or lags too far behind ends.
    pub(crate) fn send(&mut self, update: Update) {
        if !self.0.is_empty() {
            let event = WatchEvent { event: Some(update) };
            self.0.retain(|watcher| watcher.try_send(event.clone()).is_ok());
        }
    }
}

/// The last update of a job.
pub(crate) fn finished(outcome: Outcome) -> Update {
    Update::Finished(proto::JobFinished { outcome: outcome_to_wire(outcome).into() })
}

pub(crate) fn outcome_to_wire(outcome: Outcome) -> proto::Outcome {
    match outcome {
        Outcome::Done => proto::Outcome::Done,
        Outcome::Incomplete => proto::Outcome::Incomplete,
        Outcome::Cancelled => proto::Outcome::Cancelled,
    }
}

/// The update for a task's state. A delayed task counts as ready; of two running attempts the later one is named.
pub(crate) fn changed(task: TaskIndex, state: &TaskState, names: &[String]) -> TaskChanged {
    let mut update = TaskChanged { task: task.0, ..Default::default() };
    let state = match state {
        TaskState::Waiting { .. } => proto::TaskState::Waiting,
        TaskState::Ready { .. } | TaskState::Delayed { .. } => proto::TaskState::Ready,
        TaskState::Leased { leases } => {
            if let Some(lease) = leases.last() {
                update.attempt = lease.fence.number;
                update.worker = names.get(lease.worker.0 as usize).cloned().unwrap_or_default();
            }
            proto::TaskState::Leased
        }
        TaskState::Done { fence, artefact } => {
            update.attempt = fence.number;
            update.artefact = artefact.0.to_vec();
            proto::TaskState::Done
        }
        TaskState::Failed { fence, message } => {
            update.attempt = fence.number;
            update.message = message.clone();
            proto::TaskState::Failed
        }
        TaskState::Quarantined { fence, message } => {
            update.attempt = fence.number;
            update.message = message.clone();
            proto::TaskState::Quarantined
        }
    };
    update.set_state(state);
    update
}
