//! Whether a store does what a cluster relies on, found out by trying: that of many who create one object at once exactly one
//! does, that what is written is read and listed at once, and how quick it is.
//!
//! Fencing rests on the first alone. Some servers accept the request and get it wrong under load, so nothing is believed that
//! was not seen. Whether an object can be compared and swapped is not asked: nothing here needs it, and many get it wrong.

use std::fmt::Display;
use std::time::Duration;

use bytes::Bytes;
use futures::future::join_all;
use scene::ArtefactId;

use crate::{Store, StoreError};

/// Writers that create one object at the same time.
pub const WRITERS: usize = 16;
/// Objects that they race for, one after the other.
pub const RACES: usize = 12;
/// Objects whose latency is taken.
const SAMPLES: usize = 60;
/// Bytes of such an object.
const SMALL_BYTES: usize = 4096;
/// Bytes of the objects that measure bandwidth.
const LARGE_BYTES: usize = 16 << 20;
/// Above this a durable write takes so long that a coordinator's answers do, too.
const SLOW: Duration = Duration::from_secs(1);

/// How long some requests took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Latency {
    /// Half of them took at most this long.
    pub p50: Duration,
    /// Of a hundred, 99 took at most this long.
    pub p99: Duration,
}

/// What was seen.
#[derive(Debug, Clone, PartialEq)]
pub struct Findings {
    /// Of [`RACES`] races of [`WRITERS`] writers, those with exactly one winner whose object is there.
    pub races_held: usize,
    /// Creating an object, durable when it returns.
    pub create: Latency,
    /// Writing over an object.
    pub overwrite: Latency,
    /// Reading an object.
    pub read: Latency,
    /// Bytes that one large object was written with, per second.
    pub write_bytes_per_second: f64,
    /// Likewise read.
    pub read_bytes_per_second: f64,
    /// Why a cluster must not rely on this store; none: it is fit.
    pub faults: Vec<String>,
    /// What works, and not well.
    pub warnings: Vec<String>,
}

impl Findings {
    /// Whether a cluster can rely on the store.
    pub fn is_fit(&self) -> bool {
        self.faults.is_empty()
    }
}

/// Tries a store out, below a folder of its own that it leaves empty. `tag` (a part of a name) is not used twice at the same
/// time; `clock` is the time since any moment, which never steps back.
///
/// # Errors
/// The store cannot be used at all.
pub async fn examine(store: &Store, tag: &str, clock: &impl Fn() -> Duration) -> Result<Findings, StoreError> {
    let folder = format!("doctor/{tag}");
    let found = try_out(store, &folder, clock).await;
    let left = clean_up(store, &folder).await;
    let mut found = found?;
    if let Err(error) = left {
        found.warnings.push(format!("what was written cannot be deleted again: {error}"));
    }
    Ok(found)
}

async fn try_out(store: &Store, folder: &str, clock: &impl Fn() -> Duration) -> Result<Findings, StoreError> {
    // What cannot be used at all is said as such, and the first connection is not measured.
    store.put_name(&format!("{folder}/first"), Bytes::from_static(b"first")).await?;
    let mut faults = Vec::new();
    let mut races_held = 0;
    for race in 0..RACES {
        match race_for(store, &format!("{folder}/race/{race}")).await? {
            None => races_held += 1,
            Some(fault) if faults.is_empty() => faults.push(fault),
            Some(_) => {}
        }
    }
    faults.extend(what_is_seen(store, folder).await?);

    let timed = |from: Duration| clock().saturating_sub(from);
    let name = |sample: usize| format!("{folder}/small/{sample}");
    let (mut create, mut overwrite, mut read) = (Vec::new(), Vec::new(), Vec::new());
    for sample in 0..SAMPLES {
        let from = clock();
        let created = match store.create_name(&name(sample), noise(sample, SMALL_BYTES)).await {
            // It is said already that this cannot be done.
            Err(_) if !faults.is_empty() => true,
            created => created?,
        };
        create.push(timed(from));
        let from = clock();
        store.put_name(&name(sample), noise(sample + 1, SMALL_BYTES)).await?;
        overwrite.push(timed(from));
        let from = clock();
        let got = store.get_name(&name(sample)).await?;
        read.push(timed(from));
        if !created || got != Some(noise(sample + 1, SMALL_BYTES)) {
            faults.push("an object that was written over is read as it was before".into());
            break;
        }
    }

    let (large, path) = (noise(folder, LARGE_BYTES), format!("{folder}/large"));
    let from = clock();
    store.put_name(&path, large.clone()).await?;
    let write_bytes_per_second = rate(timed(from));
    let from = clock();
    let got = store.get_name(&path).await?;
    let read_bytes_per_second = rate(timed(from));
    if got != Some(large) {
        faults.push(format!("an object of {LARGE_BYTES} bytes comes back changed"));
    }

    let (create, overwrite, read) = (latency(create), latency(overwrite), latency(read));
    let mut warnings = Vec::new();
    if create.p50 > SLOW {
        let seconds = create.p50.as_secs_f64();
        warnings
            .push(format!("half of all durable writes take more than {seconds:.1} s: grants and commits will, too"));
    }
    Ok(Findings {
        races_held,
        create,
        overwrite,
        read,
        write_bytes_per_second,
        read_bytes_per_second,
        faults,
        warnings,
    })
}

/// Has all writers create one object at once. What is wrong, if anything.
async fn race_for(store: &Store, name: &str) -> Result<Option<String>, StoreError> {
    let attempts = (0..WRITERS).map(|writer| store.create_name(name, Bytes::from(format!("writer {writer}"))));
    let attempts = join_all(attempts).await.into_iter().collect::<Result<Vec<bool>, _>>();
    let won = match attempts {
        Ok(won) => won,
        // A server that does not know the request says so each time.
        Err(error) => return Ok(Some(format!("an object cannot be created only where there is none: {error}"))),
    };
    let winners: Vec<usize> = (0..WRITERS).filter(|writer| won[*writer]).collect();
    let there = store.get_name(name).await?;
    Ok(match winners[..] {
        [winner] if there == Some(Bytes::from(format!("writer {winner}"))) => None,
        [_] => Some("the object of the one that was told it had created it is not there".into()),
        _ => Some(format!(
            "of {WRITERS} writers that created one object at the same time, {} were told that they had: two coordinators \
             could lead at once",
            winners.len()
        )),
    })
}

/// Whether what was written is listed, read in parts and gone at once.
async fn what_is_seen(store: &Store, folder: &str) -> Result<Vec<String>, StoreError> {
    let mut faults = Vec::new();
    let below = format!("{folder}/listed");
    let names: Vec<String> = (0..5).map(|number| format!("{below}/{number:06}.json")).collect();
    for name in &names {
        store.put_name(name, Bytes::copy_from_slice(name.as_bytes())).await?;
        if store.newest(&below).await?.map(|(_, bytes)| bytes) != Some(Bytes::copy_from_slice(name.as_bytes())) {
            faults.push("an object that was just written is not listed".into());
            break;
        }
    }
    store.remove_name(&names[0]).await?;
    if store.get_name(&names[0]).await?.is_some() || store.names(&below).await?.contains(&names[0]) {
        faults.push("an object that was just deleted is still there".into());
    }
    let bytes = noise(folder, SMALL_BYTES);
    let id = store.put(bytes.clone()).await?;
    let parts = store.get_ranges(id, &[0..16, 100..1000]).await?;
    if parts != [bytes.slice(0..16), bytes.slice(100..1000)] {
        faults.push("parts of an object are not those that were asked for".into());
    }
    store.remove(id).await?;
    Ok(faults)
}

async fn clean_up(store: &Store, folder: &str) -> Result<(), StoreError> {
    for name in store.names(folder).await? {
        store.remove_name(&name).await?;
    }
    Ok(())
}

/// Bytes that no server can make smaller, others for each label.
fn noise(label: impl Display, length: usize) -> Bytes {
    let block = |number: usize| ArtefactId::of(format!("{label} {number}").as_bytes()).0;
    let mut bytes: Vec<u8> = (0..length.div_ceil(32)).flat_map(block).collect();
    bytes.truncate(length);
    bytes.into()
}

fn rate(taken: Duration) -> f64 {
    LARGE_BYTES as f64 / taken.as_secs_f64().max(1e-9)
}

fn latency(mut times: Vec<Duration>) -> Latency {
    times.sort();
    let of = |permille: usize| times.get((times.len() * permille).div_ceil(1000).saturating_sub(1)).copied();
    Latency { p50: of(500).unwrap_or_default(), p99: of(990).unwrap_or_default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_sorted_times() {
        let times = (1..=100).rev().map(Duration::from_millis).collect();
        assert_eq!(latency(times), Latency { p50: Duration::from_millis(50), p99: Duration::from_millis(99) });
        let one = Duration::from_millis(7);
        assert_eq!(latency(vec![one]), Latency { p50: one, p99: one });
    }
}
