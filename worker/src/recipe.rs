//! The training recipe of a block, by its level in the tree.

use blocks::{Plan, Task};
use train::Recipe;

const _: () = assert!(blocks::MAX_VIEWS_PER_STEP == train::MAX_VIEWS_PER_STEP);

/// The recipe of a task. A child refines its parent's splats, which fit already at the next coarser mip; a root starts from points.
pub(crate) fn recipe_of(plan: &Plan, task: &Task) -> Recipe {
    let (settings, from_points) = (&plan.settings, task.parent.is_none());
    let recipe = match task.parent.and_then(|parent| plan.task(parent)) {
        Some(parent) => Recipe::refinement(task.finer_share(parent) as f32),
        None => Recipe::default(),
    };
    let depth_weight = settings.depth_weight as f32;
    let picture_weight = settings.aligned_weight as f32;
    let recipe = Recipe { views_per_step: settings.views_per_step, depth_weight, picture_weight, ..recipe };
    if settings.residual > 0.0 { recipe } else { recipe.fixed_schedule(from_points) }
}
