//! Who leads, of several coordinators on one store:
//!
//! ```text
//!            lease is away, released, or beats no more
//! standing by ─────────────────────────────────────────▶ taking over ──state open, epoch durable, lease created──▶ leading
//!      ▲                                                      │ fenced                                              │
//!      └──────────────────────────────────────────────────────┴────────── fenced, or a newer lease is there ────────┘
//! ```
//! The lease ([`proto::leader`]) tells others where the leader is and that it lives. It decides nothing: a coordinator that
//! thinks that it still leads can say only what it could make durable, and the state lets no older epoch write.

use std::time::Duration;

use proto::leader::{FOLDER, Leader, name};
use store::{Store, StoreError};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::jobs::Jobs;
use crate::owner::{Inbox, Stopped, own};
use crate::state::{Restored, State, StateError};
use crate::{Durable, GRACE, Options, ServeError};

/// Leases of earlier leaders that are kept, to look at.
const LEASES_KEPT: u64 = 8;

/// Stands by, leads, stands by again, until it is stopped or the store fails.
pub(crate) async fn host(
    options: Options,
    durable: Durable,
    mut inbox: Inbox,
    stop: CancellationToken,
) -> Result<(), ServeError> {
    let mut beaten = false;
    loop {
        let Some(seen) = stand_by(&options.store, &durable, beaten, &mut inbox, &stop).await else { return Ok(()) };
        match lead(&options, &durable, seen, &mut inbox, &stop).await {
            Err(ServeError::State(StateError::Fenced)) => {
                tracing::warn!("another coordinator leads now: standing by");
                beaten = true;
            }
            ended => return ended,
        }
    }
}

/// Waits until nobody leads: the highest epoch that a lease names, 0 if there is none; `None` once stopped. Who was `beaten` gives
/// the winner time to create its lease: of many that take over at once, each could fence the one before it for ever. Calls are
/// answered meanwhile: by saying who leads.
async fn stand_by(
    store: &Store,
    durable: &Durable,
    mut beaten: bool,
    inbox: &mut Inbox,
    stop: &CancellationToken,
) -> Option<u64> {
    let mut seen = None;
    let mut since = Instant::now();
    loop {
        let lease = match store.newest_record(FOLDER).await {
            Ok(newest) => {
                let epoch = newest.as_ref().map_or(0, |(epoch, _)| *epoch);
                let lease = newest.as_ref().map(|(epoch, bytes)| Leader::from_bytes(*epoch, bytes));
                let free = match &lease {
                    None => true,
                    Some(lease) => lease.as_ref().is_ok_and(|lease| lease.released),
                };
                // By this clock alone: those of other machines may say anything.
                if seen.as_ref() != Some(&newest) {
                    beaten &= seen.is_none();
                    (seen, since) = (Some(newest), Instant::now());
                } else if since.elapsed() >= durable.patience {
                    tracing::warn!(epoch, "the leader is silent: taking over");
                    return Some(epoch);
                }
                if free && !beaten {
                    return Some(epoch);
                }
                lease.filter(|_| !free).unwrap_or_else(|| Err("it has yet to say so".into()))
            }
            Err(error) => {
                // Who cannot see the lease must not judge by its silence.
                (seen, since) = (None, Instant::now());
                Err(error.to_string())
            }
        };
        let line = match lease {
            Ok(lease) => format!("this coordinator stands by; the one at {} leads", lease.address),
            Err(problem) => format!("this coordinator stands by; who leads is not known: {problem}"),
        };
        let look_again = sleep(durable.beat);
        tokio::pin!(look_again);
        loop {
            tokio::select! {
                () = stop.cancelled() => return None,
                () = &mut look_again => break,
                call = inbox.recv() => match call {
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
    inbox: &mut Inbox,
    stop: &CancellationToken,
) -> Result<(), ServeError> {
    let (state, restored) = State::take_over(&options.store, seen).await?;
    let ended = lead_with(options, durable, &state, restored, inbox, stop).await;
    // Also of a state that failed or is another's by now: what it does in the background must end.
    if timeout(GRACE, state.close()).await.is_err() {
        tracing::warn!("the durable state is not closed in time, and left");
    }
    let lease = ended?;
    let released = Leader { beat: u64::MAX, released: true, ..lease };
    if let Err(error) = options.store.put_record(&released.name(), released.to_bytes().into()).await {
        tracing::warn!("the lease is left to run out: {error}");
    }
    Ok(())
}

/// Leads on an open state; the lease, once stopped.
async fn lead_with(
    options: &Options,
    durable: &Durable,
    state: &State,
    restored: Restored,
    inbox: &mut Inbox,
    stop: &CancellationToken,
) -> Result<Leader, ServeError> {
    let epoch = state.epoch();
    let jobs = Jobs::restore(options.clone(), restored, epoch).map_err(|error| state.damaged(&error.to_string()))?;
    let lease = Leader { epoch, address: durable.address.clone(), beat: 0, released: false };
    announce(&options.store, &lease).await?;
    tracing::info!(epoch, jobs = jobs.len(), "leading");
    let deposed = CancellationToken::new();
    // Aborted when it is dropped: whatever way this ends, the heart must not go on.
    let mut heart = JoinSet::new();
    heart.spawn(beat(options.store.clone(), lease.clone(), durable.beat, deposed.clone(), stop.clone()));
    if own(jobs, Some(state), inbox, stop, &deposed).await? == Stopped::Deposed {
        return Err(StateError::Fenced.into());
    }
    // It stops for the same reason; its last beat must not come after the release.
    heart.join_next().await;
    Ok(lease)
}

/// Creates the lease of a new leader, and deletes those that nobody looks at any more.
async fn announce(store: &Store, lease: &Leader) -> Result<(), ServeError> {
    let created = store.create_record(&lease.name(), lease.to_bytes().into()).await.map_err(of_store(store))?;
    if !created && store.get_record(&lease.name()).await.map_err(of_store(store))? != Some(lease.to_bytes().into()) {
        // Its number is that of an epoch which nobody else can have; the state was moved away, or another one's lies here.
        let what = format!("the lease {} is there, of a coordinator with another state", lease.name());
        return Err(StateError::Damaged { store: store.url().into(), what }.into());
    }
    if let Some(old) = lease.epoch.checked_sub(LEASES_KEPT) {
        store.remove_record(&name(old)).await.map_err(of_store(store))?;
    }
    Ok(())
}

fn of_store(store: &Store) -> impl Fn(StoreError) -> ServeError {
    let store = store.url().to_owned();
    move |error| StateError::Failed { store: store.clone(), action: "announced", reason: error.to_string() }.into()
}

/// Shows that the leader lives, and looks whether it still is the one.
async fn beat(store: Store, mut lease: Leader, period: Duration, deposed: CancellationToken, stop: CancellationToken) {
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
            Err(error) => tracing::warn!("who leads cannot be read: {error}"),
        }
        lease.beat += 1;
        if let Err(error) = store.put_record(&lease.name(), lease.to_bytes().into()).await {
            tracing::warn!("the lease cannot be renewed: {error}");
        }
    }
}
