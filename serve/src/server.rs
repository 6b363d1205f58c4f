//! Accepts connections, with or without TLS, and limits what a stranger can hold: connections, the time of a handshake and of a request's
//! headers, idle connections.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::service::TowerToHyperService;
use proto::KeyPair;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use scene::BadInput;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// Connections at a time; further ones wait to be accepted.
const CONNECTIONS_LIMIT: usize = 2048;
/// Time limit of a TLS handshake, and of a request's headers.
const HEADER_TIMEOUT: Duration = Duration::from_secs(10);
/// Bytes of a request's headers, and of HTTP/2 streams that a client has not read.
const HEADER_BYTES: usize = 16 << 10;
const STREAMS: u32 = 64;
const SEND_BUFFER: usize = 256 << 10;

/// The TLS configuration of a certificate.
///
/// # Errors
/// A certificate or key that cannot be used.
pub(crate) fn tls(pair: &KeyPair) -> Result<TlsAcceptor, BadInput> {
    let bad = |error: String| {
        let problem = format!("cannot be used with its key ({error})");
        BadInput::new("--tls-cert", problem, "give a certificate and its private key as PEM")
    };
    let chain = CertificateDer::pem_slice_iter(&pair.certificate).collect::<Result<Vec<_>, _>>();
    let chain = chain.map_err(|error| bad(error.to_string()))?;
    let key = PrivateKeyDer::from_pem_slice(&pair.key).map_err(|error| bad(error.to_string()))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|error| bad(error.to_string()))?
        .with_no_client_auth()
        .with_single_cert(chain, key);
    let mut config = config.map_err(|error| bad(error.to_string()))?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// Serves until `stop`.
pub(crate) async fn run(listener: TcpListener, tls: Option<TlsAcceptor>, router: Router, stop: CancellationToken) {
    let answer = |stream| connection(stream, tls.clone(), router.clone());
    telemetry::accept(listener, CONNECTIONS_LIMIT, answer, stop).await;
}

async fn connection(stream: TcpStream, tls: Option<TlsAcceptor>, router: Router) {
    // Events are small and shall not wait for more.
    let _ = stream.set_nodelay(true);
    match tls {
        None => answer(stream, router).await,
        Some(tls) => {
            if let Ok(Ok(stream)) = tokio::time::timeout(HEADER_TIMEOUT, tls.accept(stream)).await {
                answer(stream, router).await;
            }
        }
    }
}

fn answer(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
) -> impl Future<Output = ()> + Send {
    let mut server = auto::Builder::new(TokioExecutor::new());
    server.http1().timer(TokioTimer::new()).header_read_timeout(HEADER_TIMEOUT).max_buf_size(HEADER_BYTES.max(8192));
    let mut http2 = server.http2();
    http2.timer(TokioTimer::new()).max_concurrent_streams(STREAMS).max_send_buf_size(SEND_BUFFER);
    http2.max_header_list_size(HEADER_BYTES as u32).keep_alive_interval(Some(HEADER_TIMEOUT));
    async move {
        let service = TowerToHyperService::new(router);
        // A browser that leaves is not an error here.
        let _ = server.serve_connection(TokioIo::new(stream), service).await;
    }
}
