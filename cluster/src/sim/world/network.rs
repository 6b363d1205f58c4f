//! The simulated network and the workers' handling of messages and timers.

use crate::events::{Action, Event};
use crate::sim::worker::AttemptEnd;
use crate::types::WorkerId;

use super::{NODES, SETTINGS, TraceEvent, World};

impl World {
    /// Sends a message, which may be lost, delayed or duplicated.
    pub(super) fn send(&mut self, worker: usize, node: usize, message: TraceEvent) {
        if self.partitions.contains(&(worker, node)) || self.random.chance(self.loss_permille) {
            return self.count("message dropped");
        }
        let mut delay = self.random.between(1, 40);
        if self.random.chance(self.loss_permille) {
            self.count("message late");
            delay += self.random.between(100, 8000);
        }
        if self.random.chance(self.loss_permille) {
            self.count("message copied");
            let later = delay + self.random.between(0, 3000);
            self.after(later, message.clone());
        }
        self.after(delay, message);
    }

    pub(super) fn on_request(
        &mut self,
        node: usize,
        worker: usize,
        incarnation: u64,
        call: u64,
        event: Event,
    ) -> Result<(), String> {
        let on_user_request = matches!(event, Event::LeaseRequested { .. });
        let unknown = self.nodes[node].scheduler.as_ref().is_some_and(|s| s.offer(WorkerId(worker as u32)).is_none());
        if on_user_request && unknown {
            let offer = self.workers[worker].offer.clone();
            self.step_coordinator(node, Event::Joined { worker: WorkerId(worker as u32), offer })?;
        }
        for action in self.step_coordinator(node, event)?.unwrap_or_default() {
            match &action {
                Action::Stop { worker, .. } => {
                    let (worker, incarnation) = (worker.0 as usize, self.workers[worker.0 as usize].incarnation);
                    self.send(worker, node, TraceEvent::ReplyArrives { worker, incarnation, call: None, action });
                }
                Action::Grant { .. }
                | Action::NothingYet { .. }
                | Action::Unknown { .. }
                | Action::Accepted { .. }
                | Action::Refused { .. } => {
                    self.send(worker, node, TraceEvent::ReplyArrives { worker, incarnation, call: Some(call), action });
                }
                _ => {}
            }
        }
        Ok(())
    }

    pub(super) fn on_reply(
        &mut self,
        place: usize,
        incarnation: u64,
        call: Option<u64>,
        action: Action,
    ) -> Result<(), String> {
        let now = self.now;
        let worker = &mut self.workers[place];
        if worker.incarnation != incarnation || !worker.is_awake(now) || call.is_some_and(|call| call != worker.call) {
            return Ok(());
        }
        if call.is_some() {
            worker.call += 1;
            worker.unanswered = 0;
        }
        let current = worker.running.as_ref().map(|running| running.attempt);
        match action {
            Action::Grant { attempt, rate_permille, .. } if current.is_none() => {
                let job = &self.jobs[&attempt.job];
                let record = self.store.record(attempt.job, attempt.task);
                let work = record.map_or(1, |record| record.work());
                let (faults, mut counted) = (self.work_faults, Vec::new());
                let mut count = |name| counted.push(name);
                worker.begin(now, attempt, rate_permille, job, work, faults, &mut self.random, &mut count);
                counted.into_iter().for_each(|name| self.count(name));
                self.set_heartbeat_timer(place);
            }
            Action::NothingYet { wait_millis, .. } => self.set_timer(place, wait_millis),
            Action::Accepted { attempt } if current == Some(attempt) => {
                let running = worker.running.clone().filter(|running| running.reports_sent > 0);
                if let Some(running) = running {
                    if let AttemptEnd::Reports(Event::Completed { artefact, follow_ups, .. }) = running.end {
                        self.count("committed");
                        if !follow_ups.is_empty() {
                            self.count("followers");
                        }
                        if attempt.task.0 == 0 && self.jobs[&attempt.job].has_detections() {
                            self.count("detections");
                        }
                        let old = self.committed.insert((attempt.job, attempt.task), artefact);
                        if old.is_some_and(|old| old != artefact) {
                            return Err(format!("two results of {}/{} were accepted", attempt.job.0, attempt.task));
                        }
                    }
                    self.become_idle(place);
                }
            }
            Action::Refused { attempt } if current == Some(attempt) => {
                self.count("zombie refused");
                self.become_idle(place);
            }
            Action::Stop { attempt, .. } if current == Some(attempt) => self.become_idle(place),
            _ => {}
        }
        Ok(())
    }

    pub(super) fn become_idle(&mut self, place: usize) {
        self.workers[place].running = None;
        self.set_timer(place, 1);
    }

    /// Resets a worker's only timer.
    pub(super) fn set_timer(&mut self, place: usize, millis: u64) {
        self.workers[place].timer += 1;
        let timer = self.workers[place].timer;
        self.after(millis, TraceEvent::TimerFires { worker: place, timer });
    }

    /// Sets the next heartbeat timer of a worker with a running attempt.
    pub(super) fn set_heartbeat_timer(&mut self, place: usize) {
        let worker = &self.workers[place];
        let Some(running) = &worker.running else { return };
        let left = running.ends.saturating_sub(self.now);
        let heartbeat = self.random.between(SETTINGS.lease_millis / 6, SETTINGS.lease_millis / 2);
        let pause = if left == 0 { self.random.between(500, 2000) } else { left.min(heartbeat) };
        self.set_timer(place, pause);
    }

    pub(super) fn on_timer(&mut self, place: usize, timer: u64) {
        let now = self.now;
        let worker = &mut self.workers[place];
        if worker.timer != timer || !worker.up {
            return;
        }
        if worker.hangs_until > now {
            let wait = worker.hangs_until - now;
            return self.set_timer(place, wait);
        }
        worker.unanswered += 1;
        if worker.unanswered > 2 {
            worker.node = (worker.node + 1) % NODES;
            worker.unanswered = 0;
        }
        if worker.running.as_ref().is_some_and(|running| running.reports_sent >= 10) {
            worker.running = None;
        }
        let Some(event) = worker.next_request(now) else {
            return self.worker_crashes(place);
        };
        worker.call += 1;
        let (node, call, incarnation) = (worker.node, worker.call, worker.incarnation);
        if worker.running.is_none() {
            // Timeout for the answer.
            let patience = self.random.between(1500, 2500);
            self.set_timer(place, patience);
        } else {
            self.set_heartbeat_timer(place);
        }
        self.send(place, node, TraceEvent::RequestArrives { node, worker: place, incarnation, call, event });
    }
}
