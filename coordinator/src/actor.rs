//! The actor that owns all jobs: executes calls in order, and releases their replies once the changes are durable.
//!
//! ```text
//! calls ─▶ step the scheduler ─▶ changes collect in a batch ─▶ one write at a time ─▶ replies and updates of that batch
//! ```
//! This is group commit: while a write is in flight, further calls are executed and their changes collect in the next batch. Replies and
//! updates are released in order, so no client sees a state that could still be lost. Heartbeats are answered at once, as they change
//! nothing durable.

use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::jobs::{Jobs, Pending};
use crate::metrics::{LeaderMetrics, Metrics};
use crate::state::{Batch, State, StateError};

/// Interval of the scheduler's ticks.
const TICK: Duration = Duration::from_millis(100);
/// Interval at which the metrics are updated.
const METRICS_PERIOD: Duration = Duration::from_secs(1);

/// A message to the actor: a function of the jobs and the milliseconds since the actor started, or of the reason why this coordinator
/// does not lead.
pub(crate) type Call = Box<dyn FnOnce(Result<(&mut Jobs, u64), Status>) + Send>;
/// The actor's mailbox.
pub(crate) type Mailbox = mpsc::Receiver<Call>;

/// Why the actor ended without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stopped {
    /// Shutdown was requested. All executed calls are durable.
    Requested,
    /// Another coordinator leads.
    Deposed,
}

type Write<'a> = Pin<Box<dyn Future<Output = Result<(), StateError>> + Send + 'a>>;

/// Runs the actor until it is stopped or deposed; without a state the jobs live in memory. The only place that reads the scheduler's
/// clock.
///
/// # Errors
/// A failed write. It is then unknown what is durable, so no pending reply is sent and this coordinator has to end.
pub(crate) async fn run_actor(
    mut jobs: Jobs,
    state: Option<&State>,
    mailbox: &mut Mailbox,
    stop: &CancellationToken,
    deposed: &CancellationToken,
) -> Result<Stopped, StateError> {
    let metrics = jobs.metrics();
    let mut leading = metrics.start_leading(jobs.epoch());
    let ended = run_until(&mut jobs, state, mailbox, [stop, deposed], &mut leading).await;
    jobs.update_metrics(&mut leading);
    ended
}

async fn run_until(
    jobs: &mut Jobs,
    state: Option<&State>,
    mailbox: &mut Mailbox,
    [stop, deposed]: [&CancellationToken; 2],
    leading: &mut LeaderMetrics<'_>,
) -> Result<Stopped, StateError> {
    let started = Instant::now();
    let mut tick = interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut update_metrics = interval(METRICS_PERIOD);
    update_metrics.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut writing: Option<(Write<'_>, Vec<Pending>)> = None;
    loop {
        if writing.is_none() {
            let (batch, due) = jobs.take_batch();
            match state {
                Some(state) if !batch.is_empty() => {
                    writing = Some((Box::pin(write_timed(state, batch, leading.metrics())), due))
                }
                _ => jobs.release(due),
            }
        }
        let call = tokio::select! {
            biased;
            () = deposed.cancelled() => return Ok(Stopped::Deposed),
            () = stop.cancelled() => break,
            written = write_finished(&mut writing) => {
                written?;
                let due = writing.take().map(|(_, due)| due);
                jobs.release(due.unwrap_or_default());
                continue;
            }
            _ = update_metrics.tick() => {
                jobs.update_metrics(leading);
                continue;
            }
            call = mailbox.recv() => match call {
                Some(call) => call,
                None => break,
            },
            _ = tick.tick() => Box::new(|host: Result<(&mut Jobs, u64), Status>| {
                if let Ok((jobs, now)) = host {
                    jobs.tick(now);
                }
            }) as Call,
        };
        call(Ok((&mut *jobs, started.elapsed().as_millis() as u64)));
    }
    if let Some((write, due)) = writing {
        write.await?;
        jobs.release(due);
    }
    let (batch, due) = jobs.take_batch();
    if let Some(state) = state.filter(|_| !batch.is_empty()) {
        write_timed(state, batch, leading.metrics()).await?;
    }
    jobs.release(due);
    Ok(Stopped::Requested)
}

/// Makes a batch durable and records how long that took.
async fn write_timed(state: &State, batch: Batch, metrics: &Metrics) -> Result<(), StateError> {
    let began = Instant::now();
    state.write(batch).await?;
    metrics.observe_write(began.elapsed());
    Ok(())
}

async fn write_finished(writing: &mut Option<(Write<'_>, Vec<Pending>)>) -> Result<(), StateError> {
    match writing {
        Some((write, _)) => write.await,
        None => std::future::pending().await,
    }
}
