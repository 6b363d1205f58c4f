//! Space that the photos see through: no splat belongs there.
//!
//! A view that observed a sparse point saw all the way to it, so the line between them is empty. Where street photos
//! are far apart, nothing else keeps training from filling that space with a haze of large, faint splats, each of which
//! improves the few photos that see it and hangs before every other camera. Carving by lines of sight is as old as
//! voxel coloring (Seitz and Dyer 1997); here it bounds where splats may be and how far they may reach.

use glam::{DVec3, IVec3, Mat3, Quat, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{Capture, Splats};

/// Edge of a voxel, in units of the median distance between neighbouring points. The voxels of a point and of its 26
/// neighbours are never free, so a surface may have gaps of twice the edge.
const EDGE_PER_SPACING: f64 = 0.43;
/// Most voxels, of one byte each; larger scenes have larger voxels.
const MAX_VOXELS: f64 = 16e6;
/// Fewest lines of sight through a free voxel. One alone may end at a point that was matched wrongly.
const MIN_LINES: u8 = 2;
/// The value of a voxel at or beside a point.
const OCCUPIED: u8 = u8::MAX;
/// Most lines of sight of a point.
const LINES_PER_POINT: usize = 8;
/// Most lines of sight in all; of more points, every n-th is used.
const MAX_LINES: usize = 1 << 21;
/// Longest part of a line of sight in the grid, in voxels. Lines with longer ones are left out.
const MAX_LENGTH: f64 = 4096.0;
/// Positions on a line, for each voxel of its length.
const SAMPLES_PER_VOXEL: f64 = 1.5;
/// Fewer points do not show a surface.
const MIN_POINTS: usize = 100;
/// A splat may reach into free space only beyond this many standard deviations.
const REACH: f32 = 3.0;
/// Factor of an axis that reaches into free space.
const SHRINK: f32 = 0.8;

/// A grid of voxels, each free or not. Places outside the grid are not free.
#[derive(Debug)]
pub struct FreeSpace {
    edge_metres: f64,
    origin: DVec3,
    size: IVec3,
    /// Lines of sight through each voxel, or [`OCCUPIED`].
    lines: Vec<u8>,
}

impl FreeSpace {
    /// The free space around the capture's points for which `within` is true, by lines of sight of the views `views`
    /// (indices of the capture). `None` without tracks, or with too few points.
    pub fn new(capture: &Capture, views: &[u32], within: impl Fn(DVec3) -> bool) -> Option<Self> {
        let points = &capture.points;
        let inside: Vec<DVec3> = points.positions.iter().copied().filter(|&place| within(place)).collect();
        if inside.len() < MIN_POINTS || points.track_start.is_empty() {
            return None;
        }
        let mut free = Self::grid(&inside)?;
        let mut is_used = vec![false; capture.views.len()];
        for &view in views {
            if let Some(used) = is_used.get_mut(view as usize) {
                *used = true;
            }
        }
        let stride = (points.len() * LINES_PER_POINT).div_ceil(MAX_LINES).max(1);
        for point in (0..points.len()).step_by(stride) {
            let track = points.track(point).unwrap_or_default();
            let seen_by = track.iter().filter(|&&view| is_used.get(view as usize) == Some(&true));
            for &view in seen_by.step_by(track.len().div_ceil(LINES_PER_POINT).max(1)) {
                free.add_line(capture.views[view as usize].camera.centre(), points.positions[point]);
            }
        }
        for &place in &inside {
            free.occupy(place);
        }
        Some(free)
    }

    /// An empty grid around the points, without the outermost hundredth on each side.
    fn grid(points: &[DVec3]) -> Option<Self> {
        let spacing = spacing_metres(points).filter(|spacing| *spacing > 0.0 && spacing.is_finite())?;
        let bounds = [0, 1, 2].map(|axis| {
            let mut values: Vec<f64> = points.iter().map(|point| point[axis]).collect();
            values.sort_by(f64::total_cmp);
            let last = values.len() - 1;
            [values[last / 100], values[last - last / 100]]
        });
        let [low, high] = [0, 1].map(|side| DVec3::from_array([0, 1, 2].map(|axis: usize| bounds[axis][side])));
        let cells = |edge: f64| ((high - low) / edge).ceil() + 4.0;
        let mut edge_metres = EDGE_PER_SPACING * spacing;
        while cells(edge_metres).element_product() > MAX_VOXELS {
            edge_metres *= 1.1;
        }
        let size = cells(edge_metres).as_ivec3();
        let voxels = size.to_array().iter().map(|&n| n as usize).product();
        Some(Self { edge_metres, origin: low - 2.0 * edge_metres, size, lines: vec![0; voxels] })
    }

    /// Counts a line of sight in the voxels that it crosses, each once. It may miss a voxel of which it cuts a corner.
    fn add_line(&mut self, from: DVec3, to: DVec3) {
        let Some([enter, leave]) = self.crossing(from, to) else { return };
        let length = (to - from).length() / self.edge_metres;
        let crosses = length * (leave - enter) <= MAX_LENGTH;
        if !crosses {
            return;
        }
        let samples = (length * SAMPLES_PER_VOXEL).floor();
        let (first, end) = ((enter * samples) as u64, (leave * samples).ceil() as u64);
        let mut last = None;
        for sample in first..end {
            let at = self.index(self.voxel(from.lerp(to, sample as f64 / samples)));
            if let Some(index) = at.filter(|_| at != last) {
                self.lines[index] = (self.lines[index] + 1).min(OCCUPIED - 1);
            }
            last = at;
        }
    }

    /// Where a line enters the grid and leaves it, as shares of its length; `None` if it passes by.
    fn crossing(&self, from: DVec3, to: DVec3) -> Option<[f64; 2]> {
        let high = self.origin + self.size.as_dvec3() * self.edge_metres;
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for axis in 0..3 {
            let along = to[axis] - from[axis];
            let [low, high] = [self.origin[axis], high[axis]].map(|side| (side - from[axis]) / along);
            // A line along a side has no number here, which max and min leave out.
            enter = enter.max(low.min(high));
            leave = leave.min(low.max(high));
        }
        (enter < leave).then_some([enter, leave])
    }

    /// Marks the voxel of a point and its neighbours.
    fn occupy(&mut self, place: DVec3) {
        let centre = self.voxel(place);
        for n in 0..27 {
            let beside = IVec3::new(n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1);
            if let Some(index) = self.index(centre.saturating_add(beside)) {
                self.lines[index] = OCCUPIED;
            }
        }
    }

    fn voxel(&self, place: DVec3) -> IVec3 {
        ((place - self.origin) / self.edge_metres).floor().as_ivec3()
    }

    fn index(&self, voxel: IVec3) -> Option<usize> {
        let is_inside = voxel.cmpge(IVec3::ZERO).all() && voxel.cmplt(self.size).all();
        let [x, y, z] = voxel.to_array().map(|v| v as usize);
        is_inside.then(|| (z * self.size.y as usize + y) * self.size.x as usize + x)
    }

    /// Whether no splat belongs at this place.
    pub fn contains(&self, place: Vec3) -> bool {
        let index = self.index(self.voxel(place.as_dvec3()));
        index.is_some_and(|index| self.lines[index] >= MIN_LINES && self.lines[index] != OCCUPIED)
    }

    /// Shrinks each axis of a splat that reaches into free space. Called after every refinement, so that a splat keeps
    /// out of it after a few.
    pub(crate) fn clip(&self, splats: &mut Splats) {
        for row in 0..splats.len() {
            let mut splat = splats.get(row);
            let [w, x, y, z] = splat.quat;
            let rotation = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
            let before = splat.log_scale;
            for axis in 0..3 {
                let tip = rotation.col(axis) * (REACH * before[axis].exp());
                if self.contains(splat.mean + tip) || self.contains(splat.mean - tip) {
                    splat.log_scale[axis] += SHRINK.ln();
                }
            }
            if splat.log_scale != before {
                splats.set(row, &splat);
            }
        }
    }
}

/// Median distance of a point to its nearest neighbours, over at most a few thousand points.
fn spacing_metres(points: &[DVec3]) -> Option<f64> {
    const SAMPLE: usize = 4096;
    const NEIGHBOURS: usize = 3;
    let places: Vec<[f64; 3]> = points.iter().map(DVec3::to_array).collect();
    let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&places).ok()?;
    let count = std::num::NonZero::new(NEIGHBOURS + 1)?;
    let sample = places.iter().step_by(places.len().div_ceil(SAMPLE).max(1));
    let mut gaps: Vec<f64> = sample
        .map(|place| {
            let near = tree.query(place).nearest_n::<SquaredEuclidean<f64>>(count).execute();
            // The nearest neighbour is the point itself.
            near.iter().skip(1).map(|n| n.distance.sqrt()).sum::<f64>() / NEIGHBOURS as f64
        })
        .collect();
    gaps.sort_by(f64::total_cmp);
    gaps.get(gaps.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Pinhole, Rigid, SparsePoints, Splat, View};

    use super::*;

    /// A wall of points at x = 10, seen by two cameras near the origin.
    fn wall() -> Capture {
        let positions: Vec<DVec3> =
            (0..400).map(|i| DVec3::new(10.0, f64::from(i % 20) * 0.5 - 5.0, f64::from(i / 20) * 0.5)).collect();
        let view = |n: u32| {
            let pinhole = Pinhole { width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 32.0, cy: 24.0 };
            let translation = -DVec3::new(0.0, f64::from(n), 5.0);
            let camera = Camera { pinhole, camera_from_world: Rigid { translation, ..Rigid::IDENTITY } };
            View { name: format!("{n}.png"), camera, masked: false, mips: Vec::new(), depth: None, seconds: None }
        };
        let points = SparsePoints {
            colours: vec![[0; 3]; positions.len()],
            track_start: (0..=positions.len() as u32).map(|i| 2 * i).collect(),
            seen_by: [0, 1].repeat(positions.len()),
            positions,
            measured: 0,
        };
        // A point behind the cameras, so that the grid reaches there.
        let mut capture = Capture { views: vec![view(0), view(1)], points, ..Capture::default() };
        for i in 0..40 {
            capture.points.positions.push(DVec3::new(-5.0, f64::from(i) * 0.5 - 5.0, 5.0));
            capture.points.colours.push([0; 3]);
            capture.points.track_start.push(800);
        }
        capture
    }

    #[test]
    fn space_before_a_wall_is_free_and_the_wall_is_not() {
        let capture = wall();
        let free = FreeSpace::new(&capture, &[0, 1], |_| true).unwrap();
        assert!(free.contains(Vec3::new(2.0, 0.5, 5.0)));
        for place in [[10.0, 0.5, 5.0], [9.9, 0.5, 5.0], [-2.0, 0.5, 5.0], [1e30, 0.0, 0.0], [f32::NAN, 0.0, 0.0]] {
            assert!(!free.contains(Vec3::from_array(place)), "{place:?}");
        }
        // The lines of one view are too few, and those of views that are held out do not count.
        let one = FreeSpace::new(&capture, &[0], |_| true).unwrap();
        let count = |free: &FreeSpace| free.lines.iter().filter(|&&n| n >= MIN_LINES && n != OCCUPIED).count();
        assert!(count(&one) < count(&free), "{} and {}", count(&one), count(&free));
        assert!(FreeSpace::new(&capture, &[0, 1], |place| place.x < 0.0).is_none(), "too few points");
        let without_tracks = SparsePoints { track_start: Vec::new(), seen_by: Vec::new(), ..capture.points.clone() };
        assert!(FreeSpace::new(&Capture { points: without_tracks, ..capture }, &[0, 1], |_| true).is_none());
    }

    #[test]
    fn cameras_far_outside_of_the_grid_see_through_it() {
        let mut capture = wall();
        for view in &mut capture.views {
            view.camera.camera_from_world.translation.x += 30_000.0;
        }
        let free = FreeSpace::new(&capture, &[0, 1], |_| true).unwrap();
        // Both lines to a point run side by side, half a metre before the wall and on to the grid's other end.
        for x in [0.0, 5.0, 9.0] {
            assert!(free.contains(Vec3::new(x, 0.5, 5.0)), "{x}");
        }
        assert!(!free.contains(Vec3::new(10.0, 0.5, 5.0)));
    }

    #[test]
    fn splats_are_clipped_where_they_reach_into_free_space() {
        let free = FreeSpace::new(&wall(), &[0, 1], |_| true).unwrap();
        let mut splats = Splats::new(0);
        let mean = Vec3::new(10.0, 0.5, 5.0);
        splats.push(&Splat::round(mean, 0.5f32.ln(), Vec3::splat(0.5), 0.5));
        splats.push(&Splat::round(mean, 0.05f32.ln(), Vec3::splat(0.5), 0.5));
        for _ in 0..20 {
            free.clip(&mut splats);
        }
        let [thick, thin] = [0, 1].map(|i| splats.get(i).log_scale.exp());
        assert!(thick.x < 0.4 && (thick.y - 0.5).abs() < 1e-3 && (thick.z - 0.5).abs() < 1e-3, "{thick}");
        assert!((thin - Vec3::splat(0.05)).abs().max_element() < 1e-4, "{thin}");
    }
}
