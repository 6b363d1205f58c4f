//! The cost model of a training step.
//!
//! `budgets` divides the work of a plan by it, and the coordinator derives the scheduler's estimate of a task's duration
//! from it. Its constants decide how many steps a block gets, so a change of them changes every model. The worker's
//! estimate of a plan's CPU time has constants of its own.

use crate::ground::HALO_SCALE;
use crate::task::Task;

/// Cost of a splat that the window shows, in pixels: it is projected, sorted, blended over its pixels and updated.
const PER_VISIBLE: f64 = 1.0;
/// Cost of a frozen splat that the window shows. The estimate from sparse points counts too few of them.
const PER_FROZEN: f64 = 3.0;
/// Cost of a splat under training, visible or not.
const PER_TRAINED: f64 = 0.5;
/// Splats of core and halo per splat of the core: the ratio of their areas.
pub(crate) const HALO_AREA: f64 = HALO_SCALE * HALO_SCALE;

/// The cost of one training step of a task, by component, in pixels. Resolution and number of splats are the means over
/// the task's schedule.
///
/// Fitted to the 127 tasks of three cities of 0.3, 0.6 and 1.2 km² at ten steps per view on one thread: the measured
/// time of a level's steps was 0.86 to 1.10 of the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepCost {
    /// Pixels of the window.
    pub pixels: f64,
    /// Visible splats of core and halo, at the time when there are most.
    pub visible: f64,
    /// Splats under training, visible or not.
    pub trained: f64,
    /// Visible frozen splats of the context.
    pub context: f64,
}

impl StepCost {
    /// CPU seconds per pixel of cost, on one core with AVX2 (AMD EPYC of 2021). A core with AVX-512 took half.
    pub const CPU_SECONDS: f64 = 0.26e-6;

    /// The mean cost of a step of this task.
    pub fn of(task: &Task) -> Self {
        Self {
            pixels: task.window_pixels() as f64 / task.views.len().max(1) as f64,
            visible: PER_VISIBLE * f64::from(task.visible_splats),
            trained: PER_TRAINED * trained_splats(task),
            context: PER_FROZEN * f64::from(task.visible_context_splats),
        }
    }

    /// The sum of all components, pixels.
    pub fn total(&self) -> f64 {
        self.pixels + self.visible + self.trained + self.context
    }
}

/// Splats of core and halo at the end of a task.
pub fn trained_splats(task: &Task) -> f64 {
    f64::from(task.budget) * if task.block.level == 0 { 1.0 } else { HALO_AREA }
}

/// The cost of one epoch of a task (one step on each of its windows), pixels.
pub(crate) fn epoch_cost(task: &Task) -> f64 {
    StepCost::of(task).total() * task.views.len() as f64
}
