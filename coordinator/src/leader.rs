//! Leader election among the coordinators on one store.
//!
//! ```text
//!            lease is absent, released, or stale       
//! standing by ─────────────────────────────────────────▶ taking over ──state open, epoch durable, lease created──▶ leading
//!      ▲                                                      │ fenced                                              │
//!      └──────────────────────────────────────────────────────┴────────── fenced, or a newer lease is there ────────┘
//! ```
//! The lease ([`proto::leader`]) shows others the leader's address and that it is alive. It does not fence: a deposed leader cannot reply
//! before its change is durable, and the state rejects writes of an older epoch.

use std::time::Duration;

use proto::leader::{FOLDER, Leader, name};
use store::{Store, StoreError};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::actor::{Mailbox, Stopped, run_actor};
use crate::jobs::Jobs;
use crate::options::{Durable, GRACE, Options, ServeError};
use crate::state::{Restored, State, StateError};

/// Leases of earlier leaders that are kept, for inspection.
const LEASES_KEPT: u64 = 8;

/// Alternates between standing by and leading until it is stopped or the store fails.
pub(crate) async fn host(
    options: Options,
    durable: Durable,
    mut mailbox: Mailbox,
    stop: CancellationToken,
) -> Result<(), ServeError> {
    let mut was_fenced = false;
    loop {
        let Some(seen) = stand_by(&options.store, &durable, was_fenced, &mut mailbox, &stop).await else {
            return Ok(());
        };
        match lead(&options, &durable, seen, &mut mailbox, &stop).await {
            Err(ServeError::State(StateError::Fenced)) => {
                tracing::warn!("another coordinator leads now: standing by");
                was_fenced = true;
            }
            ended => return ended,
        }
    }
}

/// Waits until there is no leader and returns the highest epoch of a lease, 0 if there is none; `None` once stopped. After being fenced
/// it gives the winner time to create its lease: otherwise several candidates could fence each other in turn for ever. Meanwhile calls
/// are refused with the leader's address.
async fn stand_by(
    store: &Store,
    durable: &Durable,
    mut was_fenced: bool,
    mailbox: &mut Mailbox,
    stop: &CancellationToken,
) -> Option<u64> {
    let mut seen = None;
    let mut since = Instant::now();
    loop {
        let lease = match store.newest_record(FOLDER).await {
            Ok(newest) => {
                let epoch = newest.as_ref().map_or(0, |(epoch, _)| *epoch);
                let lease = newest.as_ref().map(|(epoch, bytes)| Leader::from_bytes(*epoch, bytes));
                let is_free = match &lease {
                    None => true,
                    Some(lease) => lease.as_ref().is_ok_and(|lease| lease.released),
                };
                // Judged by the local clock only, as clocks of other machines may differ.
                if seen.as_ref() != Some(&newest) {
                    was_fenced &= seen.is_none();
                    (seen, since) = (Some(newest), Instant::now());
                } else if since.elapsed() >= durable.patience {
                    tracing::warn!(epoch, "the leader's lease is stale: taking over");
                    return Some(epoch);
                }
                if is_free && !was_fenced {
                    return Some(epoch);
                }
                lease.filter(|_| !is_free).unwrap_or_else(|| Err("it has not written its lease yet".into()))
            }
            Err(error) => {
                // An unreadable lease must not count as a stale one.
                (seen, since) = (None, Instant::now());
                Err(error.to_string())
            }
        };
        let line = match lease {
            Ok(lease) => format!("this coordinator stands by; the one at {} leads", lease.address),
            Err(problem) => format!("this coordinator stands by; the leader is unknown: {problem}"),
        };
        let next_read = sleep(durable.beat);
        tokio::pin!(next_read);
        loop {
            tokio::select! {
                () = stop.cancelled() => return None,
                () = &mut next_read => break,
                call = mailbox.recv() => match call {
                    Some(call) => call(Err(Status::unavailable(line.clone()))),
                    None => return None,
                },
            }
        }
    }
}

/// Takes over and leads, until it is stopped (`Ok`), fenced or the store fails.
async fn lead(
    options: &Options,
    durable: &Durable,
    seen: u64,
    mailbox: &mut Mailbox,
    stop: &CancellationToken,
) -> Result<(), ServeError> {
    let (state, restored) = State::take_over(&options.store, seen).await?;
    let ended = lead_with(options, durable, &state, restored, mailbox, stop).await;
    // Also after an error or a takeover: the database's background tasks must end.
    if timeout(GRACE, state.close()).await.is_err() {
        tracing::warn!("closing the durable state timed out");
    }
    let lease = ended?;
    let released = Leader { beat: u64::MAX, released: true, ..lease };
    if let Err(error) = options.store.put_record(&released.name(), released.to_bytes().into()).await {
        tracing::warn!("the lease could not be released and has to expire: {error}");
    }
    Ok(())
}

/// Leads on an open state. Returns the lease once stopped.
async fn lead_with(
    options: &Options,
    durable: &Durable,
    state: &State,
    restored: Restored,
    mailbox: &mut Mailbox,
    stop: &CancellationToken,
) -> Result<Leader, ServeError> {
    let epoch = state.epoch();
    let began = (options.wall_clock)();
    let jobs =
        Jobs::restore(options.clone(), restored, epoch, began).map_err(|error| state.damaged(&error.to_string()))?;
    let lease = Leader { epoch, address: durable.address.clone(), beat: 0, released: false };
    announce(&options.store, &lease).await?;
    tracing::info!(epoch, jobs = jobs.len(), "leading");
    let deposed = CancellationToken::new();
    // Aborted when it is dropped: no renewal may follow the end of leadership.
    let mut renewal = JoinSet::new();
    renewal.spawn(renew(options.store.clone(), lease.clone(), durable.beat, deposed.clone(), stop.clone()));
    if run_actor(jobs, Some(state), mailbox, stop, &deposed).await? == Stopped::Deposed {
        return Err(StateError::Fenced.into());
    }
    // Stopped by the same token. Its last renewal must not follow the release.
    renewal.join_next().await;
    Ok(lease)
}

/// Creates the lease of a new leader and deletes old leases.
async fn announce(store: &Store, lease: &Leader) -> Result<(), ServeError> {
    let created = store.create_record(&lease.name(), lease.to_bytes().into()).await.map_err(announce_failed(store))?;
    if !created
        && store.get_record(&lease.name()).await.map_err(announce_failed(store))? != Some(lease.to_bytes().into())
    {
        // An epoch is used once per state, so this lease belongs to another state: one was moved away or replaced.
        let problem = format!("the lease {} exists already, of a coordinator with another state", lease.name());
        return Err(StateError::Damaged { store: store.url().into(), problem }.into());
    }
    if let Some(old) = lease.epoch.checked_sub(LEASES_KEPT) {
        store.remove_record(&name(old)).await.map_err(announce_failed(store))?;
    }
    Ok(())
}

fn announce_failed(store: &Store) -> impl Fn(StoreError) -> ServeError {
    let store = store.url().to_owned();
    move |error| StateError::Failed { store: store.clone(), action: "announced", reason: error.to_string() }.into()
}

/// Renews the lease periodically, and cancels `deposed` when a lease of a higher epoch appears.
async fn renew(store: Store, mut lease: Leader, period: Duration, deposed: CancellationToken, stop: CancellationToken) {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        match store.newest_record(FOLDER).await {
            Ok(Some((epoch, _))) if epoch > lease.epoch => return deposed.cancel(),
            Ok(_) => {}
            Err(error) => tracing::warn!("the current lease cannot be read: {error}"),
        }
        lease.beat += 1;
        if let Err(error) = store.put_record(&lease.name(), lease.to_bytes().into()).await {
            tracing::warn!("the lease cannot be renewed: {error}");
        }
    }
}
