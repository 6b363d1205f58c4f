//! A simulated worker: asks, works, gives signs of life, says its last word until it is heard; and all that can befall it.

use crate::events::{Event, Failure, FailureKind};
use crate::sim::random::Random;
use crate::sim::truth::{JobTruth, Nature, result_of};
use crate::words::{AttemptId, FULL_RATE, Offer, WorkerId};

/// A machine.
#[derive(Debug)]
pub(crate) struct SimWorker {
    pub(crate) id: WorkerId,
    pub(crate) offer: Offer,
    /// Thousandths of work per millisecond.
    pub(crate) speed: u64,
    /// Grows with every crash, so that replies to an earlier life are dropped.
    pub(crate) life: u64,
    /// Which alarm counts.
    pub(crate) alarm: u64,
    pub(crate) up: bool,
    /// Does nothing before then, and knows nothing of it afterwards.
    pub(crate) hangs_until: u64,
    /// Which coordinator it talks to.
    pub(crate) node: usize,
    /// Of its last call; the answer to any other is too late.
    pub(crate) call: u64,
    pub(crate) unanswered: u32,
    pub(crate) doing: Option<Doing>,
}

/// The attempt in hand.
#[derive(Debug, Clone)]
pub(crate) struct Doing {
    pub(crate) attempt: AttemptId,
    pub(crate) began: u64,
    pub(crate) ends: u64,
    /// How it will end.
    pub(crate) end: End,
    /// Times the last word was said.
    pub(crate) said: u32,
}

/// How an attempt ends.
#[derive(Debug, Clone)]
pub(crate) enum End {
    /// The worker says this.
    Says(Event),
    /// It takes the worker with it.
    Kills,
}

/// How often what goes wrong on a worker, in thousandths of attempts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WorkFaults {
    pub(crate) slow: u64,
    pub(crate) fails: u64,
}

impl SimWorker {
    pub(crate) fn is_awake(&self, now: u64) -> bool {
        self.up && self.hangs_until <= now
    }

    /// Begins an attempt, and notes what is worth counting.
    pub(crate) fn begin(
        &mut self,
        now: u64,
        attempt: AttemptId,
        rate_permille: u16,
        job: &JobTruth,
        work: u64,
        faults: WorkFaults,
        random: &mut Random,
        note: &mut dyn FnMut(&'static str),
    ) {
        let truth = job.of(attempt.task);
        let mut takes = (work * 1000 / self.speed).max(1) * random.between(700, 1300) / 1000;
        if random.chance(faults.slow) {
            note("worker slow");
            takes *= 12;
        }
        let fails = |kind| {
            let message = format!("{kind:?}");
            End::Says(Event::Failed { attempt, failure: Failure { kind, message } })
        };
        let diverges = match truth.nature {
            Nature::Diverges => rate_permille == FULL_RATE,
            Nature::Hopeless => true,
            _ => false,
        };
        if rate_permille < FULL_RATE {
            note("half rate");
        }
        let end = if truth.nature == Nature::Poison {
            End::Kills
        } else if truth.nature == Nature::BadInput {
            note("input failed");
            fails(FailureKind::Input)
        } else if truth.memory_bytes > self.offer.memory_bytes {
            note("out of memory");
            fails(FailureKind::OutOfMemory)
        } else if diverges {
            note("diverged");
            fails(FailureKind::Numeric)
        } else if random.chance(faults.fails) {
            note("infrastructure");
            fails(FailureKind::Infrastructure)
        } else if random.chance(faults.fails) {
            note("work failed");
            fails(FailureKind::Work)
        } else {
            End::Says(Event::Completed { attempt, artefact: result_of(attempt), followers: truth.followers })
        };
        if matches!(end, End::Kills) || matches!(&end, End::Says(Event::Failed { .. })) {
            takes = takes / 2 + 1;
        }
        self.doing = Some(Doing { attempt, began: now, ends: now + takes, end, said: 0 });
    }

    /// What it says when it wakes: that it is idle, that it is alive, or how its attempt ended.
    pub(crate) fn says(&mut self, now: u64) -> Option<Event> {
        let Some(doing) = &mut self.doing else { return Some(Event::LeaseRequested { worker: self.id }) };
        if now < doing.ends {
            let done = (now - doing.began) * 1000 / (doing.ends - doing.began);
            return Some(Event::Progressed { attempt: doing.attempt, done_permille: Some(done as u16) });
        }
        match &doing.end {
            End::Kills => None,
            End::Says(event) => {
                doing.said += 1;
                Some(event.clone())
            }
        }
    }

    /// Its process ends, and with it what it was doing.
    pub(crate) fn crash(&mut self) {
        self.life += 1;
        self.up = false;
        self.doing = None;
        self.unanswered = 0;
    }
}
