//! What a scheduler did since it began, counted for whoever watches it. Nothing is decided by it, and it is not durable.

use crate::events::{Action, FailureKind};
use crate::retry::Trouble;

/// Counts that only grow.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Events taken in.
    pub steps: u64,
    /// Attempts granted.
    pub grants: u64,
    /// Of these, second attempts at stragglers.
    pub duplicates: u64,
    /// Results taken in; one that is told twice counts once.
    pub completions: u64,
    /// News of attempts that hold no lease.
    pub refusals: u64,
    /// Attempts that ended without a result, as [`Tally::ENDS`] names them.
    pub ends: [u64; 7],
}

impl Tally {
    /// How an attempt ends without a result: as its worker said, or `lost` where the worker vanished or hung.
    pub const ENDS: [&str; 7] = ["input", "work", "infrastructure", "out_of_memory", "numeric", "given_back", "lost"];

    /// Takes in what a step came to.
    pub(crate) fn note(&mut self, actions: &[Action]) {
        self.steps += 1;
        for action in actions {
            match action {
                Action::Grant { .. } => self.grants += 1,
                Action::Refused { .. } => self.refusals += 1,
                _ => {}
            }
        }
    }

    /// An attempt ended without a result.
    pub(crate) fn ended(&mut self, trouble: &Trouble) {
        let place = match trouble {
            Trouble::Lost => 6,
            Trouble::Said(failure) => match failure.kind {
                FailureKind::Input => 0,
                FailureKind::Work => 1,
                FailureKind::Infrastructure => 2,
                FailureKind::OutOfMemory => 3,
                FailureKind::Numeric => 4,
                FailureKind::GivenBack => 5,
            },
        };
        self.ends[place] += 1;
    }
}
