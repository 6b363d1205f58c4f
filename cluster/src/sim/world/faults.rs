//! What goes wrong and when, what people want meanwhile, and how it ends.

use crate::events::{Event, Failure, FailureKind};
use crate::sim::coordinator::StoreFaults;
use crate::sim::worker::WorkFaults;
use crate::words::{TaskIndex, TaskState};

use super::{Happening, NODES, World};

/// A person looks after failed tasks this often once the faults have stopped.
const REVIEW_MILLIS: u64 = 60_000;

impl World {
    /// What is to happen of itself.
    pub(super) fn plan(&mut self) {
        self.after(0, Happening::NodeStarts { node: 0 });
        for worker in 0..self.workers.len() {
            let when = self.random.between(0, 5000);
            self.after(when, Happening::WorkerStarts { worker });
        }
        for job in self.jobs.values().cloned().collect::<Vec<_>>() {
            let when = self.random.between(0, 20_000);
            self.after(when, Happening::Asks { event: Event::Submitted { job: job.id, spec: job.spec } });
            for _ in 0..self.random.between(0, 4) {
                let when = self.random.between(when, self.ends.max(when + 1));
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
                self.after(when, Happening::Asks { event });
            }
        }
        self.after(1000, Happening::Fault);
        self.after(self.ends, Happening::Peace);
    }

    /// Something goes wrong, and something else will soon.
    pub(super) fn fault(&mut self) {
        let place = self.random.between(0, self.workers.len() as u64) as usize;
        let node = self.random.between(0, NODES as u64) as usize;
        match self.random.between(0, 12) {
            0..2 => {
                if self.workers[place].up {
                    self.worker_crashes(place);
                }
            }
            2..5 => {
                self.note("worker hung");
                let long = self.random.between(500, 20_000);
                self.workers[place].hangs_until = self.now + long;
            }
            5..7 => {
                self.note("partition");
                self.cuts.insert((place, node));
            }
            7 => self.cuts.clear(),
            8 => {
                if self.nodes[node].scheduler.is_some() {
                    self.note("coordinator crashed");
                    self.node_dies(node);
                }
            }
            9 => self.after(0, Happening::NodeStarts { node }),
            10 => self.worker_leaves(place),
            _ => self.lossy = self.random.between(0, 250),
        }
        let soon = self.random.between(100, 6000);
        self.after(soon, Happening::Fault);
    }

    pub(super) fn worker_crashes(&mut self, place: usize) {
        self.note("worker crashed");
        self.workers[place].crash();
        let later = self.random.between(100, 15_000);
        self.after(later, Happening::WorkerStarts { worker: place });
    }

    /// A worker gives back what it has, says that it leaves, and comes back after a while.
    pub(super) fn worker_leaves(&mut self, place: usize) {
        if !self.workers[place].is_awake(self.now) {
            return;
        }
        self.note("worker left");
        let worker = &mut self.workers[place];
        let (node, call, life, id) = (worker.node, worker.call, worker.life, worker.id);
        let doing = worker.doing.clone();
        worker.crash();
        if let Some(doing) = doing {
            let failure = Failure { kind: FailureKind::GivenBack, message: "leaving".into() };
            let event = Event::Failed { attempt: doing.attempt, failure };
            self.send(place, node, Happening::Arrives { node, worker: place, life, call, event });
        }
        let event = Event::Left { worker: id };
        self.send(place, node, Happening::Arrives { node, worker: place, life, call, event });
        let later = self.random.between(1000, 20_000);
        self.after(later, Happening::WorkerStarts { worker: place });
    }

    pub(super) fn make_peace(&mut self) {
        self.peace = true;
        (self.lossy, self.store_faults) = (0, StoreFaults(0));
        self.work_faults = WorkFaults { slow: 0, fails: 0 };
        self.cuts.clear();
        for place in 0..self.workers.len() {
            self.workers[place].hangs_until = self.workers[place].hangs_until.min(self.now);
        }
        self.after(100, Happening::NodeStarts { node: 0 });
        for id in self.jobs.keys().copied().collect::<Vec<_>>() {
            self.after(10_000, Happening::Asks { event: Event::ResumeRequested { job: id } });
        }
        self.after(REVIEW_MILLIS, Happening::Review);
    }

    /// Retries what failed and can be done.
    pub(super) fn review(&mut self) {
        for (id, job) in self.jobs.clone() {
            for task in (0..self.store.len(id) as u32).map(TaskIndex) {
                let state = self.store.record(id, task).map(|record| &record.state);
                let failed = matches!(state, Some(TaskState::Failed { .. } | TaskState::Quarantined { .. }));
                if failed && job.can_be_done(task) {
                    self.after(0, Happening::Asks { event: Event::RetryRequested { job: id, task } });
                }
            }
        }
        self.after(REVIEW_MILLIS, Happening::Review);
    }
}
