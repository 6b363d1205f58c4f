//! Scheduling of many workers and several jobs: placement, speculation, failure classes, fair share, restarts.

use cluster::{
    Action, AttemptId, Event, FULL_RATE, Failure, FailureKind, JobId, JobSpec, Offer, Outcome, RestoreError, Scheduler,
    Settings, Snapshot, TaskIndex, TaskNode, TaskRecord, TaskState, WorkerId, check, check_step,
};
use scene::ArtefactId;

const MIB: u64 = 1 << 20;

struct Cluster {
    scheduler: Scheduler,
    now: u64,
}

impl Cluster {
    fn new() -> Self {
        Self { scheduler: Scheduler::new(Settings::default(), 1), now: 0 }
    }

    fn step(&mut self, event: Event) -> Vec<Action> {
        let before = self.scheduler.clone();
        let actions = self.scheduler.step(self.now, event.clone());
        check(&self.scheduler).unwrap_or_else(|violation| panic!("{violation} after {event:?}"));
        check_step(&before, &self.scheduler, &event, &actions)
            .unwrap_or_else(|violation| panic!("{violation} in {event:?}"));
        actions
    }

    fn submit(&mut self, job: u64, priority: u8, weight: u32, tasks: Vec<TaskNode>) {
        let spec = JobSpec { backend: "cpu".into(), priority, weight, tasks };
        self.agree(Event::Submitted { job: JobId(job), spec });
    }

    fn agree(&mut self, event: Event) {
        let actions = self.step(event);
        assert!(actions.iter().any(|action| matches!(action, Action::Agreed { .. })), "{actions:?}");
    }

    fn join(&mut self, worker: u32, memory_bytes: u64, cached: &[ArtefactId]) {
        let offer = Offer { backend: "cpu".into(), memory_bytes, cached: cached.to_vec() };
        self.step(Event::Joined { worker: WorkerId(worker), offer });
    }

    fn ask(&mut self, worker: u32) -> Option<AttemptId> {
        let actions = self.step(Event::LeaseRequested { worker: WorkerId(worker) });
        actions.iter().find_map(|action| match action {
            Action::Grant { attempt, .. } => Some(*attempt),
            _ => None,
        })
    }

    /// The index of the task that the worker is granted.
    fn task(&mut self, worker: u32) -> Option<u32> {
        self.ask(worker).map(|attempt| attempt.task.0)
    }

    fn complete(&mut self, attempt: AttemptId) -> Vec<Action> {
        self.step(Event::Completed { attempt, artefact: result_of(attempt.task.0), follow_ups: Vec::new() })
    }

    fn fail(&mut self, attempt: AttemptId, kind: FailureKind) {
        let actions = self.step(Event::Failed { attempt, failure: Failure { kind, message: "failure".into() } });
        assert!(actions.contains(&Action::Accepted { attempt }));
    }

    fn record(&self, task: u32) -> &TaskRecord {
        self.scheduler.record(JobId(1), TaskIndex(task)).unwrap()
    }

    /// Lets the scheduler measure a worker's speed with one task of a separate job.
    fn measure_speed(&mut self, worker: u32, millis: u64) {
        let job = 1000 + u64::from(worker);
        self.submit(job, 255, 1, vec![node(&[], 1000, 0)]);
        let attempt = self.ask(worker).unwrap();
        assert_eq!(attempt.job, JobId(job));
        self.now += millis;
        self.complete(attempt);
    }
}

fn node(dependencies: &[u32], work: u64, memory_bytes: u64) -> TaskNode {
    TaskNode { dependencies: dependencies.iter().copied().map(TaskIndex).collect(), work, memory_bytes }
}

fn result_of(task: u32) -> ArtefactId {
    ArtefactId::of(&task.to_le_bytes())
}

#[test]
fn the_longest_critical_path_goes_first_then_the_plans_order() {
    let mut cluster = Cluster::new();
    // Task 3 starts a path of 9. Tasks 1 and 2 are equal. Task 0 is small.
    cluster.submit(1, 0, 1, vec![node(&[], 1, 0), node(&[], 4, 0), node(&[], 4, 0), node(&[], 3, 0), node(&[3], 6, 0)]);
    cluster.join(1, 0, &[]);
    let mut order = Vec::new();
    while let Some(attempt) = cluster.ask(1) {
        order.push(attempt.task.0);
        cluster.complete(attempt);
    }
    assert_eq!(order, [3, 4, 1, 2, 0]);
}

#[test]
fn tasks_go_where_they_fit_and_where_their_inputs_are() {
    let mut cluster = Cluster::new();
    let leaf = |parent: u32, mib: u64| node(&[parent], 8, mib * MIB);
    cluster.submit(1, 0, 1, vec![node(&[], 8, MIB), node(&[], 8, MIB), leaf(0, 4), leaf(0, 2), leaf(1, 2), leaf(1, 2)]);
    cluster.join(1, 8 * MIB, &[]);
    for _ in 0..2 {
        let attempt = cluster.ask(1).unwrap();
        cluster.complete(attempt);
    }
    cluster.join(2, 2 * MIB, &[]);
    cluster.join(3, 8 * MIB, &[result_of(1)]);
    cluster.join(4, MIB, &[]);
    cluster.step(Event::Joined { worker: WorkerId(5), offer: Offer { backend: "gpu".into(), ..Offer::default() } });
    assert_eq!(cluster.task(2), Some(3), "the first one that fits");
    assert_eq!(cluster.task(3), Some(4), "the first one whose input is cached");
    assert_eq!(cluster.task(4), None, "not enough memory for any task");
    assert_eq!(cluster.task(5), None, "another backend");
    assert_eq!(cluster.task(1), Some(2));
}

#[test]
fn large_tasks_are_reserved_for_fast_workers() {
    let mut cluster = Cluster::new();
    cluster.join(1, 0, &[]);
    cluster.join(2, 0, &[]);
    cluster.measure_speed(1, 1000);
    cluster.measure_speed(2, 8000);
    cluster.submit(1, 0, 1, vec![node(&[], 64_000, 0), node(&[], 1000, 0), node(&[], 32_000, 0), node(&[], 2000, 0)]);
    assert_eq!(
        cluster.task(2),
        Some(3),
        "the largest task that takes it no longer than the largest takes the fast worker"
    );
    assert_eq!(cluster.task(1), Some(0));
}

#[test]
fn a_straggler_gets_a_speculative_attempt_and_the_first_result_wins() {
    let mut cluster = Cluster::new();
    cluster.join(1, 0, &[]);
    cluster.join(2, 0, &[]);
    cluster.measure_speed(1, 8000);
    cluster.measure_speed(2, 1000);
    cluster.submit(1, 0, 1, vec![node(&[], 20_000, 0)]);
    let slow = cluster.ask(1).unwrap();
    let fast = cluster.ask(2).unwrap();
    assert_eq!((fast.task, fast.fence.number), (slow.task, 2));
    cluster.join(3, 0, &[]);
    assert_eq!(cluster.ask(3), None, "at most two attempts");
    cluster.now += 20_000;
    assert_eq!(cluster.step(Event::Progressed { attempt: slow, done_permille: Some(125) }).len(), 1);
    let actions = cluster.complete(fast);
    assert!(actions.contains(&Action::Stop { worker: WorkerId(1), attempt: slow }), "{actions:?}");
    assert_eq!(cluster.complete(slow), [Action::Refused { attempt: slow }]);
    assert_eq!(cluster.scheduler.finished(JobId(1)), Some(Outcome::Done));
}

#[test]
fn concurrent_attempts_that_diverge_count_as_one_divergence() {
    let mut cluster = Cluster::new();
    cluster.join(1, 0, &[]);
    cluster.join(2, 0, &[]);
    cluster.measure_speed(1, 8000);
    cluster.measure_speed(2, 1000);
    cluster.submit(1, 0, 1, vec![node(&[], 20_000, 0)]);
    let (slow, fast) = (cluster.ask(1).unwrap(), cluster.ask(2).unwrap());
    assert_eq!((slow.task, fast.fence.number), (fast.task, 2), "a speculative attempt, also at the full rate");
    let failure = Failure { kind: FailureKind::Numeric, message: "the loss is not finite".into() };
    let actions = cluster.step(Event::Failed { attempt: fast, failure: failure.clone() });
    assert!(actions.contains(&Action::Stop { worker: WorkerId(1), attempt: slow }), "{actions:?}");
    assert_eq!(cluster.step(Event::Failed { attempt: slow, failure }), [Action::Refused { attempt: slow }]);
    // The retry has the lower rate. Only a second divergence quarantines the task.
    assert_eq!((cluster.record(0).divergences, cluster.record(0).rate_permille()), (1, FULL_RATE / 2));
    let last = cluster.ask(2).unwrap();
    cluster.fail(last, FailureKind::Numeric);
    assert!(matches!(cluster.record(0).state, TaskState::Quarantined { .. }), "{:?}", cluster.record(0));
}

#[test]
fn each_failure_class_has_its_retry_policy() {
    let mut cluster = Cluster::new();
    cluster.submit(1, 0, 1, vec![node(&[], 1, 2 * MIB)]);
    cluster.join(1, 4 * MIB, &[]);
    cluster.join(2, 16 * MIB, &[]);
    // Infrastructure failure: retry after a backoff.
    let attempt = cluster.ask(1).unwrap();
    cluster.fail(attempt, FailureKind::Infrastructure);
    assert_eq!(cluster.ask(1), None);
    cluster.now += 1000;
    // Out of memory: retry on a worker with more.
    let attempt = cluster.ask(1).unwrap();
    cluster.fail(attempt, FailureKind::OutOfMemory);
    assert_eq!(cluster.ask(1), None);
    assert_eq!(cluster.record(0).memory_bytes, 4 * MIB + 1);
    // Divergence: one retry at half the learning rate.
    let attempt = cluster.ask(2).unwrap();
    cluster.fail(attempt, FailureKind::Numeric);
    let actions = cluster.step(Event::LeaseRequested { worker: WorkerId(2) });
    let rates = actions.iter().find_map(|action| match action {
        Action::Grant { rate_permille, attempt, .. } => Some((*rate_permille, *attempt)),
        _ => None,
    });
    let (rate, attempt) = rates.unwrap();
    assert_eq!(rate, FULL_RATE / 2);
    // Out of memory on the largest worker: quarantined.
    cluster.fail(attempt, FailureKind::OutOfMemory);
    let TaskState::Quarantined { message, .. } = &cluster.record(0).state else { panic!("{:?}", cluster.record(0)) };
    assert!(message.contains("it needs at least 17 MiB, the largest worker has 16 MiB"), "{message}");
    // A user's retry resets the counters and the job continues.
    cluster.agree(Event::RetryRequested { job: JobId(1), task: TaskIndex(0) });
    assert_eq!((cluster.record(0).memory_bytes, cluster.scheduler.finished(JobId(1))), (2 * MIB, None));
}

#[test]
fn a_task_that_fails_on_three_workers_is_quarantined_and_is_retried_elsewhere_first() {
    let mut cluster = Cluster::new();
    cluster.scheduler = Scheduler::new(Settings { failures_limit: 9, ..Settings::default() }, 1);
    cluster.submit(1, 0, 1, vec![node(&[], 1, 0)]);
    (1..=3).for_each(|worker| cluster.join(worker, 0, &[]));
    let attempt = cluster.ask(1).unwrap();
    cluster.fail(attempt, FailureKind::Work);
    assert_eq!(cluster.ask(1), None, "excluded on this worker");
    let attempt = cluster.ask(2).unwrap();
    cluster.fail(attempt, FailureKind::Work);
    cluster.now += Settings::default().exclusion_millis;
    let attempt = cluster.ask(1).expect("the exclusion is over");
    cluster.fail(attempt, FailureKind::Work);
    let attempt = cluster.ask(3).unwrap();
    cluster.fail(attempt, FailureKind::Work);
    assert!(matches!(cluster.record(0).state, TaskState::Quarantined { .. }), "{:?}", cluster.record(0));
}

#[test]
fn an_unschedulable_task_is_quarantined_after_a_while() {
    let mut cluster = Cluster::new();
    cluster.submit(1, 0, 1, vec![node(&[], 1, 8 * MIB)]);
    let strand = Settings::default().unschedulable_millis;
    cluster.now += strand;
    cluster.step(Event::Ticked);
    assert!(matches!(cluster.record(0).state, TaskState::Ready { .. }), "there is no worker yet");
    cluster.join(1, 4 * MIB, &[]);
    assert_eq!(cluster.ask(1), None);
    let silence = Settings::default().worker_timeout_millis;
    for _ in 0..=strand / silence {
        cluster.now += silence - 1;
        assert_eq!(cluster.ask(1), None);
    }
    assert!(matches!(&cluster.record(0).state, TaskState::Quarantined { message, .. } if message.contains("8 MiB")));
}

#[test]
fn jobs_share_by_weight_within_their_class() {
    let mut cluster = Cluster::new();
    let tasks = || (0..40).map(|_| node(&[], 1000, 0)).collect();
    cluster.submit(1, 1, 1, tasks());
    cluster.submit(2, 1, 3, tasks());
    cluster.submit(3, 0, 9, tasks());
    cluster.join(1, 0, &[]);
    let mut served = [0; 4];
    for _ in 0..40 {
        let attempt = cluster.ask(1).unwrap();
        served[attempt.job.0 as usize] += 1;
        cluster.now += 1000;
        cluster.complete(attempt);
    }
    assert_eq!(served, [0, 10, 30, 0]);
    // A later job has no claim to past service. A paused job gets no grants.
    cluster.submit(4, 1, 1, tasks());
    cluster.agree(Event::PauseRequested { job: JobId(2) });
    let mut next = || {
        let attempt = cluster.ask(1).unwrap();
        cluster.now += 1000;
        cluster.complete(attempt);
        attempt.job.0
    };
    let mut turn: Vec<u64> = (0..6).map(|_| next()).collect();
    turn.sort_unstable();
    assert_eq!(turn, [1, 1, 1, 4, 4, 4]);
    cluster.agree(Event::ReprioritiseRequested { job: JobId(3), priority: 2, weight: 1 });
    assert_eq!(cluster.ask(1).unwrap().job, JobId(3));
    cluster.agree(Event::CancelRequested { job: JobId(3) });
    cluster.agree(Event::ForgetRequested { job: JobId(3) });
    let running = cluster.step(Event::ForgetRequested { job: JobId(1) });
    assert!(matches!(&running[..], [Action::Declined { .. }]), "{running:?}");
}

#[test]
fn results_add_follow_up_tasks() {
    let mut cluster = Cluster::new();
    cluster.submit(1, 0, 1, vec![node(&[], 1, 0), node(&[0], 1, 0)]);
    cluster.join(1, 0, &[]);
    let attempt = cluster.ask(1).unwrap();
    let sibling = cluster::SIBLING_BASE;
    let follow_ups = vec![node(&[0, sibling + 1], 1, 0), node(&[1], 1, 0)];
    let event = Event::Completed { attempt, artefact: result_of(0), follow_ups };
    cluster.step(event.clone());
    assert_eq!(cluster.step(event), [Action::Accepted { attempt }], "a repeated report is accepted");
    assert_eq!(cluster.scheduler.len(JobId(1)), 4);
    let mut order = Vec::new();
    while let Some(attempt) = cluster.ask(1) {
        order.push(attempt.task.0);
        cluster.complete(attempt);
    }
    assert_eq!(order, [1, 3, 2]);
    // Invalid follow-up tasks fail the task that reported them.
    cluster.submit(2, 0, 1, vec![node(&[], 1, 0)]);
    let attempt = cluster.ask(1).unwrap();
    let follow_ups = vec![node(&[sibling], 1, 0)];
    cluster.step(Event::Completed { attempt, artefact: result_of(0), follow_ups });
    let record = cluster.scheduler.record(JobId(2), TaskIndex(0)).unwrap();
    assert!(matches!(&record.state, TaskState::Failed { message, .. } if message.contains("depends on itself")));
}

#[test]
fn a_leaving_worker_returns_its_task_and_a_hung_worker_is_detected() {
    let mut cluster = Cluster::new();
    cluster.submit(1, 0, 1, vec![node(&[], 1, 0)]);
    cluster.join(1, 0, &[]);
    cluster.ask(1).unwrap();
    cluster.step(Event::Left { worker: WorkerId(1) });
    assert_eq!(cluster.step(Event::LeaseRequested { worker: WorkerId(1) }), [Action::Unknown { worker: WorkerId(1) }]);
    assert_eq!((cluster.record(0).losses, cluster.record(0).failures), (0, 0));
    cluster.join(2, 0, &[]);
    let hung = cluster.ask(2).unwrap();
    let mut actions = Vec::new();
    for _ in 0..=Settings::default().stall_millis / 20_000 {
        cluster.now += 20_000;
        actions = cluster.step(Event::Progressed { attempt: hung, done_permille: Some(0) });
    }
    assert!(actions.contains(&Action::Refused { attempt: hung }), "{actions:?}");
}

#[test]
fn a_restored_scheduler_keeps_durable_attempts_and_refuses_others() {
    let mut cluster = Cluster::new();
    cluster.submit(1, 3, 2, vec![node(&[], 1, 0), node(&[], 1, 0), node(&[0], 1, 0)]);
    cluster.join(1, 0, &[]);
    cluster.join(2, 0, &[]);
    let known = cluster.ask(1).unwrap();
    let snapshot = cluster.scheduler.snapshot();
    let forgotten = cluster.ask(2).unwrap();
    let text = serde_json::to_string(&snapshot).unwrap();
    let snapshot: Snapshot = serde_json::from_str(&text).unwrap();
    let again = Scheduler::restore(snapshot.clone(), Settings::default(), 1, 0);
    assert!(matches!(again, Err(RestoreError::Epoch { epoch: 1, seen: 1 })));
    // The restored scheduler runs on another clock.
    cluster.scheduler = Scheduler::restore(snapshot.clone(), Settings::default(), 2, 7_000_000).unwrap();
    cluster.now = 7_000_000;
    check(&cluster.scheduler).unwrap();
    cluster.join(3, 0, &[]);
    let granted = cluster.ask(3).unwrap();
    assert_eq!((granted.task, granted.fence.number), (forgotten.task, forgotten.fence.number));
    assert_eq!(cluster.complete(forgotten), [Action::Refused { attempt: forgotten }], "the same number, another epoch");
    cluster.now += Settings::default().lease_millis - 1;
    assert!(cluster.complete(known).contains(&Action::Accepted { attempt: known }));
    // An inconsistent snapshot is refused.
    let broken = |change: &dyn Fn(&mut Vec<TaskRecord>)| {
        let mut snapshot = snapshot.clone();
        change(&mut snapshot.jobs[0].tasks);
        Scheduler::restore(snapshot, Settings::default(), 2, 0).map(|_| ()).unwrap_err().to_string()
    };
    let error = broken(&|tasks| tasks[2].state = tasks[0].state.clone());
    assert!(error.contains("dependencies are not done"), "{error}");
    let error = broken(&|tasks| tasks[1].state = tasks[0].state.clone());
    assert!(error.contains("cannot exist"), "{error}");
    let error = broken(&|tasks| tasks[1].node.dependencies = vec![TaskIndex(9)]);
    assert!(error.contains("there are only 3 tasks"), "{error}");
    let error = broken(&|tasks| tasks[0].node.dependencies = vec![TaskIndex(2)]);
    assert!(error.contains("depends on itself"), "{error}");
}
