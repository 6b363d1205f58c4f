//! What workers say: they join and leave, ask for a task, tell of progress, of results and of failures.

use scene::ArtefactId;

use crate::dag::Addition;
use crate::events::{Action, Failure, FailureKind};
use crate::lanes::{Lane, Worker};
use crate::retry::{self, Next, Site, Trouble};
use crate::scheduler::Scheduler;
use crate::words::{AttemptId, Fence, JobId, Lease, Offer, TaskIndex, TaskNode, TaskRecord, TaskState, WorkerId};

/// Requests of idle workers that the scheduler wants to hear per second, at most: beyond, each waits longer.
const ASKS_PER_SECOND: u64 = 2000;
/// The longest that a worker is told to wait, unless the settings say more.
const WAIT_LIMIT_MILLIS: u64 = 10_000;

impl Scheduler {
    pub(crate) fn join(&mut self, id: WorkerId, offer: Offer) {
        let speed = self.remove_worker(id).filter(|old| old.offer.backend == offer.backend).and_then(|old| old.speed);
        let due_millis = self.now_millis.saturating_add(self.settings.silence_millis);
        let worker = Worker::new(offer, self.now_millis, due_millis, speed);
        self.lanes.entry(worker.offer.backend.clone()).or_default().add(id, &worker);
        self.silences.insert((due_millis, id));
        self.workers.insert(id, worker);
    }

    pub(crate) fn leave(&mut self, id: WorkerId, actions: &mut Vec<Action>) {
        if let Some(&attempt) = self.indices.lease_of.get(&id) {
            let failure = Failure { kind: FailureKind::GivenBack, message: "the worker left".into() };
            self.end(attempt, Trouble::Said(failure), actions);
        }
        self.remove_worker(id);
    }

    pub(crate) fn lease(&mut self, id: WorkerId, actions: &mut Vec<Action>) {
        if let Some(&attempt) = self.indices.lease_of.get(&id) {
            self.end(attempt, Trouble::Lost, actions);
        }
        let Some(worker) = self.workers.get_mut(&id) else {
            actions.push(Action::Unknown { worker: id });
            return;
        };
        worker.seen_millis = self.now_millis;
        // What the end of an attempt made ready has to be in its place before the choice.
        self.seat_all();
        if let Some((job, task)) = self.choose(id) {
            self.grant(id, job, task, actions);
        } else {
            let idle = self.workers.len().saturating_sub(self.indices.lease_of.len()) as u64;
            let wait_millis = (idle * 1000 / ASKS_PER_SECOND).min(WAIT_LIMIT_MILLIS).max(self.settings.ask_millis);
            actions.push(Action::NothingYet { worker: id, wait_millis });
        }
    }

    pub(crate) fn grant(&mut self, id: WorkerId, job_id: JobId, task: TaskIndex, actions: &mut Vec<Action>) {
        let (now, epoch) = (self.now_millis, self.epoch);
        let until_millis = now.saturating_add(self.settings.lease_millis);
        let (Some(worker), Some(job)) = (self.workers.get(&id), self.jobs.get_mut(&job_id)) else { return };
        let lane = self.lanes.entry(job.backend.clone()).or_default();
        let expected = lane.expected_millis(job.record(task).work(), worker);
        let charged = (expected << 10) / u64::from(job.weight);
        let floor = lane.floors.entry(job.priority).or_default();
        *floor = (*floor).max(job.served);
        job.served = job.served.saturating_add(charged);
        let (fence, rate_permille) = job.alter(task, &mut self.indices, |record| {
            record.attempts += 1;
            let fence = Fence { epoch, number: record.attempts };
            let lease = Lease {
                fence,
                worker: id,
                began_millis: now,
                until_millis,
                expected_millis: now.saturating_add(expected),
                advanced_millis: now,
                done_permille: 0,
                heard: false,
                timed: true,
                charged,
            };
            match &mut record.state {
                TaskState::Leased { leases } => {
                    leases.push(lease);
                    self.tally.duplicates += 1;
                }
                state => *state = TaskState::Leased { leases: vec![lease] },
            }
            (fence, record.rate_permille())
        });
        self.touch(job_id);
        let attempt = AttemptId { job: job_id, task, fence };
        actions.push(Action::Changed { job: job_id, task });
        actions.push(Action::Grant { worker: id, attempt, until_millis, rate_permille });
    }

    pub(crate) fn progress(&mut self, attempt: AttemptId, done_permille: Option<u16>, actions: &mut Vec<Action>) {
        let (now, settings) = (self.now_millis, self.settings);
        let Some(lease) = self.holder(attempt) else {
            actions.push(Action::Refused { attempt });
            return;
        };
        let (worker, advances) = (lease.worker, done_permille.is_some_and(|done| done > lease.done_permille));
        if !advances && now.saturating_sub(lease.advanced_millis) >= settings.stall_millis {
            self.end(attempt, Trouble::Lost, actions);
            actions.push(Action::Refused { attempt });
            return;
        }
        if let Some(worker) = self.workers.get_mut(&worker) {
            worker.seen_millis = now;
        }
        let Some(job) = self.jobs.get_mut(&attempt.job) else { return };
        job.alter(attempt.task, &mut self.indices, |record| {
            let TaskState::Leased { leases } = &mut record.state else { return };
            for lease in leases.iter_mut().filter(|lease| lease.fence == attempt.fence) {
                lease.until_millis = now.saturating_add(settings.lease_millis);
                lease.heard = true;
                if let Some(done) = done_permille.filter(|_| advances).map(|done| done.min(1000)) {
                    (lease.done_permille, lease.advanced_millis) = (done, now);
                    // The first few steps say little: files are read and windows are made.
                    if done >= 100 && lease.timed {
                        let took = u128::from(now.saturating_sub(lease.began_millis));
                        let all = (took * 1000 / u128::from(done)).min(1 << 40) as u64;
                        lease.expected_millis = lease.began_millis.saturating_add(all);
                    }
                }
            }
        });
        actions.push(Action::Accepted { attempt });
    }

    pub(crate) fn complete(
        &mut self,
        attempt: AttemptId,
        artefact: ArtefactId,
        followers: Vec<TaskNode>,
        actions: &mut Vec<Action>,
    ) {
        let AttemptId { job: id, task, fence } = attempt;
        // The answer to an earlier delivery may have been lost: saying it again is no second result.
        if self.record(id, task).is_some_and(|record| record.state == TaskState::Done { fence, artefact }) {
            actions.push(Action::Accepted { attempt });
            return;
        }
        let Some(lease) = self.holder(attempt).cloned() else {
            actions.push(Action::Refused { attempt });
            return;
        };
        let addition = match Addition::new(followers, self.len(id) as u32, self.settings.tasks_limit) {
            Ok(addition) => addition,
            Err(error) => {
                let message = format!("the tasks that follow make no sense: {error}");
                self.end(attempt, Trouble::Said(Failure { kind: FailureKind::Input, message }), actions);
                actions.push(Action::Accepted { attempt });
                return;
            }
        };
        self.learn(attempt, &lease);
        self.tally.completions += 1;
        self.move_on(id, task, actions, |record| record.state = TaskState::Done { fence, artefact });
        actions.retain(|action| !matches!(action, Action::Stop { attempt: stopped, .. } if *stopped == attempt));
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let first = addition.first;
        for dependent in job.tasks[task.0 as usize].dependents.clone() {
            let since_millis = self.now_millis;
            let ready = job.alter(dependent, &mut self.indices, |record| {
                let TaskState::Waiting { missing } = &mut record.state else { return false };
                *missing -= 1;
                let ready = *missing == 0;
                if ready {
                    record.state = TaskState::Ready { since_millis };
                }
                ready
            });
            if ready {
                actions.push(Action::Changed { job: id, task: dependent });
            }
        }
        job.add(addition, &mut self.indices, self.now_millis);
        actions.extend((first..job.tasks.len() as u32).map(|task| Action::Changed { job: id, task: TaskIndex(task) }));
        actions.push(Action::Accepted { attempt });
    }

    pub(crate) fn fail(&mut self, attempt: AttemptId, failure: Failure, actions: &mut Vec<Action>) {
        if self.holder(attempt).is_none() {
            actions.push(Action::Refused { attempt });
            return;
        }
        self.end(attempt, Trouble::Said(failure), actions);
        actions.push(Action::Accepted { attempt });
    }

    /// Ends an attempt without a result.
    pub(crate) fn end(&mut self, attempt: AttemptId, trouble: Trouble, actions: &mut Vec<Action>) {
        let AttemptId { job: id, task, fence } = attempt;
        let (Some(lease), Some(job)) = (self.holder(attempt), self.jobs.get(&id)) else { return };
        let worker = self.workers.get(&lease.worker);
        let site = Site {
            worker: lease.worker,
            heard: lease.heard,
            memory: worker.map(Worker::memory).filter(|memory| *memory < u64::MAX),
            largest: self.lanes.get(&job.backend).and_then(Lane::largest_memory),
        };
        let (now, settings) = (self.now_millis, self.settings);
        self.tally.ended(&trouble);
        // Attempts under way at once have the same rate and the same results: where one diverges the other will, too. It is
        // no second try, so it ends here; counted as one, a task would be quarantined without ever having had its lower rate.
        let speaks_for_all = matches!(&trouble, Trouble::Said(Failure { kind: FailureKind::Numeric, .. }));
        self.move_on(id, task, actions, |record| {
            let next = retry::after(record, trouble, site, &settings);
            let others = record.state.leases().iter().filter(|lease| lease.fence != fence && !speaks_for_all).cloned();
            let leases: Vec<Lease> = others.collect();
            record.state = match next {
                Next::Failed(message) => TaskState::Failed { fence, message },
                Next::Quarantined(message) => TaskState::Quarantined { fence, message },
                // Another attempt is under way: that is the next one.
                Next::Again { .. } if !leases.is_empty() => TaskState::Leased { leases },
                Next::Again { pause_millis: 0 } => TaskState::Ready { since_millis: now },
                Next::Again { pause_millis } => TaskState::Delayed { until_millis: now.saturating_add(pause_millis) },
            };
        });
        actions.retain(|action| !matches!(action, Action::Stop { attempt: stopped, .. } if *stopped == attempt));
    }

    /// Changes where a task stands, and tells; attempts that hold a lease no more are told to stop, and what the job's share
    /// was charged for them becomes what they took.
    pub(crate) fn move_on(
        &mut self,
        id: JobId,
        task: TaskIndex,
        actions: &mut Vec<Action>,
        change: impl FnOnce(&mut TaskRecord),
    ) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let before = job.record(task).state.leases().to_vec();
        job.alter(task, &mut self.indices, change);
        for lease in before {
            if job.record(task).lease(lease.fence).is_none() {
                if lease.timed {
                    let took = self.now_millis.saturating_sub(lease.began_millis);
                    let fair = (took << 10) / u64::from(job.weight);
                    job.served = job.served.saturating_sub(lease.charged).saturating_add(fair);
                }
                let attempt = AttemptId { job: id, task, fence: lease.fence };
                actions.push(Action::Stop { worker: lease.worker, attempt });
            }
        }
        self.touch(id);
        actions.push(Action::Changed { job: id, task });
    }

    pub(crate) fn learn(&mut self, attempt: AttemptId, lease: &Lease) {
        let took = self.now_millis.saturating_sub(lease.began_millis);
        let work = self.record(attempt.job, attempt.task).map_or(1, TaskRecord::work);
        let Some(worker) = self.workers.get_mut(&lease.worker) else { return };
        worker.seen_millis = self.now_millis;
        if let Some(lane) = self.lanes.get_mut(&worker.offer.backend).filter(|_| lease.timed) {
            lane.learn(lease.worker, worker, work, took);
        }
    }

    /// The lease of an attempt, if it holds one.
    pub(crate) fn holder(&self, attempt: AttemptId) -> Option<&Lease> {
        self.record(attempt.job, attempt.task)?.lease(attempt.fence)
    }
}
