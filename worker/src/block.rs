//! A block as its plan and its inputs define it: windows, ownership, budget, size bounds.

use std::collections::BTreeMap;
use std::sync::Arc;

use blocks::{Cut, Plan, Task, ViewUse};
use dataset::windows::WindowReader;
use glam::DVec3;
use scene::{BLOCK_ATTRIBUTE, BlockId, Capture, Exposures, Poses, Splats};
use train::prune::Pruning;
use train::{FreeSpace, TrainView};

use crate::aligned::TalliedLoss;
use crate::result_cache::ResultCache;
use crate::task::{ExecuteError, TaskOrder};
use crate::trainer_context::TrainerContext;

/// Draws of each window that a block needs to train all splats that the plan gives it (docs/decisions/0065).
const FULL_VISITS: f64 = 2.0;

/// A block to be trained.
pub(crate) struct Block<'a> {
    pub(crate) context: &'a TrainerContext,
    pub(crate) order: &'a TaskOrder,
    pub(crate) plan: &'a Plan,
    pub(crate) task: &'a Task,
    pub(crate) capture: &'a Arc<Capture>,
    pub(crate) reader: &'a WindowReader,
    /// The loss of the plan's detector, if it has a weight.
    pub(crate) aligned: Option<&'a TalliedLoss>,
    /// `None` if nothing is resumed.
    pub(crate) cache: Option<&'a ResultCache>,
    /// The exposures that the root trained.
    pub(crate) given_exposures: Option<&'a Exposures>,
    /// The poses that the root refined.
    pub(crate) given_poses: Option<&'a Poses>,
    /// The error of the root's splats, see [`crate::refine`].
    pub(crate) given_residual: Option<f64>,
}

impl Block<'_> {
    /// The windows of these uses, in the plan's order, from the given poses.
    pub(crate) fn windows(&self, uses: &[ViewUse]) -> Result<Vec<TrainView>, ExecuteError> {
        let window = |use_: &ViewUse| {
            let view = self.capture.views.get(use_.view as usize);
            let view = view.ok_or_else(|| ExecuteError::work(format!("the capture has no view {}", use_.view)))?;
            let camera = self.given_poses.map_or(view.camera, |poses| poses.apply(use_.view, view.camera));
            Ok(TrainView { view: use_.view, mip: use_.mip, rect: use_.window, camera, camera_from_context: None })
        };
        uses.iter().map(window).collect()
    }

    /// Whether a task's result is the final one at this place. The background belongs to the root.
    pub(crate) fn owns(&self, task: &Task, place: DVec3) -> bool {
        let ground = &self.plan.ground;
        ground.owns(task.block, place) && (task.parent.is_none() || !ground.is_background(place))
    }

    /// Whether the block trains splats at this place: in its halo, not in the background, and not in the core of a neighbour that is
    /// final already.
    pub(crate) fn trains(&self, cut: &Cut, place: DVec3) -> bool {
        let ground = &self.plan.ground;
        let owner = cut.owner_of(ground, place);
        self.task.parent.is_none()
            || (ground.in_halo(self.task.block, place)
                && !ground.is_background(place)
                && owner.is_none_or(|b| b.level < self.task.block.level))
    }

    /// Number of splats to end with in the core. The plan divides a level's budget before training; the parent's densification has
    /// since put splats where the error was. So the siblings' total is divided by the number of the parent's splats in each core. The
    /// root's background splats, which no child replaces, are subtracted first. What the steps cannot train is left out.
    pub(crate) fn budget(&self, results: &BTreeMap<BlockId, Splats>) -> usize {
        let (plan, task) = (self.plan, self.task);
        let Some(splats) = task.parent.and_then(|parent| results.get(&parent)) else { return task.budget as usize };
        let siblings: Vec<&Task> = plan.tasks.iter().filter(|t| t.parent == task.parent).collect();
        let total: u64 = siblings.iter().map(|t| u64::from(t.budget)).sum();
        let mut counts = vec![0u64; siblings.len()];
        for i in 0..splats.len() {
            let place = splats.mean(i).as_dvec3();
            if let Some(of) = siblings.iter().position(|t| self.owns(t, place)) {
                counts[of] += 1;
            }
        }
        let own = siblings.iter().position(|t| t.block == task.block).map_or(0, |i| counts[i]);
        let of_level = plan.tasks.iter().filter(|t| t.block.level == task.block.level).map(|t| u64::from(t.budget));
        let of_level = of_level.sum::<u64>().max(1);
        let background =
            |root: &Splats| (0..root.len()).filter(|&i| plan.ground.is_background(root.mean(i).as_dvec3())).count();
        let background = results.get(&BlockId::ROOT).map_or(0, background) as u64;
        let total = total * (of_level - background.min(of_level / 2)) / of_level;
        let asked = (total * own / counts.iter().sum::<u64>().max(1)).max(1);
        trainable(own, asked, plan.visits([task]))
    }

    /// How the block is pruned. Inner blocks are too: viewers draw them from afar, and their children start from what is left.
    pub(crate) fn pruning(&self) -> Option<Pruning> {
        let tolerance_db = self.plan.settings.tolerance_db;
        (tolerance_db > 0.0).then(|| Pruning::within(tolerance_db))
    }

    /// The key of the block's random numbers.
    pub(crate) fn seed(&self) -> u64 {
        let BlockId { level, x, y } = self.task.block;
        let place = u64::from(level) << 58 | u64::from(x) << 29 | u64::from(y);
        train::random::bits(self.plan.settings.seed, place)
    }

    /// Smallest and largest standard deviation of a splat, metres: from a twentieth of a pixel of the block's level to one and a half
    /// times the initial size of a backdrop splat. A backdrop splat that grows much larger becomes a haze over every photo that sees it,
    /// and a hole in the sky of viewers that leave it out. Only the root has a backdrop.
    pub(crate) fn size_bounds_metres(&self, views: &[TrainView]) -> [f32; 2] {
        let largest = match self.task.parent {
            None => 1.5 * train::init::backdrop_size_metres(self.backdrop_sphere(views).1),
            Some(_) => 0.5 * self.plan.ground.edge_metres,
        };
        [self.task.rho_metres as f32 * 0.05, largest as f32]
    }

    /// Centre and radius (metres) of the backdrop: centred on the cameras, five times as far as the 98th percentile of points and
    /// cameras.
    pub(crate) fn backdrop_sphere(&self, views: &[TrainView]) -> (DVec3, f64) {
        let cameras = views.iter().map(|view| view.camera.centre());
        let centre = cameras.clone().sum::<DVec3>() / views.len().max(1) as f64;
        let points = self.capture.points.positions.iter().copied();
        let mut distances: Vec<f64> =
            points.chain(cameras).map(|p| p.distance(centre)).filter(|d| d.is_finite()).collect();
        distances.sort_by(f64::total_cmp);
        let far = distances.get(distances.len() * 98 / 100).copied().unwrap_or(1.0);
        (centre, 5.0 * far.max(self.plan.ground.edge_metres * 0.5))
    }

    /// The space in the block's halo that its views see through. Only views that are trained on count.
    pub(crate) fn free_space(&self, views: &[TrainView]) -> Option<FreeSpace> {
        let views: Vec<u32> = views.iter().map(|view| view.view).collect();
        FreeSpace::new(self.capture, &views, |place| self.plan.ground.in_halo(self.task.block, place))
    }

    /// The splats with this block in their attribute [`BLOCK_ATTRIBUTE`].
    pub(crate) fn labelled(&self, mut splats: Splats) -> Splats {
        let code = self.task.block.code().unwrap_or(0);
        splats.set_attribute(BLOCK_ATTRIBUTE, vec![code; splats.len()]);
        splats
    }

    /// The splats as other blocks, viewers and the merged model render them: at full resolution. In anti-aliased mode they already are,
    /// as the compensated opacity does not depend on the resolution.
    pub(crate) fn at_full_resolution(&self, mut splats: Splats, views: &[TrainView]) -> Splats {
        if !self.plan.settings.antialiased {
            train::low_pass::to_full_resolution(&mut splats, views);
        }
        splats
    }
}

/// Number of splats to end with, of `asked`, in a block that starts with `own` splats of its parent and draws each of its windows
/// `visits` times. A splat that is split has to be trained anew, so that splats which are added late do harm.
fn trainable(own: u64, asked: u64, visits: f64) -> usize {
    if own == 0 || asked <= own {
        return asked as usize;
    }
    let (own, asked) = (own as f64, asked as f64);
    // Geometric, as [`train::growth::Growth::target`].
    (own * (asked / own).powf((visits / FULL_VISITS).clamp(0.0, 1.0))).round() as usize
}

#[cfg(test)]
mod tests {
    use super::trainable;

    #[test]
    fn few_visits_train_few_new_splats() {
        let rows = [(0.0, 100), (0.5, 141), (1.0, 200), (2.0, 400), (30.0, 400)];
        for (visits, expected) in rows {
            assert_eq!(trainable(100, 400, visits), expected, "{visits} visits");
        }
        assert_eq!([trainable(0, 400, 0.1), trainable(400, 100, 0.1)], [400, 100]);
    }
}
