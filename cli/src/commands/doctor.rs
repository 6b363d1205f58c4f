//! `plat doctor`: tests whether a store has the guarantees that a cluster needs.

use std::hash::{BuildHasher, RandomState};
use std::time::{Duration, Instant};

use serde::Serialize;
use store::Store;
use store::doctor::{Findings, Latency, RACES, WRITERS, examine};

use crate::args::DoctorArgs;
use crate::failure::Failure;
use crate::output::Output;

/// The findings as JSON.
#[derive(Debug, Serialize)]
struct Report<'a> {
    store: &'a str,
    fit: bool,
    /// Races of many writers to create one object, and how many of them had exactly one winner.
    races: usize,
    races_held: usize,
    writers: usize,
    create_p50_ms: f64,
    create_p99_ms: f64,
    overwrite_p50_ms: f64,
    overwrite_p99_ms: f64,
    read_p50_ms: f64,
    read_p99_ms: f64,
    write_bytes_per_second: f64,
    read_bytes_per_second: f64,
    faults: &'a [String],
    warnings: &'a [String],
}

pub(crate) fn run(args: &DoctorArgs, output: &Output) -> Result<(), Failure> {
    let store = Store::open(&args.store)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.map_err(|error| Failure::Work(format!("cannot start threads: {error}")))?;
    let began = Instant::now();
    // Unique even if two machines test one store at the same time with equal process ids.
    let tag = format!("{:016x}", RandomState::new().hash_one(std::process::id()));
    let found = runtime.block_on(examine(&store, &tag, &|| began.elapsed()))?;
    output.result(&report(&args.store, &found), &text(&args.store, &found))?;
    if found.is_fit() {
        return Ok(());
    }
    let line = format!("{}: is not fit for a cluster: {}; choose another store", args.store, found.faults.join("; "));
    Err(Failure::Work(line))
}

fn report<'a>(store: &'a str, found: &'a Findings) -> Report<'a> {
    Report {
        store,
        fit: found.is_fit(),
        races: RACES,
        races_held: found.races_held,
        writers: WRITERS,
        create_p50_ms: millis(found.create.p50),
        create_p99_ms: millis(found.create.p99),
        overwrite_p50_ms: millis(found.overwrite.p50),
        overwrite_p99_ms: millis(found.overwrite.p99),
        read_p50_ms: millis(found.read.p50),
        read_p99_ms: millis(found.read.p99),
        write_bytes_per_second: found.write_bytes_per_second,
        read_bytes_per_second: found.read_bytes_per_second,
        faults: &found.faults,
        warnings: &found.warnings,
    }
}

fn text(store: &str, found: &Findings) -> String {
    let of = |what: &str, latency: Latency| {
        format!("{what:<10} p50 {:8.2} ms   p99 {:8.2} ms\n", millis(latency.p50), millis(latency.p99))
    };
    let mut text =
        format!("atomic create by {WRITERS} writers: {} of {RACES} races had exactly one winner\n", found.races_held);
    text += &of("create", found.create);
    text += &of("overwrite", found.overwrite);
    text += &of("read", found.read);
    let [written, read] = [found.write_bytes_per_second, found.read_bytes_per_second].map(|rate| rate / 1e6);
    text += &format!("bandwidth  write {written:.0} MB/s   read {read:.0} MB/s\n");
    found.warnings.iter().for_each(|line| text += &format!("warning: {line}\n"));
    found.faults.iter().for_each(|line| text += &format!("fault: {line}\n"));
    text + &format!("{store} is {}fit for a cluster", if found.is_fit() { "" } else { "not " })
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
