//! The scheduler of all jobs as a sans-I/O state machine: `step(now, event) -> actions`.
//!
//! Architecture invariant: no I/O, no clock, no thread, no randomness. Time and events are inputs, actions are outputs,
//! so that a deterministic simulation can test years of faults in seconds. The scheduler knows tasks and artefact ids,
//! but no splats, files or sockets.
//!
//! - [`Scheduler`] is the state machine. Its parts are `job`, `dag`, `ready_queue`, `pools`, `placement`, `attempts`,
//!   `timers` and `retry`.
//! - [`Snapshot`] is its durable state, [`Changes`] the part that a step changes, [`journal`] the log of its events as
//!   lines of JSON.
//! - [`check`] and [`check_step`] check the numbered invariants. [`sim`] is the deterministic simulation with fault
//!   injection.

mod attempts;
mod control;
mod dag;
mod durable;
mod events;
mod invariants;
mod job;
pub mod journal;
mod placement;
mod pools;
mod ready_queue;
mod retry;
mod scheduler;
pub mod sim;
mod snapshot;
mod tally;
mod timers;
mod types;

pub use dag::DagError;
pub use durable::Changes;
pub use events::{Action, Event, Failure, FailureKind, Outcome};
pub use invariants::{Violation, check, check_step};
pub use job::Counts;
pub use scheduler::{Scheduler, WorkerView};
pub use snapshot::{JobHeader, JobSnapshot, RestoreError, Snapshot};
pub use tally::Tally;
pub use types::{
    AttemptId, CACHED_LIMIT, FULL_RATE, Fence, JobId, JobSpec, Lease, Offer, SIBLING_BASE, Settings, TaskIndex,
    TaskNode, TaskRecord, TaskState, WorkerId,
};
