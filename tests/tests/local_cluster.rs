//! Tests coordinator and workers in one process, over real gRPC on the loopback, with an executor that trains nothing.

mod common;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use blocks::Plan;
use coordinator::{LocalError, Options, ServeError, run_local, serve};
use proto::lease_reply::Reply;
use proto::watch_event::Event as Update;
use proto::{Access, Client};
use scene::{ArtefactId, BlockId};
use store::Store;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use worker::{ExecuteError, FailureKind, Flow, Report, TaskOrder};

use common::{BACKEND, FakeExecutor, fake, lease, plan_of, result_of, task, worker_options};

/// Seven blocks: the root, its four children, and two grandchildren with their neighbours as context.
fn plan() -> Plan {
    plan_of(
        2,
        vec![
            task("0/0/0", &[]),
            task("1/0/0", &[]),
            task("1/1/1", &[]),
            task("1/1/0", &[]),
            task("1/0/1", &[]),
            task("2/0/0", &["1/1/0", "1/0/1"]),
            task("2/3/3", &["1/1/0"]),
        ],
    )
}

async fn stored_plan() -> (Store, ArtefactId) {
    let store = Store::open("memory://").unwrap();
    let plan = store.put(plan().to_frame().into()).await.unwrap();
    (store, plan)
}

fn failure(message: &str, kind: FailureKind) -> ExecuteError {
    ExecuteError { message: message.into(), kind }
}

/// Runs the plan on workers of this executor, with short waits and long leases.
async fn run(
    workers: usize,
    fake: &Arc<FakeExecutor>,
    stop: CancellationToken,
) -> (Result<Vec<ArtefactId>, LocalError>, Vec<Update>) {
    let (store, plan) = stored_plan().await;
    let options = Options { wait_millis: 5, ..Options::new(store) };
    let mut updates = Vec::new();
    let start = |coordinator_url, number, shutdown| {
        let worker_id = format!("local-{number}");
        worker::run(worker_options(coordinator_url, &worker_id), fake.clone(), shutdown)
    };
    let result = run_local(options, plan, workers, start, |event| updates.push(event.clone()), stop).await;
    (result, updates)
}

#[tokio::test(flavor = "multi_thread")]
async fn two_workers_execute_the_tree_in_dependency_order() {
    let fake = fake(|order, report| {
        for step in 1..=3 {
            let psnr = (step == 3).then_some(20.0 + f64::from(order.task));
            let flow = report(Report { step, steps: 3, loss: f64::NAN, psnr, ..Report::default() });
            assert_eq!(flow, Flow::Continue);
        }
        Ok(result_of(order))
    });
    let (result, updates) = run(2, &fake, CancellationToken::new()).await;
    let results = result.unwrap();
    let (_, plan_id) = stored_plan().await;
    let plan = plan();
    let mut expected: Vec<ArtefactId> = Vec::new();
    for (index, task) in (0..).zip(&plan.tasks) {
        let place = |block: &BlockId| plan.tasks.iter().position(|task| task.block == *block).unwrap() as u32;
        let needed = task.parent.iter().chain(&task.context).map(place);
        let inputs: BTreeMap<u32, ArtefactId> = needed.map(|place| (place, expected[place as usize])).collect();
        expected.push(result_of(&TaskOrder {
            job: 1,
            plan: plan_id,
            task: index,
            attempt: 1,
            inputs,
            rate_permille: worker::FULL_RATE,
        }));
    }
    assert_eq!(results, expected);
    let mut tasks: Vec<u32> = fake.orders.lock().unwrap().iter().map(|order| order.task).collect();
    assert_eq!(tasks[0], 0);
    tasks.sort_unstable();
    assert_eq!(tasks, [0, 1, 2, 3, 4, 5, 6], "each task is carried out once");
    // Every report arrives, in order, before its task is done. A loss that is not finite is left out.
    for task in 0..7 {
        let line = |event: &Update| match event {
            Update::Reported(reported) if reported.task == task => Some(reported.report.unwrap()),
            _ => None,
        };
        let lines: Vec<proto::Report> = updates.iter().filter_map(line).collect();
        assert_eq!(lines.iter().map(|line| line.step).collect::<Vec<_>>(), [1, 2, 3]);
        assert!(lines.iter().all(|line| line.loss.is_none()));
        assert_eq!(lines[2].psnr, Some(20.0 + f64::from(task)));
    }
    assert!(matches!(updates.last(), Some(Update::Finished(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_panicking_task_is_retried_then_quarantined_and_the_others_go_on() {
    let fake = fake(|order, _| match (order.task, order.attempt) {
        (4, attempt) => panic!("block 4 broke, attempt {attempt}"),
        (3, 1) => Err(failure("out of luck", FailureKind::Work)),
        _ => Ok(result_of(order)),
    });
    let (result, _) = run(2, &fake, CancellationToken::new()).await;
    let line = "task 4 failed in attempt 3: panicked: block 4 broke, attempt 3; 1 dependent tasks were not started";
    assert_eq!(result, Err(LocalError::Failed(line.into())));
    let count = |task| fake.orders.lock().unwrap().iter().filter(|order| order.task == task).count();
    assert_eq!([0, 1, 2, 3, 4, 5, 6].map(count), [1, 1, 1, 2, 3, 0, 1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_diverged_task_is_retried_once_at_half_the_rate() {
    let fake = fake(|order, _| match (order.task, order.rate_permille) {
        (3, 1000) | (4, _) => Err(failure("no numbers", FailureKind::Numeric)),
        _ => Ok(result_of(order)),
    });
    let (result, _) = run(1, &fake, CancellationToken::new()).await;
    let line = "task 4 failed in attempt 2: no numbers; 1 dependent tasks were not started";
    assert_eq!(result, Err(LocalError::Failed(line.into())));
    let rates = |task| -> Vec<u32> {
        let orders = fake.orders.lock().unwrap();
        orders.iter().filter(|order| order.task == task).map(|order| order.rate_permille).collect()
    };
    assert_eq!([0, 3, 4].map(rates), [vec![1000], vec![1000, 500], vec![1000, 500]]);
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_input_fails_the_job_at_once() {
    let fake = fake(|_, _| Err(failure("photo 7 is no photo", FailureKind::Input)));
    let (result, _) = run(1, &fake, CancellationToken::new()).await;
    let line = "task 0 failed in attempt 1: photo 7 is no photo; 6 dependent tasks were not started";
    assert_eq!(result, Err(LocalError::Input(line.into())));
    assert_eq!(fake.orders.lock().unwrap().len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancelled_job_stops_its_running_task() {
    let stop = CancellationToken::new();
    let cancel = stop.clone();
    let fake = fake(move |_, report| {
        cancel.cancel();
        while report(Report::default()) == Flow::Continue {
            std::thread::sleep(Duration::from_millis(1));
        }
        Err(failure("stopped", FailureKind::Work))
    });
    let (result, _) = run(1, &fake, stop).await;
    assert_eq!(result, Err(LocalError::Cancelled));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_whose_workers_all_fail_to_start_ends() {
    let (store, plan) = stored_plan().await;
    let start = |_, _, _| async { Err::<(), _>("no such device") };
    let result = run_local(Options::new(store), plan, 2, start, |_| {}, CancellationToken::new()).await;
    assert_eq!(result, Err(LocalError::Failed("no worker is left: no such device".into())));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_artefact_that_is_no_plan_is_refused() {
    let store = Store::open("memory://").unwrap();
    let note = store.put(b"not a plan".to_vec().into()).await.unwrap();
    for (plan, why) in [(note, "not a plat 'plan' frame"), (ArtefactId([9; 32]), "is not in the store")] {
        let start = |_, _, _| async { Ok::<(), String>(()) };
        let result = run_local(Options::new(store.clone()), plan, 1, start, |_| {}, CancellationToken::new()).await;
        assert!(matches!(&result, Err(LocalError::Input(line)) if line.contains(why)), "{result:?}");
    }
}

/// A coordinator with one job, and a client. They end when the returned token is cancelled.
async fn host(lease_millis: u64) -> (Client, String, u64, CancellationToken) {
    let (store, plan) = stored_plan().await;
    let mut options = Options { wait_millis: 5, ..Options::new(store.clone()) };
    options.settings.lease_millis = lease_millis;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let stop = CancellationToken::new();
    tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));
    let mut client = proto::connect(&url, &Access::default()).unwrap();
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url: store.url().into() };
    let job = client.submit(request).await.unwrap().into_inner();
    assert_eq!(job.tasks, 7);
    (client, url, job.job, stop)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stale_attempt_is_refused() {
    let (mut client, _, job, stop) = host(50).await;
    let zombie = lease(&mut client, "zombie").await;
    // The zombie sends no heartbeat, its lease expires, and the root is granted again. (On a slow machine leases may expire more than
    // once, so the attempt's exact number is not checked.)
    let heir = lease(&mut client, "heir").await;
    assert_eq!((zombie.task, zombie.number, heir.task), (0, 1, 0));
    assert!(heir.number > zombie.number);
    let artefact = ArtefactId::of(b"zombie's").0.to_vec();
    let complete = proto::CompleteRequest { attempt: Some(zombie), artefact, then: None };
    assert!(!client.complete(complete).await.unwrap().into_inner().accepted);
    let report = proto::ReportRequest { attempt: Some(zombie), reports: vec![proto::Report::default()] };
    assert!(client.report(report).await.unwrap().into_inner().cancelled);
    let status = client.status(proto::StatusRequest { job }).await.unwrap().into_inner();
    assert_eq!((status.done, status.waiting), (0, 6));
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaving_worker_gives_its_task_back() {
    let (mut client, url, job, stop) = host(3_600_000).await;
    // More often than the limit of failed attempts.
    for _ in 0..4 {
        let leave = CancellationToken::new();
        let go = leave.clone();
        let slow = fake(move |_, report| {
            go.cancel();
            while report(Report::default()) == Flow::Continue {
                std::thread::sleep(Duration::from_millis(1));
            }
            Err(failure("stopped", FailureKind::Work))
        });
        let coordinator_url = url.clone();
        worker::run(worker_options(coordinator_url, "leaving"), slow, leave).await.unwrap();
    }
    // The leases were for an hour, but the next worker gets the task at once.
    let next = lease(&mut client, "next").await;
    assert_eq!((next.task, next.number), (0, 5));
    let status = client.status(proto::StatusRequest { job }).await.unwrap().into_inner();
    assert_eq!((status.leased, status.quarantined, status.outcome), (1, 0, None));
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_quiet_executor_keeps_its_lease() {
    let (mut client, url, job, stop) = host(1000).await;
    let quiet = fake(|order, _| {
        if order.task == 0 {
            std::thread::sleep(Duration::from_millis(2500));
        }
        Ok(result_of(order))
    });
    let run = tokio::spawn(worker::run(worker_options(url, "quiet"), quiet.clone(), stop.clone()));
    let mut updates = client.watch(proto::WatchRequest { job }).await.unwrap().into_inner();
    while let Some(event) = updates.message().await.unwrap() {
        if let Some(Update::Finished(finished)) = event.event {
            assert_eq!(finished.outcome(), proto::Outcome::Done);
        }
    }
    assert_eq!(quiet.orders.lock().unwrap().iter().filter(|order| order.task == 0).count(), 1);
    stop.cancel();
    run.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_is_paused_resumed_and_retried_and_its_journal_replays() {
    let (store, plan) = stored_plan().await;
    let (journal, mut lines) = tokio::sync::mpsc::channel(10_000);
    let options = Options { wait_millis: 5, epoch: 7, journal: Some(journal), ..Options::new(store.clone()) };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let stop = CancellationToken::new();
    let hosted = tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));
    let mut client = proto::connect(&url, &Access::default()).unwrap();
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url: store.url().into() };
    let job = client.submit(request).await.unwrap().into_inner().job;

    use proto::control_request::What;
    let control = |what| proto::ControlRequest { job, what: Some(what) };
    client.control(control(What::Pause(proto::Pause {}))).await.unwrap();
    let idle = proto::LeaseRequest { worker: "idle".into(), backend: BACKEND.into(), ..Default::default() };
    assert_eq!(client.lease(idle.clone()).await.unwrap().into_inner().reply, Some(Reply::WaitMillis(5)));
    client.control(control(What::Resume(proto::Resume {}))).await.unwrap();
    let attempt = lease(&mut client, "idle").await;
    assert_eq!(attempt, proto::Attempt { job, task: 0, number: 1, epoch: 7 });
    let earlier = proto::Attempt { epoch: 6, ..attempt };
    let complete = proto::CompleteRequest { attempt: Some(earlier), artefact: vec![0; 32], then: None };
    assert!(!client.complete(complete).await.unwrap().into_inner().accepted, "of an earlier coordinator");
    let wrong = proto::FailRequest {
        attempt: Some(attempt),
        message: "photo 7 is no photo".into(),
        kind: proto::FailureKind::Input.into(),
    };
    assert!(client.fail(wrong).await.unwrap().into_inner().accepted);
    client.control(control(What::RetryTask(0))).await.unwrap();
    let refused = client.control(control(What::RetryTask(1))).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let urgent = proto::Reprioritise { priority: 256, weight: 1 };
    let refused = client.control(control(What::Reprioritise(urgent))).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert_eq!(lease(&mut client, "idle").await.number, 2);

    drop(client);
    stop.cancel();
    hosted.await.unwrap().unwrap();
    let mut text = Vec::new();
    while let Some(line) = lines.recv().await {
        text.push(line);
    }
    let replayed = cluster::journal::replay(text.iter().map(String::as_str), |_| {}).unwrap();
    assert!(replayed.steps >= 9, "{replayed:?}");
    assert_eq!(replayed.last.jobs[0].tasks[0].attempts, 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_are_validated() {
    let (mut client, _, job, stop) = host(3_600_000).await;
    let code = |result: Result<(), tonic::Status>| result.unwrap_err().code();

    let other = proto::LeaseRequest { worker: "other".into(), backend: "gpu".into(), ..Default::default() };
    let reply = client.lease(other).await.unwrap().into_inner().reply;
    assert_eq!(reply, Some(Reply::WaitMillis(5)), "a job pins its backend");

    let nameless = proto::LeaseRequest { worker: String::new(), backend: BACKEND.into(), ..Default::default() };
    assert_eq!(code(client.lease(nameless).await.map(|_| ())), Code::InvalidArgument);
    let elsewhere = proto::SubmitRequest { plan: vec![0; 32], store_url: "file:///elsewhere".into() };
    assert_eq!(code(client.submit(elsewhere).await.map(|_| ())), Code::FailedPrecondition);
    assert_eq!(code(client.watch(proto::WatchRequest { job: 77 }).await.map(|_| ())), Code::NotFound);
    assert_eq!(code(client.report(proto::ReportRequest::default()).await.map(|_| ())), Code::InvalidArgument);

    let attempt = Some(lease(&mut client, "honest").await);
    let short = proto::CompleteRequest { attempt, artefact: vec![0; 31], then: None };
    assert_eq!(code(client.complete(short).await.map(|_| ())), Code::InvalidArgument);
    let reports = vec![proto::Report { wall_seconds: f64::INFINITY, ..proto::Report::default() }];
    assert_eq!(code(client.report(proto::ReportRequest { attempt, reports }).await.map(|_| ())), Code::InvalidArgument);
    let huge = proto::SubmitRequest { plan: vec![0; 2 * proto::MESSAGE_BYTES_LIMIT], store_url: String::new() };
    assert!(client.submit(huge).await.is_err());

    // None of this had an effect.
    let complete = proto::CompleteRequest { attempt, artefact: vec![0; 32], then: None };
    assert!(client.complete(complete).await.unwrap().into_inner().accepted);
    client.cancel(proto::CancelRequest { job }).await.unwrap();
    let status = client.status(proto::StatusRequest { job }).await.unwrap().into_inner();
    assert_eq!((status.done, status.outcome()), (1, proto::Outcome::Cancelled));
    stop.cancel();
}

#[tokio::test]
async fn an_address_beyond_the_loopback_is_refused() {
    let (store, _) = stored_plan().await;
    let listener = TcpListener::bind("0.0.0.0:0").await.unwrap();
    let result = serve(listener, Options::new(store), std::future::pending()).await;
    assert!(matches!(result, Err(ServeError::Input(_))));
}
