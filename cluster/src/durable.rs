//! What a step makes durable: the one answer for the coordinator and for the simulation that checks it.

use std::collections::BTreeMap;

use crate::events::{Action, Event};
use crate::scheduler::Scheduler;
use crate::snapshot::JobHeader;
use crate::words::{JobId, TaskIndex, TaskRecord};

/// What one or more steps write, all or nothing, before what they said is carried out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Changes {
    /// Jobs whose header changed; `None`: the job and its tasks are forgotten.
    pub headers: BTreeMap<JobId, Option<JobHeader>>,
    /// Tasks whose record changed.
    pub records: BTreeMap<(JobId, TaskIndex), TaskRecord>,
}

impl Changes {
    /// What must be durable before these actions, the scheduler's answer to this event, are carried out: what they name,
    /// nothing else.
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

    /// Adds what a later step changed.
    pub fn absorb(&mut self, later: Self) {
        for (job, header) in later.headers {
            if header.is_none() {
                self.records.retain(|(of, _), _| *of != job);
            }
            self.headers.insert(job, header);
        }
        self.records.extend(later.records);
    }

    /// Whether there is nothing to write.
    pub fn is_empty(&self) -> bool {
        self.headers.is_empty() && self.records.is_empty()
    }
}
