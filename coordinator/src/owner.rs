//! The one owner of all jobs: carries out one call after the other, and lets answers out once what they say is durable.
//!
//! ```text
//! calls ─▶ step the scheduler ─▶ what changed gathers ─▶ one write at a time ─▶ answers and news of all that it made durable
//! ```
//! While a write is under way further calls are carried out and gather for the next: the more there are, the more share one.
//! What waits for a write also waits behind what came before, so nobody is told of a state that could still be lost. Signs of
//! life alone are answered at once; that a lease holds is no news.

use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::jobs::{Due, Jobs};
use crate::metrics::{Leads, Metrics};
use crate::state::{Batch, State, StateError};

/// How often time goes by for the scheduler when nothing else happens.
const TICK: Duration = Duration::from_millis(100);
/// How often the metrics are brought up to date.
const LOOK: Duration = Duration::from_secs(1);

/// A call to the owner: what to do with the jobs, at this many milliseconds since they were opened; or why there are none here.
pub(crate) type Call = Box<dyn FnOnce(Result<(&mut Jobs, u64), Status>) + Send>;
/// Where calls come from.
pub(crate) type Inbox = mpsc::Receiver<Call>;

/// Why it ended without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stopped {
    /// It was told to. All that was taken in is durable.
    Asked,
    /// Another one leads.
    Deposed,
}

type Write<'a> = Pin<Box<dyn Future<Output = Result<(), StateError>> + Send + 'a>>;

/// Owns the jobs until it is stopped or deposed; without a state they live in memory. The only place that reads a clock for
/// the scheduler.
///
/// # Errors
/// A write that failed: what is durable is not known then, so nothing that waits for it is said, and this coordinator is over.
pub(crate) async fn own(
    mut jobs: Jobs,
    state: Option<&State>,
    inbox: &mut Inbox,
    stop: &CancellationToken,
    deposed: &CancellationToken,
) -> Result<Stopped, StateError> {
    let metrics = jobs.metrics();
    let mut leads = metrics.leads(jobs.epoch());
    let ended = own_until(&mut jobs, state, inbox, [stop, deposed], &mut leads).await;
    jobs.measure(&mut leads);
    ended
}

async fn own_until(
    jobs: &mut Jobs,
    state: Option<&State>,
    inbox: &mut Inbox,
    [stop, deposed]: [&CancellationToken; 2],
    leads: &mut Leads<'_>,
) -> Result<Stopped, StateError> {
    let began = Instant::now();
    let mut tick = interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut look = interval(LOOK);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut writing: Option<(Write<'_>, Vec<Due>)> = None;
    loop {
        if writing.is_none() {
            let (batch, due) = jobs.take_gathered();
            match state {
                Some(state) if !batch.is_empty() => {
                    writing = Some((Box::pin(timed(state, batch, leads.metrics())), due))
                }
                _ => jobs.deliver(due),
            }
        }
        let call = tokio::select! {
            biased;
            () = deposed.cancelled() => return Ok(Stopped::Deposed),
            () = stop.cancelled() => break,
            written = under_way(&mut writing) => {
                written?;
                let due = writing.take().map(|(_, due)| due);
                jobs.deliver(due.unwrap_or_default());
                continue;
            }
            _ = look.tick() => {
                jobs.measure(leads);
                continue;
            }
            call = inbox.recv() => match call {
                Some(call) => call,
                None => break,
            },
            _ = tick.tick() => Box::new(|host: Result<(&mut Jobs, u64), Status>| {
                if let Ok((jobs, now)) = host {
                    jobs.tick(now);
                }
            }) as Call,
        };
        call(Ok((&mut *jobs, began.elapsed().as_millis() as u64)));
    }
    if let Some((write, due)) = writing {
        write.await?;
        jobs.deliver(due);
    }
    let (batch, due) = jobs.take_gathered();
    if let Some(state) = state.filter(|_| !batch.is_empty()) {
        timed(state, batch, leads.metrics()).await?;
    }
    jobs.deliver(due);
    Ok(Stopped::Asked)
}

/// Makes a batch durable, and tells what that took.
async fn timed(state: &State, batch: Batch, metrics: &Metrics) -> Result<(), StateError> {
    let began = Instant::now();
    state.write(batch).await?;
    metrics.wrote(began.elapsed());
    Ok(())
}

async fn under_way(writing: &mut Option<(Write<'_>, Vec<Due>)>) -> Result<(), StateError> {
    match writing {
        Some((write, _)) => write.await,
        None => std::future::pending().await,
    }
}
