//! Allots means to tasks: splats where there is most to model, steps so that plans of all modes cost the same, and
//! the memory that a task will take.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::{BlockId, Camera, Capture};

use crate::ground::Ground;
use crate::plan::{PlanSettings, Task};
use crate::price::{HALO_AREA, Price};
use crate::select::Sightings;
use crate::shown::Shown;

/// Splats of a block, against those of its children.
pub(crate) const INNER_BUDGET_RATIO: f64 = 1.0 / 2.5;
/// Splats that a task gets at least, where the whole budget allows it.
const MIN_BUDGET: u32 = 500;
/// What one block may have of splats. In a scene of more a step is counted as in a scene of so many: along a street, what a view
/// has ahead of it to the city's end grows with the city, and a tree need not pay for it.
pub(crate) const BLOCK_SPLATS: u32 = 100_000;
/// What a height sees again counts this much of what it is the first to see.
const SEEN_AGAIN: f64 = 0.05;
/// What is seen above the leaves counts this many times: all below it starts from there.
const INNER_COUNTS: f64 = 2.0;
/// A block that keeps this share of its own need, because too few of its children have a task, is worked on as a leaf.
const KEEPS_MUCH: f64 = 0.25;
/// Steps of a task at least.
const MIN_STEPS: u32 = 50;
/// Levels below the leaves of the cells in which ground is counted as seen: 16 a side (see [`Needs`]).
const CELL_LEVELS: u8 = 4;

/// How much there is to model in each block, as a share of the scene: half by sparse points, half by the number of
/// distinct finest pixels of the ground that the views see. Cells are the same for all levels, so a block needs
/// exactly what its children need.
pub(crate) struct Needs(BTreeMap<BlockId, f64>);

impl Needs {
    pub(crate) fn of(
        capture: &Capture,
        sightings: &Sightings,
        ground: &Ground,
        levels: u8,
        finest_metres: f64,
    ) -> Self {
        let cell_level = (levels + CELL_LEVELS).min(BlockId::MAX_LEVEL);
        // Per cell: its points, and the finest pixel that falls on it.
        let mut cells: BTreeMap<BlockId, (f64, f64)> = BTreeMap::new();
        let cell_of = |p: usize| ground.block_at(cell_level, capture.points.positions[p]);
        for (i, _) in capture.points.positions.iter().enumerate().filter(|(_, p)| p.is_finite()) {
            cells.entry(cell_of(i)).or_insert((0.0, f64::INFINITY)).0 += 1.0;
        }
        for s in &sightings.all {
            if let Some((_, finest)) = cells.get_mut(&cell_of(s.point as usize)) {
                *finest = finest.min(s.footprint_metres(capture));
            }
        }
        let pixels = |finest: f64| (finest_metres / finest.max(finest_metres)).powi(2);
        let (all_points, all_pixels) =
            cells.values().fold((0.0, 0.0), |(n, p), &(points, finest)| (n + points, p + pixels(finest)));
        let mut needs: BTreeMap<BlockId, f64> = BTreeMap::new();
        for (cell, (points, finest)) in cells {
            let share = 0.5 * points / f64::max(all_points, 1.0) + 0.5 * pixels(finest) / f64::max(all_pixels, 1e-300);
            for level in 0..=levels {
                *needs.entry(cell.ancestor(level)).or_default() += share;
            }
        }
        Self(needs)
    }

    fn of_block(&self, block: BlockId) -> f64 {
        self.0.get(&block).copied().unwrap_or(0.0)
    }
}

/// What a task's place in the tree says of its means.
struct Standing {
    /// Tasks below it on the way to the nearest leaf; 0 for blocks that keep much of their own ground, as a leaf does.
    height: u8,
    /// Share of the scene that stays with it: its own, less that of the children that have a task.
    kept: f64,
    /// Splats that it wants, as a share of the budget.
    splats: f64,
}

/// The standing of each task. What a block's children take over gets [`INNER_BUDGET_RATIO`] of their splats, what it
/// keeps as many as in a leaf.
fn standings(tasks: &[Task], needs: &Needs) -> Vec<Standing> {
    let mut known: BTreeMap<BlockId, Standing> = BTreeMap::new();
    // Children come after their parents.
    for block in tasks.iter().rev().map(|task| task.block) {
        let below: Vec<BlockId> = block.children().into_iter().filter(|child| known.contains_key(child)).collect();
        let need = needs.of_block(block);
        let taken: f64 = below.iter().map(|child| needs.of_block(*child)).sum();
        let kept = if below.is_empty() { need } else { (need - taken).max(0.0) };
        let inner: f64 = below.iter().map(|child| INNER_BUDGET_RATIO * known[child].splats).sum();
        let height = match below.iter().map(|child| known[child].height).min() {
            Some(lowest) if kept < KEEPS_MUCH * need => lowest + 1,
            _ => 0,
        };
        known.insert(block, Standing { height, kept, splats: kept + inner });
    }
    tasks.iter().filter_map(|task| known.remove(&task.block)).collect()
}

/// Shares out splats, steps and memory. `whole` stands for the whole scene as one task, whose steps are `settings.steps`.
pub(crate) fn set_means(
    tasks: &mut [Task],
    whole: Task,
    needs: &Needs,
    capture: &Capture,
    ground: &Ground,
    settings: &PlanSettings,
) {
    let standings = standings(tasks, needs);
    set_budgets(tasks, &standings, settings);
    set_drawn(tasks, capture, ground);
    set_context_drawn(tasks, capture, ground);
    let mut whole = [Task { budget: settings.budget.min(BLOCK_SPLATS), ..whole }];
    set_drawn(&mut whole, capture, ground);
    set_steps(tasks, &whole[0], &standings, capture, settings);
    set_memory(tasks, settings);
}

/// Splits `settings.budget` so that the merged model has that many splats, where there is most to model.
fn set_budgets(tasks: &mut [Task], standings: &[Standing], settings: &PlanSettings) {
    let total = f64::from(settings.budget);
    let parents = parents(tasks);
    // Leaves together, and inner blocks level by level; what these keep is not the leaves' to have.
    let group = |task: &Task| parents.contains(&task.block).then_some(task.block.level);
    let kept: f64 = tasks.iter().zip(standings).filter(|(task, _)| group(task).is_some()).map(|(_, s)| s.kept).sum();
    let groups: BTreeSet<Option<u8>> = tasks.iter().map(group).collect();
    for of in groups {
        let rows: Vec<usize> = (0..tasks.len()).filter(|&i| group(&tasks[i]) == of).collect();
        let shares: Vec<f64> = rows.iter().map(|&i| standings[i].splats).collect();
        let pool = if of.is_some() { total * shares.iter().sum::<f64>() } else { total * (1.0 - kept) };
        for (row, budget) in rows.into_iter().zip(split(pool.round(), &shares, MIN_BUDGET)) {
            tasks[row].budget = budget;
        }
    }
}

/// Splits a pool into whole numbers in proportion to the shares: each at least `minimum` (or a quarter of an equal
/// part, if that is less, or 1), and together the pool, but for the rounding up of a pool smaller than its parts.
fn split(pool: f64, shares: &[f64], minimum: u32) -> Vec<u32> {
    let n = shares.len() as f64;
    let least = f64::from(minimum).min((pool / (4.0 * n)).floor()).max(1.0);
    let rest = (pool - least * n).max(0.0);
    let total: f64 = shares.iter().sum();
    // Differences of a rounded running sum add up exactly, in whatever order the shares come.
    let (mut before, mut sum) = (0.0, 0.0);
    (shares.iter())
        .map(|share| {
            sum += if total > 0.0 { share / total } else { 1.0 / n };
            let upto = (rest * sum).round();
            let part = least + upto - before;
            before = upto;
            part as u32
        })
        .collect()
}

/// Shares out the work of `settings.steps` full images of the whole scene: over heights by what they are the first to see,
/// within a height so that every window is seen equally often.
fn set_steps(tasks: &mut [Task], whole: &Task, standings: &[Standing], capture: &Capture, settings: &PlanSettings) {
    if let [task] = tasks
        && task.views.iter().all(|v| v.mip == 0)
    {
        task.steps = settings.steps;
        return;
    }
    let work = f64::from(settings.steps) * cost_of_visits(whole) / whole.views.len().max(1) as f64;
    // Where splats and pixels are few a visit costs next to nothing, but needs no end of them.
    let most = INNER_COUNTS * f64::from(settings.steps) / whole.views.len().max(1) as f64;
    let shown = first_shown(tasks, standings, capture);
    let all: f64 = shown.values().sum();
    for (height, shown) in shown {
        let rows: Vec<usize> = (0..tasks.len()).filter(|&i| standings[i].height == height).collect();
        // One visit to every window of the height.
        let visit: f64 = rows.iter().map(|&i| cost_of_visits(&tasks[i])).sum();
        let visits = (work * shown / all.max(1.0) / visit.max(1.0)).min(most);
        for task in rows {
            let task = &mut tasks[task];
            task.steps = ((visits * task.views.len() as f64).round() as u32).max(MIN_STEPS.min(settings.steps));
        }
    }
}

/// What a step on each of its windows costs a task, in pixels.
pub(crate) fn cost_of_visits(task: &Task) -> f64 {
    Price::of(task).total() * task.views.len() as f64
}

/// Blocks below which there are others.
fn parents(tasks: &[Task]) -> BTreeSet<BlockId> {
    tasks.iter().filter_map(|task| task.parent).collect()
}

/// Pixels that the windows of each height are the first to show, from the root downwards, weighted; what they show again
/// counts [`SEEN_AGAIN`]. From the air every level shows four times the pixels of the one above, and leaves get three fifths of
/// the work; what stands along a road is mostly seen from so far that the root shows it as finely as any leaf.
fn first_shown(tasks: &[Task], standings: &[Standing], capture: &Capture) -> BTreeMap<u8, f64> {
    let mut heights: BTreeMap<u8, Shown> = BTreeMap::new();
    for (task, standing) in tasks.iter().zip(standings) {
        heights.entry(standing.height).or_default().add(&task.views, capture);
    }
    let mut before = Shown::default();
    let mut first = BTreeMap::new();
    for (height, shown) in heights.into_iter().rev() {
        let counts = if height > 0 { INNER_COUNTS } else { 1.0 };
        first.insert(height, counts * shown.first(&before, SEEN_AGAIN));
        before = shown.or(before);
    }
    first
}

/// Points and windows of a task that [`set_drawn`] looks at, at most.
const DRAWN_POINTS: usize = 20_000;
const DRAWN_WINDOWS: usize = 8;
/// Points that [`set_context_drawn`] looks at, at most: each of them for every task.
const CONTEXT_POINTS: usize = 4096;

/// Finite sparse points, so many at most.
fn sample(capture: &Capture, most: usize) -> Vec<DVec3> {
    let points = &capture.points.positions;
    points.iter().step_by(points.len().div_ceil(most).max(1)).filter(|p| p.is_finite()).copied().collect()
}

/// Some of a task's windows.
fn some_windows(task: &Task, capture: &Capture) -> Vec<Camera> {
    let some = task.views.iter().step_by(task.views.len().div_ceil(DRAWN_WINDOWS).max(1));
    some.map(|used| capture.views[used.view as usize].camera.mip(used.mip).window(used.window)).collect()
}

/// Is the point before the camera and inside its image?
fn shows(camera: &Camera, point: DVec3) -> bool {
    let (pixel, depth) = camera.project(point);
    let size = [f64::from(camera.pinhole.width), f64::from(camera.pinhole.height)];
    depth > 0.0 && (0.0..size[0]).contains(&pixel.x) && (0.0..size[1]).contains(&pixel.y)
}

/// Estimates how many splats of core and halo each task's windows show: as large a share as of the sparse points there.
fn set_drawn(tasks: &mut [Task], capture: &Capture, ground: &Ground) {
    let levels: BTreeSet<u8> = tasks.iter().map(|task| task.block.level).collect();
    let places: BTreeMap<BlockId, usize> = tasks.iter().enumerate().map(|(i, task)| (task.block, i)).collect();
    let windows: Vec<Vec<Camera>> = tasks.iter().map(|task| some_windows(task, capture)).collect();
    // Of each task, points that a window shows, and points times windows.
    let mut shown = vec![[0u64; 2]; tasks.len()];
    for point in sample(capture, DRAWN_POINTS) {
        for task in levels.iter().flat_map(|&level| ground.halos_at(level, point)).filter_map(|b| places.get(&b)) {
            shown[*task][0] += windows[*task].iter().filter(|camera| shows(camera, point)).count() as u64;
            shown[*task][1] += windows[*task].len() as u64;
        }
    }
    let parents = parents(tasks);
    for (task, [inside, all]) in tasks.iter_mut().zip(shown) {
        let share = inside as f64 / all.max(1) as f64;
        task.drawn = (trained_splats(task, parents.contains(&task.block)) * share).round() as u32;
    }
}

/// Estimates how many frozen splats each task's windows show: sparse points outside its halo, each for as many splats as the
/// block that is drawn there has for each of its own points.
fn set_context_drawn(tasks: &mut [Task], capture: &Capture, ground: &Ground) {
    let points = sample(capture, CONTEXT_POINTS);
    let mut own: BTreeMap<BlockId, f64> = BTreeMap::new();
    let levels: BTreeSet<u8> = tasks.iter().map(|task| task.block.level).collect();
    for block in levels.iter().flat_map(|&level| points.iter().map(move |&p| ground.block_at(level, p))) {
        *own.entry(block).or_default() += 1.0;
    }
    let splats_per_point: BTreeMap<BlockId, f64> =
        tasks.iter().map(|t| (t.block, f64::from(t.budget) / own.get(&t.block).copied().unwrap_or(1.0))).collect();
    for task in tasks.iter_mut().filter(|task| task.parent.is_some()) {
        let (cut, windows) = (task.context_cut(), some_windows(task, capture));
        let mut shown = 0.0;
        for &point in &points {
            let seen = windows.iter().filter(|camera| shows(camera, point)).count();
            let owner = if seen > 0 { cut.owner_of(ground, point) } else { None };
            let Some(owner) = owner else { continue };
            let trained = owner.level < task.block.level && ground.in_halo(task.block, point) && !ground.is_far(point);
            if !trained {
                shown += seen as f64 * splats_per_point.get(&owner).copied().unwrap_or(0.0);
            }
        }
        task.context_drawn = (shown / windows.len().max(1) as f64).round() as u32;
    }
}

/// Splats at most that a task starts with where it starts from points. What children will be made of may have as many as they
/// will: points cost little, and know where surfaces are.
pub(crate) fn first_splats(task: &Task, has_children: bool) -> u32 {
    if has_children { (f64::from(task.budget) / INNER_BUDGET_RATIO) as u32 } else { task.budget }
}

/// Splats under training, in core and halo, at the end or, if there are more, at first.
fn trained_splats(task: &Task, has_children: bool) -> f64 {
    let last = f64::from(task.budget) * if task.block.level == 0 { 1.0 } else { HALO_AREA };
    let first = if task.parent.is_none() { first_splats(task, has_children).min(task.points) } else { 0 };
    last.max(f64::from(first))
}

/// Columns of a splat of SH degree 3.
const COLUMNS: [u64; 4] = [14, 23, 38, 59];
/// Parameter, gradient and two moments, f32 each.
const BYTES_PER_TRAINED_COLUMN: u64 = 16;
/// A frozen parameter.
const BYTES_PER_FROZEN_COLUMN: u64 = 4;
/// Projected splat, its gradient, its growth statistics, its entries in tiles, and the copies that growth makes: what twelve
/// runs on the bench's captures took beyond the rest, within 15 % (a tree's process 27 % less than it takes).
const BYTES_PER_PROJECTED: u64 = 1860;
/// The same for a frozen splat: no gradient, no statistics, no copies.
const BYTES_PER_FROZEN_PROJECTED: u64 = 112;
/// Per window pixel: colour, depth, alpha, their gradients, the photo, weights and the SSIM planes.
const BYTES_PER_PIXEL: u64 = 120;
/// Windows of photos kept decoded at most; a pixel is four bytes.
const IMAGE_CACHE_BYTES: u64 = 128 << 20;
/// The program itself and its threads.
const BASE_BYTES: u64 = 17 << 20;

/// Estimates each task's peak memory: splats in core and halo under training, context frozen, one window's buffers,
/// and the image cache.
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
