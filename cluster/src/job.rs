//! One job: the records of its tasks, and the indices that follow from them.
//!
//! Every index (here and in [`Indices`]) follows from the records alone. A record changes in one place, [`Job::alter`],
//! which takes the task out of all indices and puts it back in where it belongs, so that none can be forgotten.

use std::collections::{BTreeMap, BTreeSet};

use scene::ArtefactId;

use crate::dag::{Addition, class};
use crate::events::Outcome;
use crate::queue::Queue;
use crate::words::{AttemptId, JobId, Settings, TaskIndex, TaskRecord, TaskState, WorkerId};

/// One task: what must be remembered, and what follows from it.
#[derive(Debug, Clone)]
pub(crate) struct Task {
    pub(crate) record: TaskRecord,
    pub(crate) dependents: Vec<TaskIndex>,
    /// The work of the longest chain of unfinished tasks that begins here.
    pub(crate) chain: u64,
}

/// Where the tasks of all jobs are found by time and by worker.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Indices {
    /// Soonest to end first.
    pub(crate) leases: BTreeSet<(u64, AttemptId)>,
    pub(crate) lease_of: BTreeMap<WorkerId, AttemptId>,
    /// Soonest to be ready first.
    pub(crate) delays: BTreeSet<(u64, JobId, TaskIndex)>,
}

/// How many tasks there are of each state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Whose dependencies are not done.
    pub waiting: u32,
    /// That may be granted.
    pub ready: u32,
    /// In a pause before the next attempt.
    pub delayed: u32,
    /// With an attempt under way.
    pub leased: u32,
    /// With a result.
    pub done: u32,
    /// Whose input is wrong.
    pub failed: u32,
    /// That reached a limit.
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
    /// What it had of its share: worker milliseconds by weight.
    pub(crate) served: u64,
    pub(crate) said_finished: bool,
    pub(crate) tasks: Vec<Task>,
    pub(crate) counts: Counts,
    /// Ready tasks by the octave of their work.
    pub(crate) shelves: BTreeMap<u8, Queue>,
    /// Ready tasks by the results that they read: their keys.
    pub(crate) wanted: BTreeMap<ArtefactId, BTreeSet<u64>>,
    /// Tasks with one attempt under way, by when its result is expected.
    pub(crate) running: BTreeSet<(u64, TaskIndex)>,
    /// Where it stands in its lane's turn.
    pub(crate) seat: Option<(u8, u64)>,
    /// When to look whether its ready tasks fit anyone.
    pub(crate) strand_due: Option<u64>,
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
            said_finished: false,
            tasks: Vec::new(),
            counts: Counts::default(),
            shelves: BTreeMap::new(),
            wanted: BTreeMap::new(),
            running: BTreeSet::new(),
            seat: None,
            strand_due: None,
            plan_order: settings.plan_order,
        }
    }

    pub(crate) fn task(&self, task: TaskIndex) -> Option<&Task> {
        self.tasks.get(task.0 as usize)
    }

    /// The record of a task that is known to be there.
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

    /// The key of a ready task: the longest chain first, then the plan's order.
    pub(crate) fn key(&self, task: TaskIndex) -> u64 {
        let class = if self.plan_order { 0 } else { class(self.tasks[task.0 as usize].chain) };
        u64::from(u8::MAX - class) << 32 | u64::from(task.0)
    }

    /// The octave of a task's work.
    pub(crate) fn shelf(&self, task: TaskIndex) -> u8 {
        if self.plan_order { 0 } else { self.record(task).work().ilog2() as u8 }
    }

    /// The results of the tasks that this one depends on, as far as they are done.
    pub(crate) fn inputs(&self, task: TaskIndex) -> impl Iterator<Item = (TaskIndex, ArtefactId)> + '_ {
        self.record(task).node.dependencies.iter().filter_map(|&dependency| match self.record(dependency).state {
            TaskState::Done { artefact, .. } => Some((dependency, artefact)),
            _ => None,
        })
    }

    /// Changes a record, and all indices with it.
    pub(crate) fn alter<T>(
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

    /// Adds tasks, each after those it depends on being known.
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
                troubles: 0,
                overflows: 0,
                divergences: 0,
                culprits: Vec::new(),
            };
            self.tasks.push(Task { chain: record.work(), record, dependents: Vec::new() });
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

    /// Finds the chains of the tasks from `first` on, and puts them into the indices. `order` holds their places, each
    /// after those it depends on.
    pub(crate) fn index_from(&mut self, first: u32, order: &[usize], indices: &mut Indices) {
        for place in order.iter().rev() {
            let task = first as usize + place;
            let longest = self.tasks[task].dependents.iter().map(|&task| self.tasks[task.0 as usize].chain).max();
            self.tasks[task].chain = self.tasks[task].record.work().saturating_add(longest.unwrap_or(0));
        }
        for task in (first..self.tasks.len() as u32).map(TaskIndex) {
            self.index(task, indices, true);
        }
        for task in (first..self.tasks.len() as u32).map(TaskIndex) {
            self.lengthen(task, first, indices);
        }
    }

    /// Passes the chain of a new task on to the older ones that it waits for.
    fn lengthen(&mut self, task: TaskIndex, first: u32, indices: &mut Indices) {
        let mut longer = vec![task];
        while let Some(task) = longer.pop() {
            let chain = self.tasks[task.0 as usize].chain;
            for upper in self.record(task).node.dependencies.clone() {
                let Task { record, chain: old, .. } = &self.tasks[upper.0 as usize];
                let new = record.work().saturating_add(chain);
                if upper.0 < first && new > *old && !matches!(record.state, TaskState::Done { .. }) {
                    self.index(upper, indices, false);
                    self.tasks[upper.0 as usize].chain = new;
                    self.index(upper, indices, true);
                    longer.push(upper);
                }
            }
        }
    }

    /// Puts a task into the indices or takes it out, by what its record says.
    pub(crate) fn index(&mut self, task: TaskIndex, indices: &mut Indices, put: bool) {
        let id = self.id;
        let record = &self.tasks[task.0 as usize].record;
        let count = match &record.state {
            TaskState::Waiting { .. } => &mut self.counts.waiting,
            TaskState::Ready { .. } => &mut self.counts.ready,
            TaskState::Delayed { until_millis } => {
                toggle(&mut indices.delays, (*until_millis, id, task), put);
                &mut self.counts.delayed
            }
            TaskState::Leased { leases } => {
                for lease in leases {
                    let attempt = AttemptId { job: id, task, fence: lease.fence };
                    toggle(&mut indices.leases, (lease.until_millis, attempt), put);
                    if put {
                        indices.lease_of.insert(lease.worker, attempt);
                    } else {
                        indices.lease_of.remove(&lease.worker);
                    }
                }
                if let [lease] = &leases[..] {
                    toggle(&mut self.running, (lease.expected_millis, task), put);
                }
                &mut self.counts.leased
            }
            TaskState::Done { .. } => &mut self.counts.done,
            TaskState::Failed { .. } => &mut self.counts.failed,
            TaskState::Quarantined { .. } => &mut self.counts.quarantined,
        };
        *count = if put { *count + 1 } else { *count - 1 };
        if matches!(record.state, TaskState::Ready { .. }) {
            self.shelve(task, put);
        }
    }

    fn shelve(&mut self, task: TaskIndex, put: bool) {
        let (key, shelf, memory) = (self.key(task), self.shelf(task), self.record(task).memory_bytes);
        let queue = self.shelves.entry(shelf).or_default();
        if put {
            queue.insert(key, memory);
        } else {
            queue.remove(key);
        }
        if queue.is_empty() {
            self.shelves.remove(&shelf);
        }
        let inputs: Vec<ArtefactId> = self.inputs(task).map(|(_, artefact)| artefact).collect();
        for artefact in inputs {
            let keys = self.wanted.entry(artefact).or_default();
            toggle(keys, key, put);
            if keys.is_empty() {
                self.wanted.remove(&artefact);
            }
        }
    }
}

/// The task of a key.
pub(crate) fn task_of(key: u64) -> TaskIndex {
    TaskIndex(key as u32)
}

fn toggle<T: Ord>(set: &mut BTreeSet<T>, entry: T, put: bool) {
    if put {
        set.insert(entry);
    } else {
        set.remove(&entry);
    }
}
