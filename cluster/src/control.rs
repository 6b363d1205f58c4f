//! User commands on jobs: submit, cancel, pause, resume, reprioritise, retry, forget. Each is answered by `Agreed` or
//! `Declined` and is idempotent.

use crate::dag::Addition;
use crate::events::Action;
use crate::job::Job;
use crate::retry;
use crate::scheduler::Scheduler;
use crate::types::{JobId, JobSpec, TaskIndex, TaskState};

impl Scheduler {
    pub(crate) fn submit(&mut self, id: JobId, spec: JobSpec, actions: &mut Vec<Action>) {
        let reason = if self.jobs.contains_key(&id) {
            Err(format!("job {} exists already", id.0))
        } else if self.jobs.len() >= self.settings.jobs_limit as usize {
            Err(format!("the limit of {} jobs is reached", self.jobs.len()))
        } else {
            Addition::new(spec.tasks, 0, self.settings.tasks_limit).map_err(|error| error.to_string())
        };
        match reason {
            Err(reason) => actions.push(Action::Declined { job: id, reason }),
            Ok(addition) => {
                let mut job = Job::new(id, spec.backend, spec.priority, spec.weight, &self.settings);
                job.add(addition, &mut self.indices, self.now_millis);
                self.jobs.insert(id, job);
                self.unfinished += 1;
                self.mark_changed(id);
                actions.push(Action::Agreed { job: id });
            }
        }
    }

    pub(crate) fn cancel(&mut self, id: JobId, actions: &mut Vec<Action>) {
        let running = self.records(id).filter(|(_, record)| matches!(record.state, TaskState::Leased { .. }));
        let running: Vec<TaskIndex> = running.map(|(task, _)| task).collect();
        if self.finished(id).is_none() {
            self.control(id, actions, |job| job.cancelled = true);
            for task in running {
                let since_millis = self.now_millis;
                self.transition(id, task, actions, |record| record.state = TaskState::Ready { since_millis });
            }
        } else {
            actions.push(Action::Agreed { job: id });
        }
    }

    pub(crate) fn retry(&mut self, id: JobId, task: TaskIndex, actions: &mut Vec<Action>) {
        let since_millis = self.now_millis;
        let reason = match (self.jobs.get(&id), self.record(id, task).map(|record| &record.state)) {
            (Some(job), _) if job.cancelled => "the job was cancelled",
            (_, Some(TaskState::Failed { .. } | TaskState::Quarantined { .. })) => {
                self.transition(id, task, actions, |record| {
                    retry::reset_counters(record);
                    record.state = TaskState::Ready { since_millis };
                });
                actions.push(Action::Agreed { job: id });
                return;
            }
            (Some(_), Some(_)) => "the task has neither failed nor been quarantined",
            _ => "there is no such task",
        };
        actions.push(Action::Declined { job: id, reason: reason.into() });
    }

    pub(crate) fn forget(&mut self, id: JobId, actions: &mut Vec<Action>) {
        if self.finished(id).is_none() {
            let reason = if self.jobs.contains_key(&id) { "the job is not over" } else { "there is no such job" };
            actions.push(Action::Declined { job: id, reason: reason.into() });
            return;
        }
        self.update_fair_order(id, false);
        if let Some(mut job) = self.jobs.remove(&id) {
            for task in (0..job.tasks.len() as u32).map(TaskIndex) {
                job.index(task, &mut self.indices, false);
            }
        }
        self.changed_jobs.remove(&id);
        actions.push(Action::Agreed { job: id });
    }

    pub(crate) fn control(&mut self, id: JobId, actions: &mut Vec<Action>, change: impl FnOnce(&mut Job)) {
        match self.jobs.get_mut(&id) {
            None => actions.push(Action::Declined { job: id, reason: "there is no such job".into() }),
            Some(job) => {
                change(job);
                self.mark_changed(id);
                actions.push(Action::Agreed { job: id });
            }
        }
    }
}
