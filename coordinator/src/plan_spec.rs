//! Converts a plan to the scheduler's job: dependencies, work and memory of each task.

use std::collections::BTreeMap;

use blocks::{Plan, StepCost};
use cluster::{JobSpec, TaskIndex, TaskNode};
use scene::{BlockId, CodecError};

/// The job of a plan, as the scheduler needs it.
pub(crate) fn spec_of(plan: &Plan) -> Result<JobSpec, CodecError> {
    Ok(JobSpec { backend: plan.backend.clone(), priority: 0, weight: 1, tasks: dag_of(plan)? })
}

/// The task graph: a task depends on the tasks of its parent and its context blocks.
fn dag_of(plan: &Plan) -> Result<Vec<TaskNode>, CodecError> {
    let index: BTreeMap<BlockId, u32> = plan.tasks.iter().map(|task| task.block).zip(0..).collect();
    let node = |task: &blocks::Task| {
        let dependencies = task.parent.iter().chain(&task.context);
        let found = dependencies.map(|block| {
            let missing = || CodecError::new(format!("task {} needs block {block}, which has no task", task.block));
            index.get(block).copied().map(TaskIndex).ok_or_else(missing)
        });
        Ok(TaskNode {
            dependencies: found.collect::<Result<_, CodecError>>()?,
            work: work_of(task),
            memory_bytes: task.memory_bytes,
        })
    };
    plan.tasks.iter().map(node).collect()
}

/// The estimated CPU milliseconds of a task. Only ratios between tasks matter, as the scheduler measures the workers' speeds in the same
/// unit.
fn work_of(task: &blocks::Task) -> u64 {
    // `as` saturates: a plan may have any number of steps.
    (f64::from(task.steps) * StepCost::of(task).total() * StepCost::CPU_SECONDS * 1e3) as u64
}
