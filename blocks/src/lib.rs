//! Divides a city into a quadtree of blocks, plans their training and merges the results.
//!
//! The ground plane is a quadtree of blocks ([`Ground`]). One half-open ownership rule assigns every place to a block.
//! [`cut()`] and [`merge()`] share it, so `merge(cut(s)) == s`. [`plan()`] turns a capture into an immutable, hashed
//! list of tasks. A training task states which block trains on which windows of which views, against which frozen
//! context and within which budgets; an evaluation task states on which views the merged model is measured, and a
//! detection task on which views objects are looked for. [`lint()`] checks a plan, [`draw()`] draws it as an SVG.
//! [`densities()`] says where a capture has too few photos, [`Split`] which of them are held out.
//!
//! Architecture invariant: this crate does no I/O, reads no clock, starts no thread and uses no GPU. All functions are
//! pure, and equal inputs give equal bytes.

mod block_box;
mod budgets;
pub mod cells;
mod cost;
mod coverage;
pub mod cut;
pub mod density;
mod detection;
pub mod draw;
mod draw_density;
mod evaluation;
pub mod ground;
mod layout;
pub mod lint;
pub mod lod;
mod moving;
mod page;
pub mod plan;
mod plan_error;
pub mod planner;
pub mod seams;
mod split;
mod task;
#[cfg(test)]
mod testing;
mod view_kind;
mod view_selection;
mod visibility;

pub use budgets::initial_splats;
pub use cells::Cells;
pub use cost::{StepCost, trained_splats};
pub use cut::{cut, keep_core, merge, merge_cut};
pub use density::{Density, densities};
pub use detection::{DetectorCost, detect_tasks};
pub use draw::draw;
pub use draw_density::draw_density;
pub use evaluation::CONCURRENT_FETCHES;
pub use ground::{Ground, Square};
pub use lint::{Finding, Severity, lint};
pub use lod::{Cut, context_of, sweep_of};
pub use moving::object_camera;
pub use plan::{MAX_VIEWS_PER_STEP, Mode, Plan, PlanSettings, PlannedTask};
pub use plan_error::PlanError;
pub use planner::{plan, plan_at_most};
pub use seams::{Face, Seams};
pub use split::{Part, Split};
pub use task::{DetectTask, EvalTask, ObjectTask, Task, ViewUse};
pub use view_kind::{ViewKind, view_kinds};
