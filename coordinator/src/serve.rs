//! Runs the gRPC server and the actor until shutdown.

use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;

use crate::actor::{Mailbox, run_actor};
use crate::jobs::Jobs;
use crate::options::{GRACE, Options, ServeError};
use crate::{leader, security, service};

/// Capacity of the mailbox; further calls wait in their connections.
const MAILBOX_CAPACITY: usize = 1024;
/// Open calls of one connection.
const STREAMS_LIMIT: u32 = 256;
/// Time limit of a call. The longest one reads a plan of a hundred thousand tasks.
const CALL_TIMEOUT: Duration = Duration::from_secs(60);
/// The largest header list of a call, in bytes.
const HEADER_BYTES_LIMIT: u32 = 16 << 10;

/// Serves until `shutdown` ends. Running jobs in memory are lost then, and their watchers' streams end; durable jobs go on under the next
/// coordinator. If the future is dropped, it stops at once without a flush, as if the process had been killed.
///
/// # Errors
/// An address beyond the loopback without certificate and token, an invalid certificate, a listener that fails, a durable state that
/// cannot be read or written.
pub async fn serve(
    listener: TcpListener,
    options: Options,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ServeError> {
    compiled_here(listener, options, Box::pin(shutdown)).await
}

/// The server behind a pointer. The body of an `async fn` is compiled in each crate that awaits it, and of this one that is a database, TLS
/// and HTTP, once more for each test program.
fn compiled_here<'a>(
    listener: TcpListener,
    options: Options,
    shutdown: Pin<Box<dyn Future<Output = ()> + Send + 'a>>,
) -> Pin<Box<dyn Future<Output = Result<(), ServeError>> + Send + 'a>> {
    Box::pin(run(listener, options, shutdown))
}

async fn run(
    listener: TcpListener,
    options: Options,
    shutdown: Pin<Box<dyn Future<Output = ()> + Send + '_>>,
) -> Result<(), ServeError> {
    let address = listener.local_addr()?;
    options.security.check(address)?;
    let guard = options.security.guard();
    let mut builder = tonic::transport::Server::builder()
        .max_concurrent_streams(STREAMS_LIMIT)
        .timeout(CALL_TIMEOUT)
        .http2_keepalive_interval(Some(proto::KEEP_ALIVE))
        .http2_keepalive_timeout(Some(proto::KEEP_ALIVE_TIMEOUT))
        .http2_max_header_list_size(HEADER_BYTES_LIMIT);
    if let Some(tls) = options.security.tls() {
        builder = builder.tls_config(tls).map_err(|error| security::unusable(&error))?;
    }
    let (calls, mailbox) = mpsc::channel(MAILBOX_CAPACITY);
    let stop = CancellationToken::new();
    let service = proto::server(service::Service::new(options.store.clone(), calls), guard);
    // Aborted when it is dropped.
    let mut actor = JoinSet::new();
    actor.spawn(host(options, mailbox, stop.clone()));
    // The health service needs no token: it only shows that the process is alive.
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_service_status(proto::SERVICE_NAME, tonic_health::ServingStatus::Serving).await;
    let server = builder.add_service(health_service).add_service(service).serve_with_incoming_shutdown(
        TcpIncoming::from(listener).with_nodelay(Some(true)),
        stop.clone().cancelled_owned(),
    );
    tokio::pin!(server);
    let (mut served, mut hosted) = (None, None);
    tokio::select! {
        ended = &mut server => served = Some(ended),
        ended = actor.join_next() => hosted = ended,
        () = shutdown => {}
    }
    stop.cancel();
    if served.is_none() {
        served = tokio::time::timeout(GRACE, server).await.ok();
    }
    if hosted.is_none() {
        hosted = actor.join_next().await;
    }
    hosted.map_or(Ok(()), resume_panic)?;
    Ok(served.unwrap_or(Ok(()))?)
}

/// Runs the actor: as one of several coordinators with durable jobs, else alone.
async fn host(options: Options, mut mailbox: Mailbox, stop: CancellationToken) -> Result<(), ServeError> {
    match options.durable.clone() {
        Some(durable) => leader::host(options, durable, mailbox, stop).await,
        None => {
            run_actor(Jobs::new(options), None, &mut mailbox, &stop, &CancellationToken::new()).await?;
            Ok(())
        }
    }
}

/// The actor panics only in debug builds, if an invariant of the scheduler is violated.
fn resume_panic(ended: Result<Result<(), ServeError>, JoinError>) -> Result<(), ServeError> {
    match ended {
        Ok(ended) => ended,
        Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
        Err(_) => Ok(()),
    }
}
