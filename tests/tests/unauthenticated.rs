//! Tests which clients a coordinator admits: certificates, tokens, protocol versions, message sizes, and bytes that are not gRPC.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use coordinator::{Options, Security, ServeError, serve};
use proto::coordinator_client::CoordinatorClient;
use proto::{Access, KeyPair, Token};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer};
use scene::ArtefactId;
use store::Store;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tonic::transport::Endpoint;
use tonic::{Code, Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use worker::{Execute, ExecuteError, Flow, Report, TaskOrder, WorkerError};

const TOKEN: &str = "a-token-of-enough-characters";

/// A certificate authority.
struct Authority {
    certificate: Vec<u8>,
    issuer: Issuer<'static, rcgen::KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = rcgen::KeyPair::generate().unwrap();
        let certificate = params.self_signed(&key).unwrap().pem().into_bytes();
        Self { certificate, issuer: Issuer::new(params, key) }
    }

    fn pair(&self) -> KeyPair {
        let key = rcgen::KeyPair::generate().unwrap();
        let params = CertificateParams::new(["127.0.0.1".to_string(), "localhost".to_string()]).unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        KeyPair { certificate: certificate.pem().into_bytes(), key: key.serialize_pem().into_bytes() }
    }
}

/// A coordinator. It ends when the returned token is cancelled.
async fn host(listen: &str, security: Security) -> (SocketAddr, CancellationToken) {
    let listener = TcpListener::bind(listen).await.unwrap();
    let address = SocketAddr::from(([127, 0, 0, 1], listener.local_addr().unwrap().port()));
    let options = Options { security, ..Options::new(Store::open("memory://").unwrap()) };
    let stop = CancellationToken::new();
    tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));
    (address, stop)
}

/// The result of the simplest call.
async fn call(url: &str, access: &Access) -> Result<(), Status> {
    let mut client = proto::connect(url, access).unwrap();
    client.about(proto::AboutRequest {}).await.map(|_| ())
}

/// An executor that gets no task.
struct Idle;

impl Execute for Idle {
    fn execute(&self, _: &TaskOrder, _: &mut (dyn FnMut(Report) -> Flow + Send)) -> Result<ArtefactId, ExecuteError> {
        unreachable!("no job is submitted")
    }
}

/// The result of a worker that is to be refused.
async fn work(coordinator_url: String, access: Access) -> Result<(), WorkerError> {
    let (worker_id, backend) = ("refused".into(), "cpu-none".into());
    let options = worker::Options { coordinator_url, access, worker_id, backend, memory_bytes: 0 };
    tokio::time::timeout(Duration::from_secs(60), worker::run(options, Arc::new(Idle), CancellationToken::new()))
        .await
        .expect("a refused worker does not retry")
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_the_loopback_clients_need_the_authority_and_the_token() {
    let (authority, other) = (Authority::new(), Authority::new());
    let token = Token::new(TOKEN).ok();
    let security = Security { identity: Some(authority.pair()), client_authority: None, token: token.clone() };
    let (address, stop) = host("0.0.0.0:0", security).await;
    let url = format!("https://{address}");
    let valid = Access { authority: Some(authority.certificate.clone()), identity: None, token };
    call(&url, &valid).await.unwrap();

    let no_token = Access { token: None, ..valid.clone() };
    let wrong_token = Access { token: Token::new("another-token-of-enough-characters").ok(), ..valid.clone() };
    for (access, wanted) in [(&no_token, "requires a token"), (&wrong_token, "not this coordinator's")] {
        let status = call(&url, access).await.unwrap_err();
        assert!(status.code() == Code::Unauthenticated && status.message().contains(wanted), "{status}");
        assert!(!status.message().contains(TOKEN));
        let refused = work(url.clone(), access.clone()).await.unwrap_err();
        assert!(matches!(&refused, WorkerError::Refused(why) if why.contains(wanted)), "{refused}");
    }
    let wrong_authority = Access { authority: Some(other.certificate.clone()), ..valid.clone() };
    let status = call(&url, &wrong_authority).await.unwrap_err();
    assert!(status.code() == Code::Unavailable && proto::explain(&status).contains("certificate"), "{status:?}");
    let refused = work(url.clone(), wrong_authority).await.unwrap_err().to_string();
    assert!(refused.starts_with("--tls-ca") && refused.contains("not valid"), "{refused}");
    // (The client does not send the token unencrypted.)
    let open = call(&format!("http://{address}"), &Access::default()).await.unwrap_err();
    assert_ne!(open.code(), Code::Ok);
    // The health check needs no token.
    let tls = tonic::transport::ClientTlsConfig::new()
        .ca_certificate(tonic::transport::Certificate::from_pem(&authority.certificate));
    let channel = Endpoint::from_shared(url.clone()).unwrap().tls_config(tls).unwrap().connect_lazy();
    let check = HealthCheckRequest { service: proto::SERVICE_NAME.into() };
    let health = HealthClient::new(channel).check(check).await.unwrap().into_inner();
    assert_eq!(health.status(), ServingStatus::Serving);
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_coordinator_may_require_client_certificates() {
    let (authority, other) = (Authority::new(), Authority::new());
    let token = Token::new(TOKEN).ok();
    let client_authority = Some(authority.certificate.clone());
    let security = Security { identity: Some(authority.pair()), client_authority, token: token.clone() };
    let (address, stop) = host("127.0.0.1:0", security).await;
    let url = format!("https://{address}");
    let with = |identity| Access { authority: Some(authority.certificate.clone()), identity, token: token.clone() };
    call(&url, &with(Some(authority.pair()))).await.unwrap();
    for (identity, problem) in
        [(None, "requires a client certificate"), (Some(other.pair()), "rejects the client certificate")]
    {
        // In TLS 1.3 the alert arrives after the client's handshake, so gRPC's error code depends on timing.
        let refused = call(&url, &with(identity.clone())).await.unwrap_err();
        assert!(matches!(refused.code(), Code::Unavailable | Code::Unknown | Code::Cancelled), "{refused:?}");
        // A worker does not retry: it ends with the flags to give.
        let refused = work(url.clone(), with(identity)).await.unwrap_err();
        assert!(matches!(&refused, WorkerError::Input(input) if input.subject == "--tls-cert"), "{refused}");
        let line = refused.to_string();
        assert!(line.contains(problem) && line.contains("--tls-key") && line.lines().count() == 1, "{line}");
    }
    stop.cancel();
}

/// Neither a refused connection nor one that breaks in the handshake is about certificates: the worker retries until shutdown.
#[tokio::test(flavor = "multi_thread")]
async fn network_errors_do_not_end_a_worker() {
    let authority = Authority::new();
    let access = Access { authority: Some(authority.certificate.clone()), ..Access::default() };
    let broken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let broken_url = format!("https://{}", broken.local_addr().unwrap());
    // Accepts and closes at once.
    tokio::spawn(async move { while broken.accept().await.is_ok() {} });
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let closed_url = format!("https://{}", closed.local_addr().unwrap());
    drop(closed);
    for coordinator_url in [broken_url, closed_url] {
        assert_eq!(proto::rejected_certificate(&coordinator_url, &access).await, None, "{coordinator_url}");
        let (worker_id, backend) = ("w".into(), "cpu-none".into());
        let options = worker::Options { coordinator_url, access: access.clone(), worker_id, backend, memory_bytes: 0 };
        let shutdown = CancellationToken::new();
        let running = tokio::spawn(worker::run(options, Arc::new(Idle), shutdown.clone()));
        tokio::time::sleep(Duration::from_secs(1)).await;
        assert!(!running.is_finished());
        shutdown.cancel();
        running.await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn an_invalid_certificate_ends_the_coordinator_at_its_start() {
    let pair = KeyPair { certificate: b"no certificate".to_vec(), key: b"no key".to_vec() };
    let security = Security { identity: Some(pair), token: Token::new(TOKEN).ok(), client_authority: None };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let options = Options { security, ..Options::new(Store::open("memory://").unwrap()) };
    let refused = serve(listener, options, std::future::pending()).await.unwrap_err();
    assert!(matches!(&refused, ServeError::Input(input) if input.subject == "--tls-cert"), "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_outdated_worker_is_refused_with_advice_to_update() {
    let (address, stop) = host("127.0.0.1:0", Security::default()).await;
    let channel = Endpoint::from_shared(format!("http://{address}")).unwrap().connect_lazy();
    let request = || proto::LeaseRequest { worker: "old".into(), backend: "cpu-none".into(), ..Default::default() };
    // The first protocol version did not send its number.
    let unversioned = CoordinatorClient::new(channel.clone()).lease(request()).await.unwrap_err();
    let with_version = |version: &'static str| {
        move |mut request: Request<()>| {
            request.metadata_mut().insert(proto::VERSION_HEADER, version.parse().unwrap());
            Ok(request)
        }
    };
    let older =
        CoordinatorClient::with_interceptor(channel.clone(), with_version("1")).lease(request()).await.unwrap_err();
    for status in [unversioned, older] {
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert!(status.message().contains("too old") && status.message().contains("update it"), "{status}");
    }
    let newer = CoordinatorClient::with_interceptor(channel, with_version("99")).lease(request()).await.unwrap_err();
    assert!(newer.message().contains("update the coordinator"), "{newer}");
    // None of them was registered as a worker.
    let mut client = proto::connect(&format!("http://{address}"), &Access::default()).unwrap();
    assert!(client.about(proto::AboutRequest {}).await.unwrap().into_inner().backends.is_empty());
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn oversize_messages_and_random_bytes_have_no_effect() {
    let (address, stop) = host("127.0.0.1:0", Security::default()).await;
    let url = format!("http://{address}");
    let channel = Endpoint::from_shared(url.clone()).unwrap().connect_lazy();
    let version = |mut request: Request<()>| {
        request.metadata_mut().insert(proto::VERSION_HEADER, proto::VERSION.into());
        Ok(request)
    };
    // A client without the message limit.
    let mut large = CoordinatorClient::with_interceptor(channel, version).max_encoding_message_size(usize::MAX);
    for bytes in [proto::MESSAGE_BYTES_LIMIT + 1, 8 * proto::MESSAGE_BYTES_LIMIT] {
        let request = proto::SubmitRequest { plan: vec![0; bytes], store_url: String::new() };
        let status = large.submit(request).await.unwrap_err();
        assert!(status.code() == Code::OutOfRange && status.message().contains("too large"), "{status}");
    }
    // Bytes that are not HTTP/2, random bytes after an HTTP/2 preface, and connections that send nothing.
    let mut silent = Vec::new();
    for seed in 0..200u64 {
        let mut stream = TcpStream::connect(address).await.unwrap();
        if seed % 3 > 0 {
            stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
        }
        let noise = (0..512u64).flat_map(|i| ArtefactId::of(&(seed << 32 | i).to_le_bytes()).0).collect::<Vec<u8>>();
        // The coordinator may have closed the connection already.
        let _ = stream.write_all(&noise[..(seed as usize * 83) % noise.len()]).await;
        if seed % 10 == 0 {
            silent.push(stream);
        } else {
            let _ = tokio::time::timeout(Duration::from_millis(1), stream.read(&mut [0; 64])).await;
        }
    }
    call(&url, &Access::default()).await.unwrap();
    stop.cancel();
}
