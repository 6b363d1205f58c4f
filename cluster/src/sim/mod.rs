//! Deterministic simulation testing of the scheduler.
//!
//! A small world of coordinators, workers, a network and a store runs under injected faults. Time and randomness derive
//! from one seed, so that a failing seed can be replayed with one command.
//!
//! ```text
//!   workers ◀──network: drops, copies, delays, partitions──▶ coordinators ──fails before, after, fenced──▶ store
//!   slow, hung, crashing, leaving, out of memory            crash, two leaders, skewed clocks
//! ```
//!
//! The invariants are checked after every step. After a while the faults stop (as in TigerBeetle's simulator: first
//! safety under all faults, then liveness of the healthy cluster). From then on every job must end, every result that
//! was acknowledged to a worker must still be committed, and the only unfinished tasks must be those that cannot
//! complete according to the ground truth.

mod coordinator;
mod ground_truth;
mod random;
mod report;
mod store;
mod worker;
mod world;

use std::fmt;

pub use random::Random;
pub use report::{Options, Report};

/// Runs the simulation of a seed and passes each event to `trace`.
///
/// # Errors
/// The violated property, one line.
pub fn run(seed: u64, options: Options, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<Report, String> {
    let mut world = world::World::new(seed, options);
    let result = world.run(trace);
    result.map(|()| world.report()).map_err(|error| format!("seed {seed}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Events that the seeds below must cover for the test to be meaningful.
    const COVERED: [&str; 31] = [
        "message dropped",
        "message copied",
        "message late",
        "partition",
        "store failed before",
        "store failed after",
        "store fenced",
        "coordinator crashed",
        "coordinator started",
        "two coordinators",
        "clock skewed",
        "worker crashed",
        "worker hung",
        "worker slow",
        "worker left",
        "zombie refused",
        "out of memory",
        "input failed",
        "diverged",
        "half rate",
        "infrastructure",
        "work failed",
        "second attempt",
        "stopped",
        "quarantined",
        "retried",
        "followers",
        "detections",
        "cancelled",
        "paused",
        "committed",
    ];

    #[test]
    fn every_job_ends_and_no_result_is_lost_under_faults() {
        let mut all = Report::default();
        for seed in 0..120 {
            let report = run(seed, Options::default(), &mut |_| {}).unwrap_or_else(|error| {
                panic!("{error}\nreplay: cargo run --release -p cluster --example simulate -- --seed {seed} --trace")
            });
            all.add(report);
        }
        for name in COVERED {
            assert!(all.counts.contains_key(name), "'{name}' did not occur: {:?}", all.counts);
        }
    }

    #[test]
    fn a_seed_determines_the_simulation() {
        let play = |seed| {
            let mut lines = Vec::new();
            let report = run(seed, Options::default(), &mut |line| lines.push(line.to_string())).unwrap();
            (lines, report)
        };
        assert_eq!(play(7), play(7));
        assert_ne!(play(7).0, play(8).0);
    }

    #[test]
    fn journals_replay_and_a_modified_one_is_detected() {
        let report = run(3, Options { journals: true }, &mut |_| {}).unwrap();
        let mut steps = 0;
        for journal in &report.journals {
            steps += crate::journal::replay(journal.lines(), |_| {}).unwrap().steps;
        }
        assert_eq!(steps, report.steps);
        let longest = report.journals.iter().max_by_key(|journal| journal.len()).unwrap();
        let cut = &longest[..longest.len() - 9];
        assert!(crate::journal::replay(cut.lines(), |_| {}).is_ok(), "a killed process cuts the last line off");
        let other = longest.lines().filter(|line| !line.contains("Joined"));
        assert!(crate::journal::replay(other, |_| {}).unwrap_err().contains("actions differ"));
        assert!(crate::journal::replay(["{}"].into_iter(), |_| {}).is_err());
        assert!(crate::journal::replay([].into_iter(), |_| {}).is_err());
    }
}
