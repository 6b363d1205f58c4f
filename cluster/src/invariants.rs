//! The numbered invariants of the scheduler. Simulation, tests and production check them with this code.
//!
//! Of every state ([`check`]):
//! - **C1** A task is `Waiting` exactly while some of its dependencies are not done, and stores their number.
//! - **C2** The ready queues of a job hold exactly its ready tasks, with their keys and memory. The same holds for the
//!   index of ready tasks by input.
//! - **C3** A worker holds at most one lease. A leased task has one or two leases, of different workers. The indices of
//!   leases, speculation candidates and delays agree with the records.
//! - **C4** No lease and no delay has expired by now, and no lease ends later than one lease length from now.
//! - **C5** Running attempts have different numbers, none above the last granted. The same holds for the attempt that
//!   ended a task.
//! - **C6** A task that reached a limit is in a final state.
//! - **C7** A job is over exactly when no task is ready, delayed or leased, or when it was cancelled (then no task is
//!   leased). The counters of task states and of unfinished jobs are correct.
//! - **C8** A job is in its pool's fair-share order exactly while tasks can be granted from it, with the key of its
//!   priority class and service received.
//! - **C9** The pools hold exactly the known workers, and every worker has a timeout check.
//! - **C10** The critical path of a task is its work plus the longest critical path of its dependents.
//!
//! Of every step ([`check_step`]):
//! - **C11** Final states change only by a user's retry.
//! - **C12** The number of attempts grows exactly by the grants, all of this epoch, so that no attempt is granted
//!   twice.
//! - **C13** A granted task fits the worker (backend, memory), its dependencies are done, and its job is neither paused
//!   nor cancelled. A speculative attempt is granted only for a task with exactly one running attempt on another
//!   worker.
//! - **C14** A grant does not bypass a job of a higher class with a ready task that fits and has never failed on a
//!   worker.
//! - **C15** Every change of a record that must be durable is announced.
//! - **C16** The end of a job is announced exactly once, when it occurs.
//! - **C17** Time does not go backwards. The dependencies of a task do not change, and tasks do not disappear.
//! - **C18** A report is accepted only from an attempt that held its lease before the step, or if it repeats the
//!   accepted result.

use std::collections::{BTreeMap, BTreeSet};

use crate::events::{Action, Event};
use crate::job::{Counts, Indices, Job};
use crate::pools::Pool;
use crate::retry;
use crate::scheduler::Scheduler;
use crate::types::{AttemptId, Fence, JobId, TaskIndex, TaskRecord, TaskState, WorkerId};

/// A violated invariant: a bug in the scheduler.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("C{number}: {detail}")]
pub struct Violation {
    /// Number of the invariant.
    pub number: u8,
    /// The violation.
    pub detail: String,
}

fn ensure(number: u8, holds: bool, detail: impl FnOnce() -> String) -> Result<(), Violation> {
    if holds { Ok(()) } else { Err(Violation { number, detail: detail() }) }
}

/// Checks C1 to C10 of a state, in `O((tasks + dependencies) · log)`.
///
/// # Errors
/// The first violated invariant.
pub fn check(scheduler: &Scheduler) -> Result<(), Violation> {
    let mut indices = Indices::default();
    let mut unfinished = 0;
    for job in scheduler.jobs.values() {
        check_job(scheduler, job, &mut indices)?;
        unfinished += usize::from(!job.is_over());
    }
    let agree = indices == scheduler.indices;
    ensure(3, agree, || format!("the records give {indices:?}, the indices are {:?}", scheduler.indices))?;
    let now = scheduler.now_millis;
    let late = indices.delays.first().is_some_and(|(until, ..)| *until <= now);
    ensure(4, !late, || format!("a delay ended at {:?}, now is {now}", indices.delays.first()))?;
    ensure(7, unfinished == scheduler.unfinished, || {
        format!("{unfinished} jobs are not over, counted {}", scheduler.unfinished)
    })?;
    check_lanes(scheduler)
}

fn check_job(scheduler: &Scheduler, job: &Job, indices: &mut Indices) -> Result<(), Violation> {
    let (now, settings) = (scheduler.now_millis, &scheduler.settings);
    let mut counts = Counts::default();
    let (mut ready_queues, mut wanted) = (BTreeMap::<u8, Vec<(u64, u64)>>::new(), BTreeMap::<_, BTreeSet<u64>>::new());
    let mut running = BTreeSet::new();
    for (index, task) in (0..).map(TaskIndex).zip(&job.tasks) {
        let record = &task.record;
        let name = || format!("task {}/{index}", job.id.0);
        let is_done = |task: &TaskIndex| matches!(job.record(*task).state, TaskState::Done { .. });
        let missing = record.node.dependencies.iter().filter(|task| !is_done(task)).count() as u32;
        let waits = if let TaskState::Waiting { missing } = record.state { missing } else { 0 };
        ensure(1, waits == missing, || format!("{} waits for {waits}, {missing} are missing", name()))?;
        match &record.state {
            TaskState::Waiting { .. } => counts.waiting += 1,
            TaskState::Ready { .. } => {
                counts.ready += 1;
                ready_queues.entry(job.size_class(index)).or_default().push((job.key(index), record.memory_bytes));
                for (_, artefact) in job.inputs(index) {
                    wanted.entry(artefact).or_default().insert(job.key(index));
                }
            }
            TaskState::Delayed { until_millis } => {
                counts.delayed += 1;
                indices.delays.insert((*until_millis, job.id, index));
            }
            TaskState::Leased { leases } => {
                counts.leased += 1;
                ensure(3, matches!(leases.len(), 1 | 2), || format!("{} has {} leases", name(), leases.len()))?;
                for lease in leases {
                    let attempt = AttemptId { job: job.id, task: index, fence: lease.fence };
                    let other = indices.lease_of.insert(lease.worker, attempt);
                    ensure(3, other.is_none(), || format!("{:?} holds {attempt} and {other:?}", lease.worker))?;
                    indices.leases.insert((lease.until_millis, attempt));
                    let (until, length) = (lease.until_millis, settings.lease_millis);
                    let fits = until > now && until <= now.saturating_add(length) || length == 0;
                    ensure(4, fits, || format!("the lease of {attempt} ends at {until}, now is {now}"))?;
                }
                if let [lease] = &leases[..] {
                    running.insert((lease.expected_millis, index));
                }
            }
            TaskState::Done { .. } => counts.done += 1,
            TaskState::Failed { .. } => counts.failed += 1,
            TaskState::Quarantined { .. } => counts.quarantined += 1,
        }
        check_attempts(record).map_err(|detail| Violation { number: 5, detail: format!("{} {detail}", name()) })?;
        let goes_on = !record.state.is_final() && retry::is_poison(record, settings);
        ensure(6, !goes_on, || format!("{} continues beyond a limit: {record:?}", name()))?;
        let longest = task.dependents.iter().filter_map(|task| job.task(*task)).map(|task| task.critical_path).max();
        let critical_path = record.work().saturating_add(longest.unwrap_or(0));
        let known = is_done(&index) || critical_path == task.critical_path;
        ensure(10, known, || {
            format!("the critical path of {} is {critical_path}, not {}", name(), task.critical_path)
        })?;
    }
    ready_queues.values_mut().for_each(|entries| entries.sort_unstable());
    let held: BTreeMap<u8, _> =
        job.ready_queues.iter().map(|(size_class, queue)| (*size_class, queue.entries())).collect();
    ensure(2, ready_queues == held, || format!("ready tasks of job {} are {ready_queues:?}, held {held:?}", job.id.0))?;
    ensure(2, wanted == job.wanted, || format!("job {} wants {wanted:?}, listed {:?}", job.id.0, job.wanted))?;
    ensure(3, running == job.running, || format!("running tasks of job {}: {running:?}, {:?}", job.id.0, job.running))?;
    ensure(7, counts == job.counts, || format!("job {} has {counts:?}, counted {:?}", job.id.0, job.counts))?;
    ensure(7, !job.cancelled || counts.leased == 0, || format!("job {} is cancelled with leases", job.id.0))?;
    let is_announced = job.end_announced == job.is_over();
    ensure(7, is_announced, || format!("job {} is over: {}, announced: {}", job.id.0, job.is_over(), job.end_announced))
}

fn check_attempts(record: &TaskRecord) -> Result<(), String> {
    let numbers: BTreeSet<u32> = record.state.leases().iter().map(|lease| lease.fence.number).collect();
    let last = record.attempts;
    let ended = match &record.state {
        TaskState::Done { fence, .. } | TaskState::Failed { fence, .. } | TaskState::Quarantined { fence, .. } => {
            Some(fence.number)
        }
        TaskState::Waiting { .. } if last > 0 => return Err("was granted and is waiting".into()),
        _ => None,
    };
    let fits = numbers.len() == record.state.leases().len() && numbers.iter().chain(&ended).all(|n| *n <= last);
    if fits { Ok(()) } else { Err(format!("has attempts {numbers:?} or {ended:?}, the last granted is {last}")) }
}

fn check_lanes(scheduler: &Scheduler) -> Result<(), Violation> {
    let mut expected: BTreeMap<&str, Pool> = BTreeMap::new();
    let mut worker_timeouts = BTreeSet::new();
    for (id, worker) in &scheduler.workers {
        expected.entry(&worker.offer.backend).or_default().add(*id, worker);
        worker_timeouts.insert((worker.due_millis, *id));
    }
    ensure(9, worker_timeouts == scheduler.worker_timeouts, || {
        format!("timeout checks should be {worker_timeouts:?}, are {:?}", scheduler.worker_timeouts)
    })?;
    for job in scheduler.jobs.values().filter(|job| job.is_runnable()) {
        let pool = expected.entry(&job.backend).or_default();
        if !job.ready_queues.is_empty() {
            pool.fair_order.insert((std::cmp::Reverse(job.priority), job.served, job.id));
        }
        if !job.running.is_empty() {
            pool.speculatable.insert(job.id);
        }
    }
    expected.retain(|_, pool| !pool.is_empty());
    let names: Vec<&str> = scheduler.pools.keys().map(String::as_str).collect();
    ensure(9, expected.keys().copied().eq(names.iter().copied()), || {
        format!("pools {names:?}, expected {expected:?}")
    })?;
    for (name, pool) in &scheduler.pools {
        let Some(wanted) = expected.get(name.as_str()) else { continue };
        let workers = (&wanted.memories, &wanted.speeds) == (&pool.memories, &pool.speeds);
        ensure(9, workers, || format!("pool {name} should be {wanted:?}, is {pool:?}"))?;
        let jobs = (&wanted.fair_order, &wanted.speculatable) == (&pool.fair_order, &pool.speculatable);
        ensure(8, jobs, || format!("pool {name} should be {wanted:?}, is {pool:?}"))?;
    }
    Ok(())
}

/// Checks C11 to C18 of a step from `before` to `after` that processed `event` and returned `actions`.
///
/// # Errors
/// The first violated invariant.
pub fn check_step(before: &Scheduler, after: &Scheduler, event: &Event, actions: &[Action]) -> Result<(), Violation> {
    let (mut grants, mut announced, mut ends) = (BTreeMap::new(), BTreeSet::new(), BTreeMap::<JobId, usize>::new());
    for action in actions {
        match action {
            Action::Grant { worker, attempt, .. } => {
                let other = grants.insert((attempt.job, attempt.task), attempt.fence);
                ensure(12, other.is_none(), || format!("{action:?} and {other:?} in one step"))?;
                check_grant(before, after, *worker, *attempt)?;
            }
            Action::Changed { job, task } => {
                announced.insert((*job, *task));
            }
            Action::JobFinished { job, .. } => *ends.entry(*job).or_default() += 1,
            Action::Accepted { attempt } => check_accepted(before, event, *attempt)?,
            _ => {}
        }
    }
    let agreed = |id: JobId| actions.iter().any(|action| matches!(action, Action::Agreed { job } if *job == id));
    for (id, old) in &before.jobs {
        let Some(new) = after.jobs.get(id) else {
            ensure(17, agreed(*id) && old.is_over(), || format!("job {} disappeared", id.0))?;
            continue;
        };
        ensure(17, old.tasks.len() <= new.tasks.len(), || format!("job {} lost tasks", id.0))?;
        for (task, (old, new)) in (0..).map(TaskIndex).zip(old.tasks.iter().zip(&new.tasks)) {
            let (old, new) = (&old.record, &new.record);
            if old == new {
                continue;
            }
            let name = || format!("task {}/{task} went from {old:?} to {new:?}", id.0);
            ensure(17, old.node == new.node, name)?;
            let retried = agreed(*id) && !matches!(old.state, TaskState::Done { .. });
            ensure(11, old.state == new.state || !old.state.is_final() || retried, name)?;
            let granted = grants.get(&(*id, task));
            ensure(12, new.attempts == old.attempts + u32::from(granted.is_some()), name)?;
            ensure(15, durable_part(old) == durable_part(new) || announced.contains(&(*id, task)), name)?;
        }
        for task in (old.tasks.len() as u32..new.tasks.len() as u32).map(TaskIndex) {
            ensure(15, announced.contains(&(*id, task)), || format!("task {}/{task} appeared unannounced", id.0))?;
        }
    }
    for (id, new) in &after.jobs {
        let was_over = before.jobs.get(id).is_some_and(Job::is_over);
        let (announced, due) = (ends.get(id).copied().unwrap_or(0), usize::from(!was_over && new.is_over()));
        ensure(16, announced == due, || {
            format!("the end of job {} was announced {announced} times, expected {due}", id.0)
        })?;
    }
    ensure(17, before.now_millis <= after.now_millis, || "time went backwards".to_string())
}

fn check_accepted(before: &Scheduler, event: &Event, attempt: AttemptId) -> Result<(), Violation> {
    let record = before.record(attempt.job, attempt.task);
    let (of, result) = match event {
        Event::Completed { attempt, artefact, .. } => (Some(*attempt), Some(*artefact)),
        Event::Progressed { attempt, .. } | Event::Failed { attempt, .. } => (Some(*attempt), None),
        _ => (None, None),
    };
    let held = record.is_some_and(|record| record.lease(attempt.fence).is_some());
    let again = |artefact| TaskState::Done { fence: attempt.fence, artefact };
    let is_repeated = record.zip(result).is_some_and(|(record, artefact)| record.state == again(artefact));
    let right = of == Some(attempt) && (held || is_repeated);
    ensure(18, right, || format!("a report of {attempt} was accepted after {event:?}, it was {record:?}"))
}

fn check_grant(before: &Scheduler, after: &Scheduler, id: WorkerId, attempt: AttemptId) -> Result<(), Violation> {
    let (Some(job), Some(worker)) = (after.jobs.get(&attempt.job), after.workers.get(&id)) else {
        return ensure(13, false, || format!("{attempt} was granted for an unknown job or worker"));
    };
    let record = job.record(attempt.task);
    let expected = Fence { epoch: after.epoch, number: record.attempts };
    let holds = record.lease(attempt.fence).is_some_and(|lease| lease.worker == id);
    ensure(12, holds && attempt.fence == expected, || format!("{attempt} was granted, but {record:?}"))?;
    let fits = job.backend == worker.offer.backend && record.memory_bytes <= worker.memory() && job.is_runnable();
    ensure(13, fits, || format!("{attempt} does not fit {worker:?}"))?;
    let inputs = job.inputs(attempt.task).count() == record.node.dependencies.len();
    ensure(13, inputs, || format!("{attempt} was granted before its dependencies are done"))?;
    let earlier = before.record(attempt.job, attempt.task).map_or(0, |old| old.state.leases().len());
    ensure(13, record.state.leases().len() <= earlier + 1, || format!("{attempt} was granted twice at once"))?;
    let passed_over = after.jobs.values().filter(|other| other.backend == job.backend && other.is_runnable());
    let passed_over = passed_over.filter(|other| other.priority > job.priority && other.counts.ready > 0);
    for other in passed_over {
        // If no task has failed on a worker, none can be excluded on this one.
        let clean = other.tasks.iter().all(|task| task.record.failed_workers.is_empty());
        let min_memory = other.ready_queues.values().filter_map(|queue| queue.min_memory()).min();
        let could = clean && min_memory.is_some_and(|min| min <= worker.memory());
        ensure(14, !could, || format!("{attempt} was granted before a task of job {}", other.id.0))?;
    }
    Ok(())
}

/// The part of a record that must be durable: everything except heartbeats and the progress of other tasks.
fn durable_part(record: &TaskRecord) -> impl PartialEq + use<> {
    let leases: Vec<(Fence, WorkerId)> =
        record.state.leases().iter().map(|lease| (lease.fence, lease.worker)).collect();
    let state = match &record.state {
        TaskState::Waiting { .. } => TaskState::Waiting { missing: 0 },
        TaskState::Leased { .. } => TaskState::Leased { leases: Vec::new() },
        state => state.clone(),
    };
    let counters =
        [record.attempts, record.failures, record.losses, record.infrastructure_failures, record.memory_failures];
    (leases, state, counters, record.divergences, record.failed_workers.clone(), record.memory_bytes)
}
