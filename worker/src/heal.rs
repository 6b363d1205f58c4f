//! A result that the store lost or holds damaged is made again by whoever needs it: what a task makes follows from the plan, so it comes
//! out the same, under the same name, and nobody else need know.

use std::collections::BTreeMap;

use blocks::Plan;
use bytes::Bytes;
use scene::ArtefactId;

use crate::execute::{BlockTrainer, failed};
use crate::{Execute, ExecuteError, FULL_RATE, FailureKind, Flow, Report, TaskOrder};

impl BlockTrainer {
    /// Makes the result of a task that this order needs. As long as that takes, the order's own task stands at its first step.
    pub(crate) fn make_again(
        &self,
        plan: &Plan,
        order: &TaskOrder,
        task: u32,
        wanted: ArtefactId,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<Bytes, ExecuteError> {
        tracing::warn!(task, "its result {wanted} is lost or damaged, and is made again");
        let steps = plan.tasks.get(order.task as usize).map_or(0, |task| task.steps);
        let mut alive =
            |of: Report| report(Report { step: 0, steps: steps.into(), psnr: None, merged_splats: None, ..of });
        let made = self.result_of(plan, order, task, &mut alive)?;
        if made != wanted {
            let hint = "another program, or another kind of processor, made it; submit the job again";
            return Err(failed(format!(
                "the result of task {task} was {wanted} and is lost, made again it is {made}: {hint}"
            )));
        }
        Ok(self.store.get(wanted)?)
    }

    /// What a task makes, from the store where that has it.
    fn result_of(
        &self,
        plan: &Plan,
        order: &TaskOrder,
        task: u32,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        let known = |task: &u32| order.inputs.get(task).copied();
        let mut inputs = BTreeMap::new();
        for needed in needs(plan, task) {
            let id = match known(&needed) {
                Some(id) => id,
                None => self.result_of(plan, order, needed, report)?,
            };
            inputs.insert(needed, id);
        }
        let order = TaskOrder { task, inputs, rate_permille: FULL_RATE, ..order.clone() };
        match self.execute(&order, report) {
            // It did then, too.
            Err(ExecuteError { kind: FailureKind::Numeric, .. }) => {
                self.execute(&TaskOrder { rate_permille: FULL_RATE / 2, ..order }, report)
            }
            made => made,
        }
    }
}

/// The tasks whose results a task is given.
fn needs(plan: &Plan, task: u32) -> Vec<u32> {
    let Some(task) = plan.tasks.get(task as usize) else { return Vec::new() };
    let place = |block| plan.tasks.iter().position(|task| task.block == block).map(|place| place as u32);
    task.context.iter().copied().chain(task.parent).filter_map(place).collect()
}
