//! Cuts the city and sews it back.
//!
//! The ground plane is a quadtree of blocks ([`Ground`]). One ownership rule, half-open, says which block a place
//! belongs to; [`cut()`] and [`merge()`] share it, so `merge(cut(s)) == s`. [`plan()`] turns a capture into an
//! immutable, hashed list of tasks: which block trains on which windows of which views, against which frozen
//! context, within which budget. [`lint()`] checks a plan, [`draw()`] shows it.
//!
//! Architecture invariant: nothing here does I/O, reads a clock, starts a thread or knows a GPU. Everything is a
//! function over plain data, and equal inputs give equal bytes.

mod allot;
pub mod cut;
pub mod draw;
pub mod ground;
pub mod lint;
pub mod lod;
pub mod plan;
pub mod planner;
mod price;
pub mod seams;
pub mod select;
mod shown;
#[cfg(test)]
mod testing;
pub mod view_cut;

pub use cut::{cut, keep_core, merge, sew};
pub use draw::draw;
pub use ground::{Ground, Square};
pub use lint::{Finding, Severity, lint};
pub use lod::{Cut, context_of, sweep_of};
pub use plan::{MOST_VIEWS_PER_STEP, Mode, Plan, PlanError, PlanSettings, Task, ViewUse};
pub use planner::plan;
pub use price::Price;
pub use seams::{Face, Seams};
pub use view_cut::ViewTree;
