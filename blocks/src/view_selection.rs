//! View selection: the views that train a block, their mips and their windows.
//!
//! A view is chosen by its observations of the block's sparse points and not by its position. Nothing is rendered (the
//! method of RE-Urban-GS and BlockGaussian, on tracked points). All blocks of a level are processed in one pass over
//! the observations: each observation goes to the one to four blocks whose halo contains its point.

use std::collections::BTreeMap;
use std::f64::consts::SQRT_2;

use glam::DVec2;
use scene::{BlockId, Capture, Rect};

use crate::block_box::BlockBox;
use crate::ground::{Ground, quantile};
use crate::split::Split;
use crate::task::ViewUse;
use crate::visibility::{Observation, Observations, footprint_metres, is_usable, mip_for};

/// A view needs at least this many observations of a block; fewer give no reliable depth and bounds.
const MIN_OBSERVATIONS: usize = 4;
/// A view is kept when at least this share of its observations lies in the block (BlockGaussian's first rule) ...
const MIN_SHARE_OF_VIEW: f64 = 0.3;
/// ... or when its count is at least this share of the block's 90th percentile view. BlockGaussian's second rule
/// demands 10 % of the block's points, which no view of a long street reaches.
const MIN_SHARE_OF_BEST: f64 = 0.1;
/// Views whose finest pixel is more than this many times the block's resolution are dropped ...
const TOO_COARSE: f64 = 4.0;
/// ... while at least this many finer views remain.
const ENOUGH_VIEWS: usize = 24;
/// Windows are aligned to tiles of the rasterizer, except at the image border. Pixels.
const TILE: u32 = 16;
/// Windows are padded by this share of their size on each side.
const WINDOW_PAD: f64 = 0.03;

/// The selection for one block.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ViewSelection {
    /// Training views, sorted by index.
    pub(crate) views: Vec<ViewUse>,
    /// Held-out views, sorted by index.
    pub(crate) test_views: Vec<ViewUse>,
    /// Number of training views whose finest pixels reach the block's resolution (with the rounding of mips). The
    /// parent, at half the resolution, cannot use their detail.
    pub(crate) finer_views: usize,
    /// Sparse points in the halo.
    pub(crate) halo_points: u32,
    /// Sparse points in the core.
    pub(crate) core_points: u32,
}

/// Selects views for every block of a level that has a sparse point in its core. `rho_metres` is the level's
/// resolution, metres per pixel. The root gets all views as full images.
pub(crate) fn select_level(
    capture: &Capture,
    observations: &Observations,
    ground: &Ground,
    level: u8,
    rho_metres: f64,
    split: &Split,
) -> BTreeMap<BlockId, ViewSelection> {
    let mut selections = count_points(capture, ground, level);
    if level == 0 {
        if let Some(root) = selections.get_mut(&BlockId::ROOT) {
            let uses = full_views(capture, observations, rho_metres);
            (root.test_views, root.views) = uses.into_iter().partition(|u| split.is_held_out(u.view));
        }
        return selections;
    }
    // (y, x, view, observation). After sorting, each block is a run, and each of its views a run within it.
    let mut entries: Vec<(u32, u32, u32, u32)> = Vec::new();
    let mut halos: Vec<BlockId> = Vec::new();
    let mut last = None;
    for (i, s) in observations.all.iter().enumerate() {
        if last != Some(s.point) {
            last = Some(s.point);
            halos = ground.halos_at(level, capture.points.positions[s.point as usize]).collect();
            halos.retain(|b| selections.contains_key(b));
        }
        entries.extend(halos.iter().map(|b| (b.y, b.x, s.view, i as u32)));
    }
    entries.sort_unstable();
    for run in entries.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let block = BlockId { level, x: run[0].1, y: run[0].0 };
        let views: Vec<BlockView> = run
            .chunk_by(|a, b| a.2 == b.2)
            .map(|of_view| {
                BlockView::new(capture, of_view[0].2, of_view.iter().map(|s| observations.all[s.3 as usize]))
            })
            .collect();
        let block_box = BlockBox::new(capture, ground, block, run.iter().map(|s| observations.all[s.3 as usize].point));
        let (test, train): (Vec<BlockView>, Vec<BlockView>) =
            views.into_iter().partition(|s| split.is_held_out(s.view));
        if let Some(selection) = selections.get_mut(&block) {
            let pick = |views| -> (Vec<ViewUse>, usize) {
                let uses = choose(views, observations, rho_metres);
                let uses = uses.iter().filter_map(|s| s.window(capture, &block_box, rho_metres).map(|used| (s, used)));
                let (finer, uses): (Vec<bool>, Vec<ViewUse>) =
                    uses.map(|(s, used)| (s.footprint_metres <= SQRT_2 * rho_metres, used)).unzip();
                (uses, finer.into_iter().filter(|finer| *finer).count())
            };
            (selection.views, selection.finer_views) = pick(train);
            selection.test_views = pick(test).0;
        }
    }
    selections
}

/// All usable views as full images, each at the mip that fits its median depth.
pub(crate) fn full_views(capture: &Capture, observations: &Observations, rho_metres: f64) -> Vec<ViewUse> {
    let mut depths: Vec<Vec<f64>> = vec![Vec::new(); capture.views.len()];
    for s in &observations.all {
        depths[s.view as usize].push(s.depth_metres);
    }
    let mut every: Vec<f64> = observations.all.iter().map(|s| s.depth_metres).collect();
    let typical_depth = quantile(&mut every, 0.5);
    let mut uses = Vec::new();
    for (view, depths) in depths.iter_mut().enumerate() {
        let camera = &capture.views[view].camera;
        if is_usable(camera) {
            let depth = if depths.is_empty() { typical_depth } else { quantile(depths, 0.5) };
            let mip = mip_for(camera, depth, rho_metres);
            uses.push(ViewUse { view: view as u32, mip, window: camera.mip(mip).full() });
        }
    }
    uses
}

/// Counts the sparse points in core and halo of every block of a level that has one in its core.
fn count_points(capture: &Capture, ground: &Ground, level: u8) -> BTreeMap<BlockId, ViewSelection> {
    let mut counts: BTreeMap<BlockId, ViewSelection> = BTreeMap::new();
    for &p in capture.points.positions.iter().filter(|p| p.is_finite()) {
        counts.entry(ground.block_at(level, p)).or_default().core_points += 1;
        for block in ground.halos_at(level, p) {
            counts.entry(block).or_default().halo_points += 1;
        }
    }
    counts.retain(|_, selection| selection.core_points > 0);
    counts
}

/// The observations of one block by one view, summarised.
struct BlockView {
    view: u32,
    count: usize,
    depth_metres: f64,
    footprint_metres: f64,
    /// 1st and 99th percentile of the observed positions, pixels of mip 0.
    bounds: (DVec2, DVec2),
}

impl BlockView {
    fn new(capture: &Capture, view: u32, observations: impl Iterator<Item = Observation>) -> Self {
        let (mut x, mut y, mut depth) = (Vec::new(), Vec::new(), Vec::new());
        for s in observations {
            x.push(f64::from(s.pixel[0]));
            y.push(f64::from(s.pixel[1]));
            depth.push(s.depth_metres);
        }
        let mut at = |q: f64| DVec2::new(quantile(&mut x, q), quantile(&mut y, q));
        let (bounds, depth_metres) = ((at(0.01), at(0.99)), quantile(&mut depth, 0.5));
        let footprint_metres = footprint_metres(&capture.views[view as usize].camera, depth_metres);
        Self { view, count: depth.len(), depth_metres, footprint_metres, bounds }
    }

    /// The window at the matching mip that contains the block's box (the observed points when the box cannot be
    /// projected). `None` for a window narrower than a tile.
    fn window(&self, capture: &Capture, block_box: &BlockBox, rho_metres: f64) -> Option<ViewUse> {
        let camera = &capture.views[self.view as usize].camera;
        let mip = mip_for(camera, self.depth_metres, rho_metres);
        let (low, high) = block_box.project(camera, 0.05 * self.depth_metres).unwrap_or(self.bounds);
        let small = camera.mip(mip);
        let scale = 1.0 / f64::from(1u32 << mip);
        let pad = (high - low) * WINDOW_PAD + 2.0 / scale;
        let side = |low: f64, high: f64, size: u32| {
            let size_f = f64::from(size);
            let from = (low * scale).floor().clamp(0.0, size_f) as u32 / TILE * TILE;
            let to = ((high * scale).ceil().clamp(0.0, size_f) as u32).next_multiple_of(TILE).min(size);
            let length = to.saturating_sub(from);
            (length >= TILE.min(size)).then_some((from, length))
        };
        let (x, width) = side(low.x - pad.x, high.x + pad.x, small.pinhole.width)?;
        let (y, height) = side(low.y - pad.y, high.y + pad.y, small.pinhole.height)?;
        Some(ViewUse { view: self.view, mip, window: Rect { x, y, width, height } })
    }
}

/// Keeps the views that are worth training on.
fn choose(mut views: Vec<BlockView>, observations: &Observations, rho_metres: f64) -> Vec<BlockView> {
    views.retain(|s| s.count >= MIN_OBSERVATIONS);
    let mut counts: Vec<f64> = views.iter().map(|s| s.count as f64).collect();
    let good = quantile(&mut counts, 0.9);
    views.retain(|s| {
        let of_view = s.count as f64 / f64::from(observations.per_view[s.view as usize].max(1));
        of_view >= MIN_SHARE_OF_VIEW || s.count as f64 >= MIN_SHARE_OF_BEST * good
    });
    if views.len() > ENOUGH_VIEWS {
        let mut finest: Vec<f64> = views.iter().map(|s| s.footprint_metres).collect();
        let enough = *finest.select_nth_unstable_by(ENOUGH_VIEWS - 1, f64::total_cmp).1;
        views.retain(|s| s.footprint_metres <= (TOO_COARSE * rho_metres).max(enough));
    }
    views
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::testing::{aerial, capture, street};

    fn levels_of(capture: &Capture, level: u8, rho: f64) -> BTreeMap<BlockId, ViewSelection> {
        let (observations, ground) = (Observations::of(capture), Ground::of(capture));
        select_level(capture, &observations, &ground, level, rho, &Split::new(capture, &ground, 8, 0.0))
    }

    #[test]
    fn views_are_selected_by_their_observations() {
        let capture = aerial(8, 300.0, 6000);
        let ground = Ground::of(&capture);
        let observations = Observations::of(&capture);
        for (block, selection) in levels_of(&capture, 2, 0.12) {
            assert!(!selection.views.is_empty() && selection.views.len() < 40, "{block}: {}", selection.views.len());
            assert!(selection.halo_points > selection.core_points);
            for used in selection.views.iter().chain(&selection.test_views) {
                let camera = &capture.views[used.view as usize].camera;
                let image = camera.mip(used.mip);
                let (window, full) = (used.window, image.full());
                assert!(window.x + window.width <= full.width && window.y + window.height <= full.height);
                assert!(window.x % TILE == 0 && window.y % TILE == 0);
                // The window contains at least 98 % of the observed points of the core.
                let (mut inside, mut all) = (0, 0);
                for s in observations.all.iter().filter(|s| s.view == used.view) {
                    let place = capture.points.positions[s.point as usize];
                    if ground.owns(block, place) {
                        let (pixel, _) = image.window(window).project(place);
                        all += 1;
                        inside += i32::from(
                            pixel.x >= 0.0
                                && pixel.x < f64::from(window.width)
                                && pixel.y >= 0.0
                                && pixel.y < f64::from(window.height),
                        );
                    }
                }
                assert!(all >= 4 && inside * 50 >= all * 49, "{block}: {inside} of {all}");
            }
            // Views far from the block are not used.
            let far = selection.views.iter().map(|v| capture.views[v.view as usize].camera.centre());
            let core = ground.core(block);
            assert!(far.into_iter().all(|c| (c.truncate() - core.centre()).length() < 150.0));
        }
    }

    #[test]
    fn windows_of_small_blocks_are_smaller_than_images() {
        let capture = aerial(8, 100.0, 6000);
        let selections = levels_of(&capture, 3, 0.12);
        let shares: Vec<f64> = (selections.values().flat_map(|s| &s.views))
            .map(|v| v.window.area() as f64 / capture.views[v.view as usize].camera.mip(v.mip).full().area() as f64)
            .collect();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        assert!(mean < 0.35, "{mean}");
    }

    #[test]
    fn a_capture_without_tracks_is_projected() {
        let with = aerial(4, 100.0, 800);
        let mut without = with.clone();
        (without.points.track_start, without.points.seen_by) = (Vec::new(), Vec::new());
        assert_eq!(levels_of(&with, 1, 0.12), levels_of(&without, 1, 0.12));
    }

    #[test]
    fn unusable_cameras_are_not_selected() {
        let mut bad = street(12, 600);
        bad.points.seen_by[0] = 4_000_000;
        bad.points.track_start[5] = u32::MAX;
        bad.points.positions[7] = DVec3::NAN;
        bad.views[3].camera.pinhole.fx = 0.0;
        bad.views[4].camera.camera_from_world.translation.x = f64::INFINITY;
        let selections = levels_of(&bad, 1, 0.02);
        assert!(selections.values().flat_map(|s| &s.views).all(|v| v.view != 3 && v.view != 4));
        assert!(levels_of(&capture(&[], Vec::new(), false), 2, 1.0).is_empty());
    }
}
