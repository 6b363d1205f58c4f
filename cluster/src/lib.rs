//! Who trains what, when: the scheduler of one job as a state machine, `step(now, event) -> actions`.
//!
//! Architecture invariant: no I/O, no clock, no thread, no randomness. Time and events come in as values, and what is to
//! be done goes out as values, so that a test can play years of faults in a second. It knows tasks and artefacts' names,
//! never splats, files or sockets.

mod invariants;
mod scheduler;
mod words;

pub use invariants::{Violation, check, check_step};
pub use scheduler::Scheduler;
pub use words::{
    Action, DagError, Event, Failure, FailureKind, Outcome, Settings, TaskIndex, TaskNode, TaskState, WorkerId,
};
