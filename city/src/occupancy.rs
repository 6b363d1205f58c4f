//! Panoptic voxel occupancy of the city, computed from its meshes and not from lidar points (CarlaOcc, supplement 2.1).
//!
//! A voxel is occupied if a triangle intersects it: the separating-axis test of a triangle and a box (Akenine-Möller
//! 2001), all thirteen axes, in f64. Voxels are half-open: a face on the boundary of two voxels belongs to the upper
//! one. **Only surfaces count**: the inside of a house is free.
//!
//! If several surfaces share a voxel, actors with an instance win over those without, then thin classes over thick
//! ones, then the actor with the lower row.

use glam::{DMat3, DVec3, UVec3};
use rayon::prelude::*;
use scene::Rigid;
use serde::{Deserialize, Serialize};

use crate::{
    City, Class,
    trace::motion::{asset_at, pose_at},
};

/// [`Voxels::semantic`] of a free voxel.
pub const FREE: u8 = 255;
/// Largest number of voxels of a grid.
pub const MAX_VOXELS: u64 = 1 << 29;

/// A grid of cubic voxels along the axes of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// The frame; the identity for world axes.
    pub world_from_grid: Rigid,
    /// The lowest corner of the first voxel, in the frame, metres.
    pub low: DVec3,
    /// Voxels along x, y and z.
    pub size: UVec3,
    /// Side of a voxel, metres.
    pub voxel_metres: f64,
}

impl Grid {
    /// A box along the world axes; its upper corner is rounded up to whole voxels.
    ///
    /// # Errors
    /// [`GridError`] for a box out of range.
    pub fn world_aligned(low: DVec3, high: DVec3, voxel_metres: f64) -> Result<Self, GridError> {
        Self::new(Rigid::IDENTITY, low, high, voxel_metres)
    }

    /// A box in the axes of a pose, from `low` to `high`, metres.
    ///
    /// # Errors
    /// [`GridError`] for a box or a pose out of range.
    pub fn new(world_from_grid: Rigid, low: DVec3, high: DVec3, voxel_metres: f64) -> Result<Self, GridError> {
        // slightly less, so that 51.2 m are 512 voxels of 0.1 m despite rounding
        let cells = ((high - low) / voxel_metres - 1e-6).ceil();
        if !(cells.is_finite() && cells.min_element() >= 1.0 && cells.max_element() < 1e6) {
            return Err(GridError::OutOfRange);
        }
        let grid = Self { world_from_grid, low, size: cells.as_uvec3(), voxel_metres };
        grid.check()?;
        Ok(grid)
    }

    /// # Errors
    /// [`GridError`] for numbers out of range and for more voxels than [`MAX_VOXELS`].
    pub fn check(&self) -> Result<(), GridError> {
        let voxels = self.size.to_array().iter().try_fold(1u64, |product, &n| product.checked_mul(u64::from(n)));
        if voxels.is_none_or(|n| n > MAX_VOXELS) {
            return Err(GridError::TooLarge);
        }
        let sane = self.world_from_grid.is_sane() && self.low.is_finite() && self.low.abs().max_element() < 1e7;
        if sane && (1e-3..=1e3).contains(&self.voxel_metres) { Ok(()) } else { Err(GridError::OutOfRange) }
    }
}

/// An invalid grid.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
pub enum GridError {
    /// More than [`MAX_VOXELS`].
    #[error("more than {MAX_VOXELS} voxels")]
    TooLarge,
    /// A number is not finite or out of range.
    #[error("a grid's corners, pose or voxel is out of range")]
    OutOfRange,
}

/// Semantic and instance labels per voxel, x fastest, then y, then z.
#[derive(Debug, Clone, PartialEq)]
pub struct Voxels {
    /// The grid.
    pub grid: Grid,
    /// [`Class`], or [`FREE`].
    pub semantic: Vec<u8>,
    /// [`crate::Actor::instance`]; 0 for actors without an instance and for free voxels.
    pub instance: Vec<u32>,
}

impl Voxels {
    /// Index of a voxel.
    pub fn index(&self, at: UVec3) -> usize {
        let size = self.grid.size.as_usizevec3();
        let at = at.as_usizevec3();
        (at.z * size.y + at.y) * size.x + at.x
    }

    /// Number of occupied voxels.
    pub fn occupied_count(&self) -> usize {
        self.semantic.iter().filter(|&&class| class != FREE).count()
    }
}

/// Computes the occupancy of the city at a time.
///
/// # Errors
/// [`GridError`] for an invalid grid.
pub fn voxelize(city: &City, seconds: f64, grid: &Grid) -> Result<Voxels, GridError> {
    grid.check()?;
    let faces = faces(city, seconds, grid);
    let layer = grid.size.x as usize * grid.size.y as usize;
    let total = layer * grid.size.z as usize;
    let (mut semantic, mut instance, mut rank) = (vec![FREE; total], vec![0u32; total], vec![0u8; total]);
    let layers = semantic.par_chunks_mut(layer).zip(instance.par_chunks_mut(layer)).zip(rank.par_chunks_mut(layer));
    layers.enumerate().for_each(|(z, ((semantic, instance), rank))| {
        for face in faces.iter().filter(|face| face.overlaps_layer(z)) {
            face.for_each_voxel(grid.size, z, |i| {
                if face.rank > rank[i] {
                    (semantic[i], instance[i], rank[i]) = (face.class as u8, face.instance, face.rank);
                }
            });
        }
    });
    Ok(Voxels { grid: *grid, semantic, instance })
}

/// A triangle in voxel units, relative to the grid's lowest corner.
struct Face {
    corners: [DVec3; 3],
    low: DVec3,
    high: DVec3,
    class: Class,
    instance: u32,
    rank: u8,
}

/// The triangles that overlap a grid, in the order of actors.
fn faces(city: &City, seconds: f64, grid: &Grid) -> Vec<Face> {
    let grid_from_world = grid.world_from_grid.inverse();
    let top = grid.size.as_dvec3();
    let of_actor = |actor: &crate::Actor| {
        let Some(asset) = city.assets.get(asset_at(actor, seconds) as usize) else { return Vec::new() };
        let pose = pose_at(actor, seconds);
        let rotation = grid_from_world.rotation * pose.rotation;
        let turn = DMat3::from_quat(rotation);
        let shift = grid_from_world.apply(pose.translation) - grid.low;
        let mesh = &asset.mesh;
        // a bounding sphere rejects most actors
        let reach = mesh.positions.iter().map(|p| p.length_squared()).fold(0.0, f32::max).sqrt();
        let reach = f64::from(reach) + grid.voxel_metres;
        if (shift + reach).min_element() < 0.0 || (shift - reach - top * grid.voxel_metres).max_element() > 0.0 {
            return Vec::new();
        }
        let place = |corner: &u32| {
            mesh.positions.get(*corner as usize).map(|p| (turn * p.as_dvec3() + shift) / grid.voxel_metres)
        };
        let face = |(i, t): (usize, &[u32; 3])| {
            let corners = [place(&t[0])?, place(&t[1])?, place(&t[2])?];
            let low = corners[0].min(corners[1]).min(corners[2]);
            let high = corners[0].max(corners[1]).max(corners[2]);
            let class = *mesh.classes.get(i)?;
            let here = low.is_finite() && high.is_finite() && high.cmpge(DVec3::ZERO).all() && low.cmplt(top).all();
            here.then(|| Face {
                corners,
                low,
                high,
                class,
                instance: actor.instance,
                rank: rank(class, actor.instance),
            })
        };
        mesh.triangles.iter().enumerate().filter_map(face).collect::<Vec<_>>()
    };
    let all: Vec<Vec<Face>> = city.actors.par_iter().map(of_actor).collect();
    all.into_iter().flatten().collect()
}

/// Priority in a shared voxel: actors with an instance first, then thin classes.
fn rank(class: Class, instance: u32) -> u8 {
    let thin = match class {
        Class::Person | Class::Rider => 9,
        Class::TrafficLight | Class::TrafficSign | Class::Pole => 8,
        Class::Bicycle | Class::Motorcycle => 7,
        Class::Car | Class::Truck | Class::Bus | Class::Train => 6,
        Class::StreetFurniture | Class::Fence | Class::GuardRail => 5,
        Class::Vegetation => 4,
        Class::Wall | Class::Building | Class::Bridge => 3,
        Class::RoadMarking => 2,
        _ => 1,
    };
    thin + if instance > 0 { 16 } else { 0 }
}

impl Face {
    fn overlaps_layer(&self, z: usize) -> bool {
        self.low.z < (z + 1) as f64 && self.high.z >= z as f64
    }

    /// Calls back for each voxel of a layer that the triangle intersects.
    fn for_each_voxel(&self, size: UVec3, z: usize, mut call: impl FnMut(usize)) {
        let first = |low: f64| low.floor().max(0.0) as u32;
        let end = |high: f64, n: u32| (high.floor() + 1.0).clamp(0.0, f64::from(n)) as u32;
        for y in first(self.low.y)..end(self.high.y, size.y) {
            let Some((from, to)) = self.row_span(f64::from(y), z as f64) else { continue };
            for x in first(self.low.x.max(from))..end(self.high.x.min(to), size.x) {
                if self.intersects(DVec3::new(f64::from(x), f64::from(y), z as f64)) {
                    call((y * size.x + x) as usize);
                }
            }
        }
    }

    /// Range of x in which the triangle's plane passes through a row of voxels, so that large sloping triangles cost no
    /// more than their surface.
    fn row_span(&self, y: f64, z: f64) -> Option<(f64, f64)> {
        let [a, b, c] = self.corners;
        let n = (b - a).cross(c - a);
        if n.x.abs() < 0.1 * n.abs().max_element() {
            return Some((f64::NEG_INFINITY, f64::INFINITY));
        }
        let at = |y: f64, z: f64| a.x - (n.y * (y - a.y) + n.z * (z - a.z)) / n.x;
        let ends = [at(y, z), at(y + 1.0, z), at(y, z + 1.0), at(y + 1.0, z + 1.0)];
        let (low, high) = ends.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &e| (l.min(e), h.max(e)));
        Some((low - 1.0, high + 1.0))
    }

    /// Whether the triangle intersects the voxel with this lowest corner.
    fn intersects(&self, voxel: DVec3) -> bool {
        // along the voxel's own axes: half-open
        let top = voxel + 1.0;
        if self.low.cmpge(top).any() || self.high.cmplt(voxel).any() {
            return false;
        }
        let p = self.corners.map(|c| c - (voxel + 0.5));
        let edges = [p[1] - p[0], p[2] - p[1], p[0] - p[2]];
        let apart = |axis: DVec3| {
            let reach = 0.5 * axis.abs().element_sum();
            let along = p.map(|corner| corner.dot(axis));
            let (low, high) = (along[0].min(along[1]).min(along[2]), along[0].max(along[1]).max(along[2]));
            low > reach || high < -reach
        };
        let crossed = edges.iter().any(|edge| DVec3::AXES.iter().any(|axis| apart(axis.cross(*edge))));
        !crossed && !apart(edges[0].cross(edges[1]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scene;
    use glam::{DQuat, Vec3, vec3};

    /// A box from (0.33, 0.33, 0.33) to (1.77, 1.27, 2.12).
    fn boxed() -> City {
        let mut city = City { materials: test_scene::city().materials, ..City::default() };
        let mesh = test_scene::cuboid(vec3(0.33, 0.33, 0.33), vec3(1.77, 1.27, 2.12), 0, Class::Car);
        test_scene::add_actor(&mut city, "box", mesh, Class::Car, 5, DVec3::ZERO);
        city
    }

    #[test]
    fn a_box_occupies_exactly_the_shell_of_its_voxels() {
        for voxel in [0.05, 0.1, 0.5] {
            let grid = Grid::world_aligned(DVec3::splat(-0.5), DVec3::new(2.5, 2.0, 3.0), voxel).unwrap();
            let filled = voxelize(&boxed(), 0.0, &grid).unwrap();
            let cell = |metres: f64| ((metres + 0.5) / voxel).floor() as u32;
            let low = UVec3::splat(cell(0.33));
            let high = UVec3::new(cell(1.77), cell(1.27), cell(2.12));
            for z in 0..grid.size.z {
                for y in 0..grid.size.y {
                    for x in 0..grid.size.x {
                        let at = UVec3::new(x, y, z);
                        let inside = at.cmpge(low).all() && at.cmple(high).all();
                        let shell = inside && (at.cmpeq(low).any() || at.cmpeq(high).any());
                        let i = filled.index(at);
                        assert_eq!(filled.semantic[i] == Class::Car as u8, shell, "{at} at {voxel}");
                        assert_eq!(filled.instance[i], if shell { 5 } else { 0 });
                    }
                }
            }
        }
    }

    #[test]
    fn a_slope_occupies_only_voxels_it_intersects() {
        // the plane x + y + z = 3.3 within the first octant, against its own arithmetic
        let mut city = City { materials: test_scene::city().materials, ..City::default() };
        let mut mesh = test_scene::rectangle(Vec3::ZERO, Vec3::X, Vec3::Y, 0, Class::Wall);
        mesh.positions = vec![Vec3::X * 3.3, Vec3::Y * 3.3, Vec3::Z * 3.3];
        mesh.uvs.truncate(3);
        (mesh.triangles, mesh.materials, mesh.classes) = (vec![[0, 1, 2]], vec![0], vec![Class::Wall]);
        test_scene::add_actor(&mut city, "slope", mesh, Class::Wall, 1, DVec3::ZERO);
        let grid = Grid::world_aligned(DVec3::ZERO, DVec3::splat(4.0), 0.5).unwrap();
        let filled = voxelize(&city, 0.0, &grid).unwrap();
        for i in 0..512u32 {
            let at = UVec3::new(i % 8, i / 8 % 8, i / 64);
            let low = at.as_dvec3().element_sum() * 0.5;
            assert_eq!(filled.semantic[filled.index(at)] != FREE, low <= 3.3 && low + 1.5 >= 3.3, "{at}");
        }
    }

    #[test]
    fn a_grid_around_a_pose_has_the_axes_of_the_pose() {
        let city = test_scene::city();
        let pose = Rigid {
            rotation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
            translation: DVec3::new(0.0, -1.0, 0.0),
        };
        let grid = Grid::new(pose, DVec3::new(0.05, -4.0, -0.95), DVec3::new(16.05, 4.0, 4.05), 0.1).unwrap();
        let filled = voxelize(&city, 100.0, &grid).unwrap();
        // ahead of the pose is +y: the pane 11 m ahead, the wall 13 m ahead
        let at = |x: f64, y: f64, z: f64| filled.index(((DVec3::new(x, y, z) - grid.low) / 0.1).as_uvec3());
        assert_eq!(
            (filled.semantic[at(11.0, 0.0, 1.5)], filled.instance[at(11.0, 0.0, 1.5)]),
            (Class::Building as u8, 3)
        );
        assert_eq!(filled.semantic[at(13.0, 0.0, 1.5)], Class::Wall as u8);
        assert_eq!(filled.semantic[at(12.0, 0.0, 1.5)], FREE);
        assert_eq!(filled.semantic[at(5.0, 0.0, 0.0)], Class::Road as u8);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(|| voxelize(&city, 100.0, &grid).unwrap()), filled);
    }

    #[test]
    fn invalid_grids_are_refused() {
        let block = |high: f64, voxel: f64| Grid::world_aligned(DVec3::ZERO, DVec3::splat(high), voxel);
        assert_eq!(block(1000.0, 0.05), Err(GridError::TooLarge));
        assert_eq!(block(10.0, 0.0), Err(GridError::OutOfRange));
        assert_eq!(block(-1.0, 0.1), Err(GridError::OutOfRange));
        assert_eq!(block(f64::NAN, 0.1), Err(GridError::OutOfRange));
        let huge = Grid { size: UVec3::MAX, ..block(1.0, 0.1).unwrap() };
        assert_eq!(voxelize(&City::default(), 0.0, &huge).unwrap_err(), GridError::TooLarge);
    }
}
