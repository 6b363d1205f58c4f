//! A live coordinator under seeded hostile traffic: damaged frames, oversize messages, wrong tokens, replayed and stale attempts,
//! damaged messages. All of it is refused, nothing of it changes a job, and the coordinator serves on.
//!
//! `PLAT_FUZZ_CASES` says how many cases; a few thousand without.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use blocks::{Ground, Plan, PlanSettings, Task};
use cluster::Settings;
use coordinator::{Options, Security, serve};
use glam::{DQuat, DVec2};
use prost::Message;
use proto::lease_reply::Reply;
use proto::{Access, Attempt, Client, Token};
use scene::{ArtefactId, BlockId};
use store::Store;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

const BACKEND: &str = "cpu-none";
const TOKEN: &str = "a-token-of-enough-characters";
/// Callers at the same time.
const CALLERS: u64 = 8;

fn cases() -> u64 {
    std::env::var("PLAT_FUZZ_CASES").map_or(4000, |text| text.parse().expect("PLAT_FUZZ_CASES is a number"))
}

/// A root and its four children.
fn plan() -> Plan {
    let task = |block: &str| {
        let block: BlockId = block.parse().unwrap();
        Task {
            block,
            parent: block.parent(),
            context: Vec::new(),
            views: Vec::new(),
            test_views: Vec::new(),
            points: 0,
            budget: 1,
            steps: 1,
            rho_metres: 1.0,
            visible_splats: 0,
            visible_context_splats: 0,
            memory_bytes: 0,
        }
    };
    Plan {
        version: blocks::plan::VERSION,
        capture: ArtefactId([1; 32]),
        settings: PlanSettings::default(),
        backend: BACKEND.into(),
        ground: Ground {
            ground_from_world: DQuat::IDENTITY,
            min: DVec2::ZERO,
            edge_metres: 100.0,
            height_metres: 0.0,
            near_metres: 1e300,
        },
        levels: 1,
        rho_metres: vec![2.0, 1.0],
        tasks: ["0/0/0", "1/0/0", "1/1/1", "1/1/0", "1/0/1"].map(task).to_vec(),
    }
}

/// Splitmix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit.max(1)
    }

    fn of<'a, T>(&mut self, list: &'a [T]) -> &'a T {
        &list[self.below(list.len() as u64) as usize]
    }

    /// Changes, repeats, cuts or adds some bytes.
    fn damage(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..=self.below(6) {
            let at = self.below(bytes.len() as u64) as usize;
            match self.below(6) {
                0..=2 if !bytes.is_empty() => bytes[at] = self.next() as u8,
                3 => bytes.truncate(at),
                4 => bytes.extend(self.next().to_le_bytes()),
                _ => bytes.insert(at, self.next() as u8),
            }
        }
    }
}

/// Messages as bytes, whatever they are.
#[derive(Clone, Copy, Default)]
struct Bytes;

impl Codec for Bytes {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        *self
    }

    fn decoder(&mut self) -> Self {
        *self
    }
}

impl Encoder for Bytes {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, item: Vec<u8>, target: &mut EncodeBuf<'_>) -> Result<(), Status> {
        bytes::BufMut::put_slice(target, &item);
        Ok(())
    }
}

impl Decoder for Bytes {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, source: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let mut bytes = vec![0; bytes::Buf::remaining(source)];
        bytes::Buf::copy_to_slice(source, &mut bytes);
        Ok(Some(bytes))
    }
}

/// What the attackers know: all but the token.
#[derive(Clone)]
struct Target {
    address: SocketAddr,
    channel: Channel,
    job: u64,
    plan: ArtefactId,
    /// What would count.
    held: BTreeSet<(u64, u32, u32, u64)>,
    /// The attempt that ended the root, and its result.
    ended: (Attempt, ArtefactId),
}

impl Target {
    async fn call(
        &self,
        method: &str,
        headers: &[(&'static str, String)],
        message: Vec<u8>,
    ) -> Result<Vec<u8>, Status> {
        let mut client = tonic::client::Grpc::new(self.channel.clone())
            .max_encoding_message_size(usize::MAX)
            .max_decoding_message_size(usize::MAX);
        client.ready().await.map_err(|error| Status::unavailable(error.to_string()))?;
        let mut request = Request::new(message);
        for (name, value) in headers {
            request.metadata_mut().insert(*name, value.parse().map_err(|_| Status::invalid_argument("a header"))?);
        }
        let path: PathAndQuery = format!("/{}/{method}", proto::SERVICE_NAME).parse().unwrap();
        client.unary(request, path, Bytes).await.map(tonic::Response::into_inner)
    }

    fn is_held(&self, of: &Attempt) -> bool {
        self.held.contains(&(of.job, of.task, of.number, of.epoch))
    }

    /// An attempt that does not hold its lease, near those that do.
    fn stale(&self, random: &mut Random) -> Attempt {
        loop {
            let attempt = Attempt {
                job: *random.of(&[self.job, self.job, self.job, 0, self.job + 1, u64::MAX]),
                task: *random.of(&[0, 0, 1, 2, 3, 4, 5, u32::MAX]),
                number: random.below(4) as u32,
                epoch: *random.of(&[1, 1, 1, 0, 2, u64::MAX]),
            };
            let is_ended = attempt == self.ended.0;
            if !self.is_held(&attempt) && !is_ended {
                return attempt;
            }
        }
    }

    /// A call that must be refused whoever makes it, unless `is_stranger`: then it would count with the token.
    fn message(&self, random: &mut Random, is_stranger: bool) -> (&'static str, Vec<u8>) {
        let held = self.held.iter().next().map(|&(job, task, number, epoch)| Attempt { job, task, number, epoch });
        let attempt = if is_stranger { held } else { Some(self.stale(random)) };
        let artefact = ArtefactId([random.next() as u8; 32]).0.to_vec();
        let job = if is_stranger { self.job } else { *random.of(&[0, self.job + 1, u64::MAX]) };
        match random.below(if is_stranger { 8 } else { 6 }) {
            0 => ("Complete", proto::CompleteRequest { attempt, artefact, then: None }.encode_to_vec()),
            1 => ("Fail", proto::FailRequest { attempt, message: "x".into(), kind: 1 }.encode_to_vec()),
            2 => ("Report", proto::ReportRequest { attempt, reports: vec![] }.encode_to_vec()),
            3 => ("Cancel", proto::CancelRequest { job }.encode_to_vec()),
            4 => {
                let what = Some(proto::control_request::What::Pause(proto::Pause {}));
                ("Control", proto::ControlRequest { job, what }.encode_to_vec())
            }
            5 => {
                let plan = if is_stranger { self.plan.0.to_vec() } else { artefact };
                ("Submit", proto::SubmitRequest { plan, store_url: "memory://".into() }.encode_to_vec())
            }
            6 => ("Leave", proto::LeaveRequest { worker: "w1".into() }.encode_to_vec()),
            _ => {
                let (worker, backend) = ("w9".into(), BACKEND.into());
                ("Lease", proto::LeaseRequest { worker, backend, ..Default::default() }.encode_to_vec())
            }
        }
    }

    /// Whether a damaged message happens to be one that a holder of the token may send.
    fn would_count(&self, method: &str, bytes: &[u8]) -> bool {
        let of = |attempt: Option<Attempt>| attempt.is_some_and(|of| self.is_held(&of) || of == self.ended.0);
        match method {
            "Complete" => proto::CompleteRequest::decode(bytes).is_ok_and(|request| of(request.attempt)),
            "Fail" => proto::FailRequest::decode(bytes).is_ok_and(|request| of(request.attempt)),
            "Report" => proto::ReportRequest::decode(bytes).is_ok_and(|request| of(request.attempt)),
            "Cancel" => proto::CancelRequest::decode(bytes).is_ok_and(|request| request.job == self.job),
            "Control" => proto::ControlRequest::decode(bytes).is_ok_and(|request| request.job == self.job),
            "Submit" => proto::SubmitRequest::decode(bytes).is_ok_and(|request| request.plan == self.plan.0),
            _ => true,
        }
    }

    /// The bytes of a whole connection that asks for a status, with the token.
    fn connection(&self, random: &mut Random) -> Vec<u8> {
        let mut block = vec![0x83, 0x86]; // :method POST, :scheme http
        let literal = |block: &mut Vec<u8>, name: &str, value: &str| {
            block.extend([0x00, name.len() as u8]);
            block.extend(name.bytes());
            block.push(value.len() as u8);
            block.extend(value.bytes());
        };
        literal(&mut block, ":path", "/plat.v1.Coordinator/Status");
        literal(&mut block, ":authority", "coordinator");
        literal(&mut block, "content-type", "application/grpc");
        literal(&mut block, "te", "trailers");
        literal(&mut block, proto::VERSION_HEADER, &proto::VERSION.to_string());
        literal(&mut block, "authorization", &format!("Bearer {TOKEN}"));
        let message = proto::StatusRequest { job: self.job }.encode_to_vec();
        let claimed = *random.of(&[message.len() as u32, message.len() as u32, u32::MAX, 1 << 30]);
        let mut data = vec![*random.of(&[0, 0, 1, 0xff])];
        data.extend(claimed.to_be_bytes());
        data.extend(message);
        let frame = |kind: u8, flags: u8, stream: u32, payload: &[u8]| {
            let mut frame = (payload.len() as u32).to_be_bytes()[1..].to_vec();
            frame.extend([kind, flags]);
            frame.extend(stream.to_be_bytes());
            frame.extend(payload);
            frame
        };
        let mut bytes = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
        bytes.extend(frame(4, 0, 0, &[]));
        bytes.extend(frame(1, 4, 1, &block));
        bytes.extend(frame(0, 1, 1, &data));
        for _ in 0..random.below(3) {
            // Pings, resets, windows and what there is no name for.
            let (kind, stream) = (random.below(12) as u8, random.below(4) as u32);
            bytes.extend(frame(kind, random.next() as u8, stream, &random.next().to_le_bytes()));
        }
        bytes
    }
}

fn own_headers() -> Vec<(&'static str, String)> {
    vec![(proto::VERSION_HEADER, proto::VERSION.to_string()), ("authorization", format!("Bearer {TOKEN}"))]
}

/// One case. The error is what was not refused.
async fn attack(target: &Target, random: &mut Random) -> Result<(), String> {
    match random.below(100) {
        0..20 => {
            let mut bytes = target.connection(random);
            if random.below(8) > 0 {
                random.damage(&mut bytes);
            }
            let mut stream = TcpStream::connect(target.address).await.map_err(|error| error.to_string())?;
            // It may hang up before all is said.
            let _ = stream.write_all(&bytes).await;
            if random.below(4) == 0 {
                let _ = tokio::time::timeout(Duration::from_millis(2), stream.read(&mut [0; 256])).await;
            }
            Ok(())
        }
        20..40 => {
            let (method, message) = target.message(random, true);
            let mut token = TOKEN.to_string();
            let at = random.below(token.len() as u64) as usize;
            let headers = match random.below(5) {
                0 => vec![(proto::VERSION_HEADER, proto::VERSION.to_string())],
                1 => {
                    token.truncate(at);
                    vec![own_headers()[0].clone(), ("authorization", format!("Bearer {token}"))]
                }
                2 => {
                    token.replace_range(at..=at, "~");
                    vec![own_headers()[0].clone(), ("authorization", format!("Bearer {token}"))]
                }
                3 => vec![own_headers()[0].clone(), ("authorization", TOKEN.into())],
                _ => vec![
                    own_headers()[1].clone(),
                    (proto::VERSION_HEADER, random.of(&["0", "1", "x", "99"]).to_string()),
                ],
            };
            match target.call(method, &headers, message).await {
                Err(status) if matches!(status.code(), Code::Unauthenticated | Code::FailedPrecondition) => Ok(()),
                other => Err(format!("{method} of a stranger: {other:?}")),
            }
        }
        40..70 => {
            let (method, message) = target.message(random, false);
            match target.call(method, &own_headers(), message).await {
                // `accepted` is false, or the attempt is told to stop.
                Ok(bytes) if method == "Report" && proto::ReportReply::decode(&*bytes).is_ok_and(|r| r.cancelled) => {
                    Ok(())
                }
                Ok(bytes) if method != "Report" && bytes.is_empty() => Ok(()),
                Err(_) => Ok(()),
                other => Err(format!("a stale {method}: {other:?}")),
            }
        }
        70..72 => {
            // What ended the root, said again: agreed to if it is the same, and nothing comes of it.
            let (attempt, result) = target.ended;
            let same = random.below(2) == 0;
            let artefact = if same { result } else { ArtefactId([random.next() as u8; 32]) };
            let request = proto::CompleteRequest { attempt: Some(attempt), artefact: artefact.0.to_vec(), then: None };
            let reply = target.call("Complete", &own_headers(), request.encode_to_vec()).await;
            let accepted = reply.ok().and_then(|bytes| proto::AttemptReply::decode(&*bytes).ok()).map(|r| r.accepted);
            if accepted == Some(same) {
                Ok(())
            } else {
                Err(format!("a result said again: {accepted:?}, same: {same}"))
            }
        }
        72..99 => {
            let (mut method, mut message) = target.message(random, false);
            random.damage(&mut message);
            if target.would_count(method, &message) {
                return Ok(());
            }
            if random.below(20) == 0 {
                method = "NoSuchCall";
            }
            match target.call(method, &own_headers(), message).await {
                Ok(bytes) if method == "Report" && proto::ReportReply::decode(&*bytes).is_ok_and(|r| r.cancelled) => {
                    Ok(())
                }
                Ok(bytes) if method != "Report" && bytes.is_empty() => Ok(()),
                Err(_) => Ok(()),
                other => Err(format!("a damaged {method}: {other:?}")),
            }
        }
        _ => {
            // Most are refused by their length alone.
            let bytes = proto::MESSAGE_BYTES_LIMIT + 1 + random.below(1 << 16) as usize;
            match target.call("Submit", &own_headers(), vec![random.next() as u8; bytes]).await {
                Err(status) if matches!(status.code(), Code::OutOfRange | Code::Unknown | Code::Internal) => Ok(()),
                other => Err(format!("an oversize message: {other:?}")),
            }
        }
    }
}

async fn lease(client: &mut Client, worker: &str) -> Attempt {
    loop {
        let request = proto::LeaseRequest { worker: worker.into(), backend: BACKEND.into(), ..Default::default() };
        match client.lease(request).await.unwrap().into_inner().reply.unwrap() {
            Reply::Grant(grant) => return grant.attempt.unwrap(),
            Reply::WaitMillis(millis) => tokio::time::sleep(Duration::from_millis(millis.into())).await,
            Reply::Drained(_) => panic!("drained"),
        }
    }
}

/// All that can be seen of the jobs.
async fn seen(client: &mut Client, job: u64) -> String {
    let status = client.status(proto::StatusRequest { job }).await.unwrap().into_inner();
    let jobs = client.jobs(proto::JobsRequest {}).await.unwrap().into_inner();
    let about = client.about(proto::AboutRequest {}).await.unwrap().into_inner();
    let mut watch = client.watch(proto::WatchRequest { job }).await.unwrap().into_inner();
    let mut tasks = Vec::new();
    for _ in 0..status.waiting + status.ready + status.leased + status.done + status.failed + status.quarantined {
        tasks.push(watch.message().await.unwrap());
    }
    format!("{status:?}\n{jobs:?}\n{about:?}\n{tasks:?}")
}

#[tokio::test(flavor = "multi_thread")]
async fn hostile_traffic_changes_nothing() {
    let store = Store::open("memory://").unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    // Leases outlive the test: what changes is a caller's doing.
    let hour = 3_600_000;
    let settings = Settings {
        lease_millis: hour,
        worker_timeout_millis: 2 * hour,
        stall_millis: 2 * hour,
        speculation: false,
        ..Settings::default()
    };
    let security = Security { token: Token::new(TOKEN).ok(), ..Security::default() };
    let options = Options { settings, wait_millis: 5, security, ..Options::new(store.clone()) };
    let stop = CancellationToken::new();
    let serving = tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));

    let url = format!("http://{address}");
    let access = Access { token: Token::new(TOKEN).ok(), ..Access::default() };
    let mut client = proto::connect(&url, &access).unwrap();
    let plan = store.put(plan().to_frame().into()).await.unwrap();
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url: store.url().into() };
    let job = client.submit(request).await.unwrap().into_inner().job;
    // The first attempt at the root is lost, the second ends it, and two children are under way.
    lease(&mut client, "w1").await;
    let root = lease(&mut client, "w1").await;
    assert_eq!((root.task, root.number), (0, 2));
    let result = ArtefactId::of(b"root");
    let request = proto::CompleteRequest { attempt: Some(root), artefact: result.0.to_vec(), then: None };
    assert!(client.complete(request).await.unwrap().into_inner().accepted);
    let held = [lease(&mut client, "w1").await, lease(&mut client, "w2").await];

    let target = Target {
        address,
        channel: Endpoint::from_shared(url).unwrap().connect_lazy(),
        job,
        plan,
        held: held.iter().map(|of| (of.job, of.task, of.number, of.epoch)).collect(),
        ended: (root, result),
    };
    let before = seen(&mut client, job).await;
    let total = cases();
    let attackers: Vec<_> = (0..CALLERS)
        .map(|caller| {
            let target = target.clone();
            tokio::spawn(async move {
                for case in (caller..total).step_by(CALLERS as usize) {
                    if let Err(what) = attack(&target, &mut Random(case)).await {
                        return Err(format!("case {case}: {what}"));
                    }
                }
                Ok(())
            })
        })
        .collect();
    for attacker in attackers {
        attacker.await.unwrap().unwrap_or_else(|what| panic!("{what}"));
    }
    assert_eq!(seen(&mut client, job).await, before);
    // Who holds a lease goes on as if nothing had been.
    for of in held {
        let request = proto::CompleteRequest { attempt: Some(of), artefact: vec![3; 32], then: None };
        assert!(client.complete(request).await.unwrap().into_inner().accepted);
    }
    println!("{total} cases, nothing changed");
    stop.cancel();
    serving.await.unwrap().unwrap();
}
