//! Options and report of a simulation.

use std::collections::BTreeMap;

/// Options of a simulation.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Options {
    /// Whether to keep a journal of each coordinator.
    pub journals: bool,
}

/// The report of a successful simulation.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Counts of simulated events, by name.
    pub counts: BTreeMap<&'static str, u64>,
    /// Number of scheduler steps.
    pub steps: u64,
    /// Simulated time, milliseconds.
    pub millis: u64,
    /// The journal of each incarnation of a coordinator, if requested.
    pub journals: Vec<String>,
}

impl Report {
    /// Adds the counts of another simulation.
    pub fn add(&mut self, other: Self) {
        other.counts.into_iter().for_each(|(name, count)| *self.counts.entry(name).or_default() += count);
        self.steps += other.steps;
        self.millis += other.millis;
        self.journals.extend(other.journals);
    }
}
