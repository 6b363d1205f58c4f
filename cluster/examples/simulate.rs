//! Plays the scheduler's simulation for many seeds, or one with every happening told, or replays a journal.
//!
//! ```text
//! cargo run --release -p cluster --example simulate -- --seeds 0..10000
//! cargo run --release -p cluster --example simulate -- --seed 17 --trace
//! cargo run --release -p cluster --example simulate -- --replay journal.jsonl [--trace]
//! ```
//! Exits with 1 at the first seed that fails, and says how to replay it.

use std::fmt;
use std::io::{BufWriter, Write};
use std::process::ExitCode;

use cluster::sim::{Options, Report, run};

/// What was asked for.
#[derive(Default)]
struct Asked {
    seeds: Option<(u64, u64)>,
    trace: bool,
    replay: Option<String>,
}

fn main() -> ExitCode {
    match asked(std::env::args().skip(1)) {
        Err(what) => {
            eprintln!("{what}\nusage: simulate [--seeds A..B | --seed N] [--trace] [--replay FILE]");
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
    let mut all = Report::default();
    for seed in from..to {
        let report = run(seed, Options::default(), &mut trace).map_err(|what| {
            format!("{what}\nreplay: cargo run --release -p cluster --example simulate -- --seed {seed} --trace")
        })?;
        all.add(report);
    }
    let counts: Vec<String> = all.counts.iter().map(|(what, count)| format!("{what} {count}")).collect();
    let (steps, hours) = (all.steps, all.millis / 3_600_000);
    Ok(format!("{} seeds held: {steps} steps, {hours} simulated hours; {}", to - from, counts.join(", ")))
}
