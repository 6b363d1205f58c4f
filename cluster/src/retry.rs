//! Retry policy: decides the next state of a task after an attempt without a result, by class of failure.

use crate::events::{Failure, FailureKind};
use crate::types::{Settings, TaskRecord, WorkerId};

/// Why an attempt ended without a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum FailureClass {
    /// Its worker reported a failure.
    Reported(Failure),
    /// Its worker was lost: the lease expired, the worker hangs, or it asked for another task.
    WorkerLost,
}

/// The next step of the task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NextStep {
    /// Another attempt, after a backoff of this many milliseconds.
    Retry {
        delay_millis: u64,
    },
    Failed(String),
    Quarantined(String),
}

/// The circumstances of the attempt that the decision depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AttemptSite {
    pub(crate) worker: WorkerId,
    /// Whether the worker sent a heartbeat. A worker that did not may never have received the grant.
    pub(crate) has_heartbeat: bool,
    /// The worker's memory, bytes, if known.
    pub(crate) memory: Option<u64>,
    /// The largest memory of any worker of the backend, bytes; `None` without workers.
    pub(crate) max_memory: Option<u64>,
}

/// Counts the failure in the record and decides the next step.
pub(crate) fn decide(
    record: &mut TaskRecord,
    class_of_failure: FailureClass,
    site: AttemptSite,
    settings: &Settings,
) -> NextStep {
    let again = NextStep::Retry { delay_millis: 0 };
    match class_of_failure {
        FailureClass::Reported(Failure { kind: FailureKind::Input, message }) => NextStep::Failed(message),
        FailureClass::Reported(Failure { kind: FailureKind::GivenBack, .. }) => again,
        FailureClass::Reported(Failure { kind: FailureKind::Work, message }) => {
            record.failures += 1;
            record_failed_worker(record, site.worker);
            if is_poison(record, settings) { NextStep::Quarantined(message) } else { again }
        }
        FailureClass::Reported(Failure { kind: FailureKind::Infrastructure, message }) => {
            record.infrastructure_failures += 1;
            if is_poison(record, settings) {
                return NextStep::Quarantined(message);
            }
            NextStep::Retry { delay_millis: backoff(record.infrastructure_failures, settings) }
        }
        FailureClass::Reported(Failure { kind: FailureKind::OutOfMemory, message }) => {
            record.memory_failures += 1;
            // Raise the estimate by half, up to the largest worker. If the task ran out of memory there, no worker has
            // enough.
            let beyond = site.memory.map_or(0, |memory| memory.saturating_add(1));
            let largest = site.max_memory.unwrap_or(u64::MAX);
            let raised = record.memory_bytes.saturating_add(record.memory_bytes / 2);
            record.memory_bytes = raised.min(largest).max(record.memory_bytes).max(beyond);
            if record.memory_bytes > largest {
                let [needed, largest] = [record.memory_bytes, largest].map(|bytes| bytes.div_ceil(1 << 20));
                let advice = format!("it needs at least {needed} MiB, the largest worker has {largest} MiB");
                return NextStep::Quarantined(format!("{message}: {advice}; add a larger worker and retry the task"));
            }
            if is_poison(record, settings) { NextStep::Quarantined(message) } else { again }
        }
        FailureClass::Reported(Failure { kind: FailureKind::Numeric, message }) => {
            record.divergences += 1;
            if is_poison(record, settings) { NextStep::Quarantined(message) } else { again }
        }
        FailureClass::WorkerLost => {
            record.losses += 1;
            if site.has_heartbeat {
                record_failed_worker(record, site.worker);
            }
            if is_poison(record, settings) {
                let (losses, different) = (record.losses, record.failed_workers.len());
                return NextStep::Quarantined(format!(
                    "the worker was lost in {losses} attempts; the task failed on or was lost with {different} different workers"
                ));
            }
            // The first loss is attributed to the worker, so there is no backoff.
            NextStep::Retry { delay_millis: backoff(record.losses - 1, settings) }
        }
    }
}

/// Whether a limit is reached, so that the task gets no further attempt without a user's retry.
pub(crate) fn is_poison(record: &TaskRecord, settings: &Settings) -> bool {
    record.failures >= settings.failures_limit.max(1)
        || record.losses >= settings.losses_limit.max(1)
        || record.infrastructure_failures >= settings.infrastructure_failures_limit.max(1)
        || record.memory_failures >= settings.failures_limit.max(1)
        || record.divergences > 1
        || record.failed_workers.len() >= settings.failed_workers_limit.max(1) as usize
}

/// Resets the failure counters, and the memory estimate to the plan's.
pub(crate) fn reset_counters(record: &mut TaskRecord) {
    (record.failures, record.losses, record.infrastructure_failures, record.memory_failures, record.divergences) =
        (0, 0, 0, 0, 0);
    record.failed_workers.clear();
    record.memory_bytes = record.node.memory_bytes;
}

fn record_failed_worker(record: &mut TaskRecord, worker: WorkerId) {
    if !record.failed_workers.contains(&worker) {
        record.failed_workers.push(worker);
    }
}

/// Exponential backoff, milliseconds; none for 0 failures.
fn backoff(times: u32, settings: &Settings) -> u64 {
    let Some(doublings) = times.checked_sub(1) else { return 0 };
    settings.backoff_millis.saturating_mul(1 << doublings.min(30)).min(settings.backoff_limit_millis)
}
