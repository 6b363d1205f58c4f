//! A simulated coordinator: hears an event, steps its scheduler, makes what changed durable, and only then answers.

use crate::durable::Changes;
use crate::events::{Action, Event};
use crate::invariants::{check, check_step};
use crate::journal::{Line, digest, to_text};
use crate::scheduler::Scheduler;
use crate::sim::random::Random;
use crate::sim::store::Store;
use crate::snapshot::RestoreError;
use crate::words::{Settings, TaskState};

/// A coordinator's place: a life of it may be running there.
#[derive(Debug, Default)]
pub(crate) struct Node {
    pub(crate) scheduler: Option<Scheduler>,
    /// Grows with every start, so that what was meant for an earlier life is dropped.
    pub(crate) life: u64,
    /// How far its clock is ahead, milliseconds.
    skew_millis: u64,
    /// Lines of the journal of the present life.
    journal: Option<String>,
}

/// How a coordinator's step went.
#[derive(Debug)]
pub(crate) enum Heard {
    /// Carry these out.
    Said(Vec<Action>),
    /// The store failed or fenced it, in these words: it does not know what is durable, so it is dead and has said nothing.
    Dead(&'static str),
}

/// How often the store fails, in thousandths of writes, before and after it wrote.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StoreFaults(pub(crate) u64);

impl Node {
    /// Takes over from whoever wrote last.
    pub(crate) fn start(
        &mut self,
        store: &mut Store,
        settings: Settings,
        now: u64,
        skew_millis: u64,
        journals: bool,
    ) -> Result<(), RestoreError> {
        let (epoch, snapshot) = store.take_over();
        self.life += 1;
        self.skew_millis = skew_millis;
        let now_millis = now + skew_millis;
        let began = || to_text(&Line::Began { settings, snapshot: snapshot.clone(), epoch, now_millis }) + "\n";
        self.journal = journals.then(began);
        self.scheduler = Some(Scheduler::restore(snapshot, settings, epoch, now_millis)?);
        Ok(())
    }

    /// Ends its life, and returns the journal of it.
    pub(crate) fn die(&mut self) -> Option<String> {
        self.scheduler = None;
        self.journal.take()
    }

    /// Hears an event. The error is an invariant that does not hold.
    pub(crate) fn hear(
        &mut self,
        now: u64,
        event: Event,
        store: &mut Store,
        faults: StoreFaults,
        random: &mut Random,
    ) -> Result<Heard, String> {
        let Some(scheduler) = &mut self.scheduler else { return Ok(Heard::Dead("it is down")) };
        let now_millis = now + self.skew_millis;
        let before = scheduler.clone();
        let actions = scheduler.step(now_millis, event.clone());
        if let Some(journal) = &mut self.journal {
            let line = Line::Step { now_millis, event: event.clone(), said: digest(&actions) };
            journal.push_str(&(to_text(&line) + "\n"));
        }
        let wrong = |violation| format!("{violation} after {event:?}, which was answered by {actions:?}");
        check(scheduler).map_err(wrong)?;
        check_step(&before, scheduler, &event, &actions).map_err(wrong)?;

        let changes = Changes::of(scheduler, &event, &actions);
        if !changes.is_empty() {
            if random.chance(faults.0) {
                return Ok(Heard::Dead("store failed before"));
            }
            if store.write(scheduler.epoch(), changes)?.is_err() {
                return Ok(Heard::Dead("store fenced"));
            }
            if random.chance(faults.0) {
                return Ok(Heard::Dead("store failed after"));
            }
            check_durable(scheduler, store)?;
        }
        Ok(Heard::Said(actions))
    }
}

/// Whether a coordinator that starts from the store now would know what this one knows.
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
