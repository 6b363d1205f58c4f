//! The durable changes of a step. The coordinator and the simulation use the same code.

use std::collections::BTreeMap;

use crate::events::{Action, Event};
use crate::scheduler::Scheduler;
use crate::snapshot::JobHeader;
use crate::types::{JobId, TaskIndex, TaskRecord};

/// The changes of one or more steps. They must be written atomically before the actions of these steps are carried out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Changes {
    /// Headers that changed; `None`: the job and its tasks are deleted.
    pub headers: BTreeMap<JobId, Option<JobHeader>>,
    /// Task records that changed.
    pub records: BTreeMap<(JobId, TaskIndex), TaskRecord>,
}

impl Changes {
    /// The changes that must be durable before these actions are carried out: the records and headers that they name.
    /// `actions` is the scheduler's answer to `event`.
    pub fn of(scheduler: &Scheduler, event: &Event, actions: &[Action]) -> Self {
        let mut changes = Self::default();
        for action in actions {
            match action {
                Action::Changed { job, task } => {
                    let record = scheduler.record(*job, *task).cloned();
                    changes.records.extend(record.map(|record| ((*job, *task), record)));
                }
                Action::Agreed { job } => {
                    changes.headers.insert(*job, scheduler.header(*job));
                    if let Event::Submitted { .. } = event {
                        let records = scheduler.records(*job);
                        changes.records.extend(records.map(|(task, record)| ((*job, task), record.clone())));
                    }
                }
                _ => {}
            }
        }
        changes
    }

    /// Adds the changes of a later step.
    pub fn absorb(&mut self, later: Self) {
        for (job, header) in later.headers {
            if header.is_none() {
                self.records.retain(|(of, _), _| *of != job);
            }
            self.headers.insert(job, header);
        }
        self.records.extend(later.records);
    }

    /// Whether there are no changes.
    pub fn is_empty(&self) -> bool {
        self.headers.is_empty() && self.records.is_empty()
    }
}
