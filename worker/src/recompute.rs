//! Recomputes a result that the store has lost or that is damaged. A result follows from the plan and its inputs, so it comes out the
//! same, under the same name, and the coordinator need not be involved.

use std::collections::BTreeMap;

use blocks::Plan;
use bytes::Bytes;
use scene::ArtefactId;
use store::BlockingStore;

use crate::task::{Execute, ExecuteError, FULL_RATE, Flow, Report, TaskOrder};
use proto::FailureKind;

/// Recomputes the result `wanted` of `task`, an input of `order`, and returns its bytes. Meanwhile the order's own task is reported at
/// step 0.
///
/// # Errors
/// The recomputation fails, or its result is a different one.
pub(crate) fn recompute(
    executor: &dyn Execute,
    store: &BlockingStore,
    plan: &Plan,
    order: &TaskOrder,
    (task, wanted): (u32, ArtefactId),
    report: &mut (dyn FnMut(Report) -> Flow + Send),
) -> Result<Bytes, ExecuteError> {
    tracing::warn!(task, "recomputing its result {wanted}, which is lost or damaged");
    let steps = plan.planned(order.task).map_or(0, |task| task.steps());
    let mut heartbeat =
        |of: Report| report(Report { step: 0, steps, psnr: None, merged_splats: None, aligned: None, ..of });
    let recomputed = result_of(executor, plan, order, task, &mut heartbeat)?;
    if recomputed != wanted {
        let hint =
            "another version of the program, or another kind of processor, made the first one; submit the job again";
        let problem = format!("the result {wanted} of task {task} is lost, and recomputing it gives {recomputed}");
        return Err(ExecuteError::work(format!("{problem}: {hint}")));
    }
    Ok(store.get(wanted)?)
}

/// The result of a task, computed after those of its dependencies that `order` does not name.
fn result_of(
    executor: &dyn Execute,
    plan: &Plan,
    order: &TaskOrder,
    task: u32,
    report: &mut (dyn FnMut(Report) -> Flow + Send),
) -> Result<ArtefactId, ExecuteError> {
    let known = |task: &u32| order.inputs.get(task).copied();
    let mut inputs = BTreeMap::new();
    let needed = plan.planned(task).map(|task| plan.dependencies(task)).transpose().map_err(ExecuteError::work)?;
    for dependency in needed.unwrap_or_default() {
        let id = match known(&dependency) {
            Some(id) => id,
            None => result_of(executor, plan, order, dependency, report)?,
        };
        inputs.insert(dependency, id);
    }
    let order = TaskOrder { task, inputs, rate_permille: FULL_RATE, ..order.clone() };
    match executor.execute(&order, report) {
        // The first run diverged as well, and the result is that of its retry.
        Err(ExecuteError { kind: FailureKind::Numeric, .. }) => {
            executor.execute(&TaskOrder { rate_permille: FULL_RATE / 2, ..order }, report)
        }
        recomputed => recomputed,
    }
}
