//! Estimates the time and memory that a plan takes before it runs. No result depends on the estimate.
//!
//! The plan's [`StepCost`] divides work among tasks, so its constants stay as they are; the estimate has constants of its own. They
//! are fitted to 41 trainings of five captures and two cities (docs/decisions/0054) and scaled by the measured speed of this machine
//! ([`crate::speed`]). Pixels and splats change over a task's schedule (coarse mips first, densification towards the budget); the
//! estimate uses their means. The splats that a window shows do not make it better.

use std::collections::BTreeSet;

use blocks::{Plan, StepCost, Task};
use scene::BlockId;
use serde::Serialize;
use train::prune::{self, Pruning};

use crate::recipe::recipe_of;

/// CPU seconds per pixel of a step's window.
const SECONDS_PER_PIXEL: f64 = 0.0935e-6;
/// CPU seconds per trained splat, shown or not.
const SECONDS_PER_TRAINED_SPLAT: f64 = 0.3455e-6;
/// CPU seconds per pixel of a window that is read for the first time.
const SECONDS_PER_READ_PIXEL: f64 = 0.3e-6;
/// Steps that a block from sparse points spends on a coarse mip, relative to the recipe's largest share: its error ends a stage
/// earlier.
const COARSE_SHARE: f64 = 0.2;
/// Cost of rendering a window without training on it, relative to a step.
const RENDER_COST: f64 = 0.6;
/// Cost of a splat in a step or a rendering of pruning, relative to that before: there are fewer, but larger ones.
const PRUNING_COST: f64 = 1.1;
/// Splats that a child inherits from its parent, relative to its splats at the end.
const INHERITED_SHARE: f64 = 0.4;
/// Splats of a child's core and halo at the end, relative to [`blocks::trained_splats`]: neighbours own parts of the halo, and growth
/// may end early.
const CHILD_SPLATS: f64 = 0.2;
/// CPU seconds of a detection task on the machine of these constants, relative to that of the scheduler's unit.
const DETECTION_COST: f64 = 0.5;
/// Outcome over estimate on the bench's captures: smallest and largest of 16 runs (docs/decisions/0054).
const OUTCOME_RANGE: [f64; 2] = [0.7, 1.45];
/// Floats of a splat of SH degree 0 to 3 in a merged PLY: position, normal, colour, opacity, scale and rotation.
const PLY_FLOATS: [u64; 4] = [17, 26, 41, 62];

/// Estimated time, memory and size of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// CPU seconds of all tasks that train a block or look for objects, on the CPU backend.
    pub cpu_seconds: f64,
    /// Within which the outcomes of the bench's captures lay: a plan does not know how much splats overlap, nor how detailed the
    /// photos are.
    pub cpu_seconds_range: [f64; 2],
    /// The speed of this machine that they are for, relative to that of the estimate's constants.
    pub relative_speed: f64,
    /// Memory of the process during the largest task, bytes.
    pub memory_bytes: u64,
    /// Largest size of the merged model, bytes (pruning leaves fewer splats).
    pub bytes: u64,
}

impl Estimate {
    /// The estimate for one task at a time, on a machine of this [speed](crate::speed::relative_speed).
    pub fn of(plan: &Plan, relative_speed: f64) -> Self {
        let parents: BTreeSet<BlockId> = plan.tasks.iter().filter_map(|task| task.parent).collect();
        let leaf = |task: &&Task| !parents.contains(&task.block);
        let splats: u64 = plan.tasks.iter().filter(leaf).map(|task| u64::from(task.budget)).sum();
        let training: f64 = plan.tasks.iter().map(|task| cpu_seconds(plan, task)).sum();
        let detecting = plan.detect_tasks.iter().map(|task| task.work_millis).sum::<u64>() as f64 * 1e-3;
        let moving = plan.object_tasks.iter().map(|task| task.work_millis).sum::<u64>() as f64 * 1e-3;
        let cpu_seconds = training + DETECTION_COST * detecting + moving;
        let cpu_seconds = cpu_seconds / relative_speed;
        Self {
            cpu_seconds,
            relative_speed,
            cpu_seconds_range: OUTCOME_RANGE.map(|ratio| ratio * cpu_seconds),
            memory_bytes: plan.all_tasks().map(|task| task.memory_bytes()).max().unwrap_or(0),
            bytes: splats * 4 * PLY_FLOATS[usize::from(plan.settings.sh_degree.min(3))],
        }
    }
}

/// CPU seconds of a task on the CPU backend of the machine of the constants.
pub(crate) fn cpu_seconds(plan: &Plan, task: &Task) -> f64 {
    let settings = &plan.settings;
    let pixels = StepCost::of(task).pixels;
    let is_child = task.parent.is_some();
    let trained_splats = blocks::trained_splats(task) * if is_child { CHILD_SPLATS } else { 1.0 };
    let recipe = recipe_of(plan, task);
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
    let coarse_share = match recipe.detail_factor > 0.0 {
        true if !is_child => COARSE_SHARE,
        // A block that refines its parent stays coarse as long as it may. Without errors to decide, shares are fixed.
        _ => 1.0,
    };
    let (mut mean_pixels, mut left) = (0.0, 1.0);
    for (n, share) in recipe.coarse.iter().enumerate() {
        let share = coarse_share * f64::from(*share);
        mean_pixels += share * 0.25f64.powi((recipe.coarse.len() - n) as i32);
        left -= share;
    }
    mean_pixels += left;
    // Shares are relative to the full window and to the splats at the end.
    let seconds = |pixel_share: f64, splat_share: f64| {
        SECONDS_PER_PIXEL * pixels * pixel_share + SECONDS_PER_TRAINED_SPLAT * trained_splats * splat_share
    };
    let step = seconds(mean_pixels, mean_splats);
    let read = SECONDS_PER_READ_PIXEL * task.window_pixels() as f64;
    if settings.tolerance_db == 0.0 {
        return read + f64::from(task.steps) * step;
    }
    let trained = f64::from(prune::steps_before(task.steps));
    let evaluations = Pruning::within(settings.tolerance_db).evaluations(task.steps, task.views.len());
    let recovery = f64::from(task.steps) - trained + RENDER_COST * evaluations as f64;
    read + trained * step + recovery * seconds(1.0, PRUNING_COST)
}
