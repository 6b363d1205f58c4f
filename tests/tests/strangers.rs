//! Who may call a coordinator and who may not: certificates, tokens, versions, sizes, and bytes that are no calls at all.

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

/// Signs certificates.
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

/// A coordinator; it ends with the token.
async fn host(listen: &str, security: Security) -> (SocketAddr, CancellationToken) {
    let listener = TcpListener::bind(listen).await.unwrap();
    let address = SocketAddr::from(([127, 0, 0, 1], listener.local_addr().unwrap().port()));
    let options = Options { security, ..Options::new(Store::open("memory://").unwrap()) };
    let stop = CancellationToken::new();
    tokio::spawn(serve(listener, options, stop.clone().cancelled_owned()));
    (address, stop)
}

/// What comes of the simplest call.
async fn call(url: &str, access: &Access) -> Result<(), Status> {
    let mut client = proto::connect(url, access).unwrap();
    client.about(proto::AboutRequest {}).await.map(|_| ())
}

/// Never has anything to do.
struct Idle;

impl Execute for Idle {
    fn execute(&self, _: &TaskOrder, _: &mut (dyn FnMut(Report) -> Flow + Send)) -> Result<ArtefactId, ExecuteError> {
        unreachable!("nobody submits anything")
    }
}

/// How a worker ends that is not to find work.
async fn work(coordinator_url: String, access: Access) -> Result<(), WorkerError> {
    let (worker_id, backend) = ("stranger".into(), "cpu-none".into());
    let options = worker::Options { coordinator_url, access, worker_id, backend, memory_bytes: 0 };
    tokio::time::timeout(Duration::from_secs(60), worker::run(options, Arc::new(Idle), CancellationToken::new()))
        .await
        .expect("a worker that is refused does not wait")
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_this_machine_callers_need_trust_and_the_token() {
    let (authority, other) = (Authority::new(), Authority::new());
    let token = Token::new(TOKEN).ok();
    let security = Security { identity: Some(authority.pair()), client_authority: None, token: token.clone() };
    let (address, stop) = host("0.0.0.0:0", security).await;
    let url = format!("https://{address}");
    let friend = Access { authority: Some(authority.certificate.clone()), identity: None, token };
    call(&url, &friend).await.unwrap();

    let nobody = Access { token: None, ..friend.clone() };
    let stranger = Access { token: Token::new("another-token-of-enough-characters").ok(), ..friend.clone() };
    for (access, wanted) in [(&nobody, "asks for a token"), (&stranger, "not this coordinator's")] {
        let status = call(&url, access).await.unwrap_err();
        assert!(status.code() == Code::Unauthenticated && status.message().contains(wanted), "{status}");
        assert!(!status.message().contains(TOKEN));
        let refused = work(url.clone(), access.clone()).await.unwrap_err();
        assert!(matches!(&refused, WorkerError::Refused(why) if why.contains(wanted)), "{refused}");
    }
    let misled = Access { authority: Some(other.certificate.clone()), ..friend.clone() };
    let status = call(&url, &misled).await.unwrap_err();
    assert!(status.code() == Code::Unavailable && proto::explain(&status).contains("certificate"), "{status:?}");
    // (The token would not be sent without encryption.)
    let open = call(&format!("http://{address}"), &Access::default()).await.unwrap_err();
    assert_ne!(open.code(), Code::Ok);
    // Whether it is alive, anyone may ask who trusts it.
    let tls = tonic::transport::ClientTlsConfig::new()
        .ca_certificate(tonic::transport::Certificate::from_pem(&authority.certificate));
    let channel = Endpoint::from_shared(url.clone()).unwrap().tls_config(tls).unwrap().connect_lazy();
    let check = HealthCheckRequest { service: proto::SERVICE_NAME.into() };
    let health = HealthClient::new(channel).check(check).await.unwrap().into_inner();
    assert_eq!(health.status(), ServingStatus::Serving);
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_coordinator_may_ask_for_certificates() {
    let (authority, other) = (Authority::new(), Authority::new());
    let token = Token::new(TOKEN).ok();
    let client_authority = Some(authority.certificate.clone());
    let security = Security { identity: Some(authority.pair()), client_authority, token: token.clone() };
    let (address, stop) = host("127.0.0.1:0", security).await;
    let url = format!("https://{address}");
    let with = |identity| Access { authority: Some(authority.certificate.clone()), identity, token: token.clone() };
    call(&url, &with(Some(authority.pair()))).await.unwrap();
    for stranger in [None, Some(other.pair())] {
        // TLS 1.3 refuses a certificate once its owner has begun to speak: how the broken connection shows is a matter of time.
        let refused = call(&url, &with(stranger)).await.unwrap_err();
        assert!(matches!(refused.code(), Code::Unavailable | Code::Unknown | Code::Cancelled), "{refused:?}");
    }
    stop.cancel();
}

#[tokio::test]
async fn a_certificate_that_is_none_is_said_before_anyone_calls() {
    let pair = KeyPair { certificate: b"no certificate".to_vec(), key: b"no key".to_vec() };
    let security = Security { identity: Some(pair), token: Token::new(TOKEN).ok(), client_authority: None };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let options = Options { security, ..Options::new(Store::open("memory://").unwrap()) };
    let refused = serve(listener, options, std::future::pending()).await.unwrap_err();
    assert!(matches!(&refused, ServeError::Input(input) if input.subject == "--tls-cert"), "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_old_worker_is_told_to_update() {
    let (address, stop) = host("127.0.0.1:0", Security::default()).await;
    let channel = Endpoint::from_shared(format!("http://{address}")).unwrap().connect_lazy();
    let request = || proto::LeaseRequest { worker: "old".into(), backend: "cpu-none".into(), ..Default::default() };
    // The first version of the wire did not say its number.
    let silent = CoordinatorClient::new(channel.clone()).lease(request()).await.unwrap_err();
    let said = |version: &'static str| {
        move |mut request: Request<()>| {
            request.metadata_mut().insert(proto::VERSION_HEADER, version.parse().unwrap());
            Ok(request)
        }
    };
    let older = CoordinatorClient::with_interceptor(channel.clone(), said("1")).lease(request()).await.unwrap_err();
    for status in [silent, older] {
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert!(status.message().contains("too old") && status.message().contains("update it"), "{status}");
    }
    let newer = CoordinatorClient::with_interceptor(channel, said("99")).lease(request()).await.unwrap_err();
    assert!(newer.message().contains("update the coordinator"), "{newer}");
    // None of them is known as a worker.
    let mut client = proto::connect(&format!("http://{address}"), &Access::default()).unwrap();
    assert!(client.about(proto::AboutRequest {}).await.unwrap().into_inner().backends.is_empty());
    stop.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_too_large_or_no_call_at_all_does_no_harm() {
    let (address, stop) = host("127.0.0.1:0", Security::default()).await;
    let url = format!("http://{address}");
    let channel = Endpoint::from_shared(url.clone()).unwrap().connect_lazy();
    let version = |mut request: Request<()>| {
        request.metadata_mut().insert(proto::VERSION_HEADER, proto::VERSION.into());
        Ok(request)
    };
    // A client that does not keep to the limit itself.
    let mut large = CoordinatorClient::with_interceptor(channel, version).max_encoding_message_size(usize::MAX);
    for bytes in [proto::MESSAGE_BYTES_LIMIT + 1, 8 * proto::MESSAGE_BYTES_LIMIT] {
        let request = proto::SubmitRequest { plan: vec![0; bytes], store_url: String::new() };
        let status = large.submit(request).await.unwrap_err();
        assert!(status.code() == Code::OutOfRange && status.message().contains("too large"), "{status}");
    }
    // Bytes that are no HTTP/2, that begin as such and go on at random, and silence.
    let mut silent = Vec::new();
    for seed in 0..200u64 {
        let mut stream = TcpStream::connect(address).await.unwrap();
        if seed % 3 > 0 {
            stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
        }
        let noise = (0..512u64).flat_map(|i| ArtefactId::of(&(seed << 32 | i).to_le_bytes()).0).collect::<Vec<u8>>();
        // It may have hung up already.
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
