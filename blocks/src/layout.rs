//! Layout of the block tree: its depth, the blocks that get a task, and their views and context.

use std::collections::{BTreeMap, BTreeSet};

use scene::{BlockId, Capture};

use crate::budgets::BLOCK_SPLATS;
use crate::ground::{Ground, quantile};
use crate::lod::{context_of, finished_neighbours, training_order};
use crate::plan::{MAX_LEVELS, Mode};
use crate::plan_error::PlanError;
use crate::split::Split;
use crate::task::Task;
use crate::view_selection::{ViewSelection, full_views, select_level};
use crate::visibility::Observations;

/// With automatic levels, the core of a leaf is at least this many finest pixels wide ...
const LEAF_EDGE_PIXELS: f64 = 768.0;
/// ... leaves have at least this many views on average ...
const MIN_MEAN_VIEWS: usize = 24;
/// ... at least this many sparse points on average ...
const MIN_MEAN_POINTS: usize = 500;
/// ... and together at least this share of all sparse points.
const MIN_COVERED_SHARE: f64 = 0.9;
/// A further level is added only if its parents would exceed the capacity of a block, in splats ([`BLOCK_SPLATS`]) or in
/// pixels: at equal work a scene in one piece is better.
const BLOCK_PIXELS: u64 = 500_000_000;
/// A leaf is split again if it has more than this many times the points of the median leaf ...
const CROWDED: f64 = 4.0;
/// ... at most this many times.
const MAX_SPLITS: u8 = 3;
/// A block other than the root has no task if fewer views than this observe it at a finer resolution than its parent
/// can use ...
pub(crate) const MIN_VIEWS: usize = 6;
/// ... or if its core has fewer sparse points than this.
const MIN_POINTS: u32 = 10;

/// The resolution of a level, metres per pixel: the finest at level `base` and deeper, doubled with every level above.
pub(crate) fn level_rho_metres(finest_metres: f64, base: u8, level: u8) -> f64 {
    finest_metres * f64::from(1u32 << base.saturating_sub(level))
}

/// The inputs of the layout.
pub(crate) struct Layout<'a> {
    pub(crate) capture: &'a Capture,
    pub(crate) observations: &'a Observations,
    pub(crate) ground: &'a Ground,
    pub(crate) split: &'a Split,
}

impl Layout<'_> {
    /// The blocks of a level that can be trained, with their views.
    fn trainable_blocks(&self, level: u8, rho_metres: f64) -> BTreeMap<BlockId, ViewSelection> {
        let mut selections = select_level(self.capture, self.observations, self.ground, level, rho_metres, self.split);
        selections.retain(|_, s| level == 0 || s.finer_views >= MIN_VIEWS && s.core_points >= MIN_POINTS);
        selections
    }

    /// Splits crowded leaves of level `base` into children at the same resolution: leaves with several times the points
    /// of the median leaf and enough views for all children.
    pub(crate) fn split_crowded(&self, base: u8, finest_metres: f64, tasks: &mut Vec<Task>) {
        let leaves = tasks.iter().filter(|task| task.block.level == base);
        let mut points: Vec<f64> = leaves.map(|task| f64::from(task.points)).collect();
        let median = quantile(&mut points, 0.5).max(MIN_MEAN_POINTS as f64);
        for level in base + 1..=(base + MAX_SPLITS).min(MAX_LEVELS) {
            let crowded: BTreeSet<BlockId> = (tasks.iter())
                .filter(|task| task.block.level == level - 1)
                .filter(|task| f64::from(task.points) > CROWDED * median)
                .filter(|task| task.views.len() >= 2 * MIN_MEAN_VIEWS)
                .map(|task| task.block)
                .collect();
            let mut selections = self.trainable_blocks(level, finest_metres);
            selections.retain(|block, _| block.parent().is_some_and(|parent| crowded.contains(&parent)));
            if selections.is_empty() {
                return;
            }
            let existing: BTreeSet<BlockId> = tasks.iter().map(|task| task.block).collect();
            tasks.append(&mut self.tasks_from(Mode::Tree, selections, &existing, finest_metres));
        }
    }

    /// The deepest level that the resolution allows, whose blocks have enough views and points, and without which a
    /// block would hold too much.
    pub(crate) fn choose_levels(&self, finest_metres: f64, budget: u32) -> u8 {
        let points = self.capture.points.len();
        let by_resolution = (self.ground.edge_metres / (LEAF_EDGE_PIXELS * finest_metres)).log2().floor();
        let deepest = (by_resolution.max(0.0) as u8).min(MAX_LEVELS);
        (1..=deepest)
            .rev()
            .find(|&level| {
                let tasks = self.trainable_blocks(level, finest_metres);
                let views: usize = tasks.values().map(|s| s.views.len()).sum();
                let covered: usize = tasks.values().map(|s| s.core_points as usize).sum();
                covered as f64 >= MIN_COVERED_SHARE * points as f64
                    && views >= MIN_MEAN_VIEWS * tasks.len()
                    && covered >= MIN_MEAN_POINTS * tasks.len()
                    && self.is_needed(level, finest_metres, budget)
            })
            .unwrap_or(0)
    }

    /// True when the blocks above this level alone would exceed the capacity of a block.
    fn is_needed(&self, level: u8, finest_metres: f64, budget: u32) -> bool {
        let parents = self.trainable_blocks(level - 1, 2.0 * finest_metres).len().max(1) as u64;
        let pixels: u64 = self.capture.views.iter().map(|view| view.camera.full().area()).sum();
        u64::from(budget) > u64::from(BLOCK_SPLATS) * parents || pixels > BLOCK_PIXELS * parents
    }

    /// Lays out the tasks, without budgets and steps. Returns the depth that was reached and the tasks: a tree with
    /// more levels than its views and points support is laid out again with fewer.
    ///
    /// # Errors
    /// [`PlanError::NoBlocks`] when no block can be trained.
    pub(crate) fn lay_out(&self, mode: Mode, levels: u8, finest_metres: f64) -> Result<(u8, Vec<Task>), PlanError> {
        let tree = mode == Mode::Tree;
        let first = if tree { 0 } else { levels };
        let mut tasks: Vec<Task> = Vec::new();
        let mut existing: BTreeSet<BlockId> = BTreeSet::new();
        for level in first..=levels {
            let rho_metres = level_rho_metres(finest_metres, levels, level);
            let mut selections = self.trainable_blocks(level, rho_metres);
            selections.retain(|block, _| !tree || block.parent().is_none_or(|p| existing.contains(&p)));
            if let (Mode::Whole, Some(root)) = (mode, selections.get_mut(&BlockId::ROOT)) {
                // A resolution of 0 selects mip 0 for all views.
                (root.test_views, root.views) = full_views(self.capture, self.observations, 0.0)
                    .into_iter()
                    .partition(|u| self.split.is_held_out(u.view));
            }
            let mut of_level = self.tasks_from(mode, selections, &existing, rho_metres);
            existing.extend(of_level.iter().map(|task| task.block));
            tasks.append(&mut of_level);
        }
        match tasks.last().map(|t| t.block.level) {
            None => Err(PlanError::NoBlocks { levels, needed: MIN_VIEWS }),
            Some(reached) if reached < levels => self.lay_out(mode, reached, finest_metres),
            Some(_) => Ok((levels, tasks)),
        }
    }

    /// The tasks of one level, in training order.
    fn tasks_from(
        &self,
        mode: Mode,
        selections: BTreeMap<BlockId, ViewSelection>,
        existing: &BTreeSet<BlockId>,
        rho_metres: f64,
    ) -> Vec<Task> {
        let tree = mode == Mode::Tree;
        let of_level: BTreeSet<BlockId> = selections.keys().copied().collect();
        let context = |block| -> Vec<BlockId> {
            if !tree {
                return Vec::new();
            }
            let coarser = context_of(self.ground, block, existing);
            coarser.into_iter().chain(finished_neighbours(block, &of_level)).collect()
        };
        let mut tasks: Vec<Task> = (selections.into_iter())
            .map(|(block, selection)| Task {
                block,
                parent: block.parent().filter(|_| tree),
                context: context(block),
                views: selection.views,
                test_views: selection.test_views,
                points: selection.halo_points,
                budget: 0,
                steps: 0,
                rho_metres,
                visible_splats: 0,
                visible_context_splats: 0,
                memory_bytes: 0,
            })
            .collect();
        tasks.sort_by_key(|t| training_order(t.block));
        tasks
    }
}
