//! The scheduler under faults, by seed: a small world of coordinators, workers, a network and a store, in which everything
//! that can go wrong does, and in which time and chance follow from one number. A seed that fails is one line to replay.
//!
//! ```text
//!   workers ◀──network: drops, copies, delays, partitions──▶ coordinators ──fails before, after, fenced──▶ store
//!   slow, hung, crashing, leaving, out of memory               crash, two at once, skewed clocks
//! ```
//!
//! After a while the faults stop (as in TigerBeetle's simulator: first safety under everything, then liveness once the
//! cluster is whole). From then on every job must end; what a worker was told is committed must be committed still; and no
//! task may be left over but those that truly cannot be done. The invariants are checked after every step.

mod coordinator;
mod random;
mod store;
mod truth;
mod worker;
mod world;

use std::collections::BTreeMap;
use std::fmt;

pub use random::Random;

/// What to play.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Options {
    /// Whether to keep what each coordinator heard, as journals.
    pub journals: bool,
}

/// What happened in a world that held.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// How often what happened, by name.
    pub counts: BTreeMap<&'static str, u64>,
    /// Steps of schedulers.
    pub steps: u64,
    /// Simulated milliseconds.
    pub millis: u64,
    /// A journal of each life of a coordinator, if asked for.
    pub journals: Vec<String>,
}

impl Report {
    /// Adds up what happened in several worlds.
    pub fn add(&mut self, other: Self) {
        other.counts.into_iter().for_each(|(what, count)| *self.counts.entry(what).or_default() += count);
        self.steps += other.steps;
        self.millis += other.millis;
        self.journals.extend(other.journals);
    }
}

/// Plays the world of a seed, and tells each happening to `trace`, which writes it out only if anyone reads it.
///
/// # Errors
/// What does not hold, one line.
pub fn run(seed: u64, options: Options, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<Report, String> {
    let mut world = world::World::new(seed, options);
    let held = world.play(trace);
    held.map(|()| world.report()).map_err(|what| format!("seed {seed}: {what}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What must have happened in the seeds below for them to mean anything.
    const SEEN: [&str; 30] = [
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
        "cancelled",
        "paused",
        "committed",
    ];

    #[test]
    fn every_job_ends_and_nothing_is_lost_whatever_the_faults() {
        let mut all = Report::default();
        for seed in 0..120 {
            let report = run(seed, Options::default(), &mut |_| {}).unwrap_or_else(|what| {
                panic!("{what}\nreplay: cargo run --release -p cluster --example simulate -- --seed {seed} --trace")
            });
            all.add(report);
        }
        for what in SEEN {
            assert!(all.counts.contains_key(what), "'{what}' never happened: {:?}", all.counts);
        }
    }

    #[test]
    fn a_seed_is_a_world() {
        let play = |seed| {
            let mut lines = Vec::new();
            let report = run(seed, Options::default(), &mut |line| lines.push(line.to_string())).unwrap();
            (lines, report)
        };
        assert_eq!(play(7), play(7));
        assert_ne!(play(7).0, play(8).0);
    }

    #[test]
    fn journals_replay_and_a_wrong_one_is_noticed() {
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
        assert!(crate::journal::replay(other, |_| {}).unwrap_err().contains("another answer"));
        assert!(crate::journal::replay(["{}"].into_iter(), |_| {}).is_err());
        assert!(crate::journal::replay([].into_iter(), |_| {}).is_err());
    }
}
