//! The worker's main loop: lease a task, carry it out, lease the next one.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use proto::lease_reply::Reply;
use tokio_util::sync::CancellationToken;
use tonic::{Response, Status};

use crate::attempt;
use crate::coordinator_link::{CoordinatorLink, is_transient};
use crate::options::{Options, WorkerError};
use crate::task::Execute;

/// Time limit of the call that announces the worker's shutdown. Without it the coordinator notices by the expired lease.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(2);

/// Asks the coordinator for its store and version, and retries until it answers; `None` if `shutdown` is cancelled first.
///
/// # Errors
/// [`WorkerError`].
pub fn greet<'a>(
    options: &'a Options,
    shutdown: &'a CancellationToken,
) -> Pin<Box<dyn Future<Output = Result<Option<proto::AboutReply>, WorkerError>> + Send + 'a>> {
    // Behind a pointer, so that it is compiled once, in this crate; as `coordinator::serve`.
    Box::pin(greet_until(options, shutdown))
}

async fn greet_until(
    options: &Options,
    shutdown: &CancellationToken,
) -> Result<Option<proto::AboutReply>, WorkerError> {
    let mut link = CoordinatorLink::new(options)?;
    while !shutdown.is_cancelled() {
        let answer = tokio::select! {
            biased;
            () = shutdown.cancelled() => break,
            answer = async { link.client().await?.about(proto::AboutRequest {}).await } => answer,
        };
        match answer {
            Ok(about) => return Ok(Some(about.into_inner())),
            Err(status) => back_off(&mut link, options, status, shutdown).await?,
        }
    }
    Ok(None)
}

/// Works until the coordinator has no task left (`Ok`) or `shutdown` is cancelled (`Ok`; the current task is given back). Retries
/// without limit while the coordinator is unreachable; the current task goes on meanwhile.
///
/// # Errors
/// [`WorkerError`].
pub fn run(
    options: Options,
    executor: Arc<dyn Execute>,
    shutdown: CancellationToken,
) -> Pin<Box<dyn Future<Output = Result<(), WorkerError>> + Send>> {
    Box::pin(run_until(options, executor, shutdown))
}

async fn run_until(
    options: Options,
    executor: Arc<dyn Execute>,
    shutdown: CancellationToken,
) -> Result<(), WorkerError> {
    let mut link = CoordinatorLink::new(&options)?;
    // The lease reply that came with the answer to the last task's result.
    let mut next = None;
    while !shutdown.is_cancelled() {
        let request = link.lease_request(&options);
        let answer = match next.take() {
            Some(reply) => Ok(reply),
            None => tokio::select! {
                biased;
                () = shutdown.cancelled() => break,
                answer = async { link.client().await?.lease(request).await } => answer.map(Response::into_inner),
            },
        };
        match answer.map(|answer| answer.reply) {
            Ok(Some(Reply::Grant(grant))) => {
                link.reset_backoff();
                next = attempt::run(&mut link, &options, grant, executor.clone(), &shutdown).await;
            }
            Ok(Some(Reply::WaitMillis(millis))) => {
                link.reset_backoff();
                pause(Duration::from_millis(millis.into()), &shutdown).await;
            }
            Ok(Some(Reply::Drained(_))) => return Ok(()),
            Ok(None) => return Err(WorkerError::Refused("its answer is of a newer protocol version".into())),
            Err(status) => back_off(&mut link, &options, status, &shutdown).await?,
        }
    }
    leave(&mut link, options.worker_id).await;
    Ok(())
}

/// Waits before a failed call is tried again.
///
/// # Errors
/// The coordinator rejects the worker, or one of them rejects the other's certificate: no later call will succeed.
async fn back_off(
    link: &mut CoordinatorLink,
    options: &Options,
    status: Status,
    shutdown: &CancellationToken,
) -> Result<(), WorkerError> {
    if !is_transient(&status) {
        return Err(WorkerError::Refused(proto::explain(&status)));
    }
    let rejected = tokio::select! {
        () = shutdown.cancelled() => None,
        rejected = link.rejected_certificate() => rejected,
    };
    if let Some(rejected) = rejected {
        return Err(rejected.into());
    }
    tracing::warn!(coordinator = options.coordinator_url, "waiting for the coordinator: {}", proto::explain(&status));
    pause(link.disconnect(), shutdown).await;
    Ok(())
}

async fn pause(duration: Duration, shutdown: &CancellationToken) {
    tokio::select! {
        () = shutdown.cancelled() => {}
        () = tokio::time::sleep(duration) => {}
    }
}

/// Announces the shutdown, so that a grant whose answer was not awaited is free at once.
async fn leave(link: &mut CoordinatorLink, worker: String) {
    let left = async { link.client().await?.leave(proto::LeaveRequest { worker }).await };
    if !matches!(tokio::time::timeout(LEAVE_TIMEOUT, left).await, Ok(Ok(_))) {
        tracing::warn!("the coordinator could not be notified that this worker leaves");
    }
}
