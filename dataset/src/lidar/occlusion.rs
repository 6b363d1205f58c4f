//! Which points of a cloud a camera sees.
//!
//! A lidar stands beside the cameras and sees past edges that hide what is behind them from a camera. Points far behind their
//! neighbours in the image are therefore taken to be hidden.

use glam::DVec3;
use scene::Camera;

/// Nearest depth of a point, metres.
const NEAREST_METRES: f64 = 0.5;
/// Mean number of points in a cell of the grid of nearest depths.
const POINTS_PER_CELL: f64 = 0.75;
/// Largest side of a cell as a share of the focal length: 2°.
const MAX_CELL_SHARE: f64 = 0.035;
/// A point is hidden if it lies farther than this factor of, plus `MARGIN_METRES` beyond, the nearest depth of its cell and the
/// eight around it. The ground seen at a low angle stays within.
const MAX_FACTOR: f32 = 1.2;
const MARGIN_METRES: f32 = 0.5;

/// A point that a camera sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Seen {
    /// The point's number.
    pub(crate) point: u32,
    /// The pixel that contains it.
    pub(crate) x: u32,
    /// The pixel that contains it.
    pub(crate) y: u32,
    /// Along the optical axis, metres.
    pub(crate) depth: f32,
}

/// The points that the camera sees, in their order.
pub(crate) fn visible(camera: &Camera, points: impl Iterator<Item = (u32, DVec3)>) -> Vec<Seen> {
    let (width, height) = (camera.pinhole.width, camera.pinhole.height);
    let inside = |(point, place): (u32, DVec3)| {
        let (pixel, depth) = camera.project(place);
        let (x, y) = (pixel.x, pixel.y);
        let inside = depth > NEAREST_METRES && (0.0..width.into()).contains(&x) && (0.0..height.into()).contains(&y);
        // A coordinate just below the side may round up to it.
        let pixel = |v: f64, side: u32| (v as u32).min(side - 1);
        inside.then(|| Seen { point, x: pixel(x, width), y: pixel(y, height), depth: depth as f32 })
    };
    let mut seen: Vec<Seen> = points.filter_map(inside).collect();
    let grid = NearestDepths::new(&seen, (MAX_CELL_SHARE * camera.pinhole.fx.min(camera.pinhole.fy)).max(1.0));
    seen.retain(|point| point.depth <= MAX_FACTOR * grid.around(point) + MARGIN_METRES);
    seen
}

/// Nearest depths of points in square cells of the image.
struct NearestDepths {
    cell: u32,
    left: u32,
    top: u32,
    columns: usize,
    rows: usize,
    nearest: Vec<f32>,
}

impl NearestDepths {
    fn new(seen: &[Seen], max_cell: f64) -> Self {
        let bound = |pick: fn(&Seen) -> u32| {
            let values = || seen.iter().map(pick);
            (values().min().unwrap_or(0), values().max().unwrap_or(0))
        };
        let ((left, right), (top, bottom)) = (bound(|s| s.x), bound(|s| s.y));
        let area = f64::from(right - left + 1) * f64::from(bottom - top + 1);
        let side = (POINTS_PER_CELL * area / seen.len().max(1) as f64).sqrt();
        let cell = side.min(max_cell).max(1.0).round() as u32;
        let (columns, rows) = (((right - left) / cell + 1) as usize, ((bottom - top) / cell + 1) as usize);
        let nearest = vec![f32::INFINITY; columns * rows];
        let mut grid = Self { cell, left, top, columns, rows, nearest };
        for point in seen {
            let (column, row) = grid.cell_of(point);
            let nearest = &mut grid.nearest[row * columns + column];
            *nearest = nearest.min(point.depth);
        }
        grid
    }

    fn cell_of(&self, point: &Seen) -> (usize, usize) {
        (((point.x - self.left) / self.cell) as usize, ((point.y - self.top) / self.cell) as usize)
    }

    /// The nearest depth in the point's cell and the eight around it.
    fn around(&self, point: &Seen) -> f32 {
        let (column, row) = self.cell_of(point);
        let columns = column.saturating_sub(1)..(column + 2).min(self.columns);
        let rows = row.saturating_sub(1)..(row + 2).min(self.rows);
        let rows = rows.map(|row| &self.nearest[row * self.columns..][columns.clone()]);
        rows.flatten().copied().fold(f32::INFINITY, f32::min)
    }
}

#[cfg(test)]
mod tests {
    use scene::{Pinhole, Rigid};

    use super::*;

    fn camera() -> Camera {
        let pinhole = Pinhole { width: 200, height: 100, fx: 100.0, fy: 100.0, cx: 100.0, cy: 50.0 };
        Camera { pinhole, camera_from_world: Rigid::IDENTITY }
    }

    /// A wall of points at this depth, `step` metres apart, across and down.
    fn wall(depth: f64, step: f64, [x, y]: [std::ops::Range<f64>; 2]) -> Vec<DVec3> {
        let count = |r: &std::ops::Range<f64>| ((r.end - r.start) / step) as usize;
        let at = |i: usize, j: usize| DVec3::new(x.start + i as f64 * step, y.start + j as f64 * step, depth);
        (0..count(&x)).flat_map(|i| (0..count(&y)).map(move |j| at(i, j))).collect()
    }

    #[test]
    fn points_behind_a_nearer_wall_are_hidden() {
        let near = wall(5.0, 0.2, [-2.0..0.0, -2.0..2.0]);
        let far = wall(12.0, 0.4, [-12.0..12.0, -5.0..5.0]);
        let all: Vec<DVec3> = near.iter().chain(&far).copied().collect();
        let seen = visible(&camera(), (0..).zip(all.iter().copied()));
        let near_seen = seen.iter().filter(|s| (s.point as usize) < near.len()).count();
        assert_eq!(near_seen, near.len(), "nothing hides the near wall");
        // The near wall covers pixels 60 to 100 across and 10 to 90 down.
        let is_behind = |p: &DVec3| {
            let (pixel, _) = camera().project(*p);
            (62.0..94.0).contains(&pixel.x) && (12.0..84.0).contains(&pixel.y)
        };
        let behind = far.iter().filter(|p| is_behind(p)).count();
        let leaked =
            seen.iter().filter(|s| s.point as usize >= near.len() && is_behind(&all[s.point as usize])).count();
        assert!(behind > 50 && leaked == 0, "{leaked} of {behind}");
        // Beside the near wall, all of the far wall that is inside the image is seen.
        let is_beside = |p: &DVec3| {
            let (pixel, _) = camera().project(*p);
            (112.0..200.0).contains(&pixel.x) && (0.0..100.0).contains(&pixel.y)
        };
        let beside = far.iter().filter(|p| is_beside(p)).count();
        let kept = seen.iter().filter(|s| is_beside(&all[s.point as usize])).count();
        assert!(beside > 200 && kept == beside, "{kept} of {beside}");
    }

    #[test]
    fn the_ground_at_a_low_angle_is_seen() {
        // Rings of a lidar on flat ground 1.7 m below the camera.
        let rings = (1..40).map(|i| 1.7 / (0.4f64 * f64::from(i)).to_radians().tan()).filter(|r| *r < 60.0);
        let points: Vec<DVec3> = rings
            .flat_map(|r| (-60..60).map(move |i| (r, f64::from(i) * 0.012)))
            .map(|(r, a)| DVec3::new(r * a.sin(), 1.7, r * a.cos()))
            .collect();
        let projects = |p: &&DVec3| {
            let (pixel, depth) = camera().project(**p);
            depth > 0.5 && (0.0..200.0).contains(&pixel.x) && (0.0..100.0).contains(&pixel.y)
        };
        let inside = points.iter().filter(projects).count();
        let seen = visible(&camera(), (0..).zip(points.iter().copied()));
        assert!(seen.len() as f64 > 0.9 * inside as f64, "{} of {inside}", seen.len());
        assert!(visible(&camera(), std::iter::empty()).is_empty());
    }
}
