//! Worker pools: all workers of one backend and all jobs for that backend.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use crate::types::{CACHED_LIMIT, JobId, Offer, WorkerId};

/// Speed of a worker without measurements, in thousandths.
const UNIT_SPEED: u64 = 1000;
/// The maximum speed, in thousandths.
const SPEED_LIMIT: u64 = 1_000_000_000_000;

/// A known worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Worker {
    pub(crate) offer: Offer,
    /// Time of the last message from it.
    pub(crate) seen_millis: u64,
    /// When to check its timeout. The check may be early; it is then rescheduled.
    pub(crate) due_millis: u64,
    /// Measured speed, thousandths of work per millisecond, smoothed. `None` before its first result.
    pub(crate) speed: Option<u64>,
}

impl Worker {
    pub(crate) fn new(mut offer: Offer, now: u64, due_millis: u64, speed: Option<u64>) -> Self {
        offer.cached.truncate(CACHED_LIMIT);
        offer.cached.sort_unstable();
        offer.cached.dedup();
        Self { offer, seen_millis: now, due_millis, speed }
    }

    /// Memory available to a task, bytes; `u64::MAX` if unknown.
    pub(crate) fn memory(&self) -> u64 {
        if self.offer.memory_bytes == 0 { u64::MAX } else { self.offer.memory_bytes }
    }
}

/// The sort key of the fair-share order: higher priority first, then less service received.
pub(crate) type FairKey = (Reverse<u8>, u64, JobId);

/// The workers and jobs of one backend.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Pool {
    /// Workers by memory.
    pub(crate) memories: BTreeSet<(u64, WorkerId)>,
    /// Workers with a measured speed, by speed.
    pub(crate) speeds: BTreeSet<(u64, WorkerId)>,
    /// Smoothed mean speed over recent results.
    pub(crate) mean: Option<u64>,
    /// Jobs with ready tasks, in fair-share order.
    pub(crate) fair_order: BTreeSet<FairKey>,
    /// Jobs with tasks that have exactly one running attempt: candidates for speculation.
    pub(crate) speculatable: BTreeSet<JobId>,
    /// Per priority class, the service of the job that was served last. A new or resumed job starts from this value, so
    /// that it cannot claim service for its idle time.
    pub(crate) served_floors: BTreeMap<u8, u64>,
}

impl Pool {
    pub(crate) fn add(&mut self, id: WorkerId, worker: &Worker) {
        self.memories.insert((worker.memory(), id));
        self.speeds.extend(worker.speed.map(|speed| (speed, id)));
    }

    pub(crate) fn remove(&mut self, id: WorkerId, worker: &Worker) {
        self.memories.remove(&(worker.memory(), id));
        worker.speed.iter().for_each(|&speed| {
            self.speeds.remove(&(speed, id));
        });
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.memories.is_empty() && self.fair_order.is_empty() && self.speculatable.is_empty()
    }

    /// The largest memory of any worker.
    pub(crate) fn max_memory(&self) -> Option<u64> {
        self.memories.last().map(|(memory, _)| *memory)
    }

    /// The speed estimate of a worker: measured, else the pool's mean, else unit speed.
    pub(crate) fn speed_of(&self, worker: &Worker) -> u64 {
        worker.speed.or(self.mean).unwrap_or(UNIT_SPEED)
    }

    /// How much slower the worker is than the fastest, in whole octaves.
    pub(crate) fn octaves_behind(&self, worker: &Worker) -> u8 {
        let own = self.speed_of(worker);
        let fastest = self.speeds.last().map_or(own, |(speed, _)| *speed);
        (fastest.max(own) / own).ilog2() as u8
    }

    /// The expected duration of this work on that worker, milliseconds.
    pub(crate) fn expected_millis(&self, work: u64, worker: &Worker) -> u64 {
        (u128::from(work) * u128::from(UNIT_SPEED) / u128::from(self.speed_of(worker))).clamp(1, 1 << 40) as u64
    }

    /// Updates the speeds from a completed attempt by exponential smoothing: weight 1/4 for the worker, 1/16 for the
    /// pool's mean.
    pub(crate) fn record_speed(&mut self, id: WorkerId, worker: &mut Worker, work: u64, took_millis: u64) {
        let seen = u128::from(work) * u128::from(UNIT_SPEED) / u128::from(took_millis.max(1));
        let seen = seen.clamp(1, SPEED_LIMIT.into()) as u64;
        let smooth = |old: Option<u64>, parts: u64| old.map_or(seen, |old| (old * (parts - 1) + seen) / parts).max(1);
        worker.speed.iter().for_each(|&speed| {
            self.speeds.remove(&(speed, id));
        });
        worker.speed = Some(smooth(worker.speed, 4));
        self.speeds.extend(worker.speed.map(|speed| (speed, id)));
        self.mean = Some(smooth(self.mean, 16));
    }
}
