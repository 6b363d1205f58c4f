//! Timers (leases, backoffs, worker timeouts, unschedulable tasks), and the end of every step: fair-share order and
//! ends of jobs.

use std::cmp::Reverse;

use crate::events::Action;
use crate::job::{Counts, task_of};
use crate::pools::{Pool, Worker};
use crate::retry::FailureClass;
use crate::scheduler::Scheduler;
use crate::types::{Fence, JobId, TaskIndex, TaskState, WorkerId};

impl Scheduler {
    /// Processes all timers that are due.
    pub(crate) fn expire_timers(&mut self, actions: &mut Vec<Action>) {
        let now = self.now_millis;
        while let Some(&(until, attempt)) = self.indices.leases.first()
            && until <= now
        {
            self.end_attempt(attempt, FailureClass::WorkerLost, actions);
        }
        while let Some(&(until, id, task)) = self.indices.delays.first()
            && until <= now
        {
            self.transition(id, task, actions, |record| record.state = TaskState::Ready { since_millis: now });
        }
        while let Some(&(due, id)) = self.worker_timeouts.first()
            && due <= now
        {
            self.worker_timeouts.remove(&(due, id));
            self.expire_worker(id);
        }
        while let Some(&(due, id)) = self.unschedulable_timeouts.first()
            && due <= now
        {
            self.unschedulable_timeouts.remove(&(due, id));
            self.expire_unschedulable(id, actions);
        }
    }

    /// Removes a worker after its timeout, or reschedules the check.
    pub(crate) fn expire_worker(&mut self, id: WorkerId) {
        let Some(worker) = self.workers.get_mut(&id) else { return };
        let due = worker.seen_millis.saturating_add(self.settings.worker_timeout_millis);
        let due = if self.indices.lease_of.contains_key(&id) {
            due.max(self.now_millis.saturating_add(self.settings.worker_timeout_millis))
        } else {
            due
        };
        if due > self.now_millis {
            worker.due_millis = due;
            self.worker_timeouts.insert((due, id));
        } else {
            self.remove_worker(id);
        }
    }

    /// Quarantines the ready tasks of a job that fit no worker, if there are workers and nothing of the job is running.
    pub(crate) fn expire_unschedulable(&mut self, id: JobId, actions: &mut Vec<Action>) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        job.unschedulable_due = None;
        self.changed_jobs.insert(id);
        let Some(largest) = self.pools.get(&job.backend).and_then(Pool::max_memory) else { return };
        if !job.is_runnable() || job.counts.leased + job.counts.delayed > 0 {
            return;
        }
        let ready = job.ready_queues.values().flat_map(|queue| queue.entries());
        let too_large = ready.filter(|(_, memory)| *memory > largest).map(|(key, memory)| (task_of(key), memory));
        let too_large: Vec<(TaskIndex, u64)> = too_large.collect();
        for (task, memory) in too_large {
            let [needed, largest] = [memory, largest].map(|bytes| bytes.div_ceil(1 << 20));
            let message = format!(
                "it needs {needed} MiB, the largest worker has {largest} MiB; add a larger worker and retry the task"
            );
            let epoch = self.epoch;
            self.transition(id, task, actions, |record| {
                let fence = Fence { epoch, number: record.attempts };
                record.state = TaskState::Quarantined { fence, message };
            });
        }
    }

    pub(crate) fn remove_worker(&mut self, id: WorkerId) -> Option<Worker> {
        let worker = self.workers.remove(&id)?;
        self.worker_timeouts.remove(&(worker.due_millis, id));
        if let Some(pool) = self.pools.get_mut(&worker.offer.backend) {
            pool.remove(id, &worker);
            if pool.is_empty() {
                self.pools.remove(&worker.offer.backend);
            }
        }
        Some(worker)
    }

    /// Updates the fair-share order and timers of all changed jobs and announces jobs that are over.
    pub(crate) fn finish_step(&mut self, actions: &mut Vec<Action>) {
        self.update_fair_orders();
        for id in std::mem::take(&mut self.changed_jobs) {
            let Some(job) = self.jobs.get_mut(&id) else { continue };
            if job.is_over() && !job.end_announced {
                actions.push(Action::JobFinished { job: id, outcome: job.outcome() });
                self.unfinished -= 1;
            } else if !job.is_over() && job.end_announced {
                self.unfinished += 1;
            }
            job.end_announced = job.is_over();
            let Counts { ready, delayed, leased, .. } = job.counts;
            let is_unschedulable = ready > 0 && delayed + leased == 0 && job.is_runnable();
            match job.unschedulable_due {
                Some(due) if !is_unschedulable => {
                    job.unschedulable_due = None;
                    self.unschedulable_timeouts.remove(&(due, id));
                }
                None if is_unschedulable => {
                    let due = self.now_millis.saturating_add(self.settings.unschedulable_millis.max(1));
                    job.unschedulable_due = Some(due);
                    self.unschedulable_timeouts.insert((due, id));
                }
                _ => {}
            }
        }
    }

    pub(crate) fn update_fair_orders(&mut self) {
        let changed_jobs: Vec<JobId> = self.changed_jobs.iter().copied().collect();
        changed_jobs.into_iter().for_each(|id| self.update_fair_order(id, true));
    }

    /// Updates the place of a job in its pool's fair-share order. `is_listed`: whether the job may be in it at all.
    pub(crate) fn update_fair_order(&mut self, id: JobId, is_listed: bool) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let pool = self.pools.entry(job.backend.clone()).or_default();
        let is_runnable = is_listed && job.is_runnable() && !job.ready_queues.is_empty();
        if is_runnable && job.position.is_none() {
            let floor = pool.served_floors.get(&job.priority).copied().unwrap_or(0);
            job.served = job.served.max(floor);
        }
        if let Some((priority, served)) = job.position.take() {
            pool.fair_order.remove(&(Reverse(priority), served, id));
        }
        if is_runnable {
            job.position = Some((job.priority, job.served));
            pool.fair_order.insert((Reverse(job.priority), job.served, id));
        }
        if is_listed && job.is_runnable() && !job.running.is_empty() {
            pool.speculatable.insert(id);
        } else {
            pool.speculatable.remove(&id);
        }
        if pool.is_empty() {
            self.pools.remove(&job.backend);
        }
        if !is_listed && let Some(due) = job.unschedulable_due.take() {
            self.unschedulable_timeouts.remove(&(due, id));
        }
    }
}
