//! Placement: selects the task for a worker that asks for one, in bounded time.
//!
//! 1. The first job in fair-share order (priority class, then service received) that has a fitting ready task for the
//!    backend.
//! 2. Of that job, the task with the longest critical path (in half octaves). Ties go to the task with most inputs in
//!    the worker's cache, then to the plan's order.
//! 3. Large tasks are reserved for fast workers. A worker `n` octaves slower than the fastest takes only tasks that are
//!    at least `n` octaves smaller than the largest ready task. If there is none, it takes the smallest larger task: a
//!    speculative attempt can repair a slow attempt, but nothing repairs idle time.
//! 4. Without a ready task, a speculative attempt at a running task that this worker would finish earlier (backup
//!    tasks, Dean and Ghemawat, "MapReduce", 2004, section 3.6). Results are identical, so the first one wins.

use std::ops::Bound;

use crate::job::{Job, task_of};
use crate::pools::{Pool, Worker};
use crate::scheduler::Scheduler;
use crate::types::{JobId, Settings, TaskIndex, TaskState, WorkerId};

/// Limit of tasks of a size class that are skipped because they failed on this worker.
const SKIPPED_LIMIT: usize = 8;
/// Limit of ready tasks that are examined per cached artefact.
const CACHED_TASKS_LIMIT: usize = 4;
/// Limit of attempts of a job that are examined for the latest expected and the most overdue, each.
const STRAGGLERS_LIMIT: usize = 4;
/// Limit of jobs that are examined for stragglers.
const SPECULATABLE_JOBS_LIMIT: usize = 64;

/// The worker that asks for a task, with the data for the decision.
pub(crate) struct Candidate<'a> {
    pub(crate) id: WorkerId,
    pub(crate) worker: &'a Worker,
    pub(crate) pool: &'a Pool,
    pub(crate) settings: &'a Settings,
    pub(crate) now: u64,
}

impl Scheduler {
    /// Selects the task for a worker.
    pub(crate) fn choose_task(&self, id: WorkerId) -> Option<(JobId, TaskIndex)> {
        let worker = self.workers.get(&id)?;
        let pool = self.pools.get(&worker.offer.backend)?;
        let candidate = Candidate { id, worker, pool, settings: &self.settings, now: self.now_millis };
        let job = |id: &JobId| self.jobs.get(id);
        let ready = pool.fair_order.iter().find_map(|(_, _, id)| Some((*id, candidate.ready_task_of(job(id)?)?)));
        ready.or_else(|| {
            let speculatable = pool.speculatable.iter().filter_map(job).take(SPECULATABLE_JOBS_LIMIT);
            let late =
                speculatable.filter_map(|job| candidate.straggler_of(job).map(|(gain, task)| (gain, job.id, task)));
            late.max_by_key(|(gain, ..)| *gain).map(|(_, job, task)| (job, task))
        })
    }
}

impl Candidate<'_> {
    fn ready_task_of(&self, job: &Job) -> Option<TaskIndex> {
        let largest = *job.ready_queues.keys().next_back()?;
        let limit = largest.saturating_sub(self.pool.octaves_behind(self.worker));
        let suited =
            job.ready_queues.range(..=limit).filter_map(|(size_class, _)| self.first_fitting(job, *size_class)).min();
        let larger = || job.ready_queues.range((Bound::Excluded(limit), Bound::Unbounded));
        let key = suited.or_else(|| larger().find_map(|(size_class, _)| self.first_fitting(job, *size_class)))?;
        let limit = limit.max(job.size_class(task_of(key)));
        Some(task_of(self.best_cached(job, key, limit).unwrap_or(key)))
    }

    /// The first task of a size class that fits and is not excluded on this worker.
    fn first_fitting(&self, job: &Job, size_class: u8) -> Option<u64> {
        let queue = job.ready_queues.get(&size_class)?;
        let mut from = 0;
        for _ in 0..SKIPPED_LIMIT {
            let key = queue.next_within(from, self.worker.memory())?;
            if !self.is_excluded(job, task_of(key)) {
                return Some(key);
            }
            from = key + 1;
        }
        None
    }

    /// Whether the task failed on this worker and another suitable worker exists: one with enough memory on which it
    /// has not failed.
    fn is_excluded(&self, job: &Job, task: TaskIndex) -> bool {
        let record = job.record(task);
        let TaskState::Ready { since_millis } = record.state else { return false };
        let others = self.pool.memories.iter().rev().take_while(|(memory, _)| *memory >= record.memory_bytes);
        record.failed_workers.contains(&self.id)
            && self.now < since_millis.saturating_add(self.settings.exclusion_millis)
            && others.take(record.failed_workers.len() + 1).any(|(_, other)| !record.failed_workers.contains(other))
    }

    /// Among the tasks of the same urgency class as `best`, the one with most inputs in the worker's cache, if any.
    fn best_cached(&self, job: &Job, best: u64, limit: u8) -> Option<u64> {
        let class = best >> 32;
        let mut hits: Vec<(u64, usize)> = Vec::new();
        for artefact in &self.worker.offer.cached {
            let Some(keys) = job.wanted.get(artefact) else { continue };
            for &key in keys.range(class << 32..(class + 1) << 32).take(CACHED_TASKS_LIMIT) {
                match hits.iter_mut().find(|(hit, _)| *hit == key) {
                    Some((_, count)) => *count += 1,
                    None => hits.push((key, 1)),
                }
            }
        }
        let fits = |key: u64| {
            let task = task_of(key);
            let fits = job.record(task).memory_bytes <= self.worker.memory() && job.size_class(task) <= limit;
            fits && !self.is_excluded(job, task)
        };
        let fitting = hits.into_iter().filter(|(key, _)| fits(*key));
        fitting.max_by_key(|&(key, count)| (count, std::cmp::Reverse(key))).map(|(key, _)| key)
    }

    /// The attempt of this job that a second one by this worker would overtake by most, and by how many milliseconds.
    fn straggler_of(&self, job: &Job) -> Option<(u64, TaskIndex)> {
        self.pool.mean.filter(|_| self.settings.speculation && job.is_runnable())?;
        let latest = job.running.iter().rev().take(STRAGGLERS_LIMIT);
        let overdue = job.running.iter().take(STRAGGLERS_LIMIT);
        let gain = |&(expected, task): &(u64, TaskIndex)| {
            let record = job.record(task);
            let [lease] = record.state.leases() else { return None };
            let fits = record.memory_bytes <= self.worker.memory();
            if lease.worker == self.id || !fits || record.failed_workers.contains(&self.id) {
                return None;
            }
            // An overdue attempt is assumed to take as long again as it has taken.
            let left = match expected.checked_sub(self.now) {
                None | Some(0) => self.now.saturating_sub(lease.began_millis),
                Some(left) => left,
            };
            let needed = self.pool.expected_millis(record.work(), self.worker);
            Some((left.checked_sub(needed + needed / 4).filter(|gain| *gain > 0)?, task))
        };
        latest.chain(overdue).filter_map(gain).max_by_key(|&(gain, task)| (gain, std::cmp::Reverse(task)))
    }
}
