//! What time alone does, and what every step ends with: places in the turn, and the ends of jobs.

use std::cmp::Reverse;

use crate::events::Action;
use crate::job::{Counts, task_of};
use crate::lanes::{Lane, Worker};
use crate::retry::Trouble;
use crate::scheduler::Scheduler;
use crate::words::{Fence, JobId, TaskIndex, TaskState, WorkerId};

impl Scheduler {
    /// Everything that time alone does.
    pub(crate) fn pass_time(&mut self, actions: &mut Vec<Action>) {
        let now = self.now_millis;
        while let Some(&(until, attempt)) = self.indices.leases.first()
            && until <= now
        {
            self.end(attempt, Trouble::Lost, actions);
        }
        while let Some(&(until, id, task)) = self.indices.delays.first()
            && until <= now
        {
            self.move_on(id, task, actions, |record| record.state = TaskState::Ready { since_millis: now });
        }
        while let Some(&(due, id)) = self.silences.first()
            && due <= now
        {
            self.silences.remove(&(due, id));
            self.mind_silence(id);
        }
        while let Some(&(due, id)) = self.strands.first()
            && due <= now
        {
            self.strands.remove(&(due, id));
            self.mind_strand(id, actions);
        }
    }

    pub(crate) fn mind_silence(&mut self, id: WorkerId) {
        let Some(worker) = self.workers.get_mut(&id) else { return };
        let due = worker.seen_millis.saturating_add(self.settings.silence_millis);
        let due = if self.indices.lease_of.contains_key(&id) {
            due.max(self.now_millis.saturating_add(self.settings.silence_millis))
        } else {
            due
        };
        if due > self.now_millis {
            worker.due_millis = due;
            self.silences.insert((due, id));
        } else {
            self.remove_worker(id);
        }
    }

    /// Quarantines the ready tasks of a job that fit no worker, though there are workers and nothing else is under way.
    pub(crate) fn mind_strand(&mut self, id: JobId, actions: &mut Vec<Action>) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        job.strand_due = None;
        self.touched.insert(id);
        let Some(largest) = self.lanes.get(&job.backend).and_then(Lane::largest_memory) else { return };
        if !job.is_runnable() || job.counts.leased + job.counts.delayed > 0 {
            return;
        }
        let ready = job.shelves.values().flat_map(|queue| queue.entries());
        let too_large = ready.filter(|(_, memory)| *memory > largest).map(|(key, memory)| (task_of(key), memory));
        let too_large: Vec<(TaskIndex, u64)> = too_large.collect();
        for (task, memory) in too_large {
            let [needed, largest] = [memory, largest].map(|bytes| bytes.div_ceil(1 << 20));
            let message =
                format!("it needs {needed} MiB, the largest worker has {largest}; add a larger one and retry the task");
            let epoch = self.epoch;
            self.move_on(id, task, actions, |record| {
                let fence = Fence { epoch, number: record.attempts };
                record.state = TaskState::Quarantined { fence, message };
            });
        }
    }

    pub(crate) fn remove_worker(&mut self, id: WorkerId) -> Option<Worker> {
        let worker = self.workers.remove(&id)?;
        self.silences.remove(&(worker.due_millis, id));
        if let Some(lane) = self.lanes.get_mut(&worker.offer.backend) {
            lane.remove(id, &worker);
            if lane.is_empty() {
                self.lanes.remove(&worker.offer.backend);
            }
        }
        Some(worker)
    }

    /// Gives every job that this step changed its place, and announces ends.
    pub(crate) fn settle(&mut self, actions: &mut Vec<Action>) {
        self.seat_all();
        for id in std::mem::take(&mut self.touched) {
            let Some(job) = self.jobs.get_mut(&id) else { continue };
            if job.is_over() && !job.said_finished {
                actions.push(Action::JobFinished { job: id, outcome: job.outcome() });
                self.unfinished -= 1;
            } else if !job.is_over() && job.said_finished {
                self.unfinished += 1;
            }
            job.said_finished = job.is_over();
            let Counts { ready, delayed, leased, .. } = job.counts;
            let may_strand = ready > 0 && delayed + leased == 0 && job.is_runnable();
            match job.strand_due {
                Some(due) if !may_strand => {
                    job.strand_due = None;
                    self.strands.remove(&(due, id));
                }
                None if may_strand => {
                    let due = self.now_millis.saturating_add(self.settings.strand_millis.max(1));
                    job.strand_due = Some(due);
                    self.strands.insert((due, id));
                }
                _ => {}
            }
        }
    }

    pub(crate) fn seat_all(&mut self) {
        let touched: Vec<JobId> = self.touched.iter().copied().collect();
        touched.into_iter().for_each(|id| self.reseat(id, true));
    }

    /// Gives a job its place in its lane's turn, or takes it away.
    pub(crate) fn reseat(&mut self, id: JobId, may_sit: bool) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let lane = self.lanes.entry(job.backend.clone()).or_default();
        let sits = may_sit && job.is_runnable() && !job.shelves.is_empty();
        if sits && job.seat.is_none() {
            let floor = lane.floors.get(&job.priority).copied().unwrap_or(0);
            job.served = job.served.max(floor);
        }
        if let Some((priority, served)) = job.seat.take() {
            lane.turn.remove(&(Reverse(priority), served, id));
        }
        if sits {
            job.seat = Some((job.priority, job.served));
            lane.turn.insert((Reverse(job.priority), job.served, id));
        }
        if may_sit && job.is_runnable() && !job.running.is_empty() {
            lane.racing.insert(id);
        } else {
            lane.racing.remove(&id);
        }
        if lane.is_empty() {
            self.lanes.remove(&job.backend);
        }
        if !may_sit && let Some(due) = job.strand_due.take() {
            self.strands.remove(&(due, id));
        }
    }
}
