//! Tests of the durable state: round trip, fencing, damaged rows.

use std::sync::Arc;

use cluster::{Action, Event, JobSpec, Offer, Scheduler, TaskIndex, TaskNode, TaskState, WorkerId};

use super::*;
use crate::log::Log;

async fn open(store: &Store) -> (State, Restored) {
    State::take_over(store, 0).await.unwrap()
}

/// Every second job is traced.
fn origin(job: JobId) -> Origin {
    let parent = TraceParent::parse(&format!("00-{:032x}-{:016x}-01", job.0, job.0));
    Origin { plan: ArtefactId([7; 32]), traced: parent.filter(|_| job.0.is_multiple_of(2)) }
}

/// Steps a scheduler and writes the changes as a coordinator does.
async fn step(scheduler: &mut Scheduler, state: &State, event: Event) -> Vec<Action> {
    let actions = scheduler.step(1, event.clone());
    let changes = Changes::of(scheduler, &event, &actions);
    let origins = changes.headers.keys().map(|job| (*job, origin(*job))).collect();
    let next_job = changes.headers.keys().map(|job| job.0 + 1).max();
    let batch = Batch { changes, origins, next_job, ..Batch::default() };
    if !batch.is_empty() {
        state.write(batch).await.unwrap();
    }
    actions
}

fn spec(tasks: u32) -> JobSpec {
    let node = |task: u32| TaskNode {
        dependencies: if task > 0 { vec![TaskIndex(0)] } else { vec![] },
        ..TaskNode::default()
    };
    JobSpec { backend: "b".into(), priority: 1, weight: 2, tasks: (0..tasks).map(node).collect() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_schedulers_changes_restore_its_snapshot() {
    let store = Store::open("memory://").unwrap();
    let (state, restored) = open(&store).await;
    assert_eq!((state.epoch(), restored.snapshot, restored.next_job), (1, Snapshot::default(), 1));
    let mut scheduler = Scheduler::new(cluster::Settings::default(), 1);
    for job in [1, 2, 300] {
        step(&mut scheduler, &state, Event::Submitted { job: JobId(job), spec: spec(20) }).await;
    }
    let worker = WorkerId(0);
    let offer = Offer { backend: "b".into(), ..Offer::default() };
    step(&mut scheduler, &state, Event::Joined { worker, offer }).await;
    let names = BTreeMap::from([(0, "w1".to_owned())]);
    state.write(Batch { workers: names, ..Batch::default() }).await.unwrap();
    for result in 0..5 {
        let granted = step(&mut scheduler, &state, Event::LeaseRequested { worker }).await;
        let attempt = granted.iter().find_map(|action| match action {
            Action::Grant { attempt, .. } => Some(*attempt),
            _ => None,
        });
        let done =
            Event::Completed { attempt: attempt.unwrap(), artefact: ArtefactId([result; 32]), follow_ups: vec![] };
        step(&mut scheduler, &state, done).await;
    }
    step(&mut scheduler, &state, Event::CancelRequested { job: JobId(2) }).await;
    step(&mut scheduler, &state, Event::ForgetRequested { job: JobId(2) }).await;
    step(&mut scheduler, &state, Event::PauseRequested { job: JobId(300) }).await;

    // Dropped without closing, as by a crash.
    drop(state);
    let (state, restored) = open(&store).await;
    assert_eq!((state.epoch(), restored.next_job), (2, 301));
    assert_eq!(restored.workers, ["w1"]);
    assert_eq!(restored.origins, [1, 300].map(|job| (JobId(job), origin(JobId(job)))).into());
    assert!(restored.origins[&JobId(300)].traced.is_some());
    // A job's served share may be stale, and the dependencies a task waits for are derived.
    let durable = |snapshot: &Snapshot| {
        let mut snapshot = snapshot.clone();
        for job in &mut snapshot.jobs {
            job.header.served = 0;
            let waiting = job.tasks.iter_mut().filter(|task| !task.state.is_final() && task.state.leases().is_empty());
            waiting.for_each(|task| task.state = TaskState::Waiting { missing: 0 });
        }
        (snapshot.epoch, snapshot.jobs)
    };
    assert_eq!(durable(&restored.snapshot), durable(&scheduler.snapshot()));
}

#[tokio::test(flavor = "multi_thread")]
async fn older_writers_are_fenced_and_epochs_are_used_once() {
    let store = Store::open("memory://").unwrap();
    let mut open_ones = Vec::new();
    for epoch in 1..=3 {
        let (state, _) = open(&store).await;
        assert_eq!(state.epoch(), epoch);
        open_ones.push(state);
    }
    let name = |name: &str| Batch { workers: BTreeMap::from([(0, name.to_owned())]), ..Batch::default() };
    assert_eq!(open_ones[0].write(name("first")).await, Err(StateError::Fenced));
    open_ones[2].write(name("third")).await.unwrap();
    assert_eq!(open_ones[1].write(name("second")).await, Err(StateError::Fenced));
    let (state, restored) = State::take_over(&store, 17).await.unwrap();
    assert_eq!((state.epoch(), restored.workers), (18, vec!["third".to_owned()]));
}

/// Takes several rounds: an opener that loses late has already fenced the one before it, so that none can write.
#[tokio::test(flavor = "multi_thread")]
async fn one_of_many_concurrent_openers_can_write() {
    let store = Store::open("memory://").unwrap();
    let mut seen = 0;
    for _ in 0..20 {
        let opening = (0..6).map(|_| {
            let store = store.clone();
            tokio::spawn(async move { State::take_over(&store, seen).await })
        });
        let opening: Vec<_> = opening.collect();
        let mut opened = Vec::new();
        for one in opening {
            match one.await.unwrap() {
                Ok((state, _)) => opened.push(Arc::new(state)),
                Err(error) => assert_eq!(error, StateError::Fenced),
            }
        }
        let epochs: std::collections::BTreeSet<u64> = opened.iter().map(|state| state.epoch()).collect();
        assert_eq!(epochs.len(), opened.len(), "epochs are unique");
        assert!(epochs.iter().all(|epoch| *epoch > seen));
        let mut wrote = 0;
        for state in &opened {
            let batch = Batch { next_job: Some(state.epoch()), ..Batch::default() };
            match state.write(batch).await {
                Ok(()) => wrote += 1,
                Err(error) => assert_eq!(error, StateError::Fenced),
            }
        }
        assert!(wrote <= 1);
        if wrote == 1 {
            return;
        }
        seen = epochs.last().copied().unwrap_or(seen);
    }
    panic!("no opener could write in twenty rounds");
}

#[tokio::test(flavor = "multi_thread")]
async fn job_rows_without_a_span_are_read() {
    let store = Store::open("memory://").unwrap();
    let (state, _) = open(&store).await;
    let mut scheduler = Scheduler::new(cluster::Settings::default(), 1);
    step(&mut scheduler, &state, Event::Submitted { job: JobId(2), spec: spec(3) }).await;
    let (header, plan) = (scheduler.header(JobId(2)).unwrap(), ArtefactId([9; 32]));
    let mut rows = WriteBatch::new();
    rows.put(job_key(JobId(2)), frame::encode(UNTRACED_JOB, &UntracedJobRow { header, plan }, &[]));
    state.put(rows).await.unwrap();
    drop(state);
    let (_, restored) = open(&store).await;
    assert_eq!(restored.origins, BTreeMap::from([(JobId(2), Origin { plan, traced: None })]));
    assert_eq!(restored.snapshot.jobs[0].header, scheduler.header(JobId(2)).unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn lines_of_logs_are_kept_until_they_are_dropped_or_their_job_is() {
    let store = Store::open("memory://").unwrap();
    let (state, _) = open(&store).await;
    let mut scheduler = Scheduler::new(cluster::Settings::default(), 1);
    let mut log = Log::restore(Vec::new(), 1000);
    for job in [1, 2] {
        step(&mut scheduler, &state, Event::Submitted { job: JobId(job), spec: spec(3) }).await;
        log.job(5, JobId(job), format!("submitted {job}"));
        log.job(6, JobId(job), "second line");
    }
    let added = log.take_changes();
    let [first, .., last] = &added.added[..] else { panic!("{added:?}") };
    let (first, last) = ((first.job, first.number), last.clone());
    state.write(Batch { log: added, ..Batch::default() }).await.unwrap();
    let dropped = LogChanges { added: Vec::new(), dropped: vec![first] };
    state.write(Batch { log: dropped, ..Batch::default() }).await.unwrap();
    drop(state);
    let (state, restored) = open(&store).await;
    assert_eq!(restored.lines.len(), 3);
    assert!(restored.lines.contains(&last) && restored.lines.iter().all(|line| (line.job, line.number) != first));

    // A line that is written with the end of its job leaves nothing behind.
    step(&mut scheduler, &state, Event::CancelRequested { job: JobId(2) }).await;
    let forget = Event::ForgetRequested { job: JobId(2) };
    let actions = scheduler.step(1, forget.clone());
    log.job(7, JobId(2), "requested: forget");
    let changes = Changes::of(&scheduler, &forget, &actions);
    state.write(Batch { changes, log: log.take_changes(), ..Batch::default() }).await.unwrap();
    drop(state);
    let (_, restored) = open(&store).await;
    let [line] = &restored.lines[..] else { panic!("{:?}", restored.lines) };
    assert_eq!(line.job, JobId(1));
    // Numbers go on.
    let mut log = Log::restore(restored.lines, 2000);
    log.job(0, JobId(1), "third line");
    assert!(log.take_changes().added[0].number > 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn damaged_rows_are_named() {
    let store = Store::open("memory://").unwrap();
    for (key, value, words) in [
        ("worker/00000001", frame::encode(NAME, &"w", &[]), "does not follow the worker"),
        ("worker/00000000", b"nonsense".to_vec(), "not a plat 'name' frame"),
        ("next_job", frame::encode(NAME, &"w", &[]), "'next_job'"),
        ("log/0000000000000001/0000000000000001", frame::encode(NAME, &"w", &[]), "'log/0000000000000001/"),
        ("job/0000000000000001", frame::encode(JOB, &"w", &[]), "'job/0000000000000001'"),
    ] {
        let (state, _) = open(&store).await;
        let mut rows = WriteBatch::new();
        rows.put(key, value);
        state.put(rows).await.unwrap();
        let line = State::take_over(&store, 0).await.err().unwrap().to_string();
        assert!(line.contains(words) && line.contains("memory://"), "{line}");
        // Repaired by hand: the refused opener took no epoch and fenced the one before.
        let db = Db::builder(FOLDER, store.objects()).build().await.unwrap();
        db.delete(key).await.unwrap();
        db.close().await.unwrap();
    }
}
