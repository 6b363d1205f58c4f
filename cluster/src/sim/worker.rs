//! A simulated worker: requests tasks, sends heartbeats, and reports the end of its attempt until it is acknowledged.
//! It can be slow, hang, crash or leave.

use crate::events::{Event, Failure, FailureKind};
use crate::sim::ground_truth::{Behaviour, JobGroundTruth, result_of};
use crate::sim::random::Random;
use crate::types::{AttemptId, FULL_RATE, Offer, WorkerId};

/// A simulated worker.
#[derive(Debug)]
pub(crate) struct SimWorker {
    pub(crate) id: WorkerId,
    pub(crate) offer: Offer,
    /// Speed, thousandths of work per millisecond.
    pub(crate) speed: u64,
    /// The incarnation; grows with every crash, so that replies to an earlier one are dropped.
    pub(crate) incarnation: u64,
    /// Number of the current timer; earlier ones are void.
    pub(crate) timer: u64,
    pub(crate) up: bool,
    /// Until then it hangs. It does not notice that it hung.
    pub(crate) hangs_until: u64,
    /// The coordinator node that it calls.
    pub(crate) node: usize,
    /// Number of its last call. Replies to earlier calls are ignored.
    pub(crate) call: u64,
    pub(crate) unanswered: u32,
    pub(crate) running: Option<RunningAttempt>,
}

/// The running attempt of a worker.
#[derive(Debug, Clone)]
pub(crate) struct RunningAttempt {
    pub(crate) attempt: AttemptId,
    pub(crate) began: u64,
    pub(crate) ends: u64,
    /// Its predetermined end.
    pub(crate) end: AttemptEnd,
    /// Number of times the end was reported.
    pub(crate) reports_sent: u32,
}

/// The end of an attempt.
#[derive(Debug, Clone)]
pub(crate) enum AttemptEnd {
    /// The worker reports this event.
    Reports(Event),
    /// The worker crashes.
    CrashesWorker,
}

/// Fault rates of workers, per mille of attempts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WorkFaults {
    pub(crate) slow: u64,
    pub(crate) fails: u64,
}

impl SimWorker {
    pub(crate) fn is_awake(&self, now: u64) -> bool {
        self.up && self.hangs_until <= now
    }

    /// Starts an attempt and counts the injected faults.
    pub(crate) fn begin(
        &mut self,
        now: u64,
        attempt: AttemptId,
        rate_permille: u16,
        job: &JobGroundTruth,
        work: u64,
        faults: WorkFaults,
        random: &mut Random,
        count: &mut dyn FnMut(&'static str),
    ) {
        let truth = job.task(attempt.task);
        let mut takes = (work * 1000 / self.speed).max(1) * random.between(700, 1300) / 1000;
        if random.chance(faults.slow) {
            count("worker slow");
            takes *= 12;
        }
        let fails = |kind| {
            let message = format!("{kind:?}");
            AttemptEnd::Reports(Event::Failed { attempt, failure: Failure { kind, message } })
        };
        let diverges = match truth.behaviour {
            Behaviour::Diverges => rate_permille == FULL_RATE,
            Behaviour::AlwaysDiverges => true,
            _ => false,
        };
        if rate_permille < FULL_RATE {
            count("half rate");
        }
        let end = if truth.behaviour == Behaviour::CrashesWorker {
            AttemptEnd::CrashesWorker
        } else if truth.behaviour == Behaviour::BadInput {
            count("input failed");
            fails(FailureKind::Input)
        } else if truth.memory_bytes > self.offer.memory_bytes {
            count("out of memory");
            fails(FailureKind::OutOfMemory)
        } else if diverges {
            count("diverged");
            fails(FailureKind::Numeric)
        } else if random.chance(faults.fails) {
            count("infrastructure");
            fails(FailureKind::Infrastructure)
        } else if random.chance(faults.fails) {
            count("work failed");
            fails(FailureKind::Work)
        } else {
            AttemptEnd::Reports(Event::Completed {
                attempt,
                artefact: result_of(attempt),
                follow_ups: truth.follow_ups,
            })
        };
        if matches!(end, AttemptEnd::CrashesWorker) || matches!(&end, AttemptEnd::Reports(Event::Failed { .. })) {
            takes = takes / 2 + 1;
        }
        self.running = Some(RunningAttempt { attempt, began: now, ends: now + takes, end, reports_sent: 0 });
    }

    /// The next request when its timer fires: for a task, a heartbeat, or the report of the end. `None`: the worker
    /// crashes.
    pub(crate) fn next_request(&mut self, now: u64) -> Option<Event> {
        let Some(running) = &mut self.running else { return Some(Event::LeaseRequested { worker: self.id }) };
        if now < running.ends {
            let done = (now - running.began) * 1000 / (running.ends - running.began);
            return Some(Event::Progressed { attempt: running.attempt, done_permille: Some(done as u16) });
        }
        match &running.end {
            AttemptEnd::CrashesWorker => None,
            AttemptEnd::Reports(event) => {
                running.reports_sent += 1;
                Some(event.clone())
            }
        }
    }

    /// The worker crashes and loses its attempt.
    pub(crate) fn crash(&mut self) {
        self.incarnation += 1;
        self.up = false;
        self.running = None;
        self.unanswered = 0;
    }
}
