//! Checks at the end of a simulation.

use crate::events::Outcome;
use crate::types::TaskState;

use super::World;

impl World {
    /// Whether all jobs are over and no failed task can be retried successfully.
    pub(super) fn is_over(&self) -> bool {
        let Some(scheduler) = self.leader().and_then(|node| self.nodes[node].scheduler.as_ref()) else { return false };
        self.jobs.iter().all(|(id, job)| match scheduler.finished(*id) {
            None => false,
            Some(Outcome::Done | Outcome::Cancelled) => true,
            Some(Outcome::Incomplete) => scheduler.records(*id).all(|(task, record)| {
                let failed = matches!(record.state, TaskState::Failed { .. } | TaskState::Quarantined { .. });
                !failed || !job.can_complete(task)
            }),
        })
    }

    /// Describes the first unfinished task.
    pub(super) fn unfinished_work(&self) -> String {
        let scheduler = self.leader().and_then(|node| self.nodes[node].scheduler.as_ref());
        let Some(scheduler) = scheduler else { return "there is no leader".into() };
        let open = self.jobs.keys().flat_map(|id| scheduler.records(*id).map(move |(task, record)| (id, task, record)));
        let mut open = open.filter(|(.., record)| !matches!(record.state, TaskState::Done { .. }));
        let first = open.next().map(|(id, task, record)| format!("task {}/{task} is {record:?}", id.0));
        first.unwrap_or_else(|| "a job was never submitted".into())
    }

    /// Checks that acknowledged results are durable, and that exactly the expected tasks exist and are done.
    pub(super) fn check_end(&self) -> Result<(), String> {
        for ((job, task), artefact) in &self.committed {
            let state = self.store.record(*job, *task).map(|record| &record.state);
            if !matches!(state, Some(TaskState::Done { artefact: durable, .. }) if durable == artefact) {
                return Err(format!("the result of {}/{task} was acknowledged, but is lost: {state:?}", job.0));
            }
        }
        let node = self.leader().ok_or("there is no leader")?;
        let scheduler = self.nodes[node].scheduler.as_ref().ok_or("there is no leader")?;
        for (id, job) in &self.jobs {
            let mut expected = job.spec.tasks.len();
            for (task, record) in scheduler.records(*id) {
                if matches!(record.state, TaskState::Done { .. }) {
                    expected += job.task(task).follow_ups.len();
                    if !job.can_complete(task) {
                        return Err(format!("task {}/{task} is done but cannot complete", id.0));
                    }
                }
            }
            if scheduler.len(*id) != expected {
                return Err(format!("job {} has {} tasks, expected {expected}", id.0, scheduler.len(*id)));
            }
        }
        Ok(())
    }
}
