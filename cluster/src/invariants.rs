//! What always holds of a scheduler, numbered. Simulation, tests and production check with this same code.
//!
//! Of every state ([`check`]):
//! - **C1** A task waits exactly while some of its dependencies are not done, and it knows how many.
//! - **C2** The queue holds exactly the ready tasks.
//! - **C3** A worker holds at most one lease, and the indices of leases agree with the tasks.
//! - **C4** No lease has ended by now, and none reaches further than a lease's length.
//! - **C5** A task's current or final attempt is the last one granted.
//! - **C6** A task is quarantined exactly when it reached a limit.
//! - **C7** The job is over exactly when nothing is ready or leased, or it was cancelled; then nothing is leased.
//!
//! Of every step ([`check_step`]):
//! - **C8** Final states are final.
//! - **C9** Attempts grow by exactly the grants, so that no attempt is granted twice.
//! - **C10** A grant takes the first ready task of the plan's order.
//! - **C11** Every change of a task's state is announced, except the extension of a lease.
//! - **C12** The end of the job is announced once, when it comes.
//! - **C13** Time does not go back.

use std::collections::{BTreeMap, BTreeSet};

use crate::scheduler::Scheduler;
use crate::words::{Action, TaskIndex, TaskState};

/// An invariant that does not hold: a bug in the scheduler.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("C{number}: {what}")]
pub struct Violation {
    /// Which invariant.
    pub number: u8,
    /// Where and how.
    pub what: String,
}

fn ensure(number: u8, holds: bool, what: impl FnOnce() -> String) -> Result<(), Violation> {
    if holds { Ok(()) } else { Err(Violation { number, what: what() }) }
}

/// Checks C1 to C7 of a state, in `O(tasks + dependencies)`.
///
/// # Errors
/// The first invariant that does not hold.
pub fn check(scheduler: &Scheduler) -> Result<(), Violation> {
    let settings = &scheduler.settings;
    let mut ready = BTreeSet::new();
    let mut leases = BTreeSet::new();
    let mut lease_of_worker = BTreeMap::new();
    let mut done = 0;
    for (task, record) in (0..).map(TaskIndex).zip(&scheduler.tasks) {
        let is_done = |task: &TaskIndex| matches!(scheduler.state(*task), Some(TaskState::Done { .. }));
        let missing = record.dependencies.iter().filter(|task| !is_done(task)).count() as u32;
        let waits = match record.state {
            TaskState::Waiting { missing } => missing,
            _ => 0,
        };
        ensure(1, waits == missing, || format!("task {task} waits for {waits}, {missing} are missing"))?;
        match record.state {
            TaskState::Waiting { .. } => {
                ensure(5, record.attempts == 0, || format!("task {task} was granted while it waits"))?;
            }
            TaskState::Ready => {
                ready.insert(task);
            }
            TaskState::Leased { worker, until_millis, .. } => {
                let other = lease_of_worker.insert(worker, task);
                ensure(3, other.is_none(), || format!("{worker:?} holds tasks {task} and {other:?}"))?;
                leases.insert((until_millis, task));
                let (now, length) = (scheduler.now_millis, settings.lease_millis);
                let fits = until_millis > now && until_millis <= now.saturating_add(length) || length == 0;
                ensure(4, fits, || format!("the lease of task {task} ends at {until_millis}, now is {now}"))?;
            }
            TaskState::Done { .. } => done += 1,
            TaskState::Failed { .. } | TaskState::Quarantined { .. } => {}
        }
        if let Some(attempt) = attempt_of(&record.state) {
            let last = record.attempts;
            ensure(5, attempt == last, || format!("task {task} is at attempt {attempt}, the last granted is {last}"))?;
        }
        let poisoned =
            record.failures >= settings.failures_limit.max(1) || record.losses >= settings.losses_limit.max(1);
        let quarantined = matches!(record.state, TaskState::Quarantined { .. });
        ensure(6, poisoned == quarantined, || {
            format!(
                "task {task} has {} failures and {} losses and is {:?}",
                record.failures, record.losses, record.state
            )
        })?;
    }
    ensure(2, ready == scheduler.ready, || format!("ready are {ready:?}, queued {:?}", scheduler.ready))?;
    let agree = leases == scheduler.leases && lease_of_worker == scheduler.lease_of_worker;
    ensure(3, agree, || format!("leased are {leases:?}, indexed {:?}", scheduler.leases))?;
    ensure(7, done == scheduler.done, || format!("{done} are done, counted {}", scheduler.done))?;
    let over = scheduler.cancelled || (ready.is_empty() && leases.is_empty());
    ensure(7, over == scheduler.finished().is_some(), || format!("over: {over}, says {:?}", scheduler.finished()))?;
    ensure(7, !over || leases.is_empty(), || format!("over, but leased are {leases:?}"))
}

/// Checks C8 to C13 of a step from `before` to `after`, which answered with `actions`.
///
/// # Errors
/// The first invariant that does not hold.
pub fn check_step(before: &Scheduler, after: &Scheduler, actions: &[Action]) -> Result<(), Violation> {
    let mut grants = BTreeMap::new();
    let mut announced = BTreeSet::new();
    for action in actions {
        match action {
            Action::Grant { task, attempt, worker, until_millis } => {
                grants.insert(*task, *attempt);
                let state = TaskState::Leased { attempt: *attempt, worker: *worker, until_millis: *until_millis };
                ensure(9, after.state(*task) == Some(&state), || format!("{action:?}, but {:?}", after.state(*task)))?;
                let earlier = after.ready.first().is_some_and(|first| first < task);
                ensure(10, !earlier, || format!("{action:?}, but {:?} was ready", after.ready.first()))?;
            }
            Action::Changed { task } => {
                announced.insert(*task);
            }
            _ => {}
        }
    }
    for (task, (old, new)) in (0..).map(TaskIndex).zip(before.tasks.iter().zip(&after.tasks)) {
        let same = old.state == new.state;
        ensure(8, same || !old.state.is_final(), || format!("task {task} left {:?} for {:?}", old.state, new.state))?;
        let granted = grants.get(&task).copied();
        let expected = granted.map_or(old.attempts, |_| old.attempts + 1);
        ensure(9, new.attempts == expected && granted.is_none_or(|attempt| attempt == new.attempts), || {
            format!("task {task} went from {} attempts to {}, granted {granted:?}", old.attempts, new.attempts)
        })?;
        let waits_less = matches!((&old.state, &new.state), (TaskState::Waiting { .. }, TaskState::Waiting { .. }));
        let extended = attempt_of(&old.state) == attempt_of(&new.state) && !new.state.is_final() && !same;
        ensure(11, same || waits_less || extended || announced.contains(&task), || {
            format!("task {task} went from {:?} to {:?} unannounced", old.state, new.state)
        })?;
    }
    let ends = actions.iter().filter(|action| matches!(action, Action::JobFinished { .. })).count();
    let due = usize::from(!before.said_finished && after.finished().is_some());
    ensure(12, ends == due, || format!("the end was announced {ends} times, due {due}"))?;
    ensure(13, before.now_millis <= after.now_millis, || "time went back".to_string())
}

fn attempt_of(state: &TaskState) -> Option<u32> {
    match state {
        TaskState::Waiting { .. } | TaskState::Ready => None,
        TaskState::Leased { attempt, .. }
        | TaskState::Done { attempt, .. }
        | TaskState::Failed { attempt, .. }
        | TaskState::Quarantined { attempt, .. } => Some(*attempt),
    }
}
