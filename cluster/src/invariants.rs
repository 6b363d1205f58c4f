//! What always holds of a scheduler, numbered. Simulation, tests and production check with this same code.
//!
//! Of every state ([`check`]):
//! - **C1** A task waits exactly while some of its dependencies are not done, and it knows how many.
//! - **C2** The shelves of a job hold exactly its ready tasks, with their keys and memory, and so do the lists of wanted inputs.
//! - **C3** A worker holds at most one lease, a task one or two, of different workers; the indices of leases, of attempts that
//!   may be overtaken and of pauses agree with the tasks.
//! - **C4** No lease and no pause has ended by now, and no lease reaches further than a lease's length.
//! - **C5** Attempts under way have different numbers, none above the last granted; so has the attempt that ended a task.
//! - **C6** No task goes on that has reached a limit.
//! - **C7** A job is over exactly when nothing is ready, delayed or leased, or it was cancelled (then nothing is leased); how
//!   many tasks stand where, and how many jobs are not over, is counted right.
//! - **C8** A job sits in its lane's turn exactly while it may be granted from, at the place of its class and share.
//! - **C9** The lanes hold exactly the workers that are there, and every worker will be looked at.
//! - **C10** A task's chain is its work and the longest chain that waits for it.
//!
//! Of every step ([`check_step`]):
//! - **C11** Final states are final, but for a retry that a person asked for.
//! - **C12** Attempts grow by exactly the grants, of this epoch, so that no attempt is granted twice.
//! - **C13** What is granted fits the worker (backend, memory), all that it depends on is done, and its job is neither paused
//!   nor cancelled; a second attempt is only at a task that one other worker is at.
//! - **C14** A grant passes over no job of a higher class with a ready task that would have fitted and never failed there.
//! - **C15** Every change of a task's record that must be durable is announced.
//! - **C16** The end of a job is announced when it comes, once.
//! - **C17** Time does not go back. What a task depends on does not change, and tasks do not disappear.
//! - **C18** News is accepted only of an attempt that held its lease before, or of the result that was accepted already.

use std::collections::{BTreeMap, BTreeSet};

use crate::events::{Action, Event};
use crate::job::{Counts, Indices, Job};
use crate::lanes::Lane;
use crate::retry;
use crate::scheduler::Scheduler;
use crate::words::{AttemptId, Fence, JobId, TaskIndex, TaskRecord, TaskState, WorkerId};

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

/// Checks C1 to C10 of a state, in `O((tasks + dependencies) · log)`.
///
/// # Errors
/// The first invariant that does not hold.
pub fn check(scheduler: &Scheduler) -> Result<(), Violation> {
    let mut indices = Indices::default();
    let mut unfinished = 0;
    for job in scheduler.jobs.values() {
        check_job(scheduler, job, &mut indices)?;
        unfinished += usize::from(!job.is_over());
    }
    let agree = indices == scheduler.indices;
    ensure(3, agree, || format!("the tasks say {indices:?}, the indices {:?}", scheduler.indices))?;
    let now = scheduler.now_millis;
    let late = indices.delays.first().is_some_and(|(until, ..)| *until <= now);
    ensure(4, !late, || format!("a pause ended at {:?}, now is {now}", indices.delays.first()))?;
    ensure(7, unfinished == scheduler.unfinished, || {
        format!("{unfinished} jobs are not over, {}", scheduler.unfinished)
    })?;
    check_lanes(scheduler)
}

fn check_job(scheduler: &Scheduler, job: &Job, indices: &mut Indices) -> Result<(), Violation> {
    let (now, settings) = (scheduler.now_millis, &scheduler.settings);
    let mut counts = Counts::default();
    let (mut shelves, mut wanted) = (BTreeMap::<u8, Vec<(u64, u64)>>::new(), BTreeMap::<_, BTreeSet<u64>>::new());
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
                shelves.entry(job.shelf(index)).or_default().push((job.key(index), record.memory_bytes));
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
        check_attempts(record).map_err(|what| Violation { number: 5, what: format!("{} {what}", name()) })?;
        let goes_on = !record.state.is_final() && retry::is_poison(record, settings);
        ensure(6, !goes_on, || format!("{} goes on beyond a limit: {record:?}", name()))?;
        let longest = task.dependents.iter().filter_map(|task| job.task(*task)).map(|task| task.chain).max();
        let chain = record.work().saturating_add(longest.unwrap_or(0));
        let known = is_done(&index) || chain == task.chain;
        ensure(10, known, || format!("the chain of {} is {chain}, not {}", name(), task.chain))?;
    }
    shelves.values_mut().for_each(|entries| entries.sort_unstable());
    let held: BTreeMap<u8, _> = job.shelves.iter().map(|(shelf, queue)| (*shelf, queue.entries())).collect();
    ensure(2, shelves == held, || format!("ready of job {} are {shelves:?}, held {held:?}", job.id.0))?;
    ensure(2, wanted == job.wanted, || format!("job {} wants {wanted:?}, listed {:?}", job.id.0, job.wanted))?;
    ensure(3, running == job.running, || format!("running of job {}: {running:?}, {:?}", job.id.0, job.running))?;
    ensure(7, counts == job.counts, || format!("job {} has {counts:?}, counted {:?}", job.id.0, job.counts))?;
    ensure(7, !job.cancelled || counts.leased == 0, || format!("job {} is cancelled with leases", job.id.0))?;
    let said = job.said_finished == job.is_over();
    ensure(7, said, || format!("job {} is over: {}, said: {}", job.id.0, job.is_over(), job.said_finished))
}

fn check_attempts(record: &TaskRecord) -> Result<(), String> {
    let numbers: BTreeSet<u32> = record.state.leases().iter().map(|lease| lease.fence.number).collect();
    let last = record.attempts;
    let ended = match &record.state {
        TaskState::Done { fence, .. } | TaskState::Failed { fence, .. } | TaskState::Quarantined { fence, .. } => {
            Some(fence.number)
        }
        TaskState::Waiting { .. } if last > 0 => return Err("was granted and waits".into()),
        _ => None,
    };
    let fits = numbers.len() == record.state.leases().len() && numbers.iter().chain(&ended).all(|n| *n <= last);
    if fits { Ok(()) } else { Err(format!("is at attempts {numbers:?} or {ended:?}, the last granted is {last}")) }
}

fn check_lanes(scheduler: &Scheduler) -> Result<(), Violation> {
    let mut expected: BTreeMap<&str, Lane> = BTreeMap::new();
    let mut silences = BTreeSet::new();
    for (id, worker) in &scheduler.workers {
        expected.entry(&worker.offer.backend).or_default().add(*id, worker);
        silences.insert((worker.due_millis, *id));
    }
    ensure(9, silences == scheduler.silences, || {
        format!("{silences:?} are to be looked at, {:?}", scheduler.silences)
    })?;
    for job in scheduler.jobs.values().filter(|job| job.is_runnable()) {
        let lane = expected.entry(&job.backend).or_default();
        if !job.shelves.is_empty() {
            lane.turn.insert((std::cmp::Reverse(job.priority), job.served, job.id));
        }
        if !job.running.is_empty() {
            lane.racing.insert(job.id);
        }
    }
    expected.retain(|_, lane| !lane.is_empty());
    let names: Vec<&str> = scheduler.lanes.keys().map(String::as_str).collect();
    ensure(9, expected.keys().copied().eq(names.iter().copied()), || format!("lanes {names:?}, {expected:?}"))?;
    for (name, lane) in &scheduler.lanes {
        let Some(wanted) = expected.get(name.as_str()) else { continue };
        let workers = (&wanted.memories, &wanted.speeds) == (&lane.memories, &lane.speeds);
        ensure(9, workers, || format!("lane {name} has {wanted:?}, holds {lane:?}"))?;
        let jobs = (&wanted.turn, &wanted.racing) == (&lane.turn, &lane.racing);
        ensure(8, jobs, || format!("lane {name} has {wanted:?}, holds {lane:?}"))?;
    }
    Ok(())
}

/// Checks C11 to C18 of a step from `before` to `after`, which heard `event` and answered with `actions`.
///
/// # Errors
/// The first invariant that does not hold.
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
            ensure(15, durable(old) == durable(new) || announced.contains(&(*id, task)), name)?;
        }
        for task in (old.tasks.len() as u32..new.tasks.len() as u32).map(TaskIndex) {
            ensure(15, announced.contains(&(*id, task)), || format!("task {}/{task} appeared unannounced", id.0))?;
        }
    }
    for (id, new) in &after.jobs {
        let was_over = before.jobs.get(id).is_some_and(Job::is_over);
        let (said, due) = (ends.get(id).copied().unwrap_or(0), usize::from(!was_over && new.is_over()));
        ensure(16, said == due, || format!("the end of job {} was announced {said} times, due {due}", id.0))?;
    }
    ensure(17, before.now_millis <= after.now_millis, || "time went back".to_string())
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
    let said_before = record.zip(result).is_some_and(|(record, artefact)| record.state == again(artefact));
    let right = of == Some(attempt) && (held || said_before);
    ensure(18, right, || format!("news of {attempt} was accepted after {event:?}, it was {record:?}"))
}

fn check_grant(before: &Scheduler, after: &Scheduler, id: WorkerId, attempt: AttemptId) -> Result<(), Violation> {
    let (Some(job), Some(worker)) = (after.jobs.get(&attempt.job), after.workers.get(&id)) else {
        return ensure(13, false, || format!("{attempt} was granted of or to nobody"));
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
        // No task of it has failed anywhere, so that none could have been left to another worker.
        let clean = other.tasks.iter().all(|task| task.record.culprits.is_empty());
        let least = other.shelves.values().filter_map(|queue| queue.least_memory()).min();
        let could = clean && least.is_some_and(|least| least <= worker.memory());
        ensure(14, !could, || format!("{attempt} was granted before a task of job {}", other.id.0))?;
    }
    Ok(())
}

/// What of a record must be durable: all but what signs of life and other tasks' results say.
fn durable(record: &TaskRecord) -> impl PartialEq + use<> {
    let leases: Vec<(Fence, WorkerId)> =
        record.state.leases().iter().map(|lease| (lease.fence, lease.worker)).collect();
    let state = match &record.state {
        TaskState::Waiting { .. } => TaskState::Waiting { missing: 0 },
        TaskState::Leased { .. } => TaskState::Leased { leases: Vec::new() },
        state => state.clone(),
    };
    let counters = [record.attempts, record.failures, record.losses, record.troubles, record.overflows];
    (leases, state, counters, record.divergences, record.culprits.clone(), record.memory_bytes)
}
