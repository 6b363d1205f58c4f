//! The ladder of a task:
//!
//! ```text
//! Waiting ──all dependencies done──▶ Ready ──granted──▶ Leased ──completed──▶ Done
//!                                      ▲                  │ ├──failed, the input's fault──▶ Failed
//!                                      └──failed, expired─┘ └──failed or lost too often───▶ Quarantined
//!                                         or given back
//! ```
//!
//! Each grant is a new **attempt**, numbered per task from 1. An attempt is the fence: whatever a worker says about an
//! attempt other than the one that holds the lease is refused, so a zombie can waste work and never corrupt it. `Done`,
//! `Failed` and `Quarantined` are final. What depends on a task that failed stays `Waiting` (its branch is a hole, all
//! other branches go on), and the job is over when nothing is ready or leased.
//!
//! Costs: `O(log tasks)` per event, plus the dependents of a task when it is done.

use std::collections::{BTreeMap, BTreeSet};

use scene::ArtefactId;

use crate::words::{
    Action, DagError, Event, Failure, FailureKind, Outcome, Settings, TaskIndex, TaskNode, TaskState, WorkerId,
};

/// One task's record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) dependencies: Vec<TaskIndex>,
    pub(crate) dependents: Vec<TaskIndex>,
    pub(crate) state: TaskState,
    /// Attempts granted so far; the next is one more.
    pub(crate) attempts: u32,
    pub(crate) failures: u32,
    pub(crate) losses: u32,
}

/// The scheduler of one job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scheduler {
    pub(crate) settings: Settings,
    pub(crate) tasks: Vec<Record>,
    /// Granted from the front: in the plan's order.
    pub(crate) ready: BTreeSet<TaskIndex>,
    pub(crate) lease_of_worker: BTreeMap<WorkerId, TaskIndex>,
    /// Soonest to expire first.
    pub(crate) leases: BTreeSet<(u64, TaskIndex)>,
    pub(crate) done: usize,
    pub(crate) now_millis: u64,
    pub(crate) cancelled: bool,
    pub(crate) said_finished: bool,
}

impl Scheduler {
    /// A job of these tasks, none started. Says [`Action::JobFinished`] at the first step if there are none.
    ///
    /// # Errors
    /// [`DagError`] for a dependency that is not there or a cycle.
    pub fn new(dag: Vec<TaskNode>, settings: Settings) -> Result<Self, DagError> {
        let count = dag.len();
        u32::try_from(count).map_err(|_| DagError::TooMany { tasks: count })?;
        let mut tasks: Vec<Record> = dag.into_iter().map(Record::new).collect();
        for task in 0..count {
            for i in 0..tasks[task].dependencies.len() {
                let dependency = tasks[task].dependencies[i];
                let upper = tasks.get_mut(dependency.0 as usize);
                let Some(upper) = upper else {
                    return Err(DagError::OutOfRange { task: task as u32, dependency: dependency.0, tasks: count });
                };
                upper.dependents.push(TaskIndex(task as u32));
            }
        }
        if let Some(task) = first_on_cycle(&tasks) {
            return Err(DagError::Cycle { task });
        }
        let ready = (0..count).filter(|&i| tasks[i].state == TaskState::Ready).map(|i| TaskIndex(i as u32)).collect();
        Ok(Self {
            settings,
            tasks,
            ready,
            lease_of_worker: BTreeMap::new(),
            leases: BTreeSet::new(),
            done: 0,
            now_millis: 0,
            cancelled: false,
            said_finished: false,
        })
    }

    /// Takes in one event at this time and says what is to be done, in order. A clock that steps back stands still.
    pub fn step(&mut self, now_millis: u64, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        self.now_millis = self.now_millis.max(now_millis);
        self.expire(&mut actions);
        match event {
            Event::LeaseRequested { worker } => self.lease(worker, &mut actions),
            Event::WorkerIdle { worker } => self.lose(worker, &mut actions),
            Event::Progressed { task, attempt } => self.progress(task, attempt, &mut actions),
            Event::Completed { task, attempt, artefact } => self.complete(task, attempt, artefact, &mut actions),
            Event::Failed { task, attempt, failure } => self.fail(task, attempt, failure, &mut actions),
            Event::CancelRequested => self.cancel(&mut actions),
            Event::Ticked => {}
        }
        if !self.said_finished && self.is_over() {
            self.said_finished = true;
            actions.push(Action::JobFinished { outcome: self.outcome() });
        }
        actions
    }

    /// Number of tasks.
    pub fn len(&self) -> usize {
        self.tasks.len()
    }

    /// Whether there is no task at all.
    pub fn is_empty(&self) -> bool {
        self.tasks.is_empty()
    }

    /// Where a task stands; `None` if the job has no such task.
    pub fn state(&self, task: TaskIndex) -> Option<&TaskState> {
        self.tasks.get(task.0 as usize).map(|record| &record.state)
    }

    /// Where all tasks stand, in the plan's order.
    pub fn states(&self) -> impl Iterator<Item = (TaskIndex, &TaskState)> {
        self.tasks.iter().enumerate().map(|(i, record)| (TaskIndex(i as u32), &record.state))
    }

    /// The results that this task builds on, by task: complete once the task is ready.
    pub fn inputs(&self, task: TaskIndex) -> BTreeMap<TaskIndex, ArtefactId> {
        let dependencies = self.tasks.get(task.0 as usize).map_or(&[][..], |record| &record.dependencies);
        let done = |&task: &TaskIndex| match self.state(task) {
            Some(TaskState::Done { artefact, .. }) => Some((task, *artefact)),
            _ => None,
        };
        dependencies.iter().filter_map(done).collect()
    }

    /// How the job ended, `None` while it runs.
    pub fn finished(&self) -> Option<Outcome> {
        self.is_over().then(|| self.outcome())
    }

    fn is_over(&self) -> bool {
        self.cancelled || (self.ready.is_empty() && self.leases.is_empty())
    }

    fn outcome(&self) -> Outcome {
        if self.done == self.tasks.len() {
            Outcome::Done
        } else if self.cancelled {
            Outcome::Cancelled
        } else {
            Outcome::Incomplete
        }
    }

    fn lease(&mut self, worker: WorkerId, actions: &mut Vec<Action>) {
        self.lose(worker, actions);
        if self.is_over() {
            actions.push(Action::Drained { worker });
            return;
        }
        let Some(task) = self.ready.pop_first() else {
            actions.push(Action::NothingYet { worker });
            return;
        };
        let until_millis = self.now_millis.saturating_add(self.settings.lease_millis);
        let record = &mut self.tasks[task.0 as usize];
        record.attempts += 1;
        let attempt = record.attempts;
        record.state = TaskState::Leased { attempt, worker, until_millis };
        self.lease_of_worker.insert(worker, task);
        self.leases.insert((until_millis, task));
        actions.push(Action::Changed { task });
        actions.push(Action::Grant { worker, task, attempt, until_millis });
    }

    fn progress(&mut self, task: TaskIndex, attempt: u32, actions: &mut Vec<Action>) {
        let Some(until_now) = self.lease_end(task, attempt) else {
            actions.push(Action::Refused { task, attempt });
            return;
        };
        let extended = self.now_millis.saturating_add(self.settings.lease_millis);
        self.leases.remove(&(until_now, task));
        self.leases.insert((extended, task));
        if let TaskState::Leased { until_millis, .. } = &mut self.tasks[task.0 as usize].state {
            *until_millis = extended;
        }
        actions.push(Action::Accepted { task, attempt });
    }

    fn complete(&mut self, task: TaskIndex, attempt: u32, artefact: ArtefactId, actions: &mut Vec<Action>) {
        // The answer to an earlier delivery may have been lost: saying it again is no second result.
        if self.state(task) == Some(&TaskState::Done { attempt, artefact }) {
            actions.push(Action::Accepted { task, attempt });
            return;
        }
        if self.lease_end(task, attempt).is_none() {
            actions.push(Action::Refused { task, attempt });
            return;
        }
        self.end_lease(task, TaskState::Done { attempt, artefact }, actions);
        self.done += 1;
        for dependent in std::mem::take(&mut self.tasks[task.0 as usize].dependents) {
            let record = &mut self.tasks[dependent.0 as usize];
            if let TaskState::Waiting { missing } = &mut record.state {
                *missing -= 1;
                if *missing == 0 {
                    record.state = TaskState::Ready;
                    self.ready.insert(dependent);
                    actions.push(Action::Changed { task: dependent });
                }
            }
        }
        actions.push(Action::Accepted { task, attempt });
    }

    fn fail(&mut self, task: TaskIndex, attempt: u32, failure: Failure, actions: &mut Vec<Action>) {
        if self.lease_end(task, attempt).is_none() {
            actions.push(Action::Refused { task, attempt });
            return;
        }
        let message = failure.message;
        let state = match failure.kind {
            FailureKind::Input => TaskState::Failed { attempt, message },
            FailureKind::GivenBack => TaskState::Ready,
            FailureKind::Work => {
                let record = &mut self.tasks[task.0 as usize];
                record.failures += 1;
                if record.failures < self.settings.failures_limit {
                    TaskState::Ready
                } else {
                    TaskState::Quarantined { attempt, message }
                }
            }
        };
        self.end_lease(task, state, actions);
        actions.push(Action::Accepted { task, attempt });
    }

    fn cancel(&mut self, actions: &mut Vec<Action>) {
        if !self.is_over() {
            self.cancelled = true;
            while let Some(&(_, task)) = self.leases.first() {
                self.end_lease(task, TaskState::Ready, actions);
            }
        }
    }

    fn expire(&mut self, actions: &mut Vec<Action>) {
        while let Some(&(until_millis, task)) = self.leases.first()
            && until_millis <= self.now_millis
        {
            self.lose_task(task, actions);
        }
    }

    fn lose(&mut self, worker: WorkerId, actions: &mut Vec<Action>) {
        if let Some(&task) = self.lease_of_worker.get(&worker) {
            self.lose_task(task, actions);
        }
    }

    fn lose_task(&mut self, task: TaskIndex, actions: &mut Vec<Action>) {
        let record = &mut self.tasks[task.0 as usize];
        record.losses += 1;
        let state = if record.losses < self.settings.losses_limit {
            TaskState::Ready
        } else {
            let message = format!("the worker vanished in {} attempts", record.losses);
            TaskState::Quarantined { attempt: record.attempts, message: message.into() }
        };
        self.end_lease(task, state, actions);
    }

    /// When the lease ends, if this attempt holds it.
    fn lease_end(&self, task: TaskIndex, attempt: u32) -> Option<u64> {
        match self.state(task)? {
            TaskState::Leased { attempt: holder, until_millis, .. } if *holder == attempt => Some(*until_millis),
            _ => None,
        }
    }

    /// Moves a leased task on.
    fn end_lease(&mut self, task: TaskIndex, next: TaskState, actions: &mut Vec<Action>) {
        let record = &mut self.tasks[task.0 as usize];
        if let TaskState::Leased { worker, until_millis, .. } = record.state {
            self.lease_of_worker.remove(&worker);
            self.leases.remove(&(until_millis, task));
        }
        if next == TaskState::Ready {
            self.ready.insert(task);
        }
        record.state = next;
        actions.push(Action::Changed { task });
    }
}

impl Record {
    fn new(node: TaskNode) -> Self {
        let mut dependencies = node.dependencies;
        dependencies.sort_unstable();
        dependencies.dedup();
        let state = match dependencies.len() as u32 {
            0 => TaskState::Ready,
            missing => TaskState::Waiting { missing },
        };
        Self { dependencies, dependents: Vec::new(), state, attempts: 0, failures: 0, losses: 0 }
    }
}

/// Kahn's algorithm: the first task that no order of work reaches.
fn first_on_cycle(tasks: &[Record]) -> Option<u32> {
    let mut missing: Vec<usize> = tasks.iter().map(|record| record.dependencies.len()).collect();
    let mut reached: Vec<usize> = (0..tasks.len()).filter(|&task| missing[task] == 0).collect();
    let mut next = 0;
    while let Some(&task) = reached.get(next) {
        next += 1;
        for dependent in &tasks[task].dependents {
            let missing = &mut missing[dependent.0 as usize];
            *missing -= 1;
            if *missing == 0 {
                reached.push(dependent.0 as usize);
            }
        }
    }
    missing.iter().position(|&missing| missing > 0).map(|task| task as u32)
}
