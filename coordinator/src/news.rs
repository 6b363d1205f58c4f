//! Who watches a job, and what they are told, in the wire's words.

use cluster::{Outcome, TaskIndex, TaskState};
use proto::watch_event::Event as News;
use proto::{TaskChanged, WatchEvent};
use tokio::sync::mpsc;
use tonic::Status;

/// Watchers of one job.
const WATCHERS_LIMIT: usize = 64;
/// News that a watcher may lag behind before it is cut off.
const WATCHER_LAG_LIMIT: usize = 8192;

/// What a watcher gets at once, and what follows while the job runs.
pub(crate) struct Watched {
    pub(crate) snapshot: Vec<WatchEvent>,
    pub(crate) rest: Option<mpsc::Receiver<WatchEvent>>,
}

/// Who watches one job. When they are dropped, their streams end.
#[derive(Default)]
pub(crate) struct Watchers(Vec<mpsc::Sender<WatchEvent>>);

impl Watchers {
    /// One more.
    pub(crate) fn add(&mut self) -> Result<mpsc::Receiver<WatchEvent>, Status> {
        self.0.retain(|watcher| !watcher.is_closed());
        if self.0.len() >= WATCHERS_LIMIT {
            return Err(Status::resource_exhausted(format!("{WATCHERS_LIMIT} watch this job already")));
        }
        let (sender, receiver) = mpsc::channel(WATCHER_LAG_LIMIT);
        self.0.push(sender);
        Ok(receiver)
    }

    /// Tells all; one that is gone or lags too far behind is dropped, and its stream ends early.
    pub(crate) fn tell(&mut self, news: News) {
        if !self.0.is_empty() {
            let event = WatchEvent { event: Some(news) };
            self.0.retain(|watcher| watcher.try_send(event.clone()).is_ok());
        }
    }
}

pub(crate) fn finished(outcome: Outcome) -> News {
    News::Finished(proto::JobFinished { outcome: to_wire(outcome).into() })
}

pub(crate) fn to_wire(outcome: Outcome) -> proto::Outcome {
    match outcome {
        Outcome::Done => proto::Outcome::Done,
        Outcome::Incomplete => proto::Outcome::Incomplete,
        Outcome::Cancelled => proto::Outcome::Cancelled,
    }
}

/// Where a task stands. A pause before the next attempt is told as ready; of two attempts the later one is told.
pub(crate) fn changed(task: TaskIndex, state: &TaskState, names: &[String]) -> TaskChanged {
    let mut news = TaskChanged { task: task.0, ..Default::default() };
    let state = match state {
        TaskState::Waiting { .. } => proto::TaskState::Waiting,
        TaskState::Ready { .. } | TaskState::Delayed { .. } => proto::TaskState::Ready,
        TaskState::Leased { leases } => {
            if let Some(lease) = leases.last() {
                news.attempt = lease.fence.number;
                news.worker = names.get(lease.worker.0 as usize).cloned().unwrap_or_default();
            }
            proto::TaskState::Leased
        }
        TaskState::Done { fence, artefact } => {
            news.attempt = fence.number;
            news.artefact = artefact.0.to_vec();
            proto::TaskState::Done
        }
        TaskState::Failed { fence, message } => {
            news.attempt = fence.number;
            news.message = message.clone();
            proto::TaskState::Failed
        }
        TaskState::Quarantined { fence, message } => {
            news.attempt = fence.number;
            news.message = message.clone();
            proto::TaskState::Quarantined
        }
    };
    news.set_state(state);
    news
}
