//! Carries out a detection task: looks for objects on some photos.

use blocks::DetectTask;
use dataset::windows::WindowReader;
use perceive::Detector;
use proto::FailureKind;
use scene::{ArtefactId, BadInput, Zones};
use store::BlockingStore;

use crate::clock::Stopwatch;
use crate::memory_budget::MemoryBudget;
use crate::task::{ExecuteError, Flow, Report, Reporter};

/// A detector, and the views that a task shows it.
pub(crate) struct Detection<'a> {
    pub(crate) task: &'a DetectTask,
    pub(crate) detector: &'a Detector,
    /// The artefact of the detector.
    pub(crate) id: ArtefactId,
    pub(crate) reader: &'a WindowReader,
    pub(crate) store: &'a BlockingStore,
}

/// A network that is no detector, or cannot be run, fails for every worker.
pub(crate) fn of_network(error: BadInput) -> ExecuteError {
    ExecuteError::of(FailureKind::Input, error)
}

/// What the detector finds on the task's views. Equal photos give equal objects, as `plat prune` finds them.
///
/// # Errors
/// Photos that cannot be read, a network that cannot be run, memory above the budget, or a report that was answered with
/// [`Flow::Stop`].
pub(crate) fn detect(
    detection: &Detection,
    mut memory: Option<MemoryBudget>,
    stopwatch: &Stopwatch,
    report: &mut Reporter,
) -> Result<Zones, ExecuteError> {
    let &Detection { task, detector, id, reader, store } = detection;
    dataset::zones::check_detector(detector).map_err(of_network)?;
    let steps = u64::from(task.count);
    let mut overrun = None;
    let mut goes_on = |done: usize| {
        let report = report(Report {
            step: done as u64,
            steps,
            loss: f64::NAN,
            cpu_seconds: stopwatch.cpu_seconds(),
            wall_seconds: stopwatch.wall_seconds(),
            ..Report::default()
        });
        overrun = memory.as_mut().filter(|_| (done as u64) < steps).and_then(MemoryBudget::overrun);
        report == Flow::Continue && overrun.is_none()
    };
    let views = task.views().start as usize..task.views().end as usize;
    let found = dataset::zones::detect(reader, views, (detector, id), store, &mut goes_on)?;
    if let Some(resident) = overrun {
        let message = format!("detection: the worker takes {} MiB, above its --memory", resident.div_ceil(1 << 20));
        return Err(ExecuteError::of(FailureKind::OutOfMemory, message));
    }
    // The last view's report needs no answer: the task is finished anyway.
    if (found.of_views.len() as u64) < steps {
        return Err(ExecuteError::work("stopped before all photos were looked at"));
    }
    Ok(found)
}
