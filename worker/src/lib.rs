//! Pulls tasks from a coordinator and carries them out, one at a time.
//!
//! ```text
//! lease ──wait──▶ lease ──grant──▶ execute (blocking thread) ──▶ complete and lease | fail | give back ──▶ lease … drained ──▶ end
//!                                   │ reports ▼   ▲ stop
//!                                  heartbeat (async, several per lease)
//! ```
//!
//! Architecture invariant: a worker keeps no state between tasks and decides nothing. Each of its calls names an attempt, and the
//! coordinator may refuse it. Heartbeats and reports run beside the compute and never block it.

mod aligned;
mod attempt;
mod block;
pub mod clock;
mod coordinator_link;
mod detect;
pub mod estimate;
mod evaluate;
mod execute;
mod initial_splats;
mod inputs;
mod latest;
pub mod memory_budget;
pub mod merged_eval;
pub mod metrics;
mod object;
pub mod one_block;
mod options;
mod recipe;
mod recompute;
mod refine;
mod result_cache;
mod run;
mod silhouettes;
pub mod speed;
mod task;
#[cfg(test)]
mod testing;
pub mod time_limit;
mod train_block;
mod trainer_context;

pub use coordinator_link::leader_of;
pub use execute::PlanExecutor;
pub use merged_eval::FinishedBlocks;
pub use options::{Options, WorkerError};
pub use proto::FailureKind;
pub use run::{greet, run};
pub use task::{Execute, ExecuteError, FULL_RATE, Flow, Report, TaskOrder};
pub use trainer_context::{Shared, TrainerOptions};
