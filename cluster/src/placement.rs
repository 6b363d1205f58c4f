//! Which task a worker that asks gets: a pure choice, in a number of looks that does not grow with tasks or workers.
//!
//! 1. The job whose turn it is (class, then share) among those of the worker's backend that have a ready task which fits.
//! 2. Of that job, the task at the head of the longest chain of work (half octaves count as equal), among the equal ones the
//!    one of whose inputs the worker has most, then the plan's order.
//! 3. A worker `n` octaves slower than the fastest leaves alone what is less than `n` octaves smaller than the largest ready
//!    task, as long as there is something smaller: large work is for fast workers. If there is nothing smaller it takes the
//!    smallest: a straggler's second attempt repairs that, idleness nothing.
//! 4. If nothing is ready for it, a second attempt at what would otherwise be finished later than by this worker
//!    (backup tasks, Dean and Ghemawat, "MapReduce", 2004, section 3.6). Results are identical, so the first one wins.

use std::ops::Bound;

use crate::job::{Job, task_of};
use crate::lanes::{Lane, Worker};
use crate::scheduler::Scheduler;
use crate::words::{JobId, Settings, TaskIndex, WorkerId};

/// Tasks that are passed over on a shelf because they failed on this very worker.
const PASSED_OVER_LIMIT: usize = 8;
/// Ready tasks that are looked at for each cached artefact.
const CACHED_LOOKS: usize = 4;
/// Attempts of a job that are looked at for the latest and for the most overdue, each.
const STRAGGLER_LOOKS: usize = 4;
/// Jobs with attempts under way that are looked at for stragglers.
const RACING_LOOKS: usize = 64;

/// A worker that asks, with what decides.
pub(crate) struct Asker<'a> {
    pub(crate) id: WorkerId,
    pub(crate) worker: &'a Worker,
    pub(crate) lane: &'a Lane,
    pub(crate) settings: &'a Settings,
    pub(crate) now: u64,
}

impl Scheduler {
    /// The task for a worker that asks.
    pub(crate) fn choose(&self, id: WorkerId) -> Option<(JobId, TaskIndex)> {
        let worker = self.workers.get(&id)?;
        let lane = self.lanes.get(&worker.offer.backend)?;
        let asker = Asker { id, worker, lane, settings: &self.settings, now: self.now_millis };
        let job = |id: &JobId| self.jobs.get(id);
        let ready = lane.turn.iter().find_map(|(_, _, id)| Some((*id, asker.ready_of(job(id)?)?)));
        ready.or_else(|| {
            let racing = lane.racing.iter().filter_map(job).take(RACING_LOOKS);
            let late = racing.filter_map(|job| asker.straggler_of(job).map(|(gain, task)| (gain, job.id, task)));
            late.max_by_key(|(gain, ..)| *gain).map(|(_, job, task)| (job, task))
        })
    }
}

impl Asker<'_> {
    fn ready_of(&self, job: &Job) -> Option<TaskIndex> {
        let largest = *job.shelves.keys().next_back()?;
        let limit = largest.saturating_sub(self.lane.octaves_behind(self.worker));
        let suited = job.shelves.range(..=limit).filter_map(|(shelf, _)| self.first_on(job, *shelf)).min();
        let larger = || job.shelves.range((Bound::Excluded(limit), Bound::Unbounded));
        let key = suited.or_else(|| larger().find_map(|(shelf, _)| self.first_on(job, *shelf)))?;
        let limit = limit.max(job.shelf(task_of(key)));
        Some(task_of(self.cached(job, key, limit).unwrap_or(key)))
    }

    /// The first task on a shelf that fits and did not fail on this worker.
    fn first_on(&self, job: &Job, shelf: u8) -> Option<u64> {
        let queue = job.shelves.get(&shelf)?;
        let mut from = 0;
        for _ in 0..PASSED_OVER_LIMIT {
            let key = queue.next_within(from, self.worker.memory())?;
            if !self.leaves_alone(job, task_of(key)) {
                return Some(key);
            }
            from = key + 1;
        }
        None
    }

    /// Whether the task failed on this worker and may still find another one: one that is there, has the memory, and is not
    /// a culprit too.
    fn leaves_alone(&self, job: &Job, task: TaskIndex) -> bool {
        let record = job.record(task);
        let crate::words::TaskState::Ready { since_millis } = record.state else { return false };
        let others = self.lane.memories.iter().rev().take_while(|(memory, _)| *memory >= record.memory_bytes);
        record.culprits.contains(&self.id)
            && self.now < since_millis.saturating_add(self.settings.patience_millis)
            && others.take(record.culprits.len() + 1).any(|(_, other)| !record.culprits.contains(other))
    }

    /// Among the tasks that are as urgent as `best`, the one with most inputs in the worker's cache, if any has some.
    fn cached(&self, job: &Job, best: u64, limit: u8) -> Option<u64> {
        let class = best >> 32;
        let mut hits: Vec<(u64, usize)> = Vec::new();
        for artefact in &self.worker.offer.cached {
            let Some(keys) = job.wanted.get(artefact) else { continue };
            for &key in keys.range(class << 32..(class + 1) << 32).take(CACHED_LOOKS) {
                match hits.iter_mut().find(|(hit, _)| *hit == key) {
                    Some((_, count)) => *count += 1,
                    None => hits.push((key, 1)),
                }
            }
        }
        let fits = |key: u64| {
            let task = task_of(key);
            let fits = job.record(task).memory_bytes <= self.worker.memory() && job.shelf(task) <= limit;
            fits && !self.leaves_alone(job, task)
        };
        let fitting = hits.into_iter().filter(|(key, _)| fits(*key));
        fitting.max_by_key(|&(key, count)| (count, std::cmp::Reverse(key))).map(|(key, _)| key)
    }

    /// The attempt of this job that a second one by this worker would overtake by most, and by how many milliseconds.
    fn straggler_of(&self, job: &Job) -> Option<(u64, TaskIndex)> {
        self.lane.mean.filter(|_| self.settings.duplicates && job.is_runnable())?;
        let latest = job.running.iter().rev().take(STRAGGLER_LOOKS);
        let overdue = job.running.iter().take(STRAGGLER_LOOKS);
        let gain = |&(expected, task): &(u64, TaskIndex)| {
            let record = job.record(task);
            let [lease] = record.state.leases() else { return None };
            let fits = record.memory_bytes <= self.worker.memory();
            if lease.worker == self.id || !fits || record.culprits.contains(&self.id) {
                return None;
            }
            // What is overdue will take as long again as it took, for all that is known.
            let left = match expected.checked_sub(self.now) {
                None | Some(0) => self.now.saturating_sub(lease.began_millis),
                Some(left) => left,
            };
            let needed = self.lane.expected_millis(record.work(), self.worker);
            Some((left.checked_sub(needed + needed / 4).filter(|gain| *gain > 0)?, task))
        };
        latest.chain(overdue).filter_map(gain).max_by_key(|&(gain, task)| (gain, std::cmp::Reverse(task)))
    }
}
