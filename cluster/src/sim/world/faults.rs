//! Fault injection, user commands, and the end of the faults.

use crate::events::{Event, Failure, FailureKind};
use crate::sim::coordinator::StoreFaults;
use crate::sim::worker::WorkFaults;
use crate::types::{TaskIndex, TaskState};

use super::{NODES, TraceEvent, World};

/// Interval at which a user retries failed tasks after the faults have stopped.
const REVIEW_MILLIS: u64 = 60_000;

impl World {
    /// Schedules starts, user commands, faults and their end.
    pub(super) fn schedule_initial_events(&mut self) {
        self.after(0, TraceEvent::NodeStarts { node: 0 });
        for worker in 0..self.workers.len() {
            let when = self.random.between(0, 5000);
            self.after(when, TraceEvent::WorkerStarts { worker });
        }
        for job in self.jobs.values().cloned().collect::<Vec<_>>() {
            let when = self.random.between(0, 20_000);
            self.after(when, TraceEvent::UserRequest { event: Event::Submitted { job: job.id, spec: job.spec } });
            for _ in 0..self.random.between(0, 4) {
                let when = self.random.between(when, self.faults_end.max(when + 1));
                let event = match self.random.between(0, 10) {
                    0 => Event::CancelRequested { job: job.id },
                    1..4 => Event::PauseRequested { job: job.id },
                    4..6 => Event::ResumeRequested { job: job.id },
                    6 => Event::RetryRequested { job: job.id, task: TaskIndex(self.random.between(0, 8) as u32) },
                    _ => Event::ReprioritiseRequested {
                        job: job.id,
                        priority: self.random.between(0, 3) as u8,
                        weight: self.random.between(0, 9) as u32,
                    },
                };
                self.after(when, TraceEvent::UserRequest { event });
            }
        }
        self.after(1000, TraceEvent::Fault);
        self.after(self.faults_end, TraceEvent::FaultsEnd);
    }

    /// Injects a random fault and schedules the next one.
    pub(super) fn inject_fault(&mut self) {
        let place = self.random.between(0, self.workers.len() as u64) as usize;
        let node = self.random.between(0, NODES as u64) as usize;
        match self.random.between(0, 12) {
            0..2 => {
                if self.workers[place].up {
                    self.worker_crashes(place);
                }
            }
            2..5 => {
                self.count("worker hung");
                let long = self.random.between(500, 20_000);
                self.workers[place].hangs_until = self.now + long;
            }
            5..7 => {
                self.count("partition");
                self.partitions.insert((place, node));
            }
            7 => self.partitions.clear(),
            8 => {
                if self.nodes[node].scheduler.is_some() {
                    self.count("coordinator crashed");
                    self.node_stops(node);
                }
            }
            9 => self.after(0, TraceEvent::NodeStarts { node }),
            10 => self.worker_leaves(place),
            _ => self.loss_permille = self.random.between(0, 250),
        }
        let soon = self.random.between(100, 6000);
        self.after(soon, TraceEvent::Fault);
    }

    pub(super) fn worker_crashes(&mut self, place: usize) {
        self.count("worker crashed");
        self.workers[place].crash();
        let later = self.random.between(100, 15_000);
        self.after(later, TraceEvent::WorkerStarts { worker: place });
    }

    /// A worker returns its task, leaves, and restarts after a while.
    pub(super) fn worker_leaves(&mut self, place: usize) {
        if !self.workers[place].is_awake(self.now) {
            return;
        }
        self.count("worker left");
        let worker = &mut self.workers[place];
        let (node, call, incarnation, id) = (worker.node, worker.call, worker.incarnation, worker.id);
        let running = worker.running.clone();
        worker.crash();
        if let Some(running) = running {
            let failure = Failure { kind: FailureKind::GivenBack, message: "leaving".into() };
            let event = Event::Failed { attempt: running.attempt, failure };
            self.send(place, node, TraceEvent::RequestArrives { node, worker: place, incarnation, call, event });
        }
        let event = Event::Left { worker: id };
        self.send(place, node, TraceEvent::RequestArrives { node, worker: place, incarnation, call, event });
        let later = self.random.between(1000, 20_000);
        self.after(later, TraceEvent::WorkerStarts { worker: place });
    }

    pub(super) fn end_faults(&mut self) {
        self.faults_ended = true;
        (self.loss_permille, self.store_faults) = (0, StoreFaults(0));
        self.work_faults = WorkFaults { slow: 0, fails: 0 };
        self.partitions.clear();
        for place in 0..self.workers.len() {
            self.workers[place].hangs_until = self.workers[place].hangs_until.min(self.now);
        }
        self.after(100, TraceEvent::NodeStarts { node: 0 });
        for id in self.jobs.keys().copied().collect::<Vec<_>>() {
            self.after(10_000, TraceEvent::UserRequest { event: Event::ResumeRequested { job: id } });
        }
        self.after(REVIEW_MILLIS, TraceEvent::Review);
    }

    /// Retries failed tasks that can complete.
    pub(super) fn review(&mut self) {
        for (id, job) in self.jobs.clone() {
            for task in (0..self.store.len(id) as u32).map(TaskIndex) {
                let state = self.store.record(id, task).map(|record| &record.state);
                let failed = matches!(state, Some(TaskState::Failed { .. } | TaskState::Quarantined { .. }));
                if failed && job.can_complete(task) {
                    self.after(0, TraceEvent::UserRequest { event: Event::RetryRequested { job: id, task } });
                }
            }
        }
        self.after(REVIEW_MILLIS, TraceEvent::Review);
    }
}
