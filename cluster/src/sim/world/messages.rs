//! The network, and the workers at one end of it.

use crate::events::{Action, Event};
use crate::sim::worker::End;
use crate::words::WorkerId;

use super::{Happening, NODES, SETTINGS, World};

impl World {
    /// Sends a message: it may be lost, come late, or come twice.
    pub(super) fn send(&mut self, worker: usize, node: usize, message: Happening) {
        if self.cuts.contains(&(worker, node)) || self.random.chance(self.lossy) {
            return self.note("message dropped");
        }
        let mut delay = self.random.between(1, 40);
        if self.random.chance(self.lossy) {
            self.note("message late");
            delay += self.random.between(100, 8000);
        }
        if self.random.chance(self.lossy) {
            self.note("message copied");
            let later = delay + self.random.between(0, 3000);
            self.after(later, message.clone());
        }
        self.after(delay, message);
    }

    pub(super) fn arrives(
        &mut self,
        node: usize,
        worker: usize,
        life: u64,
        call: u64,
        event: Event,
    ) -> Result<(), String> {
        let asks = matches!(event, Event::LeaseRequested { .. });
        let unknown = self.nodes[node].scheduler.as_ref().is_some_and(|s| s.offer(WorkerId(worker as u32)).is_none());
        if asks && unknown {
            let offer = self.workers[worker].offer.clone();
            self.hear(node, Event::Joined { worker: WorkerId(worker as u32), offer })?;
        }
        for action in self.hear(node, event)?.unwrap_or_default() {
            match &action {
                Action::Stop { worker, .. } => {
                    let (worker, life) = (worker.0 as usize, self.workers[worker.0 as usize].life);
                    self.send(worker, node, Happening::Told { worker, life, call: None, action });
                }
                Action::Grant { .. }
                | Action::NothingYet { .. }
                | Action::Unknown { .. }
                | Action::Accepted { .. }
                | Action::Refused { .. } => {
                    self.send(worker, node, Happening::Told { worker, life, call: Some(call), action });
                }
                _ => {}
            }
        }
        Ok(())
    }

    pub(super) fn told(&mut self, place: usize, life: u64, call: Option<u64>, action: Action) -> Result<(), String> {
        let now = self.now;
        let worker = &mut self.workers[place];
        if worker.life != life || !worker.is_awake(now) || call.is_some_and(|call| call != worker.call) {
            return Ok(());
        }
        if call.is_some() {
            worker.call += 1;
            worker.unanswered = 0;
        }
        let current = worker.doing.as_ref().map(|doing| doing.attempt);
        match action {
            Action::Grant { attempt, rate_permille, .. } if current.is_none() => {
                let job = &self.jobs[&attempt.job];
                let record = self.store.record(attempt.job, attempt.task);
                let work = record.map_or(1, |record| record.work());
                let (faults, mut notes) = (self.work_faults, Vec::new());
                let mut note = |what| notes.push(what);
                worker.begin(now, attempt, rate_permille, job, work, faults, &mut self.random, &mut note);
                notes.into_iter().for_each(|what| self.note(what));
                self.beat(place);
            }
            Action::NothingYet { wait_millis, .. } => self.wake(place, wait_millis),
            Action::Accepted { attempt } if current == Some(attempt) => {
                let doing = worker.doing.clone().filter(|doing| doing.said > 0);
                if let Some(doing) = doing {
                    if let End::Says(Event::Completed { artefact, followers, .. }) = doing.end {
                        self.note("committed");
                        if !followers.is_empty() {
                            self.note("followers");
                        }
                        let old = self.committed.insert((attempt.job, attempt.task), artefact);
                        if old.is_some_and(|old| old != artefact) {
                            return Err(format!("two results of {}/{} were accepted", attempt.job.0, attempt.task));
                        }
                    }
                    self.idle(place);
                }
            }
            Action::Refused { attempt } if current == Some(attempt) => {
                self.note("zombie refused");
                self.idle(place);
            }
            Action::Stop { attempt, .. } if current == Some(attempt) => self.idle(place),
            _ => {}
        }
        Ok(())
    }

    pub(super) fn idle(&mut self, place: usize) {
        self.workers[place].doing = None;
        self.wake(place, 1);
    }

    /// Sets a worker's alarm, its only one.
    pub(super) fn wake(&mut self, place: usize, millis: u64) {
        self.workers[place].alarm += 1;
        let alarm = self.workers[place].alarm;
        self.after(millis, Happening::Wakes { worker: place, alarm });
    }

    /// Sets a working worker's next alarm.
    pub(super) fn beat(&mut self, place: usize) {
        let worker = &self.workers[place];
        let Some(doing) = &worker.doing else { return };
        let left = doing.ends.saturating_sub(self.now);
        let beat = self.random.between(SETTINGS.lease_millis / 6, SETTINGS.lease_millis / 2);
        let pause = if left == 0 { self.random.between(500, 2000) } else { left.min(beat) };
        self.wake(place, pause);
    }

    pub(super) fn wakes(&mut self, place: usize, alarm: u64) {
        let now = self.now;
        let worker = &mut self.workers[place];
        if worker.alarm != alarm || !worker.up {
            return;
        }
        if worker.hangs_until > now {
            let wait = worker.hangs_until - now;
            return self.wake(place, wait);
        }
        worker.unanswered += 1;
        if worker.unanswered > 2 {
            worker.node = (worker.node + 1) % NODES;
            worker.unanswered = 0;
        }
        if worker.doing.as_ref().is_some_and(|doing| doing.said >= 10) {
            worker.doing = None;
        }
        let Some(event) = worker.says(now) else {
            return self.worker_crashes(place);
        };
        worker.call += 1;
        let (node, call, life) = (worker.node, worker.call, worker.life);
        if worker.doing.is_none() {
            // In case no answer comes.
            let patience = self.random.between(1500, 2500);
            self.wake(place, patience);
        } else {
            self.beat(place);
        }
        self.send(place, node, Happening::Arrives { node, worker: place, life, call, event });
    }
}
