//! The ground plane and its quadtree of blocks, which define the owner of every place.
//!
//! The root is a square on the ground. Level `L` divides it into `2^L × 2^L` half-open cores. Cores at the rim extend
//! to infinity, so every finite place has exactly one owner per level, and a block owns exactly what its four children
//! own.

use glam::{DMat3, DQuat, DVec2, DVec3};
use scene::{BlockId, Camera, Capture};
use serde::{Deserialize, Serialize};

/// Halo size relative to the core, scaled about its centre. (DOGS on Rubble: 24.25 dB at 1.2, 25.78 at 1.4, 25.97 at
/// 1.5.)
pub const HALO_SCALE: f64 = 1.4;
/// An up direction within 20° of world z snaps to world z (cosine of 20°).
const SNAP_COSINE: f64 = 0.939_692_6;
/// Cameras agree on an up direction if the length of their mean up vector exceeds this.
const MIN_UP_AGREEMENT: f64 = 0.5;
/// Places farther from the origin than this are outliers. They have an owner but do not enlarge the root. Metres.
const FAR_METRES: f64 = 1e8;
/// Padding of the root on each side, relative to the robust extent.
const ROOT_PAD: f64 = 0.02;
/// Radius of the foreground in scene extents (see [`Ground::is_background`]). The corners of the root square are at
/// 0.71; background geometry starts at 1.7.
const NEAR_EXTENTS: f64 = 1.5;

/// A half-open square of the ground plane, metres. Sides may be infinite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Square {
    /// Lower corner, inclusive.
    pub min: DVec2,
    /// Upper corner, exclusive.
    pub max: DVec2,
}

impl Square {
    /// True where `min <= at < max`.
    pub fn contains(&self, at: DVec2) -> bool {
        at.cmpge(self.min).all() && at.cmplt(self.max).all()
    }

    /// The centre. Not finite for infinite sides.
    pub fn centre(&self) -> DVec2 {
        (self.min + self.max) * 0.5
    }

    /// The shortest distance to another square, metres; 0 if they touch.
    pub fn distance(&self, other: &Self) -> f64 {
        (other.min - self.max).max(self.min - other.max).max(DVec2::ZERO).length()
    }
}

/// The ground plane: a rotation that turns z up, and the root square.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Ground {
    /// Rotates world axes to ground axes (x and y along the ground, z up); unit quaternion.
    pub ground_from_world: DQuat,
    /// Lower corner of the root square, ground metres.
    pub min: DVec2,
    /// Side of the root square, metres; positive.
    pub edge_metres: f64,
    /// Mean of the lowest and highest scene height, ground metres.
    pub height_metres: f64,
    /// Radius of the foreground around the centre of the root square at `height_metres`, metres; positive.
    pub near_metres: f64,
}

impl Ground {
    /// Estimates the ground of a capture. The up direction comes from its cameras (see `estimate_up`). The root is the
    /// square around the 1st to 99th percentiles of sparse points and of camera centres. All values are finite for
    /// every input; without points and cameras the root is a unit square.
    pub fn of(capture: &Capture) -> Self {
        let near = |p: &DVec3| p.abs().max_element() < FAR_METRES;
        let points: Vec<DVec3> = capture.points.positions.iter().copied().filter(near).collect();
        let cameras: Vec<&Camera> = (capture.views.iter().map(|v| &v.camera))
            .filter(|c| c.camera_from_world.is_sane() && near(&c.centre()))
            .collect();
        let up = if capture.geo_origin.is_some() { DVec3::Z } else { estimate_up(&cameras, &points) };
        let ground_from_world = DQuat::from_rotation_arc(up, DVec3::Z);

        let centres: Vec<DVec3> = cameras.iter().map(|c| c.centre()).collect();
        let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for places in [&points, &centres] {
            if let Some((low, high)) = robust_box(places, |p| ground_from_world * p) {
                (min, max) = (min.min(low), max.max(high));
            }
        }
        if min.cmpgt(max).any() {
            let (min, near_metres) = (DVec2::ZERO, NEAR_EXTENTS);
            return Self { ground_from_world, min, edge_metres: 1.0, height_metres: 0.0, near_metres };
        }
        let (mid_height, height_range) = (0.5 * (min.z + max.z), max.z - min.z);
        let (min, max) = (min.truncate(), max.truncate());
        let (centre, extent) = ((min + max) * 0.5, (max - min).max_element() * (1.0 + 2.0 * ROOT_PAD));
        // All points coincide. Any size works for which twenty halvings still change a coordinate.
        let edge_metres = if extent > 1e-6 * (1.0 + centre.abs().max_element()) { extent } else { 1.0 };
        let near_metres = NEAR_EXTENTS * edge_metres.max(height_range);
        Self { ground_from_world, min: centre - 0.5 * edge_metres, edge_metres, height_metres: mid_height, near_metres }
    }

    /// The ground under places whose up is z, without background: its root is the square around the 1st to 99th percentiles.
    pub fn around(places: &[DVec3]) -> Self {
        let near: Vec<DVec3> = places.iter().copied().filter(|p| p.abs().max_element() < FAR_METRES).collect();
        let (min, max) = robust_box(&near, |p| p).unwrap_or((DVec3::ZERO, DVec3::ONE));
        let (centre, extent) = (0.5 * (min + max).truncate(), (max - min).truncate().max_element());
        let edge_metres = if extent > 1e-6 * (1.0 + centre.abs().max_element()) { extent } else { 1.0 };
        Self {
            ground_from_world: DQuat::IDENTITY,
            min: centre - 0.5 * edge_metres,
            edge_metres,
            height_metres: 0.5 * (min.z + max.z),
            near_metres: f64::MAX,
        }
    }

    /// Transforms world coordinates to ground coordinates, metres.
    pub fn from_world(&self, world: DVec3) -> DVec3 {
        self.ground_from_world * world
    }

    /// Transforms ground coordinates to world coordinates, metres.
    pub fn to_world(&self, ground: DVec3) -> DVec3 {
        self.ground_from_world.inverse() * ground
    }

    /// The side length of a core of this level, metres.
    pub fn core_edge_metres(&self, level: u8) -> f64 {
        self.edge_metres / f64::from(1u32 << level.min(BlockId::MAX_LEVEL))
    }

    /// The block of `level` that owns this place. Arbitrary for NaN; see [`Ground::owns`].
    ///
    /// The cell is computed at the finest level and shifted up, so a block owns exactly what its children own, without
    /// rounding errors.
    pub fn block_at(&self, level: u8, world: DVec3) -> BlockId {
        let level = level.min(BlockId::MAX_LEVEL);
        let cells = f64::from(1u32 << BlockId::MAX_LEVEL);
        let at = (self.from_world(world).truncate() - self.min) / self.edge_metres * cells;
        let cell = |v: f64| (v.floor().clamp(0.0, cells - 1.0) as u32) >> (BlockId::MAX_LEVEL - level);
        BlockId { level, x: cell(at.x), y: cell(at.y) }
    }

    /// True when the block's core contains the place. A place that is not finite has no owner.
    pub fn owns(&self, block: BlockId, world: DVec3) -> bool {
        world.is_finite() && self.block_at(block.level, world) == block
    }

    /// True for background: places above the ground that are outside the foreground radius, such as the sky and distant
    /// tall objects.
    ///
    /// Ground columns do not partition the background in a useful way, so only the root owns and trains it
    /// ([`crate::Cut::owner_of`]). Places below the ground are never background: excluding them from the blocks of an
    /// aerial capture costs 0.2 dB.
    pub fn is_background(&self, world: DVec3) -> bool {
        let middle = (self.min + 0.5 * self.edge_metres).extend(self.height_metres);
        let from_middle = self.from_world(world) - middle;
        from_middle.z > 0.0 && from_middle.length() > self.near_metres
    }

    /// The nominal core. Finite, also at the rim, where ownership extends to infinity.
    pub fn core(&self, block: BlockId) -> Square {
        let edge = self.core_edge_metres(block.level);
        let min = self.min + DVec2::new(f64::from(block.x), f64::from(block.y)) * edge;
        Square { min, max: min + edge }
    }

    /// The nominal halo: the core scaled by [`HALO_SCALE`] about its centre. Finite.
    pub fn nominal_halo(&self, block: BlockId) -> Square {
        self.scaled_core(block, HALO_SCALE)
    }

    fn scaled_core(&self, block: BlockId, scale: f64) -> Square {
        let core = self.core(block);
        let pad = 0.5 * (scale - 1.0) * self.core_edge_metres(block.level);
        Square { min: core.min - pad, max: core.max + pad }
    }

    /// The halo: [`Ground::nominal_halo`] with its sides at the scene's rim moved to infinity.
    pub fn halo(&self, block: BlockId) -> Square {
        self.unbounded_at_rim(block, self.nominal_halo(block))
    }

    fn unbounded_at_rim(&self, block: BlockId, mut halo: Square) -> Square {
        let last = (1u32 << block.level.min(BlockId::MAX_LEVEL)) - 1;
        for (axis, cell) in [block.x, block.y].into_iter().enumerate() {
            if cell == 0 {
                halo.min[axis] = f64::NEG_INFINITY;
            }
            if cell >= last {
                halo.max[axis] = f64::INFINITY;
            }
        }
        halo
    }

    /// True when the block's halo contains the place. A place that is not finite is in no halo.
    pub fn in_halo(&self, block: BlockId, world: DVec3) -> bool {
        world.is_finite() && self.halo(block).contains(self.from_world(world).truncate())
    }

    /// The distance of a place to the block's nominal core along the ground, metres; 0 inside.
    pub fn metres_from_core(&self, block: BlockId, world: DVec3) -> f64 {
        let (core, at) = (self.core(block), self.from_world(world).truncate());
        (core.min - at).max(at - core.max).max(DVec2::ZERO).length()
    }

    /// The one to four blocks of `level` whose halo contains the place.
    pub fn halos_at(&self, level: u8, world: DVec3) -> impl Iterator<Item = BlockId> {
        let edge = self.core_edge_metres(level);
        let last = (1u32 << level.min(BlockId::MAX_LEVEL)) - 1;
        let at = (self.from_world(world).truncate() - self.min) / edge;
        // Candidates come from a slightly larger halo; in_halo makes the exact test.
        let reach = 0.5 * (HALO_SCALE - 1.0) + 1e-9;
        let cell = |v: f64| v.floor().clamp(0.0, f64::from(last)) as u32;
        let (x, y) = (cell(at.x - reach)..=cell(at.x + reach), cell(at.y - reach)..=cell(at.y + reach));
        y.flat_map(move |y| x.clone().map(move |x| BlockId { level, x, y })).filter(move |&b| self.in_halo(b, world))
    }

    /// True when all values are finite, the rotation has unit length and the lengths are positive.
    pub fn is_sane(&self) -> bool {
        let unit = (self.ground_from_world.length() - 1.0).abs() < 1e-6;
        let positive = |metres: f64| metres.is_finite() && metres > 0.0;
        unit && self.min.is_finite()
            && self.height_metres.is_finite()
            && [self.edge_metres, self.near_metres].into_iter().all(positive)
    }
}

/// Estimates the up direction, a unit vector, from the first rule that applies:
/// 1. Cameras that agree on an up within 20° of world z, or that look down along it (nadir surveys): world z.
/// 2. Cameras that face one way and are spread over an area across it (a nadir survey in an arbitrary frame, whose
///    image-up vectors are horizontal): the direction opposite to the viewing direction.
/// 3. Cameras that agree on an up: their mean up vector.
/// 4. Otherwise the axis of least variance of the sparse points, signed so that cameras lie above, snapped to z within
///    20°.
fn estimate_up(cameras: &[&Camera], points: &[DVec3]) -> DVec3 {
    let mean =
        |of: &dyn Fn(&Camera) -> DVec3| cameras.iter().map(|c| of(c)).sum::<DVec3>() / cameras.len().max(1) as f64;
    let camera_up = mean(&|c| c.camera_from_world.rotation.inverse() * DVec3::NEG_Y);
    let forward = mean(&|c| c.forward());
    let (up, is_agreed) = (camera_up.normalize_or_zero(), camera_up.length() > MIN_UP_AGREEMENT);
    let (ahead, is_one_way) = (forward.normalize_or_zero(), forward.length() > 0.9);
    if is_agreed && up.z > SNAP_COSINE || is_one_way && ahead.z < -SNAP_COSINE {
        return DVec3::Z;
    }
    let centres: Vec<DVec3> = cameras.iter().map(|c| c.centre()).collect();
    let (deviation, axes) = principal_axes(&centres);
    let is_spread = deviation[1] > 0.2 * deviation[2] && deviation[0] < 0.5 * deviation[1];
    if is_one_way && is_spread && axes[0].dot(ahead).abs() > SNAP_COSINE {
        return -ahead;
    }
    if is_agreed {
        return up;
    }
    let (deviation, axes) = principal_axes(points);
    if deviation[2] <= 0.0 {
        return DVec3::Z;
    }
    let middle = |places: &[DVec3]| places.iter().sum::<DVec3>() / places.len().max(1) as f64;
    let axis = axes[0];
    let above = (middle(&centres) - middle(points)).dot(axis);
    let axis = if above < 0.0 || above == 0.0 && axis.z < 0.0 { -axis } else { axis };
    if axis.z > SNAP_COSINE { DVec3::Z } else { axis }
}

/// The box between the 1st and 99th percentiles of the mapped places, per axis. `None` without places.
pub(crate) fn robust_box(places: &[DVec3], map: impl Fn(DVec3) -> DVec3) -> Option<(DVec3, DVec3)> {
    let mut axis_values = [0, 1, 2].map(|axis| places.iter().map(|&p| map(p)[axis]).collect::<Vec<f64>>());
    if places.is_empty() {
        return None;
    }
    let mut bounds = |q: f64| DVec3::from_array([0, 1, 2].map(|axis| quantile(&mut axis_values[axis], q)));
    Some((bounds(0.01), bounds(0.99)))
}

/// The `q` quantile of the values (nearest rank); 0 without values. Reorders the values.
pub(crate) fn quantile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// Principal axes of the places inside their robust box: standard deviations (ascending) and unit axes.
fn principal_axes(places: &[DVec3]) -> ([f64; 3], [DVec3; 3]) {
    let Some((low, high)) = robust_box(places, |p| p) else {
        return ([0.0; 3], DMat3::IDENTITY.to_cols_array_2d().map(DVec3::from_array));
    };
    let inside: Vec<DVec3> = (places.iter().copied()).filter(|p| p.cmpge(low).all() && p.cmple(high).all()).collect();
    let n = inside.len().max(1) as f64;
    let mean = inside.iter().sum::<DVec3>() / n;
    let mut covariance = DMat3::ZERO;
    for p in &inside {
        let d = *p - mean;
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let (variances, axes) = eigen(covariance * (1.0 / n));
    (variances.map(|v| v.max(0.0).sqrt()), axes)
}

/// Eigenvalues (ascending) and eigenvectors of a symmetric matrix by cyclic Jacobi rotations (Golub & Van Loan, section
/// 8.5).
fn eigen(mut a: DMat3) -> ([f64; 3], [DVec3; 3]) {
    let mut axes = DMat3::IDENTITY;
    for (p, q) in [(0, 1), (0, 2), (1, 2)].into_iter().cycle().take(60) {
        let off = a.col(p)[q];
        if off == 0.0 {
            continue;
        }
        let theta = (a.col(q)[q] - a.col(p)[p]) / (2.0 * off);
        let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
        let t = if t.is_finite() { t } else { 0.0 };
        let c = 1.0 / (t * t + 1.0).sqrt();
        let mut turn = DMat3::IDENTITY;
        turn.col_mut(p)[p] = c;
        turn.col_mut(q)[q] = c;
        turn.col_mut(p)[q] = -t * c;
        turn.col_mut(q)[p] = t * c;
        a = turn.transpose() * a * turn;
        axes *= turn;
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a.col(i)[i].total_cmp(&a.col(j)[j]));
    (order.map(|i| a.col(i)[i]), order.map(|i| axes.col(i)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::{aerial, capture, look_at, rotated, street};

    fn up(capture: &Capture) -> DVec3 {
        Ground::of(capture).to_world(DVec3::Z)
    }

    proptest! {
        #[test]
        fn every_place_has_one_owner_per_level(x in -30.0f64..30.0, y in prop_oneof![-1e9f64..1e9, (-20i32..20).prop_map(|k| f64::from(k) * 0.5)]) {
            let ground = Ground { ground_from_world: DQuat::IDENTITY, min: DVec2::new(-8.0, -7.0), edge_metres: 16.0, height_metres: 0.0, near_metres: 1e300 };
            let at = DVec3::new(x, y, 3.0);
            for level in 0..6 {
                let owner = ground.block_at(level, at);
                prop_assert_eq!(ground.block_at(level + 1, at).parent(), Some(owner));
                let side = 1 << level;
                let blocks: Vec<BlockId> = (0..side * side).map(|i| BlockId { level, x: i % side, y: i / side }).collect();
                let owners: Vec<BlockId> = blocks.iter().copied().filter(|&b| ground.owns(b, at)).collect();
                prop_assert_eq!(owners, vec![owner]);
                // Inside the root, the nominal core agrees with the ownership rule.
                if ground.core(BlockId::ROOT).contains(at.truncate()) {
                    prop_assert!(ground.core(owner).contains(at.truncate()));
                }
                let halos: Vec<BlockId> = blocks.into_iter().filter(|&b| ground.in_halo(b, at)).collect();
                prop_assert!(halos.contains(&owner) && halos.len() <= 4);
                let mut found: Vec<BlockId> = ground.halos_at(level, at).collect();
                found.sort_by_key(|b| (b.y, b.x));
                prop_assert_eq!(found, halos);
            }
        }
    }

    #[test]
    fn cores_are_half_open() {
        let ground = Ground {
            ground_from_world: DQuat::IDENTITY,
            min: DVec2::ZERO,
            edge_metres: 4.0,
            height_metres: 0.0,
            near_metres: 1e300,
        };
        let x_of = |x: f64| ground.block_at(2, DVec3::new(x, 0.0, 0.0)).x;
        assert_eq!([x_of(-5.0), x_of(0.0), x_of(1.0), x_of(2.0), x_of(4.0), x_of(9.0)], [0, 0, 1, 2, 3, 3]);
        assert_eq!(x_of(1.0 - 1e-9), 0);
        assert!(!ground.owns(BlockId::ROOT, DVec3::NAN) && !ground.in_halo(BlockId::ROOT, DVec3::INFINITY));
    }

    #[test]
    fn the_up_direction_is_estimated() {
        // Nadir cameras have a horizontal image-up vector, which must not become the up direction.
        assert_eq!(up(&aerial(4, 100.0, 500)), DVec3::Z);
        assert_eq!(up(&street(20, 500)), DVec3::Z);
        // The same captures in an arbitrary frame, as structure from motion produces.
        for turn in [DQuat::from_rotation_x(-1.5), DQuat::from_axis_angle(DVec3::new(0.6, -0.8, 0.0), 2.0)] {
            for given in [aerial(4, 100.0, 500), street(20, 500)] {
                let found = up(&rotated(given, turn));
                assert!(found.dot(turn * DVec3::Z) > 0.999, "{found}");
            }
        }
        // Cameras without a common up direction, above a plane perpendicular to world x.
        let cameras = [0.0f64, 2.0, 4.0]
            .map(|a| look_at(DVec3::new(9.0, a.cos(), a.sin()), DVec3::ZERO, DVec3::new(0.0, a.sin(), a.cos())));
        let plane =
            (0..200).map(|i| DVec3::new(0.01 * f64::from(i % 3), f64::from(i % 14), f64::from(i / 14))).collect();
        let found = up(&capture(&cameras, plane, true));
        assert!(found.x > 0.98, "{found}");
    }

    #[test]
    fn the_root_is_robust_and_finite() {
        let mut stray = aerial(4, 100.0, 500);
        stray.points.positions[3] = DVec3::splat(1e7);
        stray.points.positions[4] = DVec3::splat(f64::NAN);
        stray.points.positions[5] = DVec3::splat(-1e300);
        let ground = Ground::of(&stray);
        assert!(ground.edge_metres > 90.0 && ground.edge_metres < 120.0, "{ground:?}");
        for empty in [Capture::default(), capture(&[], vec![DVec3::splat(7.0); 50], false)] {
            let ground = Ground::of(&empty);
            assert!(ground.is_sane() && ground.edge_metres == 1.0, "{ground:?}");
        }
    }

    #[test]
    fn eigenvectors_diagonalise() {
        let m = DMat3::from_cols_array(&[4.0, 1.0, -2.0, 1.0, 3.0, 0.5, -2.0, 0.5, 7.0]);
        let (values, axes) = eigen(m);
        assert!(values.is_sorted());
        for (value, axis) in values.into_iter().zip(axes) {
            assert!((m * axis - axis * value).length() < 1e-12);
        }
    }
}
