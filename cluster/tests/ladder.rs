//! The scheduler's ladder step by step, and random histories in which messages are lost, doubled and late. The
//! invariants are checked after every step of both.

use cluster::{
    Action, AttemptId, Event, Failure, FailureKind, Fence, JobId, JobSpec, Offer, Outcome, Scheduler, Settings,
    TaskIndex, TaskNode, TaskRecord, TaskState, WorkerId, check, check_step,
};
use proptest::prelude::*;
use scene::ArtefactId;

const JOB: JobId = JobId(1);

fn settings() -> Settings {
    let limits = Settings { failures_limit: 3, losses_limit: 4, culprits_limit: 100, ..Settings::default() };
    Settings { lease_millis: 1000, backoff_millis: 0, patience_millis: 0, ..limits }
}

/// A scheduler of one job whose every step is checked.
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

    /// Grants the worker a task.
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
    Event::Completed { attempt: attempt(task, number), artefact: result_of(task, number), followers: Vec::new() }
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
    // A sign of life extends the lease.
    assert!(accepted(&job.step(900, progressed(0, 1))));
    assert_eq!(job.lease(1899, 2), None);
    assert_eq!(job.lease(1900, 2), Some((0, 2)));
    // A clock that steps back stands still (C13).
    job.step(0, Event::Ticked);
    assert!(!accepted(&job.step(1901, progressed(0, 1))));
    assert!(!job.complete(1901, 0, 1), "a stale attempt");
    assert!(!job.complete(1901, 0, 3), "an attempt never granted");
    assert!(!job.complete(1901, 7, 1), "a task that is not there");
    assert!(!job.fail(1901, 0, 1, FailureKind::Input), "a stale attempt");
    assert!(job.complete(1902, 0, 2));
    assert!(job.complete(1903, 0, 2), "the same news twice is the same news");
    let other = Event::Completed { attempt: attempt(0, 2), artefact: result_of(9, 9), followers: Vec::new() };
    assert!(!accepted(&job.step(1904, other)), "a second result");
    assert_eq!(job.state(0), TaskState::Done { fence: Fence { epoch: 1, number: 2 }, artefact: result_of(0, 2) });
}

#[test]
fn a_poison_task_is_quarantined_and_leaves_a_hole() {
    let mut job = Checked::new(&[&[], &[0], &[]]);
    for attempt in 1..=3 {
        assert_eq!(job.lease(0, attempt), Some((0, attempt)));
        assert!(job.fail(0, 0, attempt, FailureKind::Work));
    }
    assert_eq!(
        job.state(0),
        TaskState::Quarantined { fence: Fence { epoch: 1, number: 3 }, message: "it broke".into() }
    );
    assert_eq!(job.lease(0, 1), Some((2, 1)), "the rest goes on");
    let last = job.step(1, completed(2, 1));
    assert!(last.contains(&Action::JobFinished { job: JOB, outcome: Outcome::Incomplete }));
    assert_eq!(job.state(1), TaskState::Waiting { missing: 1 });
}

#[test]
fn wrong_input_fails_at_once_a_task_given_back_costs_nothing_and_lost_workers_count() {
    let mut job = Checked::new(&[&[], &[]]);
    assert_eq!(job.lease(0, 1), Some((0, 1)));
    assert!(job.fail(0, 0, 1, FailureKind::Input));
    assert!(matches!(job.state(0), TaskState::Failed { fence: Fence { number: 1, .. }, .. }));
    for attempt in 1..=20 {
        assert_eq!(job.lease(0, 1), Some((1, attempt)));
        assert!(job.fail(0, 1, attempt, FailureKind::GivenBack));
    }
    // A worker that asks while it holds a lease has lost it.
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
fn what_is_no_dag_is_refused_and_no_task_is_done_at_once() {
    let refused = |lists: &[&[u32]]| {
        let mut scheduler = Scheduler::new(settings(), 1);
        let actions = scheduler.step(0, Event::Submitted { job: JOB, spec: spec(lists) });
        check(&scheduler).unwrap();
        actions.iter().find_map(|action| match action {
            Action::Declined { why, .. } => Some(why.clone()),
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

/// One thing that may happen in a random history.
#[derive(Debug, Clone)]
enum Happening {
    Ask {
        worker: u32,
    },
    /// Deliver a message about the n-th grant so far, however old: so messages come late, twice, out of order or never.
    Say {
        grant: usize,
        what: u8,
    },
    Wait {
        millis: u64,
    },
}

fn happenings() -> impl Strategy<Value = Vec<Happening>> {
    let one = prop_oneof![
        4 => (0..4u32).prop_map(|worker| Happening::Ask { worker }),
        6 => (any::<usize>(), 0..12u8).prop_map(|(grant, what)| Happening::Say { grant, what }),
        1 => (0..1500u64).prop_map(|millis| Happening::Wait { millis }),
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
    fn any_history_keeps_the_invariants_and_honest_workers_finish_the_job(dag in dags(), history in happenings()) {
        let lists: Vec<&[u32]> = dag.iter().map(Vec::as_slice).collect();
        let mut job = Checked::new(&lists);
        let (mut now, mut grants) = (0, Vec::new());
        for happening in history {
            match happening {
                Happening::Ask { worker } => grants.extend(job.lease(now, worker)),
                Happening::Wait { millis } => {
                    now += millis;
                    job.step(now, Event::Ticked);
                }
                Happening::Say { grant, what } if !grants.is_empty() => {
                    let (task, attempt) = grants[grant % grants.len()];
                    let event = match what {
                        0..=4 => completed(task, attempt),
                        5..=8 => progressed(task, attempt),
                        9 => failed(task, attempt, FailureKind::Work),
                        10 => failed(task, attempt, FailureKind::GivenBack),
                        _ => failed(task, attempt + 1, FailureKind::Input),
                    };
                    job.step(now, event);
                }
                Happening::Say { .. } => {}
            }
        }
        // From here one honest worker does what can be done.
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
