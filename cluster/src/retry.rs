//! What comes after an attempt without a result: a decision over plain data, class by class.

use crate::events::{Failure, FailureKind};
use crate::words::{Settings, TaskRecord, WorkerId};

/// How an attempt ended without a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Trouble {
    /// Its worker said why.
    Said(Failure),
    /// Its worker vanished, hangs, or holds nothing any more.
    Lost,
}

/// What comes next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Next {
    /// Another attempt, after this many milliseconds.
    Again {
        pause_millis: u64,
    },
    Failed(String),
    Quarantined(String),
}

/// Who had the attempt, and what else there is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Site {
    pub(crate) worker: WorkerId,
    /// Whether the worker gave a sign of life: one that did not may never have heard of the grant.
    pub(crate) heard: bool,
    /// The worker's memory, bytes, where it is known.
    pub(crate) memory: Option<u64>,
    /// The most memory of any worker of the backend, bytes; `None` where there is no worker now.
    pub(crate) largest: Option<u64>,
}

/// Counts the trouble in the record and decides.
pub(crate) fn after(record: &mut TaskRecord, trouble: Trouble, site: Site, settings: &Settings) -> Next {
    let again = Next::Again { pause_millis: 0 };
    match trouble {
        Trouble::Said(Failure { kind: FailureKind::Input, message }) => Next::Failed(message),
        Trouble::Said(Failure { kind: FailureKind::GivenBack, .. }) => again,
        Trouble::Said(Failure { kind: FailureKind::Work, message }) => {
            record.failures += 1;
            blame(record, site.worker);
            if is_poison(record, settings) { Next::Quarantined(message) } else { again }
        }
        Trouble::Said(Failure { kind: FailureKind::Infrastructure, message }) => {
            record.troubles += 1;
            if is_poison(record, settings) {
                return Next::Quarantined(message);
            }
            Next::Again { pause_millis: pause(record.troubles, settings) }
        }
        Trouble::Said(Failure { kind: FailureKind::OutOfMemory, message }) => {
            record.overflows += 1;
            // Half as much again, but no more than the largest worker has; if that is where it ran out, nobody has enough.
            let beyond = site.memory.map_or(0, |memory| memory.saturating_add(1));
            let largest = site.largest.unwrap_or(u64::MAX);
            let raised = record.memory_bytes.saturating_add(record.memory_bytes / 2);
            record.memory_bytes = raised.min(largest).max(record.memory_bytes).max(beyond);
            if record.memory_bytes > largest {
                let [needed, largest] = [record.memory_bytes, largest].map(|bytes| bytes.div_ceil(1 << 20));
                let advice = format!("it needs {needed} MiB or more, the largest worker has {largest}");
                return Next::Quarantined(format!("{message}: {advice}; add a larger one and retry the task"));
            }
            if is_poison(record, settings) { Next::Quarantined(message) } else { again }
        }
        Trouble::Said(Failure { kind: FailureKind::Numeric, message }) => {
            record.divergences += 1;
            if is_poison(record, settings) { Next::Quarantined(message) } else { again }
        }
        Trouble::Lost => {
            record.losses += 1;
            if site.heard {
                blame(record, site.worker);
            }
            if is_poison(record, settings) {
                let (losses, different) = (record.losses, record.culprits.len());
                return Next::Quarantined(format!(
                    "the worker vanished in {losses} attempts; it failed on or vanished with {different} different ones"
                ));
            }
            // The first loss is the worker's: another may start at once.
            Next::Again { pause_millis: pause(record.losses - 1, settings) }
        }
    }
}

/// Whether a limit is reached, so that there will be no further attempt by itself.
pub(crate) fn is_poison(record: &TaskRecord, settings: &Settings) -> bool {
    record.failures >= settings.failures_limit.max(1)
        || record.losses >= settings.losses_limit.max(1)
        || record.troubles >= settings.troubles_limit.max(1)
        || record.overflows >= settings.failures_limit.max(1)
        || record.divergences > 1
        || record.culprits.len() >= settings.culprits_limit.max(1) as usize
}

/// Forgives a task its past; its memory is believed to be what the plan said.
pub(crate) fn forgive(record: &mut TaskRecord) {
    (record.failures, record.losses, record.troubles, record.overflows, record.divergences) = (0, 0, 0, 0, 0);
    record.culprits.clear();
    record.memory_bytes = record.node.memory_bytes;
}

fn blame(record: &mut TaskRecord, worker: WorkerId) {
    if !record.culprits.contains(&worker) {
        record.culprits.push(worker);
    }
}

/// Pauses double from the first time on.
fn pause(times: u32, settings: &Settings) -> u64 {
    let Some(doublings) = times.checked_sub(1) else { return 0 };
    settings.backoff_millis.saturating_mul(1 << doublings.min(30)).min(settings.backoff_limit_millis)
}
