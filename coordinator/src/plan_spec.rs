//! Converts a plan to the scheduler's job: dependencies, work and memory of each task.

use blocks::{Plan, PlannedTask, StepCost};
use cluster::{JobSpec, TaskIndex, TaskNode};
use scene::CodecError;

/// The job of a plan, as the scheduler needs it.
pub(crate) fn spec_of(plan: &Plan) -> Result<JobSpec, CodecError> {
    Ok(JobSpec { backend: plan.backend.clone(), priority: 0, weight: 1, tasks: dag_of(plan)? })
}

/// CPU seconds of measuring a pixel of a held-out view: rendering, PSNR, SSIM and SSIMULACRA2. On the machine of
/// [`StepCost::CPU_SECONDS`], without AVX-512; with it half.
const SECONDS_PER_EVALUATED_PIXEL: f64 = 2e-6;
/// CPU seconds of reading a splat of the merged model on that machine.
const SECONDS_PER_READ_SPLAT: f64 = 1e-6;

/// The task graph: a task depends on those whose results it reads.
fn dag_of(plan: &Plan) -> Result<Vec<TaskNode>, CodecError> {
    let node = |task: PlannedTask| {
        let dependencies = plan.dependencies(task)?.into_iter().map(TaskIndex).collect();
        Ok(TaskNode { dependencies, work: work_of(plan, task), memory_bytes: task.memory_bytes() })
    };
    plan.all_tasks().map(node).collect()
}

/// The estimated CPU milliseconds of a task. Only ratios between tasks matter, as the scheduler measures the workers' speeds in the same
/// unit.
fn work_of(plan: &Plan, task: PlannedTask) -> u64 {
    let seconds = match task {
        PlannedTask::Train(task) => f64::from(task.steps) * StepCost::of(task).total() * StepCost::CPU_SECONDS,
        PlannedTask::Evaluate(task) => {
            let splats = f64::from(plan.settings.budget);
            task.pixels as f64 * SECONDS_PER_EVALUATED_PIXEL + splats * SECONDS_PER_READ_SPLAT
        }
        PlannedTask::Detect(task) => return task.work_millis,
        PlannedTask::Object(task) => return task.work_millis,
    };
    // `as` saturates: a plan may have any number of steps.
    (seconds * 1e3) as u64
}
