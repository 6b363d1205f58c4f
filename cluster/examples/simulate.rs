//! Runs the scheduler's deterministic simulation for many seeds, or one seed with a trace, or replays a journal.
//!
//! ```text
//! cargo run --release -p cluster --example simulate -- --seeds 0..10000 [--threads N]
//! cargo run --release -p cluster --example simulate -- --seed 17 --trace
//! cargo run --release -p cluster --example simulate -- --replay journal.jsonl [--trace]
//! ```
//! Seeds are distributed over all cores (`--threads N` for fewer), with a progress bar on a terminal. A trace is
//! written by one thread in order. Exits with 1 if a seed fails, and prints the lowest failing seed and the command to
//! replay it.

use std::fmt;
use std::io::{BufWriter, Write};
use std::num::NonZero;
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use indicatif::{ProgressBar, ProgressStyle};

use cluster::sim::{Options, Report, run};

/// The command-line arguments.
#[derive(Default)]
struct Args {
    seeds: Option<(u64, u64)>,
    threads: Option<NonZero<usize>>,
    trace: bool,
    replay: Option<String>,
}

fn main() -> ExitCode {
    match parse(std::env::args().skip(1)) {
        Err(error) => {
            eprintln!("{error}\nusage: simulate [--seeds A..B | --seed N] [--threads N] [--trace] [--replay FILE]");
            ExitCode::from(2)
        }
        Ok(args) => match run_all(&args) {
            Ok(summary) => {
                println!("{summary}");
                ExitCode::SUCCESS
            }
            Err(error) => {
                eprintln!("{error}");
                ExitCode::from(1)
            }
        },
    }
}

fn parse(mut input: impl Iterator<Item = String>) -> Result<Args, String> {
    let mut args = Args::default();
    while let Some(arg) = input.next() {
        let mut value = || input.next().ok_or_else(|| format!("{arg} needs a value"));
        let number = |text: &str| text.parse::<u64>().map_err(|_| format!("'{text}' is not a seed"));
        match arg.as_str() {
            "--seed" => {
                let seed = number(&value()?)?;
                args.seeds = Some((seed, seed.saturating_add(1)));
            }
            "--seeds" => {
                let range = value()?;
                let (from, to) = range.split_once("..").ok_or_else(|| format!("'{range}' is not of the form A..B"))?;
                args.seeds = Some((number(from)?, number(to)?));
            }
            "--threads" => {
                let text = value()?;
                args.threads = Some(text.parse().map_err(|_| format!("'{text}' is not a number of threads"))?);
            }
            "--trace" => args.trace = true,
            "--replay" => args.replay = Some(value()?),
            _ => return Err(format!("'{arg}' is unknown")),
        }
    }
    Ok(args)
}

fn run_all(args: &Args) -> Result<String, String> {
    let mut out = BufWriter::new(std::io::stdout());
    let mut trace = |line: fmt::Arguments<'_>| {
        if args.trace {
            // A closed pipe is ignored.
            let _ = writeln!(out, "{line}");
        }
    };
    if let Some(path) = &args.replay {
        let text = std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))?;
        let replayed =
            cluster::journal::replay(text.lines(), &mut trace).map_err(|error| format!("{path}: {error}"))?;
        return Ok(format!("{} steps and {} restarts replayed", replayed.steps, replayed.restarts));
    }
    let (from, to) = args.seeds.unwrap_or((0, 1000));
    let all = if args.trace {
        let mut all = Report::default();
        for seed in from..to {
            all.add(run_seed(seed, &mut trace)?);
        }
        all
    } else {
        let cores = || thread::available_parallelism().unwrap_or(NonZero::<usize>::MIN);
        run_parallel(from, to, args.threads.unwrap_or_else(cores))?
    };
    let counts: Vec<String> = all.counts.iter().map(|(name, count)| format!("{name} {count}")).collect();
    let (steps, hours) = (all.steps, all.millis / 3_600_000);
    Ok(format!("{} seeds held: {steps} steps, {hours} simulated hours; {}", to.saturating_sub(from), counts.join(", ")))
}

fn run_seed(seed: u64, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<Report, String> {
    run(seed, Options::default(), trace).map_err(|error| {
        format!("{error}\nreplay: cargo run --release -p cluster --example simulate -- --seed {seed} --trace")
    })
}

/// Runs the seeds on several threads. The sum of the reports does not depend on the order.
fn run_parallel(from: u64, to: u64, threads: NonZero<usize>) -> Result<Report, String> {
    let (next, stop) = (AtomicU64::new(from), AtomicBool::new(false));
    let failure: Mutex<Option<(u64, String)>> = Mutex::new(None);
    let bar = ProgressBar::new(to.saturating_sub(from));
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} seeds, {eta} left") {
        bar.set_style(style);
    }
    let work = || {
        let mut all = Report::default();
        while !stop.load(Ordering::Relaxed) {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= to {
                break;
            }
            match run_seed(seed, &mut |_| {}) {
                Ok(report) => all.add(report),
                Err(error) => {
                    stop.store(true, Ordering::Relaxed);
                    let mut failure = failure.lock().expect("no thread panics with the lock");
                    if failure.as_ref().is_none_or(|(lowest, _)| seed < *lowest) {
                        *failure = Some((seed, error));
                    }
                }
            }
            bar.inc(1);
        }
        all
    };
    let reports = thread::scope(|scope| {
        let threads: Vec<_> = (0..threads.get()).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(thread::ScopedJoinHandle::join).collect::<Result<Vec<_>, _>>()
    });
    bar.finish_and_clear();
    let reports = reports.map_err(|_| "a thread panicked; see the message above".to_string())?;
    if let Some((_, error)) = failure.into_inner().expect("no thread panics with the lock") {
        return Err(error);
    }
    let mut all = Report::default();
    reports.into_iter().for_each(|report| all.add(report));
    Ok(all)
}
