//! The results of a job, gathered from its watch stream.

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
    /// The job was cancelled.
    #[error("the job was cancelled")]
    Cancelled,
}

/// The last known state of each task of a job.
#[derive(Debug)]
pub struct Results {
    tasks: Vec<proto::TaskChanged>,
}

impl Results {
    /// A job of this many tasks, all waiting.
    pub fn new(tasks: u32) -> Self {
        Self { tasks: (0..tasks).map(|task| proto::TaskChanged { task, ..Default::default() }).collect() }
    }

    /// Applies a task's update.
    ///
    /// # Errors
    /// An update of a task that the job does not have.
    pub fn update(&mut self, changed: proto::TaskChanged) -> Result<(), LocalError> {
        let task = changed.task;
        let unknown =
            || LocalError::Failed(format!("the coordinator reports task {task}, which the plan does not have"));
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

    /// The results of the first `count` tasks, if they are done.
    pub fn first(&self, count: usize) -> Option<Vec<ArtefactId>> {
        let is_done = |task: &&proto::TaskChanged| task.state() == TaskState::Done;
        let of = |task: &proto::TaskChanged| proto::artefact_id(&task.artefact).ok();
        self.tasks.get(..count)?.iter().map(|task| Some(task).filter(is_done).and_then(of)).collect()
    }

    /// The first task that failed, its error, and how many others were not run because of it.
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
            line += &format!("; {blocked} dependent tasks were not started");
        }
        if first.state() == TaskState::Failed { LocalError::Input(line) } else { LocalError::Failed(line) }
    }
}

/// Classifies an error: a refused call is the input's fault, anything else the cluster's.
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
