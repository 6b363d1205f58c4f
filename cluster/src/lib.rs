//! Who trains what, when: the scheduler of all jobs as a state machine, `step(now, event) -> actions`.
//!
//! Architecture invariant: no I/O, no clock, no thread, no randomness. Time and events come in as values, and what is to
//! be done goes out as values, so that a test can play years of faults in a second. It knows tasks and artefacts' names,
//! never splats, files or sockets.
//!
//! - [`Scheduler`] is the state machine; `job`, `dag`, `queue`, `lanes`, `placement` and `retry` are its parts.
//! - [`Snapshot`] is what must be durable of it, [`Changes`] what a step changes of that, [`journal`] what it heard as lines of JSON.
//! - [`check`] and [`check_step`] are the numbered invariants, [`sim`] plays faults by seed.

mod attempts;
mod control;
mod dag;
mod durable;
mod events;
mod invariants;
mod job;
pub mod journal;
mod lanes;
mod placement;
mod queue;
mod retry;
mod scheduler;
pub mod sim;
mod snapshot;
mod tally;
mod upkeep;
mod words;

pub use dag::DagError;
pub use durable::Changes;
pub use events::{Action, Event, Failure, FailureKind, Outcome};
pub use invariants::{Violation, check, check_step};
pub use job::Counts;
pub use scheduler::Scheduler;
pub use snapshot::{JobHeader, JobSnapshot, RestoreError, Snapshot};
pub use tally::Tally;
pub use words::{
    AttemptId, CACHED_LIMIT, FULL_RATE, Fence, JobId, JobSpec, Lease, Offer, Settings, TaskIndex, TaskNode, TaskRecord,
    TaskState, WorkerId,
};
