//! Which views train a block, at which mip, and which window of them: by what a view *sees* of the block, not by
//! where it stands, and without rendering (as RE-Urban-GS and BlockGaussian do it with tracked points).
//!
//! The tracks are walked once per level: [`Sightings`] lists every (point, view, pixel, depth) of the capture, and
//! [`select_level`] hands each to the one to four blocks whose halo holds the point.

use std::collections::BTreeMap;
use std::f64::consts::SQRT_2;

use glam::{DVec2, DVec3};
use scene::{BlockId, Camera, Capture, Rect};

use crate::ground::{Ground, Square, quantile};
use crate::plan::ViewUse;

/// A view needs this many seen points of a block; fewer say too little about depth and place.
const MIN_SEEN: usize = 4;
/// A view is kept when this share of what it sees lies in the block (BlockGaussian's first rule) ...
const SHARE_OF_VIEW: f64 = 0.3;
/// ... or when it sees this share of what the block's good views (their 90th percentile) see of it. BlockGaussian's
/// second rule takes 10 % of the block's points, which no view of a long street reaches.
const SHARE_OF_BEST: f64 = 0.1;
/// Views whose finest pixel is this much larger than the block resolves are left out ...
const TOO_COARSE: f64 = 4.0;
/// ... where at least this many others remain.
const ENOUGH_VIEWS: usize = 24;
/// Windows start and end on tiles of the rasterizer, where the image lets them.
const TILE: u32 = 16;
/// Windows are wider than what they must show by this share on each side.
const WINDOW_PAD: f64 = 0.03;
/// Mips exist while the shorter side has at least this many pixels.
pub const MIN_MIP_SIDE: u32 = 16;
/// Where there are no tracks, points are sampled so that at most this many (point, view) pairs are tried.
const MAX_TRIES: usize = 20_000_000;

/// A point seen by a view.
#[derive(Debug, Clone, Copy)]
pub struct Sighting {
    /// Index of the point.
    pub point: u32,
    /// Index of the view.
    pub view: u32,
    /// Where, in pixels of mip 0.
    pub pixel: [f32; 2],
    /// Depth in metres, positive.
    pub depth_metres: f64,
}

/// Everything that the views of a capture see of its sparse points.
#[derive(Debug, Clone, Default)]
pub struct Sightings {
    /// By (point, view), each pair once.
    pub all: Vec<Sighting>,
    /// Sightings of each view.
    pub per_view: Vec<u32>,
}

/// True for cameras that can be projected into.
pub fn usable(camera: &Camera) -> bool {
    let k = &camera.pinhole;
    let focal = k.fx.is_finite() && k.fy.is_finite() && k.fx > 0.0 && k.fy > 0.0;
    camera.camera_from_world.is_sane() && focal && k.cx.is_finite() && k.cy.is_finite() && k.width > 0 && k.height > 0
}

/// The coarsest mip of an image of this size.
pub fn max_mip(width: u32, height: u32) -> u8 {
    (width.min(height) / MIN_MIP_SIDE).checked_ilog2().unwrap_or(0) as u8
}

/// Metres on the ground that one pixel of mip 0 covers at this depth.
fn footprint_metres(camera: &Camera, depth_metres: f64) -> f64 {
    depth_metres / (camera.pinhole.fx * camera.pinhole.fy).sqrt()
}

impl Sighting {
    /// Metres that one pixel of mip 0 covers here.
    pub fn footprint_metres(&self, capture: &Capture) -> f64 {
        footprint_metres(&capture.views[self.view as usize].camera, self.depth_metres)
    }
}

impl Sightings {
    /// Walks the tracks; a point whose track is empty or absent counts as seen by every view it projects into, if the
    /// capture has no tracks at all. Sightings behind a camera or outside its image are left out.
    pub fn of(capture: &Capture) -> Self {
        let cameras: Vec<Option<&Camera>> =
            capture.views.iter().map(|v| Some(&v.camera).filter(|c| usable(c))).collect();
        let mut seen = Self { all: Vec::new(), per_view: vec![0; capture.views.len()] };
        let points = &capture.points.positions;
        let tracked = !capture.points.seen_by.is_empty();
        let stride = if tracked { 1 } else { (points.len() * cameras.len()).div_ceil(MAX_TRIES).max(1) };
        let every: Vec<u32> = if tracked { Vec::new() } else { (0..cameras.len() as u32).collect() };
        let mut track = Vec::new();
        for point in (0..points.len()).step_by(stride) {
            track.clear();
            track.extend_from_slice(if tracked { capture.points.track(point).unwrap_or(&[]) } else { &every });
            track.sort_unstable();
            track.dedup();
            for &view in &track {
                let Some(camera) = cameras.get(view as usize).copied().flatten() else { continue };
                let (pixel, depth_metres) = camera.project(points[point]);
                let size = DVec2::new(f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
                let inside = Square { min: DVec2::ZERO, max: size }.contains(pixel);
                if inside && depth_metres.is_finite() && depth_metres > 0.0 {
                    let sighting =
                        Sighting { point: point as u32, view, pixel: pixel.as_vec2().to_array(), depth_metres };
                    seen.all.push(sighting);
                    seen.per_view[view as usize] += 1;
                }
            }
        }
        seen
    }
}

/// What was selected for one block.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Selection {
    /// Views to train on, by index.
    pub views: Vec<ViewUse>,
    /// Held-out views, by index.
    pub test_views: Vec<ViewUse>,
    /// Training views whose finest pixels are as small as the block resolves (rounded as mips are): its parent, which
    /// resolves half as much, cannot use them.
    pub finer_views: usize,
    /// Sparse points in the halo.
    pub halo_points: u32,
    /// Sparse points in the core.
    pub core_points: u32,
}

/// Selects views for every block of a level that has a sparse point in its core. `rho_metres`: metres per pixel
/// that the level resolves. The root sees everything: all views, full images.
pub fn select_level(
    capture: &Capture,
    sightings: &Sightings,
    ground: &Ground,
    level: u8,
    rho_metres: f64,
    test_every: u32,
) -> BTreeMap<BlockId, Selection> {
    let mut selections = count_points(capture, ground, level);
    if level == 0 {
        if let Some(root) = selections.get_mut(&BlockId::ROOT) {
            let uses = full_views(capture, sightings, rho_metres);
            (root.test_views, root.views) =
                uses.into_iter().partition(|u| Capture::is_test(u.view as usize, test_every));
        }
        return selections;
    }
    // (y, x, view, sighting): sorted, each block's share is a run, and each view's within it.
    let mut seen: Vec<(u32, u32, u32, u32)> = Vec::new();
    let mut halos: Vec<BlockId> = Vec::new();
    let mut last = None;
    for (i, s) in sightings.all.iter().enumerate() {
        if last != Some(s.point) {
            last = Some(s.point);
            halos = ground.halos_at(level, capture.points.positions[s.point as usize]).collect();
            halos.retain(|b| selections.contains_key(b));
        }
        seen.extend(halos.iter().map(|b| (b.y, b.x, s.view, i as u32)));
    }
    seen.sort_unstable();
    for run in seen.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let block = BlockId { level, x: run[0].1, y: run[0].0 };
        let views: Vec<Seen> = run
            .chunk_by(|a, b| a.2 == b.2)
            .map(|of_view| Seen::new(capture, of_view[0].2, of_view.iter().map(|s| sightings.all[s.3 as usize])))
            .collect();
        let content = Content::new(capture, ground, block, run.iter().map(|s| sightings.all[s.3 as usize].point));
        let (test, train): (Vec<Seen>, Vec<Seen>) =
            views.into_iter().partition(|s| Capture::is_test(s.view as usize, test_every));
        if let Some(selection) = selections.get_mut(&block) {
            let pick = |seen| -> (Vec<ViewUse>, usize) {
                let uses = choose(seen, sightings, rho_metres);
                let uses = uses.iter().filter_map(|s| s.window(capture, &content, rho_metres).map(|used| (s, used)));
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

/// All usable views in full, each at the mip that fits its median depth.
pub fn full_views(capture: &Capture, sightings: &Sightings, rho_metres: f64) -> Vec<ViewUse> {
    let mut depths: Vec<Vec<f64>> = vec![Vec::new(); capture.views.len()];
    for s in &sightings.all {
        depths[s.view as usize].push(s.depth_metres);
    }
    let mut every: Vec<f64> = sightings.all.iter().map(|s| s.depth_metres).collect();
    let typical_depth = quantile(&mut every, 0.5);
    let mut uses = Vec::new();
    for (view, depths) in depths.iter_mut().enumerate() {
        let camera = &capture.views[view].camera;
        if usable(camera) {
            let depth = if depths.is_empty() { typical_depth } else { quantile(depths, 0.5) };
            let mip = mip_for(camera, depth, rho_metres);
            uses.push(ViewUse { view: view as u32, mip, window: camera.mip(mip).full() });
        }
    }
    uses
}

/// The mip whose pixel covers about `rho_metres` at this depth.
pub fn mip_for(camera: &Camera, depth_metres: f64, rho_metres: f64) -> u8 {
    let mip = (rho_metres / footprint_metres(camera, depth_metres)).log2().round();
    // `as` saturates and takes NaN to 0.
    (mip as u8).min(max_mip(camera.pinhole.width, camera.pinhole.height))
}

/// The blocks of a level with a point in their core, and how many points lie in core and halo.
fn count_points(capture: &Capture, ground: &Ground, level: u8) -> BTreeMap<BlockId, Selection> {
    let mut counts: BTreeMap<BlockId, Selection> = BTreeMap::new();
    for &p in capture.points.positions.iter().filter(|p| p.is_finite()) {
        counts.entry(ground.block_at(level, p)).or_default().core_points += 1;
        for block in ground.halos_at(level, p) {
            counts.entry(block).or_default().halo_points += 1;
        }
    }
    counts.retain(|_, selection| selection.core_points > 0);
    counts
}

/// What one view sees of one block.
struct Seen {
    view: u32,
    count: usize,
    depth_metres: f64,
    footprint_metres: f64,
    /// Robust bounds of the seen points, pixels of mip 0.
    bounds: (DVec2, DVec2),
}

impl Seen {
    fn new(capture: &Capture, view: u32, sightings: impl Iterator<Item = Sighting>) -> Self {
        let (mut x, mut y, mut depth) = (Vec::new(), Vec::new(), Vec::new());
        for s in sightings {
            x.push(f64::from(s.pixel[0]));
            y.push(f64::from(s.pixel[1]));
            depth.push(s.depth_metres);
        }
        let mut at = |q: f64| DVec2::new(quantile(&mut x, q), quantile(&mut y, q));
        let (bounds, depth_metres) = ((at(0.01), at(0.99)), quantile(&mut depth, 0.5));
        let footprint_metres = footprint_metres(&capture.views[view as usize].camera, depth_metres);
        Self { view, count: depth.len(), depth_metres, footprint_metres, bounds }
    }

    /// The window of the mip that fits, around the box of the block's core (around the seen points where that cannot be
    /// projected); `None` where it is a sliver.
    fn window(&self, capture: &Capture, content: &Content, rho_metres: f64) -> Option<ViewUse> {
        let camera = &capture.views[self.view as usize].camera;
        let mip = mip_for(camera, self.depth_metres, rho_metres);
        let (low, high) = content.project(camera, 0.05 * self.depth_metres).unwrap_or(self.bounds);
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

/// The views worth training on, of those that see anything of the block.
fn choose(mut seen: Vec<Seen>, sightings: &Sightings, rho_metres: f64) -> Vec<Seen> {
    seen.retain(|s| s.count >= MIN_SEEN);
    let mut counts: Vec<f64> = seen.iter().map(|s| s.count as f64).collect();
    let good = quantile(&mut counts, 0.9);
    seen.retain(|s| {
        let of_view = s.count as f64 / f64::from(sightings.per_view[s.view as usize].max(1));
        of_view >= SHARE_OF_VIEW || s.count as f64 >= SHARE_OF_BEST * good
    });
    if seen.len() > ENOUGH_VIEWS {
        let mut finest: Vec<f64> = seen.iter().map(|s| s.footprint_metres).collect();
        let enough = *finest.select_nth_unstable_by(ENOUGH_VIEWS - 1, f64::total_cmp).1;
        seen.retain(|s| s.footprint_metres <= (TOO_COARSE * rho_metres).max(enough));
    }
    seen
}

/// The box of what a block holds, as corners in the world.
struct Content {
    corners: [DVec3; 8],
}

impl Content {
    /// The core, out to the points where it lies at the scene's rim, and the height range of the points in it.
    fn new(capture: &Capture, ground: &Ground, block: BlockId, points: impl Iterator<Item = u32>) -> Self {
        let mut indices: Vec<u32> = points.collect();
        indices.sort_unstable();
        indices.dedup();
        let places: Vec<DVec3> =
            indices.iter().map(|&i| ground.from_world(capture.points.positions[i as usize])).collect();
        let axis = |k: usize| places.iter().map(|p| p[k]).collect::<Vec<f64>>();
        let (mut x, mut y, mut z) = (axis(0), axis(1), axis(2));
        let (core, halo) = (ground.core(block), ground.halo(block));
        let reach = |values: &mut [f64], k: usize| {
            let low = if halo.min[k].is_finite() { core.min[k] } else { core.min[k].min(quantile(values, 0.01)) };
            let high = if halo.max[k].is_finite() { core.max[k] } else { core.max[k].max(quantile(values, 0.99)) };
            [low, high]
        };
        let (x, y) = (reach(&mut x, 0), reach(&mut y, 1));
        let (low, high) = (quantile(&mut z, 0.01), quantile(&mut z, 0.99));
        let pad = 0.1 * (high - low) + 0.02 * ground.core_edge_metres(block.level);
        let z = [low - pad, high + pad];
        let corner = |i: usize| ground.to_world(DVec3::new(x[i & 1], y[i >> 1 & 1], z[i >> 2]));
        Self { corners: [0, 1, 2, 3, 4, 5, 6, 7].map(corner) }
    }

    /// Bounds in pixels of mip 0 of the part of the box that is in the image; `None` where nothing is.
    ///
    /// Each face is clipped to the camera's frustum before it is projected (Sutherland & Hodgman 1974), so the bounds
    /// are tight where the box runs across the image at an angle, and right where the camera stands inside the box.
    fn project(&self, camera: &Camera, near_metres: f64) -> Option<(DVec2, DVec2)> {
        let k = &camera.pinhole;
        let (width, height) = (f64::from(k.width), f64::from(k.height));
        // A point is inside where `normal · point >= offset`.
        let frustum = [
            (DVec3::Z, near_metres),
            (DVec3::new(k.fx, 0.0, k.cx), 0.0),
            (DVec3::new(-k.fx, 0.0, width - k.cx), 0.0),
            (DVec3::new(0.0, k.fy, k.cy), 0.0),
            (DVec3::new(0.0, -k.fy, height - k.cy), 0.0),
        ];
        let corners = self.corners.map(|c| camera.camera_from_world.apply(c));
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for face in FACES {
            let mut polygon: Vec<DVec3> = face.map(|i| corners[i]).to_vec();
            for (normal, offset) in frustum {
                polygon = clip(&polygon, normal, offset);
            }
            for p in polygon {
                let pixel = DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
                (low, high) = (low.min(pixel), high.max(pixel));
            }
        }
        (low.is_finite() && high.is_finite() && near_metres > 0.0).then_some((low, high))
    }
}

/// Corners of the faces of a box, in order around each: bit 0 of a corner is x, bit 1 y, bit 2 z.
const FACES: [[usize; 4]; 6] = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];

/// The part of a convex polygon where `normal · point >= offset`.
fn clip(polygon: &[DVec3], normal: DVec3, offset: f64) -> Vec<DVec3> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, &a) in polygon.iter().enumerate() {
        let b = polygon[(i + 1) % polygon.len()];
        let (from, to) = (normal.dot(a) - offset, normal.dot(b) - offset);
        if from >= 0.0 {
            kept.push(a);
        }
        if (from >= 0.0) != (to >= 0.0) {
            kept.push(a.lerp(b, from / (from - to)));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{aerial, capture, look, street};

    fn levels_of(capture: &Capture, level: u8, rho: f64) -> BTreeMap<BlockId, Selection> {
        select_level(capture, &Sightings::of(capture), &Ground::of(capture), level, rho, 8)
    }

    #[test]
    fn mips_match_the_resolution() {
        let camera = look(DVec3::ZERO, DVec3::X, DVec3::Z);
        // A pixel of mip 0 covers 0.1 m at 50 m.
        let mips = [0.01, 0.1, 0.13, 0.2, 0.41, 100.0, 0.0].map(|rho| mip_for(&camera, 50.0, rho));
        assert_eq!(mips, [0, 0, 0, 1, 2, 4, 0]);
        assert_eq!(mip_for(&camera, f64::NAN, 1.0), 0);
        assert_eq!([max_mip(640, 480), max_mip(16, 900), max_mip(15, 15), max_mip(1000, 749)], [4, 0, 0, 5]);
    }

    #[test]
    fn views_are_chosen_by_what_they_see() {
        let capture = aerial(8, 300.0, 6000);
        let ground = Ground::of(&capture);
        let sightings = Sightings::of(&capture);
        for (block, selection) in levels_of(&capture, 2, 0.12) {
            assert!(!selection.views.is_empty() && selection.views.len() < 40, "{block}: {}", selection.views.len());
            assert!(selection.halo_points > selection.core_points);
            for used in selection.views.iter().chain(&selection.test_views) {
                let camera = &capture.views[used.view as usize].camera;
                let image = camera.mip(used.mip);
                let (window, full) = (used.window, image.full());
                assert!(window.x + window.width <= full.width && window.y + window.height <= full.height);
                assert!(window.x % TILE == 0 && window.y % TILE == 0);
                // All but stray points of the core that this view sees lie in the window.
                let (mut inside, mut all) = (0, 0);
                for s in sightings.all.iter().filter(|s| s.view == used.view) {
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
            // A view that sees none of it is not used.
            let far = selection.views.iter().map(|v| capture.views[v.view as usize].camera.centre());
            let core = ground.core(block);
            assert!(far.into_iter().all(|c| (c.truncate() - core.centre()).length() < 150.0));
        }
    }

    #[test]
    fn windows_are_smaller_than_images_where_blocks_are() {
        let capture = aerial(8, 100.0, 6000);
        let selections = levels_of(&capture, 3, 0.12);
        let shares: Vec<f64> = (selections.values().flat_map(|s| &s.views))
            .map(|v| v.window.area() as f64 / capture.views[v.view as usize].camera.mip(v.mip).full().area() as f64)
            .collect();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        assert!(mean < 0.35, "{mean}");
    }

    #[test]
    fn the_box_is_clipped_to_the_frustum() {
        let corners = [0, 1, 2, 3, 4, 5, 6, 7usize]
            .map(|i| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0);
        let content = Content { corners };
        let size = DVec2::new(640.0, 480.0);
        let close = |a: (DVec2, DVec2), low: DVec2, high: DVec2| {
            assert!((a.0 - low).length() < 1e-6 && (a.1 - high).length() < 1e-6, "{a:?}");
        };
        // From inside, and from the face: the whole image.
        for eye in [DVec3::ZERO, DVec3::new(-1.0, 0.0, 0.0)] {
            close(content.project(&look(eye, DVec3::X * 9.0, DVec3::Z), 0.01).unwrap(), DVec2::ZERO, size);
        }
        // From afar: the near face, 2 m wide at 9 m.
        let half = 500.0 / 9.0;
        let afar = content.project(&look(DVec3::X * -10.0, DVec3::ZERO, DVec3::Z), 0.01).unwrap();
        close(afar, size * 0.5 - half, size * 0.5 + half);
        // Behind the camera: nothing.
        assert!(content.project(&look(DVec3::X * -10.0, DVec3::X * -20.0, DVec3::Z), 0.01).is_none());
    }

    #[test]
    fn no_tracks_means_projection() {
        let with = aerial(4, 100.0, 800);
        let mut without = with.clone();
        (without.points.track_start, without.points.seen_by) = (Vec::new(), Vec::new());
        assert_eq!(levels_of(&with, 1, 0.12), levels_of(&without, 1, 0.12));
    }

    #[test]
    fn hostile_tracks_and_cameras_are_left_out() {
        let mut bad = street(12, 600);
        bad.points.seen_by[0] = 4_000_000;
        bad.points.track_start[5] = u32::MAX;
        bad.points.positions[7] = DVec3::NAN;
        bad.views[3].camera.pinhole.fx = 0.0;
        bad.views[4].camera.camera_from_world.translation.x = f64::INFINITY;
        let sightings = Sightings::of(&bad);
        assert!(sightings.all.iter().all(|s| s.point != 7 && s.view != 3 && s.view != 4 && s.view < 12));
        assert!(!sightings.all.is_empty());
        let selections = levels_of(&bad, 1, 0.02);
        assert!(selections.values().flat_map(|s| &s.views).all(|v| v.view != 3 && v.view != 4));
        assert!(levels_of(&capture(&[], Vec::new(), false), 2, 1.0).is_empty());
    }
}
