//! The simulated durable store, with writers fenced by epoch.

use std::collections::BTreeMap;

use crate::durable::Changes;
use crate::snapshot::{JobHeader, JobSnapshot, Snapshot};
use crate::types::{JobId, TaskIndex, TaskRecord, TaskState};

/// The writer's epoch is older than the newest one.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Fenced;

#[derive(Debug, Default)]
pub(crate) struct Store {
    pub(crate) epoch: u64,
    headers: BTreeMap<JobId, JobHeader>,
    records: BTreeMap<(JobId, TaskIndex), TaskRecord>,
}

impl Store {
    /// Starts a new epoch and fences writers of older ones. Returns the new epoch and the stored snapshot.
    pub(crate) fn take_over(&mut self) -> (u64, Snapshot) {
        let epoch = self.epoch;
        self.epoch += 1;
        let tasks = |id: JobId| {
            let range = (id, TaskIndex(0))..=(id, TaskIndex(u32::MAX));
            self.records.range(range).map(|(_, record)| record.clone()).collect()
        };
        let jobs = self.headers.iter().map(|(id, header)| JobSnapshot { header: header.clone(), tasks: tasks(*id) });
        (self.epoch, Snapshot { epoch, jobs: jobs.collect() })
    }

    /// Writes the changes of a step under an epoch.
    ///
    /// The outer error is a safety violation: the write would change a committed result.
    pub(crate) fn write(&mut self, epoch: u64, changes: Changes) -> Result<Result<(), Fenced>, String> {
        if epoch < self.epoch {
            return Ok(Err(Fenced));
        }
        for ((job, task), record) in &changes.records {
            let old = self.records.get(&(*job, *task)).map(|old| &old.state);
            if let Some(TaskState::Done { .. }) = old
                && old != Some(&record.state)
            {
                return Err(format!("the result of {}/{task} is committed twice: {old:?}, {:?}", job.0, record.state));
            }
        }
        for (id, header) in changes.headers {
            match header {
                Some(header) => {
                    self.headers.insert(id, header);
                }
                None => {
                    self.headers.remove(&id);
                    self.records.retain(|(job, _), _| *job != id);
                }
            }
        }
        self.records.extend(changes.records);
        Ok(Ok(()))
    }

    pub(crate) fn record(&self, job: JobId, task: TaskIndex) -> Option<&TaskRecord> {
        self.records.get(&(job, task))
    }

    /// The number of tasks of a job.
    pub(crate) fn len(&self, job: JobId) -> usize {
        self.records.range((job, TaskIndex(0))..=(job, TaskIndex(u32::MAX))).count()
    }
}
