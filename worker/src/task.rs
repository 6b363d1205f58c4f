//! A task as the executor sees it: what to do, how far it is, and how it ended.

use std::collections::BTreeMap;

use dataset::ingest::IngestError;
use proto::FailureKind;
use scene::ArtefactId;
use store::StoreError;

/// [`TaskOrder::rate_permille`] of a task that never diverged.
pub const FULL_RATE: u32 = 1000;

/// The input of one task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskOrder {
    /// The job, as the coordinator numbers it.
    pub job: u64,
    /// The plan's artefact.
    pub plan: ArtefactId,
    /// The task's index in the plan.
    pub task: u32,
    /// The attempt's number, from 1. No result may depend on it.
    pub attempt: u32,
    /// The results of the tasks that it depends on, by their index in the plan.
    pub inputs: BTreeMap<u32, ArtefactId>,
    /// Factor on the learning rates in thousandths: less than [`FULL_RATE`] if an earlier attempt diverged.
    pub rate_permille: u32,
}

/// Progress of a task: one line of metrics.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Report {
    /// Optimiser steps done; views of an evaluation or a detection.
    pub step: u64,
    /// Optimiser steps or views in all.
    pub steps: u64,
    /// The loss at this step; left out if it is not finite.
    pub loss: f64,
    /// Current number of splats.
    pub splats: u64,
    /// CPU seconds of the task so far, without evaluation.
    pub cpu_seconds: f64,
    /// Wall seconds of the task so far, without evaluation.
    pub wall_seconds: f64,
    /// Mean PSNR of the merged model so far over the job's test views in dB, if it was evaluated at this step.
    pub psnr: Option<f64>,
    /// Splats of the model that was evaluated.
    pub merged_splats: Option<u64>,
    /// The perception-aligned loss since the last report, if it was computed.
    pub aligned: Option<AlignedReport>,
}

/// What the perception-aligned loss was and took in some steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedReport {
    /// Mean over the windows with objects, without its weight; `None` without any.
    pub loss: Option<f64>,
    /// CPU seconds that it took in a step, mean. With several workers in one process those of all.
    pub cpu_seconds: f64,
}

/// The answer to a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// Continue.
    Continue,
    /// The attempt is void or the worker shuts down: return soon, with any error unless the task is finished anyway.
    Stop,
}

/// How a task reports.
pub(crate) type Reporter<'a> = dyn FnMut(Report) -> Flow + Send + 'a;

/// Why a task has no result.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct ExecuteError {
    /// One line for a person.
    pub message: String,
    /// The class of the failure, by which the coordinator decides about a retry. Never `GivenBack`, which is no failure.
    pub kind: FailureKind,
}

impl ExecuteError {
    pub(crate) fn of(kind: FailureKind, message: impl ToString) -> Self {
        Self { message: message.to_string(), kind }
    }

    /// A failure of the work itself: another attempt may succeed.
    pub(crate) fn work(message: impl ToString) -> Self {
        Self::of(FailureKind::Work, message)
    }
}

impl From<IngestError> for ExecuteError {
    fn from(error: IngestError) -> Self {
        match error {
            IngestError::Store(error) => error.into(),
            IngestError::BadInput(error) => Self::work(error),
        }
    }
}

impl From<StoreError> for ExecuteError {
    /// Every store error is retried: an outage may pass, a full disk may be cleared, a missing object may be restored.
    fn from(error: StoreError) -> Self {
        Self::of(FailureKind::Infrastructure, error)
    }
}

/// Carries out tasks. Blocking, on a thread of its own; a panic is a failed attempt.
pub trait Execute: Send + Sync + 'static {
    /// Carries out the task, puts its result into the store and returns its name. Calls `report` from time to time, which
    /// never blocks, and obeys its answer.
    ///
    /// # Errors
    /// [`ExecuteError`], also if it stopped because a report was answered with [`Flow::Stop`].
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError>;
}
