//! Tests a live coordinator under seeded hostile traffic: damaged frames, oversize messages, wrong tokens, replayed and stale attempts,
//! damaged messages. It refuses all of them, no job changes, and it goes on serving.
//!
//! `PLAT_FUZZ_CASES` sets the number of cases; the default is a few thousand.

mod common;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use blocks::Plan;
use cluster::Settings;
use coordinator::{Options, Security, serve};
use prost::Message;
use proto::{Access, Attempt, Client, Token};
use scene::ArtefactId;
use store::Store;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

use common::{BACKEND, lease, plan_of, task};

const TOKEN: &str = "a-token-of-enough-characters";
/// Concurrent callers.
const CALLERS: u64 = 8;

fn cases() -> u64 {
    std::env::var("PLAT_FUZZ_CASES").map_or(4000, |text| text.parse().expect("PLAT_FUZZ_CASES is a number"))
}

/// A root and its four children.
fn plan() -> Plan {
    plan_of(1, ["0/0/0", "1/0/0", "1/1/1", "1/1/0", "1/0/1"].map(|block| task(block, &[])).to_vec())
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

    /// Changes, removes or inserts some bytes.
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

/// A codec of raw message bytes.
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

/// What the attackers know: everything but the token.
#[derive(Clone)]
struct Target {
    address: SocketAddr,
    channel: Channel,
    job: u64,
    plan: ArtefactId,
    /// The attempts that hold a lease: job, task, number, epoch.
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

    /// A call that must be refused from any caller; with `is_unauthenticated`, one that would be accepted with the token.
    fn message(&self, random: &mut Random, is_unauthenticated: bool) -> (&'static str, Vec<u8>) {
        let held = self.held.iter().next().map(|&(job, task, number, epoch)| Attempt { job, task, number, epoch });
        let attempt = if is_unauthenticated { held } else { Some(self.stale(random)) };
        let artefact = ArtefactId([random.next() as u8; 32]).0.to_vec();
        let job = if is_unauthenticated { self.job } else { *random.of(&[0, self.job + 1, u64::MAX]) };
        match random.below(if is_unauthenticated { 8 } else { 6 }) {
            0 => ("Complete", proto::CompleteRequest { attempt, artefact, then: None }.encode_to_vec()),
            1 => ("Fail", proto::FailRequest { attempt, message: "x".into(), kind: 1 }.encode_to_vec()),
            2 => ("Report", proto::ReportRequest { attempt, reports: vec![] }.encode_to_vec()),
            3 => ("Cancel", proto::CancelRequest { job }.encode_to_vec()),
            4 => {
                let what = Some(proto::control_request::What::Pause(proto::Pause {}));
                ("Control", proto::ControlRequest { job, what }.encode_to_vec())
            }
            5 => {
                let plan = if is_unauthenticated { self.plan.0.to_vec() } else { artefact };
                ("Submit", proto::SubmitRequest { plan, store_url: "memory://".into() }.encode_to_vec())
            }
            6 => ("Leave", proto::LeaveRequest { worker: "w1".into() }.encode_to_vec()),
            _ => {
                let (worker, backend) = ("w9".into(), BACKEND.into());
                ("Lease", proto::LeaseRequest { worker, backend, ..Default::default() }.encode_to_vec())
            }
        }
    }

    /// Whether a damaged message happens to be acceptable with the token.
    fn is_acceptable(&self, method: &str, bytes: &[u8]) -> bool {
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

    /// The bytes of a connection that requests a status, with the token.
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
            // Pings, resets, window updates and unknown frames.
            let (kind, stream) = (random.below(12) as u8, random.below(4) as u32);
            bytes.extend(frame(kind, random.next() as u8, stream, &random.next().to_le_bytes()));
        }
        bytes
    }
}

fn valid_headers() -> Vec<(&'static str, String)> {
    vec![(proto::VERSION_HEADER, proto::VERSION.to_string()), ("authorization", format!("Bearer {TOKEN}"))]
}

/// Runs one case. The error describes a call that was not refused.
async fn attack(target: &Target, random: &mut Random) -> Result<(), String> {
    match random.below(100) {
        0..20 => damaged_connection(target, random).await,
        20..40 => unauthenticated_call(target, random).await,
        40..70 => stale_call(target, random).await,
        70..72 => repeated_completion(target, random).await,
        72..99 => damaged_call(target, random).await,
        _ => oversize_call(target, random).await,
    }
}

/// Writes the bytes of a connection, mostly damaged, and hangs up.
async fn damaged_connection(target: &Target, random: &mut Random) -> Result<(), String> {
    let mut bytes = target.connection(random);
    if random.below(8) > 0 {
        random.damage(&mut bytes);
    }
    let mut stream = TcpStream::connect(target.address).await.map_err(|error| error.to_string())?;
    // The coordinator may close the connection before all is written.
    let _ = stream.write_all(&bytes).await;
    if random.below(4) == 0 {
        let _ = tokio::time::timeout(Duration::from_millis(2), stream.read(&mut [0; 256])).await;
    }
    Ok(())
}

/// A call without the token, with a wrong one, or of an unsupported version.
async fn unauthenticated_call(target: &Target, random: &mut Random) -> Result<(), String> {
    let (method, message) = target.message(random, true);
    let mut token = TOKEN.to_string();
    let at = random.below(token.len() as u64) as usize;
    let headers = match random.below(5) {
        0 => vec![(proto::VERSION_HEADER, proto::VERSION.to_string())],
        1 => {
            token.truncate(at);
            vec![valid_headers()[0].clone(), ("authorization", format!("Bearer {token}"))]
        }
        2 => {
            token.replace_range(at..=at, "~");
            vec![valid_headers()[0].clone(), ("authorization", format!("Bearer {token}"))]
        }
        3 => vec![valid_headers()[0].clone(), ("authorization", TOKEN.into())],
        _ => {
            let version = random.of(&["0", "1", "x", "99"]).to_string();
            vec![valid_headers()[1].clone(), (proto::VERSION_HEADER, version)]
        }
    };
    match target.call(method, &headers, message).await {
        Err(status) if matches!(status.code(), Code::Unauthenticated | Code::FailedPrecondition) => Ok(()),
        other => Err(format!("an unauthenticated {method}: {other:?}")),
    }
}

/// A call about an attempt without a lease.
async fn stale_call(target: &Target, random: &mut Random) -> Result<(), String> {
    let (method, message) = target.message(random, false);
    is_refused(method, target.call(method, &valid_headers(), message).await).map_err(|reply| format!("a stale {reply}"))
}

/// The completion of the root again: accepted with the same result, refused with another one.
async fn repeated_completion(target: &Target, random: &mut Random) -> Result<(), String> {
    let (attempt, result) = target.ended;
    let is_same = random.below(2) == 0;
    let artefact = if is_same { result } else { ArtefactId([random.next() as u8; 32]) };
    let request = proto::CompleteRequest { attempt: Some(attempt), artefact: artefact.0.to_vec(), then: None };
    let reply = target.call("Complete", &valid_headers(), request.encode_to_vec()).await;
    let accepted = reply.ok().and_then(|bytes| proto::AttemptReply::decode(&*bytes).ok()).map(|r| r.accepted);
    if accepted == Some(is_same) {
        Ok(())
    } else {
        Err(format!("a repeated completion: {accepted:?}, same result: {is_same}"))
    }
}

/// A call with a damaged message.
async fn damaged_call(target: &Target, random: &mut Random) -> Result<(), String> {
    let (mut method, mut message) = target.message(random, false);
    random.damage(&mut message);
    if target.is_acceptable(method, &message) {
        return Ok(());
    }
    if random.below(20) == 0 {
        method = "NoSuchCall";
    }
    is_refused(method, target.call(method, &valid_headers(), message).await)
        .map_err(|reply| format!("a damaged {reply}"))
}

/// A message above the size limit. Most are refused by their length alone.
async fn oversize_call(target: &Target, random: &mut Random) -> Result<(), String> {
    let bytes = proto::MESSAGE_BYTES_LIMIT + 1 + random.below(1 << 16) as usize;
    match target.call("Submit", &valid_headers(), vec![random.next() as u8; bytes]).await {
        Err(status) if matches!(status.code(), Code::OutOfRange | Code::Unknown | Code::Internal) => Ok(()),
        other => Err(format!("an oversize message: {other:?}")),
    }
}

/// Whether a reply refuses the call: by an error, by `accepted` = false, or by `cancelled` for a report. The error names the call.
fn is_refused(method: &str, reply: Result<Vec<u8>, Status>) -> Result<(), String> {
    match reply {
        Ok(bytes) if method == "Report" && proto::ReportReply::decode(&*bytes).is_ok_and(|r| r.cancelled) => Ok(()),
        Ok(bytes) if method != "Report" && bytes.is_empty() => Ok(()),
        Err(_) => Ok(()),
        other => Err(format!("{method}: {other:?}")),
    }
}

/// All visible state of the jobs, as text.
async fn visible_state(client: &mut Client, job: u64) -> String {
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
    // Leases outlive the test, so only a call can change a job.
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
    // The first attempt at the root is lost, the second completes it, and two children are running.
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
    let before = visible_state(&mut client, job).await;
    let total = cases();
    let attackers: Vec<_> = (0..CALLERS)
        .map(|caller| {
            let target = target.clone();
            tokio::spawn(async move {
                for case in (caller..total).step_by(CALLERS as usize) {
                    if let Err(problem) = attack(&target, &mut Random(case)).await {
                        return Err(format!("case {case}: {problem}"));
                    }
                }
                Ok(())
            })
        })
        .collect();
    for attacker in attackers {
        attacker.await.unwrap().unwrap_or_else(|problem| panic!("{problem}"));
    }
    assert_eq!(visible_state(&mut client, job).await, before);
    // The holders of the leases can still complete their tasks.
    for of in held {
        let request = proto::CompleteRequest { attempt: Some(of), artefact: vec![3; 32], then: None };
        assert!(client.complete(request).await.unwrap().into_inner().accepted);
    }
    println!("{total} cases, nothing changed");
    stop.cancel();
    serving.await.unwrap().unwrap();
}
