//! Budgets: the splats, steps and memory of every task.
//!
//! Splats go where the scene has most detail. Steps are set so that plans of all modes cost the same. Memory is
//! estimated.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::{BlockId, Camera, Capture};

use crate::cost::{HALO_AREA, epoch_cost};
use crate::coverage::PixelCoverage;
use crate::ground::Ground;
use crate::plan::{Plan, PlanSettings};
use crate::task::Task;
use crate::visibility::Observations;

/// Splats of an inner block per splat of its children.
const INNER_BUDGET_RATIO: f64 = 1.0 / 2.5;
/// Minimum number of splats of a task, where the whole budget allows it.
const MIN_BUDGET: u32 = 500;
/// Splats that one block can hold, in about 1.6 GB. With automatic levels a scene of more is divided.
pub(crate) const BLOCK_SPLATS: u32 = 400_000;
/// The reference cost of a step is that of a scene of at most this many splats: along a street a view of the whole
/// scene shows ever more splats as the city grows, and a tree does not have that cost.
pub(crate) const COSTED_SPLATS: u32 = 100_000;
/// Weight of a pixel that a coarser level covers already, relative to a new pixel. Leaves have more splats than their
/// parent, and each has to be trained. At 0.05 the leaves of a dense street drew their windows 0.7 times, and the tree
/// had 23.0 dB where the whole scene had 30.7 (docs/decisions/0056).
const REPEATED_PIXEL_WEIGHT: f64 = 0.5;
/// Most visits of a window, relative to those of a view in a job of one block.
const MAX_VISITS: f64 = 2.0;
/// A block that keeps at least this share of its detail, because too few of its children have a task, counts as a leaf.
const LEAF_KEPT_SHARE: f64 = 0.25;
/// Minimum number of steps of a task.
const MIN_STEPS: u32 = 50;
/// Depth of the cells of [`DetailShares`] below the leaves: 16 cells a side.
const CELL_LEVELS: u8 = 4;

/// The detail in each block as a share of the whole scene: half by sparse points, half by the number of distinct finest
/// ground pixels that the views observe. All levels use the same cells, so the share of a block is the sum of its
/// children's.
pub(crate) struct DetailShares(BTreeMap<BlockId, f64>);

impl DetailShares {
    pub(crate) fn of(
        capture: &Capture,
        observations: &Observations,
        ground: &Ground,
        levels: u8,
        finest_metres: f64,
    ) -> Self {
        let cell_level = (levels + CELL_LEVELS).min(BlockId::MAX_LEVEL);
        // Per cell: the number of points and the finest pixel, metres.
        let mut cells: BTreeMap<BlockId, (f64, f64)> = BTreeMap::new();
        let cell_of = |p: usize| ground.block_at(cell_level, capture.points.positions[p]);
        for (i, _) in capture.points.positions.iter().enumerate().filter(|(_, p)| p.is_finite()) {
            cells.entry(cell_of(i)).or_insert((0.0, f64::INFINITY)).0 += 1.0;
        }
        for s in &observations.all {
            if let Some((_, finest)) = cells.get_mut(&cell_of(s.point as usize)) {
                *finest = finest.min(s.footprint_metres(capture));
            }
        }
        let pixels = |finest: f64| (finest_metres / finest.max(finest_metres)).powi(2);
        let (all_points, all_pixels) =
            cells.values().fold((0.0, 0.0), |(n, p), &(points, finest)| (n + points, p + pixels(finest)));
        let mut shares: BTreeMap<BlockId, f64> = BTreeMap::new();
        for (cell, (points, finest)) in cells {
            let share = 0.5 * points / f64::max(all_points, 1.0) + 0.5 * pixels(finest) / f64::max(all_pixels, 1e-300);
            for level in 0..=levels {
                *shares.entry(cell.ancestor(level)).or_default() += share;
            }
        }
        Self(shares)
    }

    fn of_block(&self, block: BlockId) -> f64 {
        self.0.get(&block).copied().unwrap_or(0.0)
    }
}

/// What a task's position in the tree implies for its budgets.
struct TreePosition {
    /// Number of tasks below it on the path to the nearest leaf; 0 for blocks that count as leaves
    /// ([`LEAF_KEPT_SHARE`]).
    height: u8,
    /// Share of the scene's detail that it keeps: its own less that of the children with a task.
    kept: f64,
    /// Splats it should get, as a share of the budget.
    splats: f64,
}

/// The tree position of each task. A block gets [`INNER_BUDGET_RATIO`] of the splats of its children for the part they
/// refine, and as many as a leaf for the part it keeps.
fn tree_positions(tasks: &[Task], shares: &DetailShares) -> Vec<TreePosition> {
    let mut known: BTreeMap<BlockId, TreePosition> = BTreeMap::new();
    // Children come after their parents in the plan, so the reverse order visits children first.
    for block in tasks.iter().rev().map(|task| task.block) {
        let below: Vec<BlockId> = block.children().into_iter().filter(|child| known.contains_key(child)).collect();
        let share = shares.of_block(block);
        let taken: f64 = below.iter().map(|child| shares.of_block(*child)).sum();
        let kept = if below.is_empty() { share } else { (share - taken).max(0.0) };
        let inner: f64 = below.iter().map(|child| INNER_BUDGET_RATIO * known[child].splats).sum();
        let height = match below.iter().map(|child| known[child].height).min() {
            Some(lowest) if kept < LEAF_KEPT_SHARE * share => lowest + 1,
            _ => 0,
        };
        known.insert(block, TreePosition { height, kept, splats: kept + inner });
    }
    tasks.iter().filter_map(|task| known.remove(&task.block)).collect()
}

/// Sets splats, steps and memory of all tasks. `whole` is the reference task of the cost: the whole scene as one task
/// of `settings.steps` steps.
pub(crate) fn set_all(
    tasks: &mut [Task],
    whole: Task,
    shares: &DetailShares,
    capture: &Capture,
    ground: &Ground,
    settings: &PlanSettings,
) {
    let positions = tree_positions(tasks, shares);
    set_budgets(tasks, &positions, settings);
    set_visible_splats(tasks, capture, ground);
    set_visible_context_splats(tasks, capture, ground);
    let mut whole = [Task { budget: settings.budget.min(COSTED_SPLATS), ..whole }];
    set_visible_splats(&mut whole, capture, ground);
    set_steps(tasks, &whole[0], &positions, capture, settings);
    set_memory(tasks, settings);
}

/// Splits `settings.budget` by detail, so that the merged model has that many splats.
fn set_budgets(tasks: &mut [Task], positions: &[TreePosition], settings: &PlanSettings) {
    let total = f64::from(settings.budget);
    let parents = parents(tasks);
    // All leaves form one group, inner blocks one group per level. Detail kept by inner blocks is not part of the
    // leaves' pool.
    let group = |task: &Task| parents.contains(&task.block).then_some(task.block.level);
    let kept: f64 = tasks.iter().zip(positions).filter(|(task, _)| group(task).is_some()).map(|(_, s)| s.kept).sum();
    let groups: BTreeSet<Option<u8>> = tasks.iter().map(group).collect();
    for of in groups {
        let rows: Vec<usize> = (0..tasks.len()).filter(|&i| group(&tasks[i]) == of).collect();
        let shares: Vec<f64> = rows.iter().map(|&i| positions[i].splats).collect();
        let pool = if of.is_some() { total * shares.iter().sum::<f64>() } else { total * (1.0 - kept) };
        for (row, budget) in rows.into_iter().zip(split(pool.round(), &shares, MIN_BUDGET)) {
            tasks[row].budget = budget;
        }
    }
}

/// Splits a pool into integers in proportion to the shares. Each part is at least `minimum`, or a quarter of an equal
/// part if that is less, and never below 1. The parts add up to the pool, unless the pool is smaller than the number of
/// parts.
fn split(pool: f64, shares: &[f64], minimum: u32) -> Vec<u32> {
    let n = shares.len() as f64;
    let minimum = f64::from(minimum).min((pool / (4.0 * n)).floor()).max(1.0);
    let rest = (pool - minimum * n).max(0.0);
    let total: f64 = shares.iter().sum();
    // Differences of a rounded running sum add up exactly to the rounded total.
    let (mut before, mut sum) = (0.0, 0.0);
    (shares.iter())
        .map(|share| {
            sum += if total > 0.0 { share / total } else { 1.0 / n };
            let upto = (rest * sum).round();
            let part = minimum + upto - before;
            before = upto;
            part as u32
        })
        .collect()
}

/// Divides the work of `settings.steps` full-image steps on the whole scene: between heights in proportion to their new
/// pixels, within a height so that every window gets equally many steps.
fn set_steps(tasks: &mut [Task], whole: &Task, positions: &[TreePosition], capture: &Capture, settings: &PlanSettings) {
    if let [task] = tasks
        && task.views.iter().all(|v| v.mip == 0)
    {
        task.steps = settings.steps;
        return;
    }
    let work = f64::from(settings.steps) * epoch_cost(whole) / whole.views.len().max(1) as f64;
    // A cheap epoch (few splats and pixels) must not lead to an unbounded number of steps.
    let max_epochs = MAX_VISITS * f64::from(settings.steps) / whole.views.len().max(1) as f64;
    let new_pixels = new_pixels_by_height(tasks, positions, capture);
    let all: f64 = new_pixels.values().sum();
    for (height, pixels) in new_pixels {
        let rows: Vec<usize> = (0..tasks.len()).filter(|&i| positions[i].height == height).collect();
        let epoch: f64 = rows.iter().map(|&i| epoch_cost(&tasks[i])).sum();
        let epochs = (work * pixels / all.max(1.0) / epoch.max(1.0)).min(max_epochs);
        for task in rows {
            let task = &mut tasks[task];
            task.steps = ((epochs * task.views.len() as f64).round() as u32).max(MIN_STEPS.min(settings.steps));
        }
    }
}

/// The blocks that have children.
fn parents(tasks: &[Task]) -> BTreeSet<BlockId> {
    tasks.iter().filter_map(|task| task.parent).collect()
}

/// The number of pixels that the windows of each height add to the heights above it. Repeated pixels count
/// [`REPEATED_PIXEL_WEIGHT`].
///
/// In an aerial capture every level has four times the pixels of the level above, and leaves get three quarters of the
/// work. In a street capture most content is observed from so far away that the root resolves it as finely as a leaf,
/// and leaves get a third.
fn new_pixels_by_height(tasks: &[Task], positions: &[TreePosition], capture: &Capture) -> BTreeMap<u8, f64> {
    let mut heights: BTreeMap<u8, PixelCoverage> = BTreeMap::new();
    for (task, position) in tasks.iter().zip(positions) {
        heights.entry(position.height).or_default().add(&task.views, capture);
    }
    let mut before = PixelCoverage::default();
    let mut first = BTreeMap::new();
    for (height, coverage) in heights.into_iter().rev() {
        first.insert(height, coverage.new_pixels(&before, REPEATED_PIXEL_WEIGHT));
        before = coverage.max_per_view(before);
    }
    first
}

/// Maximum number of points that [`set_visible_splats`] samples.
const MAX_VISIBLE_POINTS: usize = 20_000;
/// Maximum number of windows of a task that are sampled.
const MAX_SAMPLED_WINDOWS: usize = 8;
/// Maximum number of points that [`set_visible_context_splats`] samples. Each is tested against every task.
const MAX_CONTEXT_POINTS: usize = 4096;

/// A regular sample of at most `max` sparse points, the finite ones.
fn sample_points(capture: &Capture, max: usize) -> Vec<DVec3> {
    let points = &capture.points.positions;
    points.iter().step_by(points.len().div_ceil(max).max(1)).filter(|p| p.is_finite()).copied().collect()
}

/// The cameras of a regular sample of a task's windows.
fn sample_windows(task: &Task, capture: &Capture) -> Vec<Camera> {
    let some = task.views.iter().step_by(task.views.len().div_ceil(MAX_SAMPLED_WINDOWS).max(1));
    some.map(|used| capture.views[used.view as usize].camera.mip(used.mip).window(used.window)).collect()
}

/// True when the point is in front of the camera and inside its image.
fn is_visible(camera: &Camera, point: DVec3) -> bool {
    let (pixel, depth) = camera.project(point);
    let size = [f64::from(camera.pinhole.width), f64::from(camera.pinhole.height)];
    depth > 0.0 && (0.0..size[0]).contains(&pixel.x) && (0.0..size[1]).contains(&pixel.y)
}

/// Estimates the number of visible splats of core and halo per window: the same share as of the sparse points there.
fn set_visible_splats(tasks: &mut [Task], capture: &Capture, ground: &Ground) {
    let levels: BTreeSet<u8> = tasks.iter().map(|task| task.block.level).collect();
    let places: BTreeMap<BlockId, usize> = tasks.iter().enumerate().map(|(i, task)| (task.block, i)).collect();
    let windows: Vec<Vec<Camera>> = tasks.iter().map(|task| sample_windows(task, capture)).collect();
    // Per task: visible (point, window) pairs and all pairs.
    let mut visible = vec![[0u64; 2]; tasks.len()];
    for point in sample_points(capture, MAX_VISIBLE_POINTS) {
        for task in levels.iter().flat_map(|&level| ground.halos_at(level, point)).filter_map(|b| places.get(&b)) {
            visible[*task][0] += windows[*task].iter().filter(|camera| is_visible(camera, point)).count() as u64;
            visible[*task][1] += windows[*task].len() as u64;
        }
    }
    let parents = parents(tasks);
    for (task, [seen, all]) in tasks.iter_mut().zip(visible) {
        let share = seen as f64 / all.max(1) as f64;
        task.visible_splats = (trained_splats(task, parents.contains(&task.block)) * share).round() as u32;
    }
}

/// Estimates the number of visible frozen splats per window: each sparse point outside the task's halo stands for as
/// many splats as the owning context block has per point of its core.
fn set_visible_context_splats(tasks: &mut [Task], capture: &Capture, ground: &Ground) {
    let points = sample_points(capture, MAX_CONTEXT_POINTS);
    let mut points_of: BTreeMap<BlockId, f64> = BTreeMap::new();
    let levels: BTreeSet<u8> = tasks.iter().map(|task| task.block.level).collect();
    for block in levels.iter().flat_map(|&level| points.iter().map(move |&p| ground.block_at(level, p))) {
        *points_of.entry(block).or_default() += 1.0;
    }
    let splats_per_point: BTreeMap<BlockId, f64> = tasks
        .iter()
        .map(|t| (t.block, f64::from(t.budget) / points_of.get(&t.block).copied().unwrap_or(1.0)))
        .collect();
    for task in tasks.iter_mut().filter(|task| task.parent.is_some()) {
        let (cut, windows) = (task.context_cut(), sample_windows(task, capture));
        let mut visible = 0.0;
        for &point in &points {
            let seen = windows.iter().filter(|camera| is_visible(camera, point)).count();
            let owner = if seen > 0 { cut.owner_of(ground, point) } else { None };
            let Some(owner) = owner else { continue };
            let trained =
                owner.level < task.block.level && ground.in_halo(task.block, point) && !ground.is_background(point);
            if !trained {
                visible += seen as f64 * splats_per_point.get(&owner).copied().unwrap_or(0.0);
            }
        }
        task.visible_context_splats = (visible / windows.len().max(1) as f64).round() as u32;
    }
}

/// The maximum number of splats that a task without a parent is initialised with from sparse points.
///
/// An inner block may start with as many splats as its children end with: points are cheap and lie on surfaces.
pub fn initial_splats(plan: &Plan, task: &Task) -> u32 {
    max_initial_splats(task, plan.tasks.iter().any(|t| t.parent == Some(task.block)))
}

fn max_initial_splats(task: &Task, has_children: bool) -> u32 {
    if has_children { (f64::from(task.budget) / INNER_BUDGET_RATIO) as u32 } else { task.budget }
}

/// The number of splats under training in core and halo: the maximum of the initial and the final number.
fn trained_splats(task: &Task, has_children: bool) -> f64 {
    let last = f64::from(task.budget) * if task.block.level == 0 { 1.0 } else { HALO_AREA };
    let first = if task.parent.is_none() { max_initial_splats(task, has_children).min(task.points) } else { 0 };
    last.max(f64::from(first))
}

/// Parameters of a splat, by SH degree.
pub(crate) const COLUMNS: [u64; 4] = [14, 23, 38, 59];
/// Bytes per trained parameter: value, gradient and two Adam moments, f32 each.
pub(crate) const BYTES_PER_TRAINED_COLUMN: u64 = 16;
/// Bytes per frozen parameter.
pub(crate) const BYTES_PER_FROZEN_COLUMN: u64 = 4;
/// Bytes per splat under training beyond its parameters: the projected splat, its gradient, densification statistics,
/// tile entries and copies made by densification. Fitted to twelve bench runs within 15 %; the processes of tree plans
/// used up to 27 % less.
pub(crate) const BYTES_PER_PROJECTED: u64 = 1860;
/// The same for a frozen splat, which has no gradient, statistics or copies.
pub(crate) const BYTES_PER_FROZEN_PROJECTED: u64 = 112;
/// Bytes per window pixel: colour, depth, alpha, their gradients, the photo, weights and SSIM planes.
pub(crate) const BYTES_PER_PIXEL: u64 = 120;
/// Limit of the decoded-window cache. A pixel takes four bytes.
const IMAGE_CACHE_BYTES: u64 = 128 << 20;
/// Bytes of the process itself and its threads.
pub(crate) const BASE_BYTES: u64 = 17 << 20;

/// Estimates each task's peak memory, bytes: splats under training, frozen context, the buffers of one window and the
/// image cache.
fn set_memory(tasks: &mut [Task], settings: &PlanSettings) {
    let columns = COLUMNS[usize::from(settings.sh_degree.min(3))];
    let budgets: BTreeMap<BlockId, u64> = tasks.iter().map(|t| (t.block, u64::from(t.budget))).collect();
    let parents = parents(tasks);
    for task in tasks {
        let trained = trained_splats(task, parents.contains(&task.block)) as u64;
        let frozen: u64 = task.context.iter().chain(&task.parent).filter_map(|b| budgets.get(b)).sum();
        let window = task.views.iter().map(|v| v.window.area()).max().unwrap_or(0);
        task.memory_bytes = BASE_BYTES
            + trained * (columns * BYTES_PER_TRAINED_COLUMN + BYTES_PER_PROJECTED)
            + frozen * (columns * BYTES_PER_FROZEN_COLUMN + BYTES_PER_FROZEN_PROJECTED)
            + window * BYTES_PER_PIXEL
            + (task.window_pixels() * 4).min(IMAGE_CACHE_BYTES);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_add_up() {
        for (pool, shares, minimum) in [
            (1000.0, vec![1.0, 2.0, 0.0, 7.0], 50),
            (10.0, vec![0.0; 7], 500),
            (3.0, vec![1.0; 5], 500),
            (1e9, vec![1e-9, 3.0], 1),
        ] {
            let parts = split(pool, &shares, minimum);
            let sum: u64 = parts.iter().map(|&p| u64::from(p)).sum();
            assert_eq!(sum, (pool as u64).max(shares.len() as u64));
            assert!(parts.iter().all(|&p| p >= 1));
        }
        assert_eq!(split(1000.0, &[1.0, 0.0], 50), [950, 50]);
    }
}
