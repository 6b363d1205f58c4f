//! Trees over triangles and over placed meshes, and how rays walk them.

use glam::{Mat3, Quat, Vec2, Vec3};
use obvhs::{
    BvhBuildParams,
    aabb::Aabb,
    cwbvh::{CwBvh, builder::build_cwbvh},
};
use scene::Rigid;

use super::{
    walk::{Boxes, walk},
    world::{Hit, Meets, Ray},
};
use crate::{Material, Mesh};

/// Marks a triangle that light goes through, in [`Triangle::row`].
pub(super) const CLEAR: u32 = 1 << 31;
/// How trees are made that many actors share: with care. The ground's is made quickly.
pub(super) const SHARED: BvhBuildParams = BvhBuildParams { pre_split: false, ..BvhBuildParams::very_slow_build() };

/// A mesh's triangles in its own frame.
pub(super) fn local(mesh: &Mesh, materials: &[Material]) -> Vec<Triangle> {
    let one = |(i, corners): (usize, &[u32; 3])| {
        let [a, b, c] = corners.map(|corner| mesh.positions[corner as usize]);
        let clear = materials[usize::from(mesh.materials[i])].transparency > 0.0;
        Triangle { corner: a, second: b - a, third: c - a, row: i as u32 | if clear { CLEAR } else { 0 } }
    };
    mesh.triangles.iter().enumerate().map(one).collect()
}

pub(super) fn rotation(pose: &Rigid) -> Mat3 {
    Mat3::from_quat(Quat::from_array(pose.rotation.as_quat().to_array()).normalize())
}

/// A normal to the side that a ray came from.
pub(super) fn turned(normal: Vec3, direction: Vec3) -> Vec3 {
    if normal.dot(direction) > 0.0 { -normal } else { normal }
}

/// Triangles in the order of the tree over them.
#[derive(Default)]
pub(super) struct Solid {
    pub(super) bvh: CwBvh,
    pub(super) triangles: Vec<Triangle>,
    pub(super) low: Vec3,
    pub(super) high: Vec3,
}

/// A corner and the two edges from it.
#[derive(Clone, Copy)]
pub(super) struct Triangle {
    pub(super) corner: Vec3,
    pub(super) second: Vec3,
    pub(super) third: Vec3,
    /// Its number; the highest bit marks glass.
    pub(super) row: u32,
}

impl Solid {
    pub(super) fn new(all: Vec<Triangle>, quality: BvhBuildParams) -> Self {
        let boxes: Vec<Aabb> = all.iter().map(Triangle::bounds).collect();
        let bvh = tree(&boxes, quality);
        let triangles = bvh.primitive_indices.iter().map(|&i| all[i as usize]).collect();
        let (low, high) = (bvh.total_aabb.min.to_array().into(), bvh.total_aabb.max.to_array().into());
        Self { bvh, triangles, low, high }
    }

    /// The nearest triangle along a ray given in the mesh's own frame: its distance, its place in the order and the
    /// shares of its corners.
    #[inline(always)]
    pub(super) fn cast<B: Boxes>(
        &self,
        origin: Vec3,
        direction: Vec3,
        ray: &Ray,
        to: f32,
        meets: Meets,
    ) -> Option<(f32, usize, Vec2)> {
        let mut found = None;
        let mut outer = outer(origin, direction, to);
        walk!(B, self.bvh, outer, i => {
            let triangle = &self.triangles[i];
            if let Some((t, u, v)) = triangle.meet(origin, direction)
                && t > ray.from
                && t < outer.tmax
                && !(meets == Meets::Opaque && triangle.row & CLEAR != 0)
            {
                outer.tmax = t;
                found = Some((t, i, Vec2::new(u, v)));
            }
        });
        found
    }

    /// Whether an opaque triangle lies on a ray given in the mesh's own frame.
    #[inline(always)]
    pub(super) fn blocks<B: Boxes>(&self, origin: Vec3, direction: Vec3, ray: &Ray) -> bool {
        let outer = outer(origin, direction, ray.to);
        'met: {
            walk!(B, self.bvh, outer, i => {
                let triangle = &self.triangles[i];
                if let Some((t, ..)) = triangle.meet(origin, direction)
                    && t > ray.from
                    && t < ray.to
                    && triangle.row & CLEAR == 0
                {
                    break 'met true;
                }
            });
            false
        }
    }
}

impl Triangle {
    fn bounds(&self) -> Aabb {
        let (b, c) = (self.corner + self.second, self.corner + self.third);
        let (low, high) = (self.corner.min(b).min(c), self.corner.max(b).max(c));
        Aabb::new(low.to_array().into(), high.to_array().into())
    }

    /// Distance of a ray to the triangle and the shares of its second and third corner (Möller and Trumbore 1997), a
    /// hair's breadth beyond its edges too, so that no ray slips through between two triangles.
    #[inline(always)]
    fn meet(&self, origin: Vec3, direction: Vec3) -> Option<(f32, f32, f32)> {
        const HAIR: f32 = -1e-6;
        let p = direction.cross(self.third);
        let inverse = 1.0 / self.second.dot(p);
        let s = origin - self.corner;
        let u = s.dot(p) * inverse;
        let q = s.cross(self.second);
        let v = direction.dot(q) * inverse;
        // not-a-number, of a ray along the triangle, fails every comparison
        (u >= HAIR && v >= HAIR && u + v <= 1.0 - HAIR).then(|| (self.third.dot(q) * inverse, u, v))
    }
}

/// An actor's asset and the way from the world into it.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub(super) asset_from_world: Mat3,
    pub(super) origin: Vec3,
    pub(super) solid: u32,
    pub(super) actor: u32,
}

impl Place {
    /// None where the asset is empty.
    pub(super) fn new(solids: &[Solid], actor: u32, solid: u32, pose: &Rigid) -> Option<(Self, Aabb)> {
        let Solid { low, high, triangles, .. } = &solids[solid as usize];
        if triangles.is_empty() {
            return None;
        }
        let world_from_asset = rotation(pose);
        let origin = pose.translation.as_vec3();
        let (centre, half) = (0.5 * (*low + *high), 0.5 * (*high - *low));
        let reach = world_from_asset.x_axis.abs() * half.x
            + world_from_asset.y_axis.abs() * half.y
            + world_from_asset.z_axis.abs() * half.z;
        let centre = world_from_asset * centre + origin;
        // what the turning rounds away must not cut a face off
        let reach = reach + 1e-6 * (centre.abs() + reach) + 1e-5;
        let bounds = Aabb::new((centre - reach).to_array().into(), (centre + reach).to_array().into());
        Some((Self { asset_from_world: world_from_asset.transpose(), origin, solid, actor }, bounds))
    }

    #[inline(always)]
    fn inside(&self, ray: &Ray) -> (Vec3, Vec3) {
        (self.asset_from_world * (ray.origin - self.origin), self.asset_from_world * ray.direction)
    }
}

/// Actors and a tree over their bounds.
pub(super) struct Level {
    pub(super) bvh: CwBvh,
    /// In the order of the tree.
    pub(super) places: Vec<Place>,
}

impl Level {
    pub(super) fn new(placed: Vec<(Place, Aabb)>, quality: BvhBuildParams) -> Self {
        let boxes: Vec<Aabb> = placed.iter().map(|(_, bounds)| *bounds).collect();
        let bvh = tree(&boxes, quality);
        let places = bvh.primitive_indices.iter().map(|&i| placed[i as usize].0).collect();
        Self { bvh, places }
    }

    #[inline(always)]
    pub(super) fn cast<B: Boxes>(&self, solids: &[Solid], ray: &Ray, meets: Meets) -> Option<Hit> {
        let mut found: Option<(usize, usize, Vec2)> = None;
        let mut outer = outer(ray.origin, ray.direction, ray.to);
        walk!(B, self.bvh, outer, i => {
            let place = &self.places[i];
            let (origin, direction) = place.inside(ray);
            if let Some((t, triangle, corners)) =
                solids[place.solid as usize].cast::<B>(origin, direction, ray, outer.tmax, meets)
            {
                outer.tmax = t;
                found = Some((i, triangle, corners));
            }
        });
        let nearest = outer.tmax;
        let (place, triangle, corners) = found?;
        let place = &self.places[place];
        let met = &solids[place.solid as usize].triangles[triangle];
        let normal = place.asset_from_world.transpose() * met.second.cross(met.third).normalize_or_zero();
        let (asset, triangle) = (place.solid, met.row & !CLEAR);
        Some(Hit {
            distance: nearest,
            actor: place.actor,
            asset,
            triangle,
            corners,
            normal: turned(normal, ray.direction),
        })
    }

    #[inline(always)]
    pub(super) fn blocks<B: Boxes>(&self, solids: &[Solid], ray: &Ray) -> bool {
        let outer = outer(ray.origin, ray.direction, ray.to);
        'met: {
            walk!(B, self.bvh, outer, i => {
                let place = &self.places[i];
                let (origin, direction) = place.inside(ray);
                if solids[place.solid as usize].blocks::<B>(origin, direction, ray) {
                    break 'met true;
                }
            });
            false
        }
    }
}

/// The tree's own ray: its crate has another version of our vectors, and takes -0 for uphill where it inverts it and for
/// downhill where it compares it, so that a ray along an axis would meet nothing.
#[inline(always)]
fn outer(origin: Vec3, direction: Vec3, to: f32) -> obvhs::ray::Ray {
    let direction = direction + Vec3::ZERO;
    obvhs::ray::Ray::new(origin.to_array().into(), direction.to_array().into(), 0.0, to)
}

fn tree(boxes: &[Aabb], quality: BvhBuildParams) -> CwBvh {
    // the time it took is of no interest, and must not be in what is made
    let unread = &mut std::time::Duration::default();
    if boxes.is_empty() { CwBvh::default() } else { build_cwbvh(boxes, quality, unread) }
}
