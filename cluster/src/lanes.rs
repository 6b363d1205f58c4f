//! Workers, by what they compute with: a lane is all workers of one backend and all jobs that are for it.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use crate::words::{CACHED_LIMIT, JobId, Offer, WorkerId};

/// Speed of a worker of which nothing is known, in thousandths.
const UNIT_SPEED: u64 = 1000;
/// Speeds are between one and this.
const SPEED_LIMIT: u64 = 1_000_000_000_000;

/// A worker that is there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Worker {
    pub(crate) offer: Offer,
    /// When it was last heard of.
    pub(crate) seen_millis: u64,
    /// When to look whether it is silent; may be too early, then it is looked at again.
    pub(crate) due_millis: u64,
    /// Thousandths of work per millisecond, smoothed; `None` before it finished anything.
    pub(crate) speed: Option<u64>,
}

impl Worker {
    pub(crate) fn new(mut offer: Offer, now: u64, due_millis: u64, speed: Option<u64>) -> Self {
        offer.cached.truncate(CACHED_LIMIT);
        offer.cached.sort_unstable();
        offer.cached.dedup();
        Self { offer, seen_millis: now, due_millis, speed }
    }

    /// Memory that a task may take, bytes.
    pub(crate) fn memory(&self) -> u64 {
        if self.offer.memory_bytes == 0 { u64::MAX } else { self.offer.memory_bytes }
    }
}

/// A place in a lane's turn: the higher class first, then who had less of its share.
pub(crate) type Seat = (Reverse<u8>, u64, JobId);

/// What shares a backend.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Lane {
    /// Its workers by memory.
    pub(crate) memories: BTreeSet<(u64, WorkerId)>,
    /// Its workers of known speed.
    pub(crate) speeds: BTreeSet<(u64, WorkerId)>,
    /// Mean speed of what was finished lately.
    pub(crate) mean: Option<u64>,
    /// Jobs with ready tasks.
    pub(crate) turn: BTreeSet<Seat>,
    /// Jobs with tasks that have one attempt under way.
    pub(crate) racing: BTreeSet<JobId>,
    /// By class, what the job that was last served had had: who comes later begins there, and hoards no claim.
    pub(crate) floors: BTreeMap<u8, u64>,
}

impl Lane {
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
        self.memories.is_empty() && self.turn.is_empty() && self.racing.is_empty()
    }

    /// The most memory that any worker has.
    pub(crate) fn largest_memory(&self) -> Option<u64> {
        self.memories.last().map(|(memory, _)| *memory)
    }

    /// The speed that a worker is believed to have.
    pub(crate) fn speed_of(&self, worker: &Worker) -> u64 {
        worker.speed.or(self.mean).unwrap_or(UNIT_SPEED)
    }

    /// How many times slower a worker is than the fastest, in whole octaves.
    pub(crate) fn octaves_behind(&self, worker: &Worker) -> u8 {
        let own = self.speed_of(worker);
        let fastest = self.speeds.last().map_or(own, |(speed, _)| *speed);
        (fastest.max(own) / own).ilog2() as u8
    }

    /// Milliseconds that this work will take that worker.
    pub(crate) fn expected_millis(&self, work: u64, worker: &Worker) -> u64 {
        (u128::from(work) * u128::from(UNIT_SPEED) / u128::from(self.speed_of(worker))).clamp(1, 1 << 40) as u64
    }

    /// Learns from a finished attempt: the newest counts a quarter, and in the lane's mean a sixteenth.
    pub(crate) fn learn(&mut self, id: WorkerId, worker: &mut Worker, work: u64, took_millis: u64) {
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
