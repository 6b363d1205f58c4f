//! One attempt: the compute on a blocking thread, the heartbeat beside it, and the last word to the coordinator.

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

use crate::link::Link;
use crate::{Execute, ExecuteError, FULL_RATE, Flow, Options, Report, TaskOrder, asks, is_passing};

/// News go out this often, if there are any.
const NEWS_PERIOD: Duration = Duration::from_millis(250);
/// Signs of life per lease.
const BEATS_PER_LEASE: u32 = 4;
/// Tries to deliver the last word before the lease is left to expire: about half a minute.
const LAST_WORD_TRIES: u32 = 13;

/// Carries out what was granted, says how it ended, and returns what the coordinator answered to the worker's asking for more, if
/// it did. Troubles on the wire are logged, not returned: the lease expires and the coordinator grants the task anew.
pub(crate) async fn run(
    link: &mut Link,
    options: &Options,
    grant: proto::Grant,
    executor: Arc<dyn Execute>,
    shutdown: &CancellationToken,
) -> Option<proto::LeaseReply> {
    let lease = Duration::from_millis(grant.lease_millis.into());
    let parent = TraceParent::parse(&grant.traceparent);
    let Some((key, order)) = order_of(grant) else {
        tracing::error!("a grant that makes no sense was dropped");
        tokio::time::sleep(NEWS_PERIOD).await;
        return None;
    };
    link.saw(key.epoch);
    let proto::Attempt { job, task, number: attempt, .. } = key;
    // Of the highest level, so that whatever is logged within says of which attempt it is.
    let worker = &options.worker_id;
    let span = tracing::error_span!("task", job, task, attempt, worker, artefact = Empty, otel.status_code = Empty);
    parent.iter().for_each(|parent| parent.adopt(&span));
    carry_out(link, options, (key, order), lease, executor, shutdown).instrument(span).await
}

async fn carry_out(
    link: &mut Link,
    options: &Options,
    (key, order): (proto::Attempt, TaskOrder),
    lease: Duration,
    executor: Arc<dyn Execute>,
    shutdown: &CancellationToken,
) -> Option<proto::LeaseReply> {
    tracing::info!("begins");
    let stop = Arc::new(AtomicBool::new(false));
    let (sender, mut news) = mpsc::channel(REPORTS_LIMIT);
    let mut work = {
        let (stop, span) = (stop.clone(), Span::current());
        tokio::task::spawn_blocking(move || {
            let mut report = |report: Report| {
                // A full channel means that the coordinator is away: the line is lost, the compute goes on.
                let _ = sender.try_send(to_wire(report));
                if stop.load(Ordering::Relaxed) { Flow::Stop } else { Flow::Continue }
            };
            span.in_scope(|| executor.execute(&order, &mut report))
        })
    };

    let longest_silence = lease / BEATS_PER_LEASE;
    let mut beat = tokio::time::interval(NEWS_PERIOD.min(longest_silence).max(Duration::from_millis(1)));
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last_call = Instant::now();
    // How long to wait before it is looked for again who leads, where nobody answered.
    let mut pause: Option<Duration> = None;
    let (mut void, mut leaving) = (false, false);
    let result = loop {
        tokio::select! {
            biased;
            result = &mut work => break result,
            () = shutdown.cancelled(), if !leaving => {
                leaving = true;
                stop.store(true, Ordering::Relaxed);
            }
            _ = beat.tick(), if !void => {
                let due = match pause {
                    Some(pause) => last_call.elapsed() >= pause,
                    None => !news.is_empty() || last_call.elapsed() >= longest_silence,
                };
                if due {
                    let told = tell(link, key, &mut news).await;
                    last_call = Instant::now();
                    pause = if let Told::Nobody(pause) = told { Some(pause) } else { None };
                    void = told == Told::Void;
                    if void {
                        tracing::warn!("the attempt is void, stopping");
                        stop.store(true, Ordering::Relaxed);
                    }
                }
            }
        }
    };
    if !void {
        while !news.is_empty() && tell(link, key, &mut news).await == Told::Counts {}
    }
    if void {
        return None;
    }
    let result = result.unwrap_or_else(|error| {
        let message = if error.is_panic() { panic_text(&*error.into_panic()) } else { error.to_string() };
        Err(ExecuteError::of(FailureKind::Work, message))
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
    let then = (!shutdown.is_cancelled()).then(|| asks(options, link));
    say_last_word(link, key, result, leaving, then).await
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
    }
}

/// What came of a report.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Told {
    /// The attempt holds its lease.
    Counts,
    /// It does not.
    Void,
    /// Nobody answered; the next try after this long.
    Nobody(Duration),
}

/// Sends the waiting news, or a mere sign of life.
async fn tell(link: &mut Link, key: proto::Attempt, news: &mut mpsc::Receiver<proto::Report>) -> Told {
    let reports = std::iter::from_fn(|| news.try_recv().ok()).take(REPORTS_LIMIT).collect();
    let request = proto::ReportRequest { attempt: Some(key), reports };
    let answer = async { link.client().await?.report(request).await }.await;
    match answer {
        Ok(reply) => {
            link.found();
            if reply.into_inner().cancelled { Told::Void } else { Told::Counts }
        }
        // A coordinator that does not know the job has forgotten it; any other trouble may pass.
        Err(status) if status.code() == Code::NotFound => Told::Void,
        Err(status) => {
            tracing::warn!("no answer to a report: {}", status.message());
            Told::Nobody(link.lost())
        }
    }
}

async fn say_last_word(
    link: &mut Link,
    key: proto::Attempt,
    result: Result<scene::ArtefactId, ExecuteError>,
    leaving: bool,
    then: Option<proto::LeaseRequest>,
) -> Option<proto::LeaseReply> {
    for _ in 0..LAST_WORD_TRIES {
        let answer = match &result {
            Ok(artefact) => {
                let (attempt, artefact) = (Some(key), artefact.0.to_vec());
                let request = proto::CompleteRequest { attempt, artefact, then: then.clone() };
                async { link.client().await?.complete(traced(request)).await }.await
            }
            Err(error) => {
                let kind = if leaving { FailureKind::GivenBack } else { error.kind };
                let message = proto::one_line(&error.message);
                let request = proto::FailRequest { attempt: Some(key), message, kind: kind.into() };
                async { link.client().await?.fail(traced(request)).await }.await
            }
        };
        match answer {
            Ok(reply) => {
                link.found();
                if !reply.get_ref().accepted {
                    tracing::warn!("the coordinator refuses the result of a stale attempt");
                }
                return reply.into_inner().next;
            }
            Err(status) if is_passing(&status) => tokio::time::sleep(link.lost()).await,
            Err(status) => {
                tracing::warn!("{}", status.message());
                return None;
            }
        }
    }
    tracing::warn!("the coordinator could not be told how it ended");
    None
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!("panicked: {}", text.unwrap_or("without a message"))
}
