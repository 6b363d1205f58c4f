//! Runs one attempt: the compute on a blocking thread, the heartbeat beside it, and the delivery of the outcome.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use proto::{FailureKind, REPORTS_LIMIT};
use telemetry::{TraceParent, traced};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tracing::field::Empty;
use tracing::{Instrument, Span};

use crate::coordinator_link::{CoordinatorLink, is_transient};
use crate::options::Options;
use crate::task::{Execute, ExecuteError, FULL_RATE, Flow, Report, TaskOrder};

/// Interval at which queued reports are sent.
const REPORT_PERIOD: Duration = Duration::from_millis(250);
/// Heartbeats per lease.
const HEARTBEATS_PER_LEASE: u32 = 4;
/// Tries to deliver the outcome before the lease is left to expire: about half a minute.
const OUTCOME_TRIES: u32 = 13;

/// Carries out a grant and delivers its outcome. Returns the reply to the lease request that goes with the outcome, if there is one.
/// Connection errors are logged, not returned: the lease expires and the coordinator grants the task again.
pub(crate) async fn run(
    link: &mut CoordinatorLink,
    options: &Options,
    grant: proto::Grant,
    executor: Arc<dyn Execute>,
    shutdown: &CancellationToken,
) -> Option<proto::LeaseReply> {
    let lease = Duration::from_millis(grant.lease_millis.into());
    let parent = TraceParent::parse(&grant.traceparent);
    let Some((key, order)) = order_of(grant) else {
        tracing::error!("dropped a malformed grant");
        tokio::time::sleep(REPORT_PERIOD).await;
        return None;
    };
    link.observe_epoch(key.epoch);
    let proto::Attempt { job, task, number: attempt, .. } = key;
    // At the highest level, so that every event within it carries the attempt's fields.
    let worker = &options.worker_id;
    let span = tracing::error_span!("task", job, task, attempt, worker, artefact = Empty, otel.status_code = Empty);
    parent.iter().for_each(|parent| parent.adopt(&span));
    carry_out(link, options, (key, order), lease, executor, shutdown).instrument(span).await
}

async fn carry_out(
    link: &mut CoordinatorLink,
    options: &Options,
    (key, order): (proto::Attempt, TaskOrder),
    lease: Duration,
    executor: Arc<dyn Execute>,
    shutdown: &CancellationToken,
) -> Option<proto::LeaseReply> {
    tracing::info!("begins");
    let stop = Arc::new(AtomicBool::new(false));
    let (sender, mut reports) = mpsc::channel(REPORTS_LIMIT);
    let mut work = {
        let (stop, span) = (stop.clone(), Span::current());
        tokio::task::spawn_blocking(move || {
            let mut report = |report: Report| {
                // The channel is full while the coordinator is unreachable: the report is dropped, the compute goes on.
                let _ = sender.try_send(to_wire(report));
                if stop.load(Ordering::Relaxed) { Flow::Stop } else { Flow::Continue }
            };
            span.in_scope(|| executor.execute(&order, &mut report))
        })
    };

    let max_silence = lease / HEARTBEATS_PER_LEASE;
    let mut heartbeat = tokio::time::interval(REPORT_PERIOD.min(max_silence).max(Duration::from_millis(1)));
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last_call = Instant::now();
    // Set while the coordinator does not answer: the pause before the next try.
    let mut retry_after: Option<Duration> = None;
    let (mut is_void, mut is_leaving) = (false, false);
    let result = loop {
        tokio::select! {
            biased;
            result = &mut work => break result,
            () = shutdown.cancelled(), if !is_leaving => {
                is_leaving = true;
                stop.store(true, Ordering::Relaxed);
            }
            _ = heartbeat.tick(), if !is_void => {
                let is_due = match retry_after {
                    Some(retry_after) => last_call.elapsed() >= retry_after,
                    None => !reports.is_empty() || last_call.elapsed() >= max_silence,
                };
                if is_due {
                    let answer = send_reports(link, key, &mut reports).await;
                    last_call = Instant::now();
                    retry_after = if let LeaseStatus::Unknown { retry_after } = answer { Some(retry_after) } else { None };
                    is_void = answer == LeaseStatus::Void;
                    if is_void {
                        tracing::warn!("the attempt is void, stopping");
                        stop.store(true, Ordering::Relaxed);
                    }
                }
            }
        }
    };
    if !is_void {
        while !reports.is_empty() && send_reports(link, key, &mut reports).await == LeaseStatus::Held {}
    }
    if is_void {
        return None;
    }
    let result = result.unwrap_or_else(|error| {
        let message = if error.is_panic() { panic_text(&*error.into_panic()) } else { error.to_string() };
        Err(ExecuteError::work(message))
    });
    match &result {
        Ok(artefact) => {
            Span::current().record("artefact", tracing::field::display(artefact));
            tracing::info!(%artefact, "done");
        }
        Err(error) => {
            Span::current().record("otel.status_code", "ERROR");
            tracing::warn!("ends without a result: {error}");
        }
    }
    let then = (!shutdown.is_cancelled()).then(|| link.lease_request(options));
    deliver_outcome(link, key, result, is_leaving, then).await
}

fn order_of(grant: proto::Grant) -> Option<(proto::Attempt, TaskOrder)> {
    let key = grant.attempt?;
    let input = |input: &proto::Input| Some((input.task, proto::artefact_id(&input.artefact).ok()?));
    let order = TaskOrder {
        job: key.job,
        plan: proto::artefact_id(&grant.plan).ok()?,
        task: key.task,
        attempt: key.number,
        inputs: grant.inputs.iter().map(input).collect::<Option<_>>()?,
        rate_permille: if grant.rate_permille == 0 { FULL_RATE } else { grant.rate_permille.min(FULL_RATE) },
    };
    Some((key, order))
}

fn to_wire(report: Report) -> proto::Report {
    let finite = |value: f64| if value.is_finite() { value } else { 0.0 };
    proto::Report {
        step: report.step,
        steps: report.steps,
        loss: Some(report.loss).filter(|loss| loss.is_finite()),
        splats: report.splats,
        cpu_seconds: finite(report.cpu_seconds),
        wall_seconds: finite(report.wall_seconds),
        psnr: report.psnr.filter(|psnr| psnr.is_finite()),
        merged_splats: report.merged_splats,
        aligned_loss: report.aligned.and_then(|aligned| aligned.loss).filter(|loss| loss.is_finite()),
        aligned_cpu_seconds: report.aligned.map(|aligned| finite(aligned.cpu_seconds)),
    }
}

/// The state of an attempt's lease, as the answer to a report shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
enum LeaseStatus {
    /// The attempt holds its lease.
    Held,
    /// The attempt has lost its lease.
    Void,
    /// The coordinator did not answer.
    Unknown { retry_after: Duration },
}

/// Sends the queued reports, or an empty heartbeat.
async fn send_reports(
    link: &mut CoordinatorLink,
    key: proto::Attempt,
    queue: &mut mpsc::Receiver<proto::Report>,
) -> LeaseStatus {
    let reports = std::iter::from_fn(|| queue.try_recv().ok()).take(REPORTS_LIMIT).collect();
    let request = proto::ReportRequest { attempt: Some(key), reports };
    let answer = async { link.client().await?.report(request).await }.await;
    match answer {
        Ok(reply) => {
            link.reset_backoff();
            if reply.into_inner().cancelled { LeaseStatus::Void } else { LeaseStatus::Held }
        }
        // The coordinator no longer knows the job. Any other error may pass.
        Err(status) if status.code() == Code::NotFound => LeaseStatus::Void,
        Err(status) => {
            tracing::warn!("no answer to a report: {}", status.message());
            LeaseStatus::Unknown { retry_after: link.disconnect() }
        }
    }
}

async fn deliver_outcome(
    link: &mut CoordinatorLink,
    key: proto::Attempt,
    result: Result<scene::ArtefactId, ExecuteError>,
    is_leaving: bool,
    then: Option<proto::LeaseRequest>,
) -> Option<proto::LeaseReply> {
    for _ in 0..OUTCOME_TRIES {
        let answer = match &result {
            Ok(artefact) => {
                let (attempt, artefact) = (Some(key), artefact.0.to_vec());
                let request = proto::CompleteRequest { attempt, artefact, then: then.clone() };
                async { link.client().await?.complete(traced(request)).await }.await
            }
            Err(error) => {
                let kind = if is_leaving { FailureKind::GivenBack } else { error.kind };
                let message = proto::one_line(&error.message);
                let request = proto::FailRequest { attempt: Some(key), message, kind: kind.into() };
                async { link.client().await?.fail(traced(request)).await }.await
            }
        };
        match answer {
            Ok(reply) => {
                link.reset_backoff();
                if !reply.get_ref().accepted {
                    tracing::warn!("the coordinator refuses the result of a stale attempt");
                }
                return reply.into_inner().next;
            }
            Err(status) if is_transient(&status) => tokio::time::sleep(link.disconnect()).await,
            Err(status) => {
                tracing::warn!("{}", status.message());
                return None;
            }
        }
    }
    tracing::warn!("the outcome could not be delivered; the lease is left to expire");
    None
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!("panicked: {}", text.unwrap_or("without a message"))
}
