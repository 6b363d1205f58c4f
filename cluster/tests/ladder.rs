//! The state transitions of tasks, and random histories with lost, duplicated and late messages. The invariants are
//! checked after every step.

use cluster::{
    Action, AttemptId, Event, Failure, FailureKind, Fence, JobId, JobSpec, Offer, Outcome, Scheduler, Settings,
    TaskIndex, TaskNode, TaskRecord, TaskState, WorkerId, check, check_step,
};
use proptest::prelude::*;
use scene::ArtefactId;

const JOB: JobId = JobId(1);

fn settings() -> Settings {
    let limits = Settings { failures_limit: 3, losses_limit: 4, failed_workers_limit: 100, ..Settings::default() };
    Settings { lease_millis: 1000, backoff_millis: 0, exclusion_millis: 0, ..limits }
}

/// A scheduler with one job that checks the invariants after every step.
struct Checked(Scheduler);

impl Checked {
    fn new(dependencies: &[&[u32]]) -> Self {
        let mut checked = Self(Scheduler::new(settings(), 1));
        let actions = checked.step(0, Event::Submitted { job: JOB, spec: spec(dependencies) });
        assert!(actions.contains(&Action::Agreed { job: JOB }), "{actions:?}");
        checked
    }

    fn step(&mut self, now: u64, event: Event) -> Vec<Action> {
        let before = self.0.clone();
        let actions = self.0.step(now, event.clone());
        check(&self.0).unwrap_or_else(|violation| panic!("{violation} after {event:?}"));
        check_step(&before, &self.0, &event, &actions).unwrap_or_else(|violation| panic!("{violation} in {event:?}"));
        actions
    }

    /// Requests a task for the worker.
    fn lease(&mut self, now: u64, worker: u32) -> Option<(u32, u32)> {
        let worker = WorkerId(worker);
        if self.0.offer(worker).is_none() {
            self.step(now, Event::Joined { worker, offer: Offer { backend: "cpu".into(), ..Offer::default() } });
        }
        let actions = self.step(now, Event::LeaseRequested { worker });
        actions.iter().find_map(|action| match action {
            Action::Grant { attempt, .. } => Some((attempt.task.0, attempt.fence.number)),
            _ => None,
        })
    }

    fn complete(&mut self, now: u64, task: u32, attempt: u32) -> bool {
        accepted(&self.step(now, completed(task, attempt)))
    }

    fn fail(&mut self, now: u64, task: u32, attempt: u32, kind: FailureKind) -> bool {
        accepted(&self.step(now, failed(task, attempt, kind)))
    }

    fn state(&self, task: u32) -> TaskState {
        self.record(task).state.clone()
    }

    fn record(&self, task: u32) -> &TaskRecord {
        self.0.record(JOB, TaskIndex(task)).unwrap()
    }
}

fn node(dependencies: &[u32]) -> TaskNode {
    TaskNode { dependencies: dependencies.iter().copied().map(TaskIndex).collect(), ..TaskNode::default() }
}

fn spec(dependencies: &[&[u32]]) -> JobSpec {
    let tasks = dependencies.iter().map(|list| node(list)).collect();
    JobSpec { backend: "cpu".into(), priority: 0, weight: 1, tasks }
}

fn accepted(actions: &[Action]) -> bool {
    actions.iter().any(|action| matches!(action, Action::Accepted { .. }))
}

fn attempt(task: u32, number: u32) -> AttemptId {
    AttemptId { job: JOB, task: TaskIndex(task), fence: Fence { epoch: 1, number } }
}

fn result_of(task: u32, attempt: u32) -> ArtefactId {
    ArtefactId::of(format!("{task}/{attempt}").as_bytes())
}

fn completed(task: u32, number: u32) -> Event {
    Event::Completed { attempt: attempt(task, number), artefact: result_of(task, number), follow_ups: Vec::new() }
}

fn failed(task: u32, number: u32, kind: FailureKind) -> Event {
    Event::Failed { attempt: attempt(task, number), failure: Failure { kind, message: "it broke".into() } }
}

fn progressed(task: u32, number: u32) -> Event {
    Event::Progressed { attempt: attempt(task, number), done_permille: None }
}

#[test]
fn tasks_are_granted_in_the_plans_order_once_their_dependencies_are_done() {
    let mut job = Checked::new(&[&[], &[0], &[0, 0], &[1, 2]]);
    assert_eq!(job.lease(0, 1), Some((0, 1)));
    assert_eq!(job.lease(0, 2), None);
    assert!(job.complete(1, 0, 1));
    assert_eq!(job.lease(1, 2), Some((1, 1)));
    assert_eq!(job.lease(1, 1), Some((2, 1)));
    assert!(job.complete(2, 2, 1));
    assert_eq!(job.lease(2, 1), None);
    assert!(job.complete(3, 1, 1));
    assert_eq!(job.lease(3, 1), Some((3, 1)));
    let inputs: Vec<_> = job.0.inputs(JOB, TaskIndex(3)).into_iter().collect();
    assert_eq!(inputs, [(TaskIndex(1), result_of(1, 1)), (TaskIndex(2), result_of(2, 1))]);
    let last = job.step(4, completed(3, 1));
    assert!(last.contains(&Action::JobFinished { job: JOB, outcome: Outcome::Done }));
    assert!(job.0.is_drained());
    assert_eq!(job.lease(5, 1), None);
}

#[test]
fn an_expired_lease_goes_to_another_and_the_zombie_is_refused() {
    let mut job = Checked::new(&[&[]]);
    assert_eq!(job.lease(0, 1), Some((0, 1)));
    // A heartbeat extends the lease.
    assert!(accepted(&job.step(900, progressed(0, 1))));
    assert_eq!(job.lease(1899, 2), None);
    assert_eq!(job.lease(1900, 2), Some((0, 2)));
    // Time does not go backwards (C17).
    job.step(0, Event::Ticked);
    assert!(!accepted(&job.step(1901, progressed(0, 1))));
    assert!(!job.complete(1901, 0, 1), "a stale attempt");
    assert!(!job.complete(1901, 0, 3), "an attempt never granted");
    assert!(!job.complete(1901, 7, 1), "a task that is not there");
    assert!(!job.fail(1901, 0, 1, FailureKind::Input), "a stale attempt");
    assert!(job.complete(1902, 0, 2));
    assert!(job.complete(1903, 0, 2), "a repeated report is accepted");
    let other = Event::Completed { attempt: attempt(0, 2), artefact: result_of(9, 9), follow_ups: Vec::new() };
    assert!(!accepted(&job.step(1904, other)), "a second result");
    assert_eq!(job.state(0), TaskState::Done { fence: Fence { epoch: 1, number: 2 }, artefact: result_of(0, 2) });
}

#[test]
fn a_poison_task_is_quarantined_and_its_dependents_wait() {
    let mut job = Checked::new(&[&[], &[0], &[]]);
    for attempt in 1..=3 {
        assert_eq!(job.lease(0, attempt), Some((0, attempt)));
        assert!(job.fail(0, 0, attempt, FailureKind::Work));
    }
    assert_eq!(
        job.state(0),
        TaskState::Quarantined { fence: Fence { epoch: 1, number: 3 }, message: "it broke".into() }
    );
    assert_eq!(job.lease(0, 1), Some((2, 1)), "other branches continue");
    let last = job.step(1, completed(2, 1));
    assert!(last.contains(&Action::JobFinished { job: JOB, outcome: Outcome::Incomplete }));
    assert_eq!(job.state(1), TaskState::Waiting { missing: 1 });
}

#[test]
fn invalid_input_fails_at_once_returned_tasks_are_free_and_lost_workers_count() {
    let mut job = Checked::new(&[&[], &[]]);
    assert_eq!(job.lease(0, 1), Some((0, 1)));
    assert!(job.fail(0, 0, 1, FailureKind::Input));
    assert!(matches!(job.state(0), TaskState::Failed { fence: Fence { number: 1, .. }, .. }));
    for attempt in 1..=20 {
        assert_eq!(job.lease(0, 1), Some((1, attempt)));
        assert!(job.fail(0, 1, attempt, FailureKind::GivenBack));
    }
    // A worker that requests a task loses the lease that it holds.
    for attempt in 21..=24 {
        assert_eq!(job.lease(0, 1), Some((1, attempt)));
    }
    assert_eq!(job.lease(0, 1), None);
    assert!(matches!(job.state(1), TaskState::Quarantined { fence: Fence { number: 24, .. }, .. }));
}

#[test]
fn a_cancelled_job_stops_its_workers() {
    let mut job = Checked::new(&[&[], &[]]);
    assert_eq!(job.lease(0, 1), Some((0, 1)));
    let actions = job.step(1, Event::CancelRequested { job: JOB });
    assert!(actions.contains(&Action::JobFinished { job: JOB, outcome: Outcome::Cancelled }));
    assert!(!accepted(&job.step(2, progressed(0, 1))));
    assert_eq!(job.lease(3, 1), None);
    assert!(job.0.is_drained());
}

#[test]
fn a_cyclic_graph_is_refused_and_an_empty_job_is_done_at_once() {
    let refused = |lists: &[&[u32]]| {
        let mut scheduler = Scheduler::new(settings(), 1);
        let actions = scheduler.step(0, Event::Submitted { job: JOB, spec: spec(lists) });
        check(&scheduler).unwrap();
        actions.iter().find_map(|action| match action {
            Action::Declined { reason, .. } => Some(reason.clone()),
            _ => None,
        })
    };
    let cycle = "depends on itself, directly or through others";
    assert_eq!(refused(&[&[0]]), Some(format!("task 0 {cycle}")));
    assert_eq!(refused(&[&[], &[0, 3], &[1], &[2]]), Some(format!("task 1 {cycle}")));
    assert_eq!(refused(&[&[], &[2]]), Some("task 1 depends on task 2, but there are only 2 tasks".into()));
    assert_eq!(
        refused(&[&[], &[u32::MAX]]),
        Some(format!("task 1 depends on task {}, but there are only 2 tasks", u32::MAX))
    );
    let mut scheduler = Scheduler::new(settings(), 1);
    let actions = scheduler.step(0, Event::Submitted { job: JOB, spec: spec(&[]) });
    assert!(actions.contains(&Action::JobFinished { job: JOB, outcome: Outcome::Done }));
}

/// One event of a random history.
#[derive(Debug, Clone)]
enum HistoryEvent {
    Request {
        worker: u32,
    },
    /// Delivers a message about the n-th grant so far, so that messages are late, duplicated, reordered or lost.
    Report {
        grant: usize,
        kind: u8,
    },
    Wait {
        millis: u64,
    },
}

fn histories() -> impl Strategy<Value = Vec<HistoryEvent>> {
    let one = prop_oneof![
        4 => (0..4u32).prop_map(|worker| HistoryEvent::Request { worker }),
        6 => (any::<usize>(), 0..12u8).prop_map(|(grant, kind)| HistoryEvent::Report { grant, kind }),
        1 => (0..1500u64).prop_map(|millis| HistoryEvent::Wait { millis }),
    ];
    prop::collection::vec(one, 0..200)
}

/// Random dependencies on earlier tasks.
fn dags() -> impl Strategy<Value = Vec<Vec<u32>>> {
    prop::collection::vec(prop::collection::vec(any::<u32>(), 0..4), 1..12).prop_map(|lists| {
        let earlier = |(task, list): (usize, Vec<u32>)| {
            if task == 0 { Vec::new() } else { list.into_iter().map(|at| at % task as u32).collect() }
        };
        lists.into_iter().enumerate().map(earlier).collect()
    })
}

proptest! {
    #[test]
    fn any_history_keeps_the_invariants_and_a_correct_worker_finishes_the_job(dag in dags(), history in histories()) {
        let lists: Vec<&[u32]> = dag.iter().map(Vec::as_slice).collect();
        let mut job = Checked::new(&lists);
        let (mut now, mut grants) = (0, Vec::new());
        for event in history {
            match event {
                HistoryEvent::Request { worker } => grants.extend(job.lease(now, worker)),
                HistoryEvent::Wait { millis } => {
                    now += millis;
                    job.step(now, Event::Ticked);
                }
                HistoryEvent::Report { grant, kind } if !grants.is_empty() => {
                    let (task, attempt) = grants[grant % grants.len()];
                    let event = match kind {
                        0..=4 => completed(task, attempt),
                        5..=8 => progressed(task, attempt),
                        9 => failed(task, attempt, FailureKind::Work),
                        10 => failed(task, attempt, FailureKind::GivenBack),
                        _ => failed(task, attempt + 1, FailureKind::Input),
                    };
                    job.step(now, event);
                }
                HistoryEvent::Report { .. } => {}
            }
        }
        // From here a correct worker completes all remaining tasks.
        now += 10_000;
        for _ in 0..dag.len() {
            if let Some((task, attempt)) = job.lease(now, 99) {
                prop_assert!(job.complete(now, task, attempt));
            }
        }
        let outcome = job.0.finished(JOB);
        let poisoned = job.0.records(JOB).any(|(_, record)| matches!(record.state, TaskState::Quarantined { .. } | TaskState::Failed { .. }));
        prop_assert_eq!(outcome, Some(if poisoned { Outcome::Incomplete } else { Outcome::Done }));
    }
}
