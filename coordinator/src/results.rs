//! What becomes of a job, as those who watch it see it.

use proto::TaskState;
use scene::ArtefactId;
use tonic::{Code, Status};

/// Why a job has no result.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LocalError {
    /// The plan or a task's input is wrong: exit code 2.
    #[error("{0}")]
    Input(String),
    /// The work failed.
    #[error("{0}")]
    Failed(String),
    /// It was stopped.
    #[error("the job was cancelled")]
    Cancelled,
}

/// The last known state of each task of a job, as its news tell.
#[derive(Debug)]
pub struct Results {
    tasks: Vec<proto::TaskChanged>,
}

impl Results {
    /// Of a job of so many tasks, of which nothing is known yet.
    pub fn new(tasks: u32) -> Self {
        Self { tasks: (0..tasks).map(|task| proto::TaskChanged { task, ..Default::default() }).collect() }
    }

    /// Takes in a task's news.
    ///
    /// # Errors
    /// News of a task that the job does not have.
    pub fn note(&mut self, changed: proto::TaskChanged) -> Result<(), LocalError> {
        let task = changed.task;
        let unknown = || LocalError::Failed(format!("news of task {task}, which the plan does not have"));
        *self.tasks.get_mut(task as usize).ok_or_else(unknown)? = changed;
        Ok(())
    }

    /// The last known state of each task, in the plan's order.
    pub fn tasks(&self) -> &[proto::TaskChanged] {
        &self.tasks
    }

    /// Every task's result, in the plan's order.
    ///
    /// # Errors
    /// A task that is not done.
    pub fn all(&self) -> Result<Vec<ArtefactId>, LocalError> {
        self.tasks.iter().map(|task| proto::artefact_id(&task.artefact).map_err(of_status)).collect()
    }

    /// The first task that failed, why, and how many others were not run because of it.
    pub fn failure(&self) -> LocalError {
        let count = |wanted: TaskState| self.tasks.iter().filter(|task| task.state() == wanted).count();
        let first = self.tasks.iter().find(|task| matches!(task.state(), TaskState::Failed | TaskState::Quarantined));
        let Some(first) = first else {
            return LocalError::Failed("the job ended before all tasks were done".into());
        };
        let mut line = format!("task {} failed in attempt {}: {}", first.task, first.attempt, first.message);
        let others = count(TaskState::Failed) + count(TaskState::Quarantined) - 1;
        let blocked = count(TaskState::Waiting);
        if others > 0 {
            line += &format!("; {others} more failed");
        }
        if blocked > 0 {
            line += &format!("; {blocked} that depend on such were not started");
        }
        if first.state() == TaskState::Failed { LocalError::Input(line) } else { LocalError::Failed(line) }
    }
}

/// A refusal is the input's fault, anything else the cluster's.
pub fn of_status(status: Status) -> LocalError {
    let line = proto::explain(&status);
    match status.code() {
        Code::InvalidArgument
        | Code::NotFound
        | Code::FailedPrecondition
        | Code::Unauthenticated
        | Code::PermissionDenied
        | Code::Unimplemented => LocalError::Input(line),
        _ => LocalError::Failed(line),
    }
}
