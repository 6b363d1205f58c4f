//! A simulated coordinator: it steps its scheduler, makes the changes durable, and only then answers.

use crate::durable::Changes;
use crate::events::{Action, Event};
use crate::invariants::{check, check_step};
use crate::journal::{Line, digest, to_text};
use crate::scheduler::Scheduler;
use crate::sim::random::Random;
use crate::sim::store::Store;
use crate::snapshot::RestoreError;
use crate::types::{Settings, TaskState};

/// A node on which a coordinator may run.
#[derive(Debug, Default)]
pub(crate) struct Node {
    pub(crate) scheduler: Option<Scheduler>,
    /// The incarnation; grows with every start, so that messages to an earlier incarnation are dropped.
    pub(crate) incarnation: u64,
    /// Clock skew, milliseconds ahead.
    skew_millis: u64,
    /// The journal of the current incarnation.
    journal: Option<String>,
}

/// The outcome of a coordinator's step.
#[derive(Debug)]
pub(crate) enum StepOutcome {
    /// The actions to carry out.
    Actions(Vec<Action>),
    /// The store failed or fenced it, for this reason. Its durable state is unknown, so it stops without an answer.
    Crashed(&'static str),
}

/// Failure rate of store writes, per mille, each before and after the write.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StoreFaults(pub(crate) u64);

impl Node {
    /// Starts a coordinator from the store, under a new epoch.
    pub(crate) fn start(
        &mut self,
        store: &mut Store,
        settings: Settings,
        now: u64,
        skew_millis: u64,
        journals: bool,
    ) -> Result<(), RestoreError> {
        let (epoch, snapshot) = store.take_over();
        self.incarnation += 1;
        self.skew_millis = skew_millis;
        let now_millis = now + skew_millis;
        let began = || to_text(&Line::Began { settings, snapshot: snapshot.clone(), epoch, now_millis }) + "\n";
        self.journal = journals.then(began);
        self.scheduler = Some(Scheduler::restore(snapshot, settings, epoch, now_millis)?);
        Ok(())
    }

    /// Stops the coordinator and returns its journal.
    pub(crate) fn stop(&mut self) -> Option<String> {
        self.scheduler = None;
        self.journal.take()
    }

    /// Processes an event. The error is a violated invariant.
    pub(crate) fn step(
        &mut self,
        now: u64,
        event: Event,
        store: &mut Store,
        faults: StoreFaults,
        random: &mut Random,
    ) -> Result<StepOutcome, String> {
        let Some(scheduler) = &mut self.scheduler else { return Ok(StepOutcome::Crashed("it is down")) };
        let now_millis = now + self.skew_millis;
        let before = scheduler.clone();
        let actions = scheduler.step(now_millis, event.clone());
        if let Some(journal) = &mut self.journal {
            let line = Line::Step { now_millis, event: event.clone(), answer: digest(&actions) };
            journal.push_str(&(to_text(&line) + "\n"));
        }
        let describe = |violation| format!("{violation} after {event:?}, which returned {actions:?}");
        check(scheduler).map_err(describe)?;
        check_step(&before, scheduler, &event, &actions).map_err(describe)?;

        let changes = Changes::of(scheduler, &event, &actions);
        if !changes.is_empty() {
            if random.chance(faults.0) {
                return Ok(StepOutcome::Crashed("store failed before"));
            }
            if store.write(scheduler.epoch(), changes)?.is_err() {
                return Ok(StepOutcome::Crashed("store fenced"));
            }
            if random.chance(faults.0) {
                return Ok(StepOutcome::Crashed("store failed after"));
            }
            check_durable(scheduler, store)?;
        }
        Ok(StepOutcome::Actions(actions))
    }
}

/// Checks that the store agrees with the scheduler, so that a coordinator that starts from the store now has the same
/// state.
fn check_durable(scheduler: &Scheduler, store: &Store) -> Result<(), String> {
    for job in scheduler.jobs() {
        for (task, live) in scheduler.records(job) {
            let Some(stored) = store.record(job, task) else {
                return Err(format!("task {}/{task} is not durable", job.0));
            };
            let fences = |state: &TaskState| state.leases().iter().map(|lease| lease.fence).collect::<Vec<_>>();
            let same = stored.attempts == live.attempts
                && fences(&stored.state) == fences(&live.state)
                && stored.state.is_final() == live.state.is_final();
            if !same {
                return Err(format!("task {}/{task} is {live:?}, but durable is {stored:?}", job.0));
            }
        }
    }
    Ok(())
}
