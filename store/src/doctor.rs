//! Tests whether a store has the properties that a cluster relies on, and measures its latency and bandwidth.
//!
//! A cluster needs an exclusive create (of concurrent creates of one object exactly one succeeds) and read-after-write and
//! list-after-write consistency. The coordinator's fencing depends on the exclusive create. Some servers accept the request
//! and violate it under load, so the test races writers. Compare-and-swap is not tested: nothing here needs it.

use std::fmt::Display;
use std::time::Duration;

use bytes::Bytes;
use futures::future::join_all;
use scene::ArtefactId;

use crate::{Store, StoreError};

/// Concurrent writers of a race.
pub const WRITERS: usize = 16;
/// Races, one after the other.
pub const RACES: usize = 12;
/// Objects whose latency is measured.
const SAMPLES: usize = 60;
/// Bytes of an object whose latency is measured.
const SMALL_BYTES: usize = 4096;
/// Bytes of the object whose bandwidth is measured.
const LARGE_BYTES: usize = 16 << 20;
/// A median durable write above this slows the coordinator's replies noticeably.
const SLOW_WRITE: Duration = Duration::from_secs(1);

/// Percentiles of request latency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Latency {
    /// Median.
    pub p50: Duration,
    /// 99th percentile.
    pub p99: Duration,
}

/// Results of an examination.
#[derive(Debug, Clone, PartialEq)]
pub struct Findings {
    /// Of [`RACES`] races of [`WRITERS`] writers, those with exactly one winner whose object is stored.
    pub races_held: usize,
    /// Exclusive create of an object, durable when it returns.
    pub create: Latency,
    /// Overwriting an object.
    pub overwrite: Latency,
    /// Reading an object.
    pub read: Latency,
    /// Write bandwidth of one large object, bytes per second.
    pub write_bytes_per_second: f64,
    /// Read bandwidth of one large object, bytes per second.
    pub read_bytes_per_second: f64,
    /// Violated properties; empty if a cluster can rely on the store.
    pub faults: Vec<String>,
    /// Properties that hold but limit a cluster.
    pub warnings: Vec<String>,
}

impl Findings {
    /// Whether a cluster can rely on the store.
    pub fn is_fit(&self) -> bool {
        self.faults.is_empty()
    }
}

/// Examines a store, using records below `doctor/<tag>`, which are deleted afterwards. Concurrent examinations need different
/// tags. `clock` is monotonic time since any moment.
///
/// # Errors
/// The store cannot be used at all.
pub async fn examine(store: &Store, tag: &str, clock: &impl Fn() -> Duration) -> Result<Findings, StoreError> {
    let folder = format!("doctor/{tag}");
    let findings = run_tests(store, &folder, clock).await;
    let cleaned = clean_up(store, &folder).await;
    let mut findings = findings?;
    if let Err(error) = cleaned {
        findings.warnings.push(format!("the test objects cannot be deleted: {error}"));
    }
    Ok(findings)
}

async fn run_tests(store: &Store, folder: &str, clock: &impl Fn() -> Duration) -> Result<Findings, StoreError> {
    // An unusable store fails here, and the connection is established before the measurements.
    store.put_record(&format!("{folder}/first"), Bytes::from_static(b"first")).await?;
    let mut faults = Vec::new();
    let mut races_held = 0;
    for number in 0..RACES {
        match race(store, &format!("{folder}/race/{number}")).await? {
            None => races_held += 1,
            Some(fault) if faults.is_empty() => faults.push(fault),
            Some(_) => {}
        }
    }
    faults.extend(check_consistency(store, folder).await?);

    let timed = |from: Duration| clock().saturating_sub(from);
    let name = |sample: usize| format!("{folder}/small/{sample}");
    let (mut create, mut overwrite, mut read) = (Vec::new(), Vec::new(), Vec::new());
    for sample in 0..SAMPLES {
        let from = clock();
        let created = match store.create_record(&name(sample), noise(sample, SMALL_BYTES)).await {
            // A missing exclusive create is in the faults already.
            Err(_) if !faults.is_empty() => true,
            created => created?,
        };
        create.push(timed(from));
        let from = clock();
        store.put_record(&name(sample), noise(sample + 1, SMALL_BYTES)).await?;
        overwrite.push(timed(from));
        let from = clock();
        let got = store.get_record(&name(sample)).await?;
        read.push(timed(from));
        if !created || got != Some(noise(sample + 1, SMALL_BYTES)) {
            faults.push("a read after an overwrite returns the old object".into());
            break;
        }
    }

    let (large, path) = (noise(folder, LARGE_BYTES), format!("{folder}/large"));
    let from = clock();
    store.put_record(&path, large.clone()).await?;
    let write_bytes_per_second = rate(timed(from));
    let from = clock();
    let got = store.get_record(&path).await?;
    let read_bytes_per_second = rate(timed(from));
    if got != Some(large) {
        faults.push(format!("an object of {LARGE_BYTES} bytes is not read as it was written"));
    }

    let (create, overwrite, read) = (latency(create), latency(overwrite), latency(read));
    let mut warnings = Vec::new();
    if create.p50 > SLOW_WRITE {
        let seconds = create.p50.as_secs_f64();
        warnings.push(format!("the median durable write takes {seconds:.1} s: each grant and commit waits for one"));
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

/// Lets all writers create one object concurrently. Returns the fault, if any.
async fn race(store: &Store, name: &str) -> Result<Option<String>, StoreError> {
    let attempts = (0..WRITERS).map(|writer| store.create_record(name, Bytes::from(format!("writer {writer}"))));
    let attempts = join_all(attempts).await.into_iter().collect::<Result<Vec<bool>, _>>();
    let won = match attempts {
        Ok(won) => won,
        // A server without exclusive create refuses every request.
        Err(error) => return Ok(Some(format!("an exclusive create (create unless the object exists) fails: {error}"))),
    };
    let winners: Vec<usize> = (0..WRITERS).filter(|writer| won[*writer]).collect();
    let stored = store.get_record(name).await?;
    Ok(match winners[..] {
        [winner] if stored == Some(Bytes::from(format!("writer {winner}"))) => None,
        [_] => Some("the winner of a concurrent create was not the writer whose object is stored".into()),
        _ => Some(format!(
            "of {WRITERS} concurrent creates of one object {} succeeded instead of one: two coordinators could lead at once",
            winners.len()
        )),
    })
}

/// Checks list-after-write, read-after-delete and range reads. Returns the faults.
async fn check_consistency(store: &Store, folder: &str) -> Result<Vec<String>, StoreError> {
    let mut faults = Vec::new();
    let below = format!("{folder}/listed");
    let names: Vec<String> = (0..5).map(|number| format!("{below}/{number:06}.json")).collect();
    for name in &names {
        store.put_record(name, Bytes::copy_from_slice(name.as_bytes())).await?;
        if store.newest_record(&below).await?.map(|(_, bytes)| bytes) != Some(Bytes::copy_from_slice(name.as_bytes())) {
            faults.push("an object that was just written is not listed".into());
            break;
        }
    }
    store.remove_record(&names[0]).await?;
    if store.get_record(&names[0]).await?.is_some() || store.record_names(&below).await?.contains(&names[0]) {
        faults.push("an object that was just deleted is still there".into());
    }
    let bytes = noise(folder, SMALL_BYTES);
    let id = store.put(bytes.clone()).await?;
    let parts = store.get_ranges(id, &[0..16, 100..1000]).await?;
    if parts != [bytes.slice(0..16), bytes.slice(100..1000)] {
        faults.push("a range read returns other bytes than requested".into());
    }
    store.remove(id).await?;
    Ok(faults)
}

async fn clean_up(store: &Store, folder: &str) -> Result<(), StoreError> {
    for name in store.record_names(folder).await? {
        store.remove_record(&name).await?;
    }
    Ok(())
}

/// Incompressible bytes that depend on the label.
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
    let percentile = |permille: usize| times.get((times.len() * permille).div_ceil(1000).saturating_sub(1)).copied();
    Latency { p50: percentile(500).unwrap_or_default(), p99: percentile(990).unwrap_or_default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_ranks_of_the_sorted_times() {
        let times = (1..=100).rev().map(Duration::from_millis).collect();
        assert_eq!(latency(times), Latency { p50: Duration::from_millis(50), p99: Duration::from_millis(99) });
        let one = Duration::from_millis(7);
        assert_eq!(latency(vec![one]), Latency { p50: one, p99: one });
    }
}
