//! Serves Prometheus metrics at `GET /metrics` on an address of its own, without authentication: metrics contain only numbers and labels
//! from bounded sets, no secrets.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{ALLOW, CONTENT_TYPE};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use prometheus_client::encoding::text::encode;
use prometheus_client::registry::Registry;
use scene::BadInput;
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

use crate::accept::accept;

/// Concurrent connections; further ones wait to be accepted.
const CONNECTIONS_LIMIT: usize = 16;
/// Time limit of receiving a request's headers.
const HEADER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of a connection.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(20);
/// The content type of OpenMetrics text.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Binds the metrics address.
///
/// # Errors
/// The address cannot be bound.
pub async fn listen(address: SocketAddr) -> Result<TcpListener, BadInput> {
    TcpListener::bind(address).await.map_err(|error| {
        let advice = "choose another address, or stop the process that uses it";
        BadInput::new(format!("--metrics {address}"), format!("cannot be listened on ({error})"), advice)
    })
}

/// Serves scrapes until `stop` is cancelled.
pub async fn serve(listener: TcpListener, registry: Registry, stop: CancellationToken) {
    let registry = Arc::new(registry);
    let answer = |stream| {
        let registry = registry.clone();
        async move {
            // An early disconnect is not an error here.
            let _ = tokio::time::timeout(CONNECTION_TIMEOUT, answer_one(stream, registry)).await;
        }
    };
    accept(listener, CONNECTIONS_LIMIT, answer, stop).await;
}

async fn answer_one(stream: TcpStream, registry: Arc<Registry>) -> hyper::Result<()> {
    let mut connection = http1::Builder::new();
    connection.timer(TokioTimer::new()).header_read_timeout(HEADER_TIMEOUT).keep_alive(false);
    let registry = &*registry;
    let answer = |request: Request<Incoming>| async move { Ok::<_, Infallible>(answer(&request, registry)) };
    connection.serve_connection(TokioIo::new(stream), service_fn(answer)).await
}

fn answer(request: &Request<Incoming>, registry: &Registry) -> Response<Full<Bytes>> {
    let (status, body) = match (request.method(), request.uri().path()) {
        (&Method::GET, "/metrics") => match text(registry) {
            Ok(text) => (StatusCode::OK, text),
            Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")),
        },
        (_, "/metrics") => (StatusCode::METHOD_NOT_ALLOWED, "only GET\n".into()),
        _ => (StatusCode::NOT_FOUND, "the metrics are at /metrics\n".into()),
    };
    let kind = if status == StatusCode::OK { OPEN_METRICS } else { "text/plain; charset=utf-8" };
    let mut response = Response::new(Full::new(Bytes::from(body)));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, kind.parse().expect("a constant"));
    if status == StatusCode::METHOD_NOT_ALLOWED {
        response.headers_mut().insert(ALLOW, "GET".parse().expect("a constant"));
    }
    response
}

/// The metrics as OpenMetrics text.
///
/// # Errors
/// A metric cannot be encoded.
pub fn text(registry: &Registry) -> Result<String, std::fmt::Error> {
    let mut text = String::new();
    encode(&mut text, registry)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use prometheus_client::metrics::counter::Counter;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    #[tokio::test]
    async fn only_the_metrics_are_served() {
        let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let address = listener.local_addr().unwrap();
        assert!(listen(address).await.unwrap_err().to_string().starts_with("--metrics 127.0.0.1:"));
        let mut registry = Registry::default();
        let requests = Counter::<u64>::default();
        registry.register("plat_asked", "How often", requests.clone());
        requests.inc_by(41);
        let stop = CancellationToken::new();
        let serving = tokio::spawn(serve(listener, registry, stop.clone()));
        let ask = async |words: &str| {
            let mut stream = TcpStream::connect(address).await.unwrap();
            stream.write_all(words.as_bytes()).await.unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).await.unwrap();
            answer
        };
        // Idle connections up to the limit, less one.
        let mut silent = Vec::new();
        for _ in 1..CONNECTIONS_LIMIT {
            silent.push(TcpStream::connect(address).await.unwrap());
        }
        let answer = ask("GET /metrics HTTP/1.1\r\nHost: a\r\n\r\n").await;
        assert!(answer.starts_with("HTTP/1.1 200 ") && answer.contains("openmetrics-text"), "{answer}");
        assert!(answer.contains("plat_asked_total 41\n") && answer.ends_with("# EOF\n"), "{answer}");
        for (words, status) in [
            ("POST /metrics HTTP/1.1\r\nHost: a\r\nContent-Length: 0\r\n\r\n", "HTTP/1.1 405 "),
            ("GET /secrets HTTP/1.1\r\nHost: a\r\n\r\n", "HTTP/1.1 404 "),
            ("GET  nonsense\r\n\r\n", "HTTP/1.1 400 "),
        ] {
            let answer = ask(words).await;
            assert!(answer.starts_with(status), "{words}: {answer}");
        }
        stop.cancel();
        serving.await.unwrap();
        assert!(TcpStream::connect(address).await.is_err());
    }
}
