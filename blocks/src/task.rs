//! The tasks of a plan: they train a block or an object that moves, measure the model, or look for objects.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use glam::DVec3;
use scene::{BlockId, Rect};
use serde::{Deserialize, Serialize};

use crate::ground::{Ground, HALO_SCALE};
use crate::lod::Cut;

/// A window of a view at one mip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ViewUse {
    /// Index into the capture's views.
    pub view: u32,
    /// Mip of the image; 0 is full resolution.
    pub mip: u8,
    /// The window, pixels of that mip.
    pub window: Rect,
}

/// The task of training one block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// The block. It identifies the task within the plan.
    pub block: BlockId,
    /// The block whose result initialises this one. `None`: initialised from sparse points.
    pub parent: Option<BlockId>,
    /// Context: blocks that are rendered frozen with this one. Coarser blocks outside the halo, and finished neighbours
    /// of the same level, which also count inside the halo. Together with the parent they cover the plane; see
    /// [`Task::context_cut`].
    pub context: Vec<BlockId>,
    /// Training windows, sorted by view.
    pub views: Vec<ViewUse>,
    /// Held-out windows for evaluation, sorted by view.
    pub test_views: Vec<ViewUse>,
    /// Number of sparse points in the halo.
    pub points: u32,
    /// Target number of splats in the core at the end of training.
    pub budget: u32,
    /// Estimated number of own splats (core and halo) that a window shows at the end, mean over the windows.
    #[serde(rename = "drawn")]
    pub visible_splats: u32,
    /// Estimated number of frozen context splats that a window shows, mean over the windows.
    #[serde(rename = "context_drawn")]
    pub visible_context_splats: u32,
    /// Training steps, one window each.
    pub steps: u32,
    /// Target resolution, metres per pixel.
    pub rho_metres: f64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

impl Task {
    /// The total number of pixels of all training windows.
    pub fn window_pixels(&self) -> u64 {
        self.views.iter().map(|v| v.window.area()).sum()
    }

    /// The share of the pixels of the training windows that are finer than the parent's of the same view, 0 to 1: what
    /// the parent has not been trained on.
    pub fn finer_share(&self, parent: &Task) -> f64 {
        let mips: BTreeMap<u32, u8> = parent.views.iter().map(|used| (used.view, used.mip)).collect();
        let is_finer = |used: &&ViewUse| mips.get(&used.view).is_none_or(|mip| used.mip < *mip);
        let finer: u64 = self.views.iter().filter(is_finer).map(|used| used.window.area()).sum();
        finer as f64 / self.window_pixels().max(1) as f64
    }

    /// The donor of a place (world metres): the finished neighbour whose splats initialise that part of this block's
    /// core. `None`: the parent's splats are used.
    ///
    /// The donor is the nearest finished neighbour whose halo contains the place in its inner half. The neighbour
    /// trained its splats there together with the splats that stay frozen on its side of the face. In the outer half of
    /// its halo it has too few observations.
    pub fn donor(&self, ground: &Ground, place: DVec3) -> Option<BlockId> {
        const INNER: f64 = 0.25 * (HALO_SCALE - 1.0);
        if !ground.owns(self.block, place) || ground.is_background(place) {
            return None;
        }
        let reach = INNER * ground.core_edge_metres(self.block.level);
        (self.context.iter())
            .filter(|neighbour| neighbour.level == self.block.level)
            .map(|&neighbour| (ground.metres_from_core(neighbour, place), neighbour))
            .filter(|&(metres, _)| metres <= reach)
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, neighbour)| neighbour)
    }

    /// The cut that the block is trained against: its context and its parent.
    pub fn context_cut(&self) -> Cut {
        self.context.iter().copied().chain(self.parent).collect()
    }
}

/// The task of measuring the merged model on some held-out views. It reads the results of all blocks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EvalTask {
    /// Indices of the views, ascending. They are compared at full resolution.
    pub views: Vec<u32>,
    /// Pixels of all these views.
    pub pixels: u64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

/// The task of running the plan's detector on views that follow each other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DetectTask {
    /// Index of its first view.
    pub first: u32,
    /// Number of its views, at least 1.
    pub count: u32,
    /// Estimated CPU time, milliseconds, on the machine of [`StepCost::CPU_SECONDS`](crate::StepCost::CPU_SECONDS).
    pub work_millis: u64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

impl DetectTask {
    /// Indices of its views.
    pub fn views(&self) -> Range<u32> {
        self.first..self.first.saturating_add(self.count)
    }
}

/// The task of training an object that moves, in its own axes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectTask {
    /// Its place among the capture's objects.
    pub object: u32,
    /// Training windows around its box, sorted by view.
    pub views: Vec<ViewUse>,
    /// The blocks that are rendered frozen with it, a cut of the tree around its path.
    pub context: Vec<BlockId>,
    /// Most splats at the end of training.
    pub budget: u32,
    /// Training steps, one window each.
    pub steps: u32,
    /// Estimated CPU time, milliseconds, on the machine of [`StepCost::CPU_SECONDS`](crate::StepCost::CPU_SECONDS).
    pub work_millis: u64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

/// The tasks, by their place among these, of some views and of the views before and after each.
pub(crate) fn tasks_of_views(tasks: &[DetectTask], views: impl Iterator<Item = u32>) -> BTreeSet<usize> {
    let near = views.flat_map(|view| view.saturating_sub(1)..=view.saturating_add(1));
    near.map(|view| tasks.partition_point(|task| task.views().end <= view))
        .filter(|&place| place < tasks.len())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_needs_its_neighbours() {
        let task = |first, count| DetectTask { first, count, work_millis: 1, memory_bytes: 1 };
        let tasks = [task(0, 3), task(3, 2), task(5, 1), task(6, 4)];
        let of = |views: &[u32]| tasks_of_views(&tasks, views.iter().copied()).into_iter().collect::<Vec<_>>();
        assert_eq!([of(&[0]), of(&[1]), of(&[9]), of(&[])], [vec![0], vec![0], vec![3], vec![]]);
        assert_eq!([of(&[2]), of(&[3]), of(&[5]), of(&[0, 8])], [vec![0, 1], vec![0, 1], vec![1, 2, 3], vec![0, 3]]);
        // What a damaged plan may name.
        assert_eq!(of(&[10, u32::MAX]), [3]);
        assert!(tasks_of_views(&[], [0].into_iter()).is_empty());
    }
}
