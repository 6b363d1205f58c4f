//! Carries out an evaluation task: measures the merged model on held-out views.

use blocks::{EvalTask, Plan};
use dataset::windows::WindowReader;
use eval::{EvalError, Fits, ViewFigures};
use model::ModelObject;
use proto::FailureKind;
use render::Options;
use scene::Splats;
use train::Backend;

use crate::clock::Stopwatch;
use crate::memory_budget::MemoryBudget;
use crate::task::{ExecuteError, Flow, Report};

/// A merged model, and the held-out views that a task measures it on.
pub(crate) struct Evaluation<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) task: &'a EvalTask,
    pub(crate) model: &'a Splats,
    /// Those that move.
    pub(crate) objects: &'a [ModelObject],
    pub(crate) reader: &'a WindowReader,
    pub(crate) backend: &'a Backend,
}

/// The figures of the task's views. Equal models and photos give equal figures, as `plat eval` does.
///
/// # Errors
/// Photos that cannot be read, a renderer that fails, memory above the budget, or a report that was answered with
/// [`Flow::Stop`].
pub(crate) fn evaluate(
    evaluation: &Evaluation,
    mut memory: Option<MemoryBudget>,
    stopwatch: &Stopwatch,
    report: &mut (dyn FnMut(Report) -> Flow + Send),
) -> Result<Vec<ViewFigures>, ExecuteError> {
    let Evaluation { plan, task, model, objects, reader, backend } = evaluation;
    let options =
        Options { antialiased: plan.settings.antialiased, sh_degree: model.sh_degree(), ..Options::default() };
    let fits =
        Fits { pose: plan.settings.refine_poses || plan.settings.refine_sensors, exposure: plan.settings.exposure };
    let steps = task.views.len() as u64;
    let mut overrun = None;
    let goes_on = |done: usize| {
        let report = report(Report {
            step: done as u64,
            steps,
            loss: f64::NAN,
            splats: model.len() as u64,
            cpu_seconds: stopwatch.cpu_seconds(),
            wall_seconds: stopwatch.wall_seconds(),
            psnr: None,
            merged_splats: None,
            aligned: None,
        });
        overrun = memory.as_mut().filter(|_| (done as u64) < steps).and_then(MemoryBudget::overrun);
        report == Flow::Continue && overrun.is_none()
    };
    let figures = eval::figures_of_views(model, objects, &options, reader, &task.views, backend, fits, goes_on);
    let figures = figures.map_err(failure)?;
    if let Some(resident) = overrun {
        let message = format!("evaluation: the worker takes {} MiB, above its --memory", resident.div_ceil(1 << 20));
        return Err(ExecuteError::of(FailureKind::OutOfMemory, message));
    }
    // The last view's report needs no answer: the task is finished anyway.
    if figures.len() < task.views.len() {
        return Err(ExecuteError::work("stopped before all views were measured"));
    }
    Ok(figures)
}

fn failure(error: EvalError) -> ExecuteError {
    match error {
        EvalError::Store(error) => error.into(),
        // Most photos that cannot be read are a store's failure, which may pass.
        error @ EvalError::Window(_) => ExecuteError::of(FailureKind::Infrastructure, error),
        error => ExecuteError::work(error),
    }
}
