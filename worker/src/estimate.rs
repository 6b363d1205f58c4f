//! Estimates the time and memory that a plan takes before it runs. No result depends on the estimate.
//!
//! The cost of a training step is the plan's ([`StepCost`]). Pixels and splats change over a task's schedule (coarse mips first,
//! densification towards the budget); the estimate uses their means. The constants are of one machine, whose speed varies by a factor
//! of 1.4.

use std::collections::BTreeSet;

use blocks::{Plan, StepCost, Task};
use scene::BlockId;
use serde::Serialize;
use train::prune::{self, Pruning};

use crate::recipe::recipe_of;

/// Pixels per step at the mean resolution of a schedule of coarse mips, which [`StepCost`] assumes, relative to all of a window.
const MEAN_PIXELS: f64 = 0.475;
/// CPU seconds per pixel of a window that is read for the first time.
const SECONDS_PER_READ_PIXEL: f64 = 0.3e-6;
/// Cost of rendering a window without training on it, relative to a step.
const RENDER_COST: f64 = 0.45;
/// Mean number of splats during pruning, relative to those before.
const PRUNED_SHARE: f64 = 0.75;
/// Splats that a child inherits from its parent, relative to the child's budget.
const INHERITED_SHARE: f64 = 0.4;
/// Floats of a splat of SH degree 0 to 3 in a merged PLY: position, normal, colour, opacity, scale and rotation.
const PLY_FLOATS: [u64; 4] = [17, 26, 41, 62];

/// Estimated time, memory and size of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// CPU seconds of all tasks on the CPU backend.
    pub cpu_seconds: f64,
    /// Memory of the process during the largest task, bytes.
    pub memory_bytes: u64,
    /// Largest size of the merged model, bytes (pruning leaves fewer splats).
    pub bytes: u64,
}

impl Estimate {
    /// The estimate for one task at a time.
    pub fn of(plan: &Plan) -> Self {
        let parents = parents(plan);
        let leaf = |task: &&Task| !parents.contains(&task.block);
        let splats: u64 = plan.tasks.iter().filter(leaf).map(|task| u64::from(task.budget)).sum();
        Self {
            cpu_seconds: plan.tasks.iter().map(|task| cpu_seconds(plan, task, leaf(&task))).sum(),
            memory_bytes: plan.tasks.iter().map(|task| task.memory_bytes).max().unwrap_or(0),
            bytes: splats * 4 * PLY_FLOATS[usize::from(plan.settings.sh_degree.min(3))],
        }
    }
}

/// Blocks that have children.
pub(crate) fn parents(plan: &Plan) -> BTreeSet<BlockId> {
    plan.tasks.iter().filter_map(|task| task.parent).collect()
}

/// CPU seconds of a task on the CPU backend.
pub(crate) fn cpu_seconds(plan: &Plan, task: &Task, leaf: bool) -> f64 {
    let settings = &plan.settings;
    let cost = StepCost::of(task);
    let recipe = recipe_of(settings, task);
    let first = match task.parent {
        Some(_) => INHERITED_SHARE,
        None => {
            (f64::from(task.points.min(blocks::initial_splats(plan, task))) / f64::from(task.budget.max(1))).max(0.01)
        }
    };
    // Densification grows geometrically from `first` to 1; an inner block may start with more than its budget.
    let until = f64::from(recipe.growth.until);
    let mean_growing = if first < 0.999 { (1.0 - first) / -first.ln() } else { first };
    let mean_splats = until * mean_growing + (1.0 - until) * first.max(1.0);
    let (mut mean_pixels, mut left) = (0.0, 1.0);
    for (n, share) in recipe.coarse.iter().enumerate() {
        mean_pixels += f64::from(*share) * 0.25f64.powi((recipe.coarse.len() - n) as i32);
        left -= f64::from(*share);
    }
    mean_pixels += left;
    let seconds = |pixels: f64, splats: f64| {
        // The visible splats are those of a full budget, also for a root that starts with more than its budget.
        let splats = cost.visible * splats.min(1.0) + cost.trained * splats;
        StepCost::CPU_SECONDS * (cost.pixels * pixels / MEAN_PIXELS + splats + cost.context)
    };
    let step = seconds(mean_pixels, mean_splats);
    let read = SECONDS_PER_READ_PIXEL * task.window_pixels() as f64;
    if settings.tolerance_db == 0.0 || !leaf {
        return read + f64::from(task.steps) * step;
    }
    let trained = f64::from(prune::steps_before(task.steps));
    let evaluations = Pruning::within(settings.tolerance_db).evaluations(task.steps, task.views.len());
    let recovery = f64::from(task.steps) - trained + RENDER_COST * evaluations as f64;
    read + trained * step + recovery * seconds(1.0, PRUNED_SHARE)
}
