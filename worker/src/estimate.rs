//! What a plan will take, before anything runs. An estimate: no result depends on it.
//!
//! A training step is priced as in the plan ([`StepCost`]). Pixels and splats change over a task's schedule (coarse mips first, growth
//! towards the budget), which the means here follow. Other machines are as much slower or faster as they are; one and the same
//! was 1.4 times faster at another hour.

use std::collections::BTreeSet;

use blocks::{Plan, StepCost, Task};
use scene::BlockId;
use serde::Serialize;
use train::prune::{self, Pruning};

use crate::block::recipe_of;

/// Pixels of a window at the mean resolution of a schedule of coarse mips, which the price is of, against all of them.
const MEAN_PIXELS: f64 = 0.475;
/// CPU seconds of reading a pixel of a window the first time.
const PER_READ_PIXEL: f64 = 0.3e-6;
/// Drawing a window without training on it, against a step.
const LOOKING: f64 = 0.45;
/// Splats on the way through pruning, against those before.
const PRUNED: f64 = 0.75;
/// Splats that a parent leaves where a child starts, against the child's budget.
const INHERITED: f64 = 0.4;
/// Bytes of a splat of SH degree 0 to 3 in a merged PLY: floats of position, normal, colour, opacity, scale and rotation.
const PLY_FLOATS: [u64; 4] = [17, 26, 41, 62];

/// What a plan will take.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// All tasks, on the CPU backend.
    pub cpu_seconds: f64,
    /// Of the process, with the largest task under way: bytes.
    pub memory_bytes: u64,
    /// Of the merged model, at most (pruning leaves fewer splats).
    pub bytes: u64,
}

impl Estimate {
    /// Of all tasks, one at a time.
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

/// Blocks below which others are trained.
pub(crate) fn parents(plan: &Plan) -> BTreeSet<BlockId> {
    plan.tasks.iter().filter_map(|task| task.parent).collect()
}

/// What a task will take on the CPU backend, CPU seconds.
pub(crate) fn cpu_seconds(plan: &Plan, task: &Task, leaf: bool) -> f64 {
    let settings = &plan.settings;
    let price = StepCost::of(task);
    let recipe = recipe_of(settings, task);
    let first = match task.parent {
        Some(_) => INHERITED,
        None => (f64::from(task.points.min(blocks::initial_splats(plan, task))) / f64::from(task.budget.max(1))).max(0.01),
    };
    // Geometric growth from `first` to 1 until its end; an inner block may begin with more than it asks for.
    let until = f64::from(recipe.growth.until);
    let growing = if first < 0.999 { (1.0 - first) / -first.ln() } else { first };
    let mean_splats = until * growing + (1.0 - until) * first.max(1.0);
    let (mut mean_pixels, mut left) = (0.0, 1.0);
    for (n, share) in recipe.coarse.iter().enumerate() {
        mean_pixels += f64::from(*share) * 0.25f64.powi((recipe.coarse.len() - n) as i32);
        left -= f64::from(*share);
    }
    mean_pixels += left;
    let seconds = |pixels: f64, splats: f64| {
        // What is shown is of whenever there are most splats: a root that begins with more than its budget shows no more than that.
        let splats = price.visible * splats.min(1.0) + price.trained * splats;
        StepCost::CPU_SECONDS * (price.pixels * pixels / MEAN_PIXELS + splats + price.context)
    };
    let step = seconds(mean_pixels, mean_splats);
    let read = PER_READ_PIXEL * task.window_pixels() as f64;
    if settings.tolerance_db == 0.0 || !leaf {
        return read + f64::from(task.steps) * step;
    }
    let trained = f64::from(prune::steps_before(task.steps));
    let looks = Pruning::within(settings.tolerance_db).evaluations(task.steps, task.views.len());
    let healing = f64::from(task.steps) - trained + LOOKING * looks as f64;
    read + trained * step + healing * seconds(1.0, PRUNED)
}
