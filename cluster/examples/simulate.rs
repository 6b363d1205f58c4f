//! Plays the scheduler's simulation for many seeds, or one with every happening told, or replays a journal.
//!
//! ```text
//! cargo run --release -p cluster --example simulate -- --seeds 0..10000 [--threads N]
//! cargo run --release -p cluster --example simulate -- --seed 17 --trace
//! cargo run --release -p cluster --example simulate -- --replay journal.jsonl [--trace]
//! ```
//! Seeds are shared out over all cores (`--threads N` for fewer) with a bar on a terminal; a trace is told by one thread, in order.
//! Exits with 1 at a seed that fails, the lowest that was found, and says how to replay it.

use std::fmt;
use std::io::{BufWriter, Write};
use std::num::NonZero;
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use indicatif::{ProgressBar, ProgressStyle};

use cluster::sim::{Options, Report, run};

/// What was asked for.
#[derive(Default)]
struct Asked {
    seeds: Option<(u64, u64)>,
    threads: Option<NonZero<usize>>,
    trace: bool,
    replay: Option<String>,
}

fn main() -> ExitCode {
    match asked(std::env::args().skip(1)) {
        Err(what) => {
            eprintln!("{what}\nusage: simulate [--seeds A..B | --seed N] [--threads N] [--trace] [--replay FILE]");
            ExitCode::from(2)
        }
        Ok(asked) => match play(&asked) {
            Ok(said) => {
                println!("{said}");
                ExitCode::SUCCESS
            }
            Err(what) => {
                eprintln!("{what}");
                ExitCode::from(1)
            }
        },
    }
}

fn asked(mut args: impl Iterator<Item = String>) -> Result<Asked, String> {
    let mut asked = Asked::default();
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
        let number = |text: &str| text.parse::<u64>().map_err(|_| format!("'{text}' is not a seed"));
        match arg.as_str() {
            "--seed" => {
                let seed = number(&value()?)?;
                asked.seeds = Some((seed, seed.saturating_add(1)));
            }
            "--seeds" => {
                let range = value()?;
                let (from, to) = range.split_once("..").ok_or_else(|| format!("'{range}' is not of the form A..B"))?;
                asked.seeds = Some((number(from)?, number(to)?));
            }
            "--threads" => {
                let text = value()?;
                asked.threads = Some(text.parse().map_err(|_| format!("'{text}' is not a number of threads"))?);
            }
            "--trace" => asked.trace = true,
            "--replay" => asked.replay = Some(value()?),
            _ => return Err(format!("'{arg}' is not known")),
        }
    }
    Ok(asked)
}

fn play(asked: &Asked) -> Result<String, String> {
    let mut out = BufWriter::new(std::io::stdout());
    let mut trace = |line: fmt::Arguments<'_>| {
        if asked.trace {
            // A reader that had enough closes the pipe; there is nobody left to tell.
            let _ = writeln!(out, "{line}");
        }
    };
    if let Some(path) = &asked.replay {
        let text = std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))?;
        let replayed = cluster::journal::replay(text.lines(), &mut trace).map_err(|what| format!("{path}: {what}"))?;
        return Ok(format!("{} steps and {} restarts replayed", replayed.steps, replayed.restarts));
    }
    let (from, to) = asked.seeds.unwrap_or((0, 1000));
    let all = if asked.trace {
        let mut all = Report::default();
        for seed in from..to {
            all.add(held(seed, &mut trace)?);
        }
        all
    } else {
        let cores = || thread::available_parallelism().unwrap_or(NonZero::<usize>::MIN);
        play_all(from, to, asked.threads.unwrap_or_else(cores))?
    };
    let counts: Vec<String> = all.counts.iter().map(|(what, count)| format!("{what} {count}")).collect();
    let (steps, hours) = (all.steps, all.millis / 3_600_000);
    Ok(format!("{} seeds held: {steps} steps, {hours} simulated hours; {}", to.saturating_sub(from), counts.join(", ")))
}

fn held(seed: u64, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<Report, String> {
    run(seed, Options::default(), trace).map_err(|what| {
        format!("{what}\nreplay: cargo run --release -p cluster --example simulate -- --seed {seed} --trace")
    })
}

/// Plays the seeds on several threads, each taking the next one. What happened adds up to the same in any order.
fn play_all(from: u64, to: u64, threads: NonZero<usize>) -> Result<Report, String> {
    let (next, stop) = (AtomicU64::new(from), AtomicBool::new(false));
    let wrong: Mutex<Option<(u64, String)>> = Mutex::new(None);
    let bar = ProgressBar::new(to.saturating_sub(from));
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} seeds, {eta} left") {
        bar.set_style(style);
    }
    let play = || {
        let mut all = Report::default();
        while !stop.load(Ordering::Relaxed) {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= to {
                break;
            }
            match held(seed, &mut |_| {}) {
                Ok(report) => all.add(report),
                Err(what) => {
                    stop.store(true, Ordering::Relaxed);
                    let mut wrong = wrong.lock().expect("nobody panics with it");
                    if wrong.as_ref().is_none_or(|(lowest, _)| seed < *lowest) {
                        *wrong = Some((seed, what));
                    }
                }
            }
            bar.inc(1);
        }
        all
    };
    let reports = thread::scope(|scope| {
        let threads: Vec<_> = (0..threads.get()).map(|_| scope.spawn(play)).collect();
        threads.into_iter().map(thread::ScopedJoinHandle::join).collect::<Result<Vec<_>, _>>()
    });
    bar.finish_and_clear();
    let reports = reports.map_err(|_| "a thread panicked: see above".to_string())?;
    if let Some((_, what)) = wrong.into_inner().expect("nobody panics with it") {
        return Err(what);
    }
    let mut all = Report::default();
    reports.into_iter().for_each(|report| all.add(report));
    Ok(all)
}
