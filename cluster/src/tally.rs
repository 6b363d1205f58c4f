//! Counters of a scheduler's activity, for metrics. They influence no decision and are not durable.

use crate::events::{Action, FailureKind};
use crate::retry::FailureClass;

/// Monotonic counters since the start of the scheduler.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Events processed.
    pub steps: u64,
    /// Attempts granted.
    pub grants: u64,
    /// Of these, speculative attempts.
    pub speculative_attempts: u64,
    /// Results accepted. A repeated report counts once.
    pub completions: u64,
    /// Reports refused because the attempt holds no lease.
    pub refusals: u64,
    /// Attempts that ended without a result, in the order of [`Tally::ENDS`].
    pub ends: [u64; 7],
}

impl Tally {
    /// Names of the classes of failure: as reported by the worker, or `lost` if the worker was lost or hung.
    pub const ENDS: [&str; 7] = ["input", "work", "infrastructure", "out_of_memory", "numeric", "given_back", "lost"];

    /// Counts a step and its actions.
    pub(crate) fn record_step(&mut self, actions: &[Action]) {
        self.steps += 1;
        for action in actions {
            match action {
                Action::Grant { .. } => self.grants += 1,
                Action::Refused { .. } => self.refusals += 1,
                _ => {}
            }
        }
    }

    /// Counts an attempt that ended without a result.
    pub(crate) fn record_end(&mut self, class: &FailureClass) {
        let place = match class {
            FailureClass::WorkerLost => 6,
            FailureClass::Reported(failure) => match failure.kind {
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
