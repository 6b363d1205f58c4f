//! Tests coordinators that are killed, replaced and fenced, over real gRPC on the loopback and one shared store. A kill drops the future of
//! the coordinator: nothing is flushed, and no reply is sent.

mod common;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use blocks::{Plan, Task};
use cluster::Settings;
use coordinator::{Durable, Options, ServeError, serve};
use proto::leader::Leader;
use proto::lease_reply::Reply;
use proto::{Access, Client, Outcome, StatusReply};
use scene::ArtefactId;
use store::Store;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use worker::{Flow, Report, TaskOrder};

use common::{BACKEND, fake, plan_of, result_of, task, worker_options};

/// Interval at which the lease is read.
const QUICK: Duration = Duration::from_millis(10);
/// Milliseconds.
const AGE_OF_FIRST: u64 = 86_400_000;
/// Longer than any test.
const LONG: Duration = Duration::from_secs(3600);

/// A root and its four children, of which two have four children each.
fn plan() -> Plan {
    let names = ["0/0/0", "1/0/0", "1/1/0", "1/0/1", "1/1/1"].map(str::to_owned);
    let grandchildren = [(0, 0), (1, 0), (0, 1), (1, 1), (2, 2), (3, 2), (2, 3), (3, 3)];
    let names = names.into_iter().chain(grandchildren.map(|(x, y)| format!("2/{x}/{y}")));
    let mut tasks: Vec<Task> = names.map(|block| task(&block, &[])).collect();
    tasks.sort_by_key(|task| (task.block.level, blocks::sweep_of(task.block), task.block.y, task.block.x));
    plan_of(2, tasks)
}

/// A coordinator of these tests.
struct Host {
    client: Client,
    address: String,
    stop: CancellationToken,
    serving: JoinHandle<Result<(), ServeError>>,
}

impl Host {
    async fn start(store: &Store, beat: Duration, patience: Duration) -> Self {
        Self::start_with(store, beat, patience, None).await
    }

    async fn start_with(
        store: &Store,
        beat: Duration,
        patience: Duration,
        journal: Option<tokio::sync::mpsc::Sender<String>>,
    ) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let durable = Durable { beat, patience, ..Durable::new(&address).unwrap() };
        // No speculative attempts: each task is to be executed once.
        let settings = Settings { speculation: false, ..Settings::default() };
        // Of a leader that began a day later, if there was one before.
        let wall_clock: fn() -> u64 = if journal.is_some() { || AGE_OF_FIRST + 3_600_000 } else { || 0 };
        let durable = Some(durable);
        let options = Options { settings, wait_millis: 5, durable, journal, wall_clock, ..Options::new(store.clone()) };
        let stop = CancellationToken::new();
        let serving = tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));
        let client = proto::connect(&address, &Access::default()).unwrap();
        Self { client, address, stop, serving }
    }

    /// Drops the coordinator, as kill -9 would.
    async fn kill(self) {
        self.serving.abort();
        assert!(self.serving.await.unwrap_err().is_cancelled());
    }

    /// Waits until it leads.
    async fn leads(mut self) -> Self {
        loop {
            match self.client.status(proto::StatusRequest { job: u64::MAX }).await {
                Err(status) if status.code() == Code::NotFound => return self,
                _ => tokio::time::sleep(Duration::from_millis(5)).await,
            }
        }
    }

    async fn submit(&mut self, store: &Store) -> u64 {
        let plan = store.put(plan().to_frame().into()).await.unwrap();
        let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url: store.url().into() };
        self.client.submit(request).await.unwrap().into_inner().job
    }

    async fn lease(&mut self, worker: &str) -> proto::Attempt {
        common::lease(&mut self.client, worker).await
    }

    async fn complete(&mut self, attempt: proto::Attempt, result: &[u8]) -> Result<bool, tonic::Status> {
        let artefact = ArtefactId::of(result).0.to_vec();
        let reply = self.client.complete(proto::CompleteRequest { attempt: Some(attempt), artefact, then: None }).await;
        reply.map(|reply| reply.into_inner().accepted)
    }

    async fn log(&mut self, job: u64) -> Vec<proto::LogLine> {
        self.client.logs(proto::LogsRequest { job, after: 0 }).await.unwrap().into_inner().lines
    }

    async fn status(&mut self, job: u64) -> StatusReply {
        self.client.status(proto::StatusRequest { job }).await.unwrap().into_inner()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn acknowledged_changes_survive_a_kill_and_the_epoch_rises() {
    let store = Store::open("memory://").unwrap();
    let mut first = Host::start(&store, LONG, LONG).await.leads().await;
    let job = first.submit(&store).await;
    let root = first.lease("w1").await;
    assert!(first.complete(root, b"root").await.unwrap());
    let [one, two] = [first.lease("w1").await, first.lease("w2").await];
    assert_eq!((one.epoch, two.epoch), (1, 1));
    let before = first.log(job).await;
    first.kill().await;

    let (journal, mut lines) = tokio::sync::mpsc::channel(10_000);
    let mut second = Host::start_with(&store, QUICK, Duration::from_millis(50), Some(journal)).await.leads().await;
    let status = second.status(job).await;
    assert_eq!((status.done, status.leased, status.ready, status.waiting), (1, 2, 2, 8));
    // The log goes on: every line that was shown, with its number, then the change of leaders.
    let after = second.log(job).await;
    let told = |lines: &[proto::LogLine]| -> Vec<_> {
        lines.iter().map(|line| (line.number, line.kind, line.task, line.worker.clone(), line.what.clone())).collect()
    };
    assert_eq!(told(&before), told(&after[..before.len()]));
    assert!(before.iter().any(|line| line.worker == "w2" && line.what == "granted"), "{before:?}");
    let [changed] = &after[before.len()..] else { panic!("{after:?}") };
    assert!(changed.number > before.len() as u64 && changed.what.contains("another coordinator leads"), "{changed:?}");
    assert!(changed.millis_ago < 3_600_000 && after[0].millis_ago >= AGE_OF_FIRST, "{after:?}");
    // Running attempts go on under the fencing token of their grant.
    assert!(
        !second
            .client
            .report(proto::ReportRequest { attempt: Some(one), reports: vec![] })
            .await
            .unwrap()
            .into_inner()
            .cancelled
    );
    assert!(second.complete(one, b"one").await.unwrap());
    // A committed result is final. Completing it again is idempotent.
    assert!(second.complete(root, b"root").await.unwrap());
    // Worker names are durable: w2 requests a task, and its old lease is revoked.
    let next = second.lease("w2").await;
    assert_eq!(next.epoch, 2);
    assert!(!second.complete(two, b"two").await.unwrap(), "a zombie's commit is refused");
    // The numbers of attempts and jobs continue.
    let mut granted = vec![next];
    while granted.iter().all(|attempt| attempt.task != two.task) {
        granted.push(second.lease(&format!("new-{}", granted.len())).await);
    }
    assert_eq!(
        granted.iter().find(|attempt| attempt.task == two.task).map(|attempt| attempt.number),
        Some(two.number + 1)
    );
    assert_eq!(second.submit(&store).await, job + 1);
    second.stop.cancel();
    second.serving.await.unwrap().unwrap();

    let mut text = Vec::new();
    while let Some(line) = lines.recv().await {
        text.push(line);
    }
    let replayed = cluster::journal::replay(text.iter().map(String::as_str), |_| {}).unwrap();
    assert_eq!((replayed.last.epoch, replayed.last.jobs.len()), (2, 2));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_result_and_the_next_task_take_one_call() {
    let store = Store::open("memory://").unwrap();
    let mut host = Host::start(&store, LONG, LONG).await.leads().await;
    let job = host.submit(&store).await;
    let ask = proto::LeaseRequest { worker: "w1".into(), backend: BACKEND.into(), ..Default::default() };
    let complete = |attempt, then| proto::CompleteRequest { attempt: Some(attempt), artefact: vec![7; 32], then };
    let root = host.lease("w1").await;
    let reply = host.client.complete(complete(root, Some(ask.clone()))).await.unwrap().into_inner();
    assert!(reply.accepted);
    let Some(Reply::Grant(grant)) = reply.next.unwrap().reply else { panic!("the root's children are ready") };
    let child = grant.attempt.unwrap();
    assert_ne!(child.task, root.task);
    let status = host.status(job).await;
    assert_eq!((status.done, status.leased, status.ready), (1, 1, 3));
    // The reply was lost and the call is repeated: the result still counts, and the first grant is void.
    let again = host.client.complete(complete(root, Some(ask))).await.unwrap().into_inner();
    assert!(again.accepted && matches!(again.next.unwrap().reply, Some(Reply::Grant(_))));
    assert_eq!(host.status(job).await.leased, 1);
    assert!(!host.complete(child, b"child").await.unwrap());
    // A malformed lease request fails the whole call. Without one, no task is granted.
    let other = host.lease("w2").await;
    let wrong = proto::LeaseRequest { worker: "no name".into(), ..Default::default() };
    let refused = host.client.complete(complete(other, Some(wrong))).await.unwrap_err();
    assert_eq!((refused.code(), host.status(job).await.done), (Code::InvalidArgument, 1));
    assert_eq!(host.client.complete(complete(other, None)).await.unwrap().into_inner().next, None);
    // Such a grant is durable before the reply, as any grant is.
    host.kill().await;
    let mut second = Host::start(&store, QUICK, Duration::from_millis(50)).await.leads().await;
    let status = second.status(job).await;
    assert_eq!((status.done, status.leased), (2, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_stays_in_its_trace_under_a_new_leader() {
    const PARENT: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
    let store = Store::open("memory://").unwrap();
    let mut host = Host::start(&store, LONG, LONG).await.leads().await;
    let plan = store.put(plan().to_frame().into()).await.unwrap().0.to_vec();
    for header in [Some(PARENT), Some("00-nonsense"), None] {
        let request = proto::SubmitRequest { plan: plan.clone(), store_url: store.url().into() };
        let mut request = tonic::Request::new(request);
        if let Some(header) = header {
            request.metadata_mut().insert("traceparent", header.parse().unwrap());
        }
        host.client.submit(request).await.unwrap();
    }
    for epoch in 1..3 {
        let mut granted = BTreeMap::new();
        for worker in 0..3 {
            let (worker, backend) = (format!("{epoch}-{worker}"), BACKEND.into());
            let request = proto::LeaseRequest { worker, backend, ..Default::default() };
            let Some(Reply::Grant(grant)) = host.client.lease(request).await.unwrap().into_inner().reply else {
                panic!("the root of a job is left")
            };
            let attempt = grant.attempt.unwrap();
            assert_eq!(attempt.epoch, epoch);
            granted.insert(attempt.job, grant.traceparent);
            // Given back, so that the next leader can grant the root of each job as well.
            let given_back = proto::FailRequest {
                attempt: Some(attempt),
                message: String::new(),
                kind: proto::FailureKind::GivenBack.into(),
            };
            host.client
                .control(proto::ControlRequest {
                    job: attempt.job,
                    what: Some(proto::control_request::What::Pause(proto::Pause {})),
                })
                .await
                .unwrap();
            assert!(host.client.fail(given_back).await.unwrap().into_inner().accepted);
        }
        assert_eq!(granted, [(1, PARENT), (2, ""), (3, "")].map(|(job, parent)| (job, parent.to_owned())).into());
        for job in 1..4 {
            let what = Some(proto::control_request::What::Resume(proto::Resume {}));
            host.client.control(proto::ControlRequest { job, what }).await.unwrap();
        }
        host.kill().await;
        host = Host::start(&store, QUICK, Duration::from_millis(50)).await.leads().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_standby_names_the_leader_and_follows_one_that_shuts_down() {
    let store = Store::open("memory://").unwrap();
    let mut first = Host::start(&store, QUICK, LONG).await.leads().await;
    let job = first.submit(&store).await;
    let mut standby = Host::start(&store, QUICK, LONG).await;
    let refused = standby.client.status(proto::StatusRequest { job }).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    assert!(refused.message().contains(&first.address), "{refused}");
    first.stop.cancel();
    first.serving.await.unwrap().unwrap();
    // The lease was released, so the standby does not wait for its patience of an hour.
    let mut standby = standby.leads().await;
    assert_eq!(standby.status(job).await.ready, 1);
    let (epoch, lease) = store.newest_record("leader").await.unwrap().unwrap();
    let lease = Leader::from_bytes(epoch, &lease).unwrap();
    assert_eq!((lease.epoch, &lease.address, lease.released), (2, &standby.address, false));
    assert_eq!(store.record_names("leader").await.unwrap(), ["leader/000001.json", "leader/000002.json"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leader_with_a_stale_lease_is_fenced() {
    let store = Store::open("memory://").unwrap();
    // It renews its lease once an hour, so it seems dead.
    let mut old = Host::start(&store, LONG, LONG).await.leads().await;
    let job = old.submit(&store).await;
    let held = old.lease("w1").await;
    let mut new = Host::start(&store, QUICK, Duration::from_millis(60)).await.leads().await;
    // The old leader still accepts calls, but its reply needs a durable write, which fails.
    let refused = old.complete(held, b"to the old one").await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert_eq!(new.status(job).await.done, 0);
    assert!(new.complete(held, b"to the new one").await.unwrap());
    let granted = new.lease("w1").await;
    assert_eq!((granted.epoch, new.status(job).await.done), (2, 1));
    // From now on it stands by.
    let line = loop {
        let refused = old.client.status(proto::StatusRequest { job }).await.unwrap_err();
        assert_eq!(refused.code(), Code::Unavailable);
        if refused.message().contains("stands by") {
            break refused.message().to_owned();
        }
    };
    assert!(line.contains(&new.address), "{line}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_caller_of_a_higher_epoch_is_not_told_that_its_attempt_is_void() {
    let store = Store::open("memory://").unwrap();
    let mut host = Host::start(&store, LONG, LONG).await.leads().await;
    let job = host.submit(&store).await;
    let of_a_later_leader = proto::Attempt { job, task: 0, number: 1, epoch: 5 };
    assert_eq!(host.complete(of_a_later_leader, b"x").await.unwrap_err().code(), Code::Unavailable);
    let report = proto::ReportRequest { attempt: Some(of_a_later_leader), reports: vec![] };
    assert_eq!(host.client.report(report).await.unwrap_err().code(), Code::Unavailable);
    let ask = proto::LeaseRequest { worker: "w".into(), backend: BACKEND.into(), epoch: 5, ..Default::default() };
    assert_eq!(host.client.lease(ask.clone()).await.unwrap_err().code(), Code::Unavailable);
    let ask = proto::LeaseRequest { epoch: 1, ..ask };
    assert!(matches!(host.client.lease(ask).await.unwrap().into_inner().reply, Some(Reply::Grant(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn workers_find_each_new_leader_and_no_task_runs_twice() {
    let folder = tempfile::tempdir().unwrap();
    let url = format!("file://{}", folder.path().display());
    let store = Store::open(&url).unwrap();
    let patience = Duration::from_millis(60);
    let mut host = Host::start(&store, QUICK, patience).await.leads().await;
    let job = host.submit(&store).await;

    // The root runs until the first kill is over, the others briefly.
    let killed = Arc::new(AtomicBool::new(false));
    let wait = killed.clone();
    let fake = fake(move |order, report| {
        while order.task == 0 && !wait.load(Ordering::Relaxed) {
            assert_eq!(report(Report { steps: 2, step: 1, ..Report::default() }), Flow::Continue);
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(60));
        Ok(result_of(order))
    });
    let shutdown = CancellationToken::new();
    let workers: Vec<_> = (0..3)
        .map(|number| {
            let options = worker_options(url.clone(), &format!("w{number}"));
            tokio::spawn(worker::run(options, fake.clone(), shutdown.clone()))
        })
        .collect();
    while fake.orders.lock().unwrap().is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let mut kills = 0;
    loop {
        host.kill().await;
        kills += 1;
        host = Host::start(&store, QUICK, patience).await.leads().await;
        killed.store(true, Ordering::Relaxed);
        let before = host.status(job).await.done;
        // Each leader commits some tasks, then is killed.
        let status = loop {
            let status = host.status(job).await;
            if status.outcome.is_some() || status.done > before + 2 {
                break status;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        };
        if status.outcome.is_some() {
            assert_eq!((status.outcome(), status.done), (Outcome::Done, 13));
            break;
        }
    }
    assert!(kills >= 2, "{kills} kills");
    shutdown.cancel();
    for worker in workers {
        worker.await.unwrap().unwrap();
    }
    // Every task ran exactly once, with its parent's only result as input.
    let orders = fake.orders.lock().unwrap().clone();
    let by_task: BTreeMap<u32, &TaskOrder> = orders.iter().map(|order| (order.task, order)).collect();
    assert_eq!((orders.len(), by_task.len()), (13, 13));
    let plan = plan();
    for (task, order) in &by_task {
        let parent = plan.tasks[*task as usize].parent;
        let parent =
            parent.and_then(|block| plan.tasks.iter().position(|task| task.block == block)).map(|at| at as u32);
        let given: BTreeMap<_, _> = parent.map(|parent| (parent, result_of(by_task[&parent]))).into_iter().collect();
        assert_eq!(order.inputs, given, "task {task}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_finished_job_is_forgotten_with_the_objects_that_only_it_refers_to() {
    use proto::control_request::What;
    let store = Store::open("memory://").unwrap();
    let mut host = Host::start(&store, LONG, LONG).await.leads().await;
    let job = host.submit(&store).await;
    let forget = |job| proto::ControlRequest { job, what: Some(What::Forget(proto::Forget {})) };
    let result = store.put("root".into()).await.unwrap();
    let root = host.lease("w1").await;
    assert!(host.complete(root, b"root").await.unwrap());
    let running = host.client.control(forget(job)).await.unwrap_err();
    assert_eq!(running.code(), Code::FailedPrecondition, "{running}");
    host.client.cancel(proto::CancelRequest { job }).await.unwrap();
    let deleted = host.client.control(forget(job)).await.unwrap().into_inner().deleted;
    assert_eq!((deleted, store.exists(result).await.unwrap()), (2, false));
    let gone = |status: tonic::Status| assert_eq!(status.code(), Code::NotFound);
    gone(host.client.status(proto::StatusRequest { job }).await.unwrap_err());
    host.kill().await;
    // Also under the next leader, and its number is not reused.
    let mut next = Host::start(&store, QUICK, Duration::from_millis(50)).await.leads().await;
    gone(next.client.status(proto::StatusRequest { job }).await.unwrap_err());
    assert_eq!(next.submit(&store).await, job + 1);
    gone(next.client.logs(proto::LogsRequest { job, after: 0 }).await.unwrap_err());
    assert_eq!(next.log(job + 1).await[0].what.split(':').next(), Some("submitted"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_state_ends_the_coordinator_with_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap();
    Host::start(&store, LONG, LONG).await.leads().await.kill().await;
    for entry in std::fs::read_dir(folder.path().join("state/manifest")).unwrap() {
        std::fs::write(entry.unwrap().path(), "nonsense").unwrap();
    }
    let next = Host::start(&store, QUICK, Duration::from_millis(20)).await;
    let line = next.serving.await.unwrap().unwrap_err().to_string();
    assert!(line.starts_with("the durable state in ") && line.lines().count() == 1, "{line}");
}
