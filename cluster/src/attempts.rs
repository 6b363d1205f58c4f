//! Worker events: join, leave, requests for a task, heartbeats, results and failures of attempts.

use scene::ArtefactId;

use crate::dag::Addition;
use crate::events::{Action, Failure, FailureKind};
use crate::pools::{Pool, Worker};
use crate::retry::{self, AttemptSite, FailureClass, NextStep};
use crate::scheduler::Scheduler;
use crate::types::{AttemptId, Fence, JobId, Lease, Offer, TaskIndex, TaskNode, TaskRecord, TaskState, WorkerId};

/// Target limit of requests by idle workers per second. With more idle workers, each waits longer.
const POLLS_PER_SECOND: u64 = 2000;
/// The longest poll interval, unless `poll_millis` is longer. Milliseconds.
const WAIT_LIMIT_MILLIS: u64 = 10_000;

impl Scheduler {
    pub(crate) fn join(&mut self, id: WorkerId, offer: Offer) {
        let speed = self.remove_worker(id).filter(|old| old.offer.backend == offer.backend).and_then(|old| old.speed);
        let due_millis = self.now_millis.saturating_add(self.settings.worker_timeout_millis);
        let worker = Worker::new(offer, self.now_millis, due_millis, speed);
        self.pools.entry(worker.offer.backend.clone()).or_default().add(id, &worker);
        self.worker_timeouts.insert((due_millis, id));
        self.workers.insert(id, worker);
    }

    pub(crate) fn leave(&mut self, id: WorkerId, actions: &mut Vec<Action>) {
        if let Some(&attempt) = self.indices.lease_of.get(&id) {
            let failure = Failure { kind: FailureKind::GivenBack, message: "the worker left".into() };
            self.end_attempt(attempt, FailureClass::Reported(failure), actions);
        }
        self.remove_worker(id);
    }

    pub(crate) fn lease(&mut self, id: WorkerId, actions: &mut Vec<Action>) {
        if let Some(&attempt) = self.indices.lease_of.get(&id) {
            self.end_attempt(attempt, FailureClass::WorkerLost, actions);
        }
        let Some(worker) = self.workers.get_mut(&id) else {
            actions.push(Action::Unknown { worker: id });
            return;
        };
        worker.seen_millis = self.now_millis;
        // A task that the end of an attempt made ready must be in the fair-share order before the choice.
        self.update_fair_orders();
        if let Some((job, task)) = self.choose_task(id) {
            self.grant(id, job, task, actions);
        } else {
            let idle = self.workers.len().saturating_sub(self.indices.lease_of.len()) as u64;
            let wait_millis = (idle * 1000 / POLLS_PER_SECOND).min(WAIT_LIMIT_MILLIS).max(self.settings.poll_millis);
            actions.push(Action::NothingYet { worker: id, wait_millis });
        }
    }

    pub(crate) fn grant(&mut self, id: WorkerId, job_id: JobId, task: TaskIndex, actions: &mut Vec<Action>) {
        let (now, epoch) = (self.now_millis, self.epoch);
        let until_millis = now.saturating_add(self.settings.lease_millis);
        let (Some(worker), Some(job)) = (self.workers.get(&id), self.jobs.get_mut(&job_id)) else { return };
        let pool = self.pools.entry(job.backend.clone()).or_default();
        let expected = pool.expected_millis(job.record(task).work(), worker);
        let charged = (expected << 10) / u64::from(job.weight);
        let floor = pool.served_floors.entry(job.priority).or_default();
        *floor = (*floor).max(job.served);
        job.served = job.served.saturating_add(charged);
        let (fence, rate_permille) = job.update_record(task, &mut self.indices, |record| {
            record.attempts += 1;
            let fence = Fence { epoch, number: record.attempts };
            let lease = Lease {
                fence,
                worker: id,
                began_millis: now,
                until_millis,
                expected_millis: now.saturating_add(expected),
                progressed_millis: now,
                done_permille: 0,
                has_heartbeat: false,
                is_timed: true,
                charged,
            };
            match &mut record.state {
                TaskState::Leased { leases } => {
                    leases.push(lease);
                    self.tally.speculative_attempts += 1;
                }
                state => *state = TaskState::Leased { leases: vec![lease] },
            }
            (fence, record.rate_permille())
        });
        self.mark_changed(job_id);
        let attempt = AttemptId { job: job_id, task, fence };
        actions.push(Action::Changed { job: job_id, task });
        actions.push(Action::Grant { worker: id, attempt, until_millis, rate_permille });
    }

    pub(crate) fn progress(&mut self, attempt: AttemptId, done_permille: Option<u16>, actions: &mut Vec<Action>) {
        let (now, settings) = (self.now_millis, self.settings);
        let Some(lease) = self.find_lease(attempt) else {
            actions.push(Action::Refused { attempt });
            return;
        };
        let (worker, advances) = (lease.worker, done_permille.is_some_and(|done| done > lease.done_permille));
        if !advances && now.saturating_sub(lease.progressed_millis) >= settings.stall_millis {
            self.end_attempt(attempt, FailureClass::WorkerLost, actions);
            actions.push(Action::Refused { attempt });
            return;
        }
        if let Some(worker) = self.workers.get_mut(&worker) {
            worker.seen_millis = now;
        }
        let Some(job) = self.jobs.get_mut(&attempt.job) else { return };
        job.update_record(attempt.task, &mut self.indices, |record| {
            let TaskState::Leased { leases } = &mut record.state else { return };
            for lease in leases.iter_mut().filter(|lease| lease.fence == attempt.fence) {
                lease.until_millis = now.saturating_add(settings.lease_millis);
                lease.has_heartbeat = true;
                if let Some(done) = done_permille.filter(|_| advances).map(|done| done.min(1000)) {
                    (lease.done_permille, lease.progressed_millis) = (done, now);
                    // Early progress is not representative, because files are read and windows are built first.
                    if done >= 100 && lease.is_timed {
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
        follow_ups: Vec<TaskNode>,
        actions: &mut Vec<Action>,
    ) {
        let AttemptId { job: id, task, fence } = attempt;
        // The answer to an earlier delivery may have been lost. A repeated report is accepted again.
        if self.record(id, task).is_some_and(|record| record.state == TaskState::Done { fence, artefact }) {
            actions.push(Action::Accepted { attempt });
            return;
        }
        let Some(lease) = self.find_lease(attempt).cloned() else {
            actions.push(Action::Refused { attempt });
            return;
        };
        let addition = match Addition::new(follow_ups, self.len(id) as u32, self.settings.tasks_limit) {
            Ok(addition) => addition,
            Err(error) => {
                let message = format!("the follow-up tasks are invalid: {error}");
                self.end_attempt(
                    attempt,
                    FailureClass::Reported(Failure { kind: FailureKind::Input, message }),
                    actions,
                );
                actions.push(Action::Accepted { attempt });
                return;
            }
        };
        self.record_speed(attempt, &lease);
        self.tally.completions += 1;
        self.transition(id, task, actions, |record| record.state = TaskState::Done { fence, artefact });
        actions.retain(|action| !matches!(action, Action::Stop { attempt: stopped, .. } if *stopped == attempt));
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let first = addition.first;
        for dependent in job.tasks[task.0 as usize].dependents.clone() {
            let since_millis = self.now_millis;
            let ready = job.update_record(dependent, &mut self.indices, |record| {
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
        if self.find_lease(attempt).is_none() {
            actions.push(Action::Refused { attempt });
            return;
        }
        self.end_attempt(attempt, FailureClass::Reported(failure), actions);
        actions.push(Action::Accepted { attempt });
    }

    /// Ends an attempt without a result.
    pub(crate) fn end_attempt(
        &mut self,
        attempt: AttemptId,
        class_of_failure: FailureClass,
        actions: &mut Vec<Action>,
    ) {
        let AttemptId { job: id, task, fence } = attempt;
        let (Some(lease), Some(job)) = (self.find_lease(attempt), self.jobs.get(&id)) else { return };
        let worker = self.workers.get(&lease.worker);
        let site = AttemptSite {
            worker: lease.worker,
            has_heartbeat: lease.has_heartbeat,
            memory: worker.map(Worker::memory).filter(|memory| *memory < u64::MAX),
            max_memory: self.pools.get(&job.backend).and_then(Pool::max_memory),
        };
        let (now, settings) = (self.now_millis, self.settings);
        self.tally.record_end(&class_of_failure);
        // Concurrent attempts have the same learning rate and identical results, so all of them diverge. The others end
        // here too. Counted separately, they would quarantine the task before it was retried with a lower rate.
        let ends_all_attempts =
            matches!(&class_of_failure, FailureClass::Reported(Failure { kind: FailureKind::Numeric, .. }));
        self.transition(id, task, actions, |record| {
            let next = retry::decide(record, class_of_failure, site, &settings);
            let others =
                record.state.leases().iter().filter(|lease| lease.fence != fence && !ends_all_attempts).cloned();
            let leases: Vec<Lease> = others.collect();
            record.state = match next {
                NextStep::Failed(message) => TaskState::Failed { fence, message },
                NextStep::Quarantined(message) => TaskState::Quarantined { fence, message },
                // The other running attempt serves as the retry.
                NextStep::Retry { .. } if !leases.is_empty() => TaskState::Leased { leases },
                NextStep::Retry { delay_millis: 0 } => TaskState::Ready { since_millis: now },
                NextStep::Retry { delay_millis } => {
                    TaskState::Delayed { until_millis: now.saturating_add(delay_millis) }
                }
            };
        });
        actions.retain(|action| !matches!(action, Action::Stop { attempt: stopped, .. } if *stopped == attempt));
    }

    /// Changes the record of a task and announces the change. Attempts that lose their lease are stopped, and their
    /// estimated fair-share charge is replaced by the actual time.
    pub(crate) fn transition(
        &mut self,
        id: JobId,
        task: TaskIndex,
        actions: &mut Vec<Action>,
        change: impl FnOnce(&mut TaskRecord),
    ) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let before = job.record(task).state.leases().to_vec();
        job.update_record(task, &mut self.indices, change);
        for lease in before {
            if job.record(task).lease(lease.fence).is_none() {
                if lease.is_timed {
                    let took = self.now_millis.saturating_sub(lease.began_millis);
                    let fair = (took << 10) / u64::from(job.weight);
                    job.served = job.served.saturating_sub(lease.charged).saturating_add(fair);
                }
                let attempt = AttemptId { job: id, task, fence: lease.fence };
                actions.push(Action::Stop { worker: lease.worker, attempt });
            }
        }
        self.mark_changed(id);
        actions.push(Action::Changed { job: id, task });
    }

    pub(crate) fn record_speed(&mut self, attempt: AttemptId, lease: &Lease) {
        let took = self.now_millis.saturating_sub(lease.began_millis);
        let work = self.record(attempt.job, attempt.task).map_or(1, TaskRecord::work);
        let Some(worker) = self.workers.get_mut(&lease.worker) else { return };
        worker.seen_millis = self.now_millis;
        if let Some(pool) = self.pools.get_mut(&worker.offer.backend).filter(|_| lease.is_timed) {
            pool.record_speed(lease.worker, worker, work, took);
        }
    }

    /// The lease of an attempt, if it holds one.
    pub(crate) fn find_lease(&self, attempt: AttemptId) -> Option<&Lease> {
        self.record(attempt.job, attempt.task)?.lease(attempt.fence)
    }
}
