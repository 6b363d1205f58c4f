//! One job: the records of its tasks, and the indices derived from them.
//!
//! Every index, here and in [`Indices`], is a function of the records. Records change only in [`Job::update_record`],
//! which removes the task from all indices and inserts it again, so that no index can become stale.

use std::collections::{BTreeMap, BTreeSet};

use scene::ArtefactId;

use crate::dag::{Addition, urgency_class};
use crate::events::Outcome;
use crate::ready_queue::ReadyQueue;
use crate::types::{AttemptId, JobId, Settings, TaskIndex, TaskRecord, TaskState, WorkerId};

/// One task: its durable record and derived data.
#[derive(Debug, Clone)]
pub(crate) struct Task {
    pub(crate) record: TaskRecord,
    pub(crate) dependents: Vec<TaskIndex>,
    /// The critical path: the work of the longest chain of unfinished tasks that starts with this one.
    pub(crate) critical_path: u64,
}

/// Indices over the tasks of all jobs, by time and by worker.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Indices {
    /// Leases by expiry.
    pub(crate) leases: BTreeSet<(u64, AttemptId)>,
    pub(crate) lease_of: BTreeMap<WorkerId, AttemptId>,
    /// Delayed tasks by end of the backoff.
    pub(crate) delays: BTreeSet<(u64, JobId, TaskIndex)>,
}

/// The number of tasks in each state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// With dependencies that are not done.
    pub waiting: u32,
    /// Ready to be granted.
    pub ready: u32,
    /// In a backoff.
    pub delayed: u32,
    /// With a running attempt.
    pub leased: u32,
    /// With a result.
    pub done: u32,
    /// With invalid input.
    pub failed: u32,
    /// Quarantined.
    pub quarantined: u32,
}

#[derive(Debug, Clone)]
pub(crate) struct Job {
    pub(crate) id: JobId,
    pub(crate) backend: String,
    pub(crate) priority: u8,
    pub(crate) weight: u32,
    pub(crate) paused: bool,
    pub(crate) cancelled: bool,
    /// Service received, for fair share: worker milliseconds divided by weight.
    pub(crate) served: u64,
    pub(crate) end_announced: bool,
    pub(crate) tasks: Vec<Task>,
    pub(crate) counts: Counts,
    /// Ready tasks by size class.
    pub(crate) ready_queues: BTreeMap<u8, ReadyQueue>,
    /// Keys of ready tasks by the artefacts that they read.
    pub(crate) wanted: BTreeMap<ArtefactId, BTreeSet<u64>>,
    /// Tasks with exactly one running attempt, by its expected completion.
    pub(crate) running: BTreeSet<(u64, TaskIndex)>,
    /// Its key in the pool's fair-share order, if it is listed: priority and service received.
    pub(crate) position: Option<(u8, u64)>,
    /// When to check whether its ready tasks fit any worker.
    pub(crate) unschedulable_due: Option<u64>,
    plan_order: bool,
}

impl Job {
    pub(crate) fn new(id: JobId, backend: String, priority: u8, weight: u32, settings: &Settings) -> Self {
        Self {
            id,
            backend,
            priority,
            weight: weight.max(1),
            paused: false,
            cancelled: false,
            served: 0,
            end_announced: false,
            tasks: Vec::new(),
            counts: Counts::default(),
            ready_queues: BTreeMap::new(),
            wanted: BTreeMap::new(),
            running: BTreeSet::new(),
            position: None,
            unschedulable_due: None,
            plan_order: settings.plan_order,
        }
    }

    pub(crate) fn task(&self, task: TaskIndex) -> Option<&Task> {
        self.tasks.get(task.0 as usize)
    }

    /// The record of a task that is known to exist.
    pub(crate) fn record(&self, task: TaskIndex) -> &TaskRecord {
        &self.tasks[task.0 as usize].record
    }

    /// Whether its tasks may be granted.
    pub(crate) fn is_runnable(&self) -> bool {
        !self.paused && !self.cancelled
    }

    pub(crate) fn is_over(&self) -> bool {
        self.cancelled || self.counts.ready + self.counts.delayed + self.counts.leased == 0
    }

    pub(crate) fn outcome(&self) -> Outcome {
        if self.counts.done as usize == self.tasks.len() {
            Outcome::Done
        } else if self.cancelled {
            Outcome::Cancelled
        } else {
            Outcome::Incomplete
        }
    }

    /// The key of a ready task: longest critical path first (by urgency class), then the plan's order.
    pub(crate) fn key(&self, task: TaskIndex) -> u64 {
        let class = if self.plan_order { 0 } else { urgency_class(self.tasks[task.0 as usize].critical_path) };
        u64::from(u8::MAX - class) << 32 | u64::from(task.0)
    }

    /// The size class of a task: the octave of its work.
    pub(crate) fn size_class(&self, task: TaskIndex) -> u8 {
        if self.plan_order { 0 } else { self.record(task).work().ilog2() as u8 }
    }

    /// The available results of the task's dependencies.
    pub(crate) fn inputs(&self, task: TaskIndex) -> impl Iterator<Item = (TaskIndex, ArtefactId)> + '_ {
        self.record(task).node.dependencies.iter().filter_map(|&dependency| match self.record(dependency).state {
            TaskState::Done { artefact, .. } => Some((dependency, artefact)),
            _ => None,
        })
    }

    /// Changes a record and updates all indices.
    pub(crate) fn update_record<T>(
        &mut self,
        task: TaskIndex,
        indices: &mut Indices,
        change: impl FnOnce(&mut TaskRecord) -> T,
    ) -> T {
        self.index(task, indices, false);
        let result = change(&mut self.tasks[task.0 as usize].record);
        self.index(task, indices, true);
        result
    }

    /// Adds validated tasks.
    pub(crate) fn add(&mut self, addition: Addition, indices: &mut Indices, now: u64) {
        let Addition { first, nodes, order } = addition;
        for (index, node) in (first..).map(TaskIndex).zip(nodes) {
            for &dependency in &node.dependencies {
                if dependency.0 < first {
                    self.tasks[dependency.0 as usize].dependents.push(index);
                }
            }
            let is_missing =
                |task: &&TaskIndex| task.0 >= first || !matches!(self.record(**task).state, TaskState::Done { .. });
            let state = match node.dependencies.iter().filter(is_missing).count() as u32 {
                0 => TaskState::Ready { since_millis: now },
                missing => TaskState::Waiting { missing },
            };
            let record = TaskRecord {
                memory_bytes: node.memory_bytes,
                node,
                state,
                attempts: 0,
                failures: 0,
                losses: 0,
                infrastructure_failures: 0,
                memory_failures: 0,
                divergences: 0,
                failed_workers: Vec::new(),
            };
            self.tasks.push(Task { critical_path: record.work(), record, dependents: Vec::new() });
        }
        for place in first..self.tasks.len() as u32 {
            for dependency in self.tasks[place as usize].record.node.dependencies.clone() {
                if dependency.0 >= first {
                    self.tasks[dependency.0 as usize].dependents.push(TaskIndex(place));
                }
            }
        }
        self.index_from(first, &order, indices);
    }

    /// Computes the critical paths of the tasks from `first` on and indexes them. `order` is a topological order of
    /// these tasks, relative to `first`.
    pub(crate) fn index_from(&mut self, first: u32, order: &[usize], indices: &mut Indices) {
        for place in order.iter().rev() {
            let task = first as usize + place;
            let longest =
                self.tasks[task].dependents.iter().map(|&task| self.tasks[task.0 as usize].critical_path).max();
            self.tasks[task].critical_path = self.tasks[task].record.work().saturating_add(longest.unwrap_or(0));
        }
        for task in (first..self.tasks.len() as u32).map(TaskIndex) {
            self.index(task, indices, true);
        }
        for task in (first..self.tasks.len() as u32).map(TaskIndex) {
            self.propagate_critical_path(task, first, indices);
        }
    }

    /// Propagates the critical path of a new task to the older tasks that it depends on.
    fn propagate_critical_path(&mut self, task: TaskIndex, first: u32, indices: &mut Indices) {
        let mut longer = vec![task];
        while let Some(task) = longer.pop() {
            let critical_path = self.tasks[task.0 as usize].critical_path;
            for upper in self.record(task).node.dependencies.clone() {
                let Task { record, critical_path: old, .. } = &self.tasks[upper.0 as usize];
                let new = record.work().saturating_add(critical_path);
                if upper.0 < first && new > *old && !matches!(record.state, TaskState::Done { .. }) {
                    self.index(upper, indices, false);
                    self.tasks[upper.0 as usize].critical_path = new;
                    self.index(upper, indices, true);
                    longer.push(upper);
                }
            }
        }
    }

    /// Inserts a task into the indices or removes it, according to its record.
    pub(crate) fn index(&mut self, task: TaskIndex, indices: &mut Indices, insert: bool) {
        let id = self.id;
        let record = &self.tasks[task.0 as usize].record;
        let count = match &record.state {
            TaskState::Waiting { .. } => &mut self.counts.waiting,
            TaskState::Ready { .. } => &mut self.counts.ready,
            TaskState::Delayed { until_millis } => {
                toggle(&mut indices.delays, (*until_millis, id, task), insert);
                &mut self.counts.delayed
            }
            TaskState::Leased { leases } => {
                for lease in leases {
                    let attempt = AttemptId { job: id, task, fence: lease.fence };
                    toggle(&mut indices.leases, (lease.until_millis, attempt), insert);
                    if insert {
                        indices.lease_of.insert(lease.worker, attempt);
                    } else {
                        indices.lease_of.remove(&lease.worker);
                    }
                }
                if let [lease] = &leases[..] {
                    toggle(&mut self.running, (lease.expected_millis, task), insert);
                }
                &mut self.counts.leased
            }
            TaskState::Done { .. } => &mut self.counts.done,
            TaskState::Failed { .. } => &mut self.counts.failed,
            TaskState::Quarantined { .. } => &mut self.counts.quarantined,
        };
        *count = if insert { *count + 1 } else { *count - 1 };
        if matches!(record.state, TaskState::Ready { .. }) {
            self.update_ready_queue(task, insert);
        }
    }

    fn update_ready_queue(&mut self, task: TaskIndex, insert: bool) {
        let (key, size_class, memory) = (self.key(task), self.size_class(task), self.record(task).memory_bytes);
        let queue = self.ready_queues.entry(size_class).or_default();
        if insert {
            queue.insert(key, memory);
        } else {
            queue.remove(key);
        }
        if queue.is_empty() {
            self.ready_queues.remove(&size_class);
        }
        let inputs: Vec<ArtefactId> = self.inputs(task).map(|(_, artefact)| artefact).collect();
        for artefact in inputs {
            let keys = self.wanted.entry(artefact).or_default();
            toggle(keys, key, insert);
            if keys.is_empty() {
                self.wanted.remove(&artefact);
            }
        }
    }
}

/// The task of a ready key.
pub(crate) fn task_of(key: u64) -> TaskIndex {
    TaskIndex(key as u32)
}

fn toggle<T: Ord>(set: &mut BTreeSet<T>, entry: T, insert: bool) {
    if insert {
        set.insert(entry);
    } else {
        set.remove(&entry);
    }
}
