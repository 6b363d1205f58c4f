//! Trees over triangles and over placed meshes, and how rays traversal them.

use glam::{Mat3, Quat, Vec2, Vec3};
use obvhs::{
    BvhBuildParams,
    aabb::Aabb,
    cwbvh::{CwBvh, builder::build_cwbvh},
};
use scene::Rigid;

use super::{
    ray::{Hit, Ray, RayMask},
    traversal::{NodeTest, traverse_bvh},
};
use crate::{Material, Mesh};

/// Bit of [`Triangle::row`] that marks a transparent triangle.
pub(super) const TRANSPARENT: u32 = 1 << 31;
/// Build quality of shared meshes, which are built once and traversed often.
pub(super) const SHARED_QUALITY: BvhBuildParams =
    BvhBuildParams { pre_split: false, ..BvhBuildParams::very_slow_build() };

/// The triangles of a mesh in its own frame.
pub(super) fn local_triangles(mesh: &Mesh, materials: &[Material]) -> Vec<Triangle> {
    let one = |(i, corners): (usize, &[u32; 3])| {
        let [a, b, c] = corners.map(|corner| mesh.positions[corner as usize]);
        let clear = materials[usize::from(mesh.materials[i])].transparency > 0.0;
        Triangle { corner: a, second: b - a, third: c - a, row: i as u32 | if clear { TRANSPARENT } else { 0 } }
    };
    mesh.triangles.iter().enumerate().map(one).collect()
}

pub(super) fn rotation(pose: &Rigid) -> Mat3 {
    Mat3::from_quat(Quat::from_array(pose.rotation.as_quat().to_array()).normalize())
}

/// The normal, flipped to the side that the ray comes from.
pub(super) fn facing_ray(normal: Vec3, direction: Vec3) -> Vec3 {
    if normal.dot(direction) > 0.0 { -normal } else { normal }
}

/// A BVH and its triangles in leaf order.
#[derive(Default)]
pub(super) struct Blas {
    pub(super) bvh: CwBvh,
    pub(super) triangles: Vec<Triangle>,
    pub(super) low: Vec3,
    pub(super) high: Vec3,
}

/// A corner and the two edges that start there.
#[derive(Clone, Copy)]
pub(super) struct Triangle {
    pub(super) corner: Vec3,
    pub(super) second: Vec3,
    pub(super) third: Vec3,
    /// Row in the mesh; the highest bit is [`TRANSPARENT`].
    pub(super) row: u32,
}

impl Blas {
    pub(super) fn new(all: Vec<Triangle>, quality: BvhBuildParams) -> Self {
        let boxes: Vec<Aabb> = all.iter().map(Triangle::bounds).collect();
        let bvh = build_bvh(&boxes, quality);
        let triangles = bvh.primitive_indices.iter().map(|&i| all[i as usize]).collect();
        let (low, high) = (bvh.total_aabb.min.to_array().into(), bvh.total_aabb.max.to_array().into());
        Self { bvh, triangles, low, high }
    }

    /// The nearest triangle along a ray in the mesh's frame: distance, index into [`Self::triangles`], barycentrics.
    #[inline(always)]
    pub(super) fn cast<B: NodeTest>(
        &self,
        origin: Vec3,
        direction: Vec3,
        ray: &Ray,
        to: f32,
        mask: RayMask,
    ) -> Option<(f32, usize, Vec2)> {
        let mut found = None;
        let mut outer = obvhs_ray(origin, direction, to);
        traverse_bvh!(B, self.bvh, outer, i => {
            let triangle = &self.triangles[i];
            if let Some((t, u, v)) = triangle.intersect(origin, direction)
                && t > ray.t_min
                && t < outer.tmax
                && !(mask == RayMask::Opaque && triangle.row & TRANSPARENT != 0)
            {
                outer.tmax = t;
                found = Some((t, i, Vec2::new(u, v)));
            }
        });
        found
    }

    /// Whether an opaque triangle lies on a ray in the mesh's frame.
    #[inline(always)]
    pub(super) fn occludes<B: NodeTest>(&self, origin: Vec3, direction: Vec3, ray: &Ray) -> bool {
        let outer = obvhs_ray(origin, direction, ray.t_max);
        'met: {
            traverse_bvh!(B, self.bvh, outer, i => {
                let triangle = &self.triangles[i];
                if let Some((t, ..)) = triangle.intersect(origin, direction)
                    && t > ray.t_min
                    && t < ray.t_max
                    && triangle.row & TRANSPARENT == 0
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

    /// Distance along the ray and barycentrics of the second and third corner (Möller and Trumbore 1997). The edges
    /// have a small tolerance, so that no ray passes between two adjacent triangles.
    #[inline(always)]
    fn intersect(&self, origin: Vec3, direction: Vec3) -> Option<(f32, f32, f32)> {
        const TOLERANCE: f32 = -1e-6;
        let p = direction.cross(self.third);
        let inverse = 1.0 / self.second.dot(p);
        let s = origin - self.corner;
        let u = s.dot(p) * inverse;
        let q = s.cross(self.second);
        let v = direction.dot(q) * inverse;
        // a ray in the triangle's plane gives NaN, which fails every comparison
        (u >= TOLERANCE && v >= TOLERANCE && u + v <= 1.0 - TOLERANCE).then(|| (self.third.dot(q) * inverse, u, v))
    }
}

/// A placed asset: one actor.
#[derive(Clone, Copy)]
pub(super) struct Instance {
    pub(super) asset_from_world: Mat3,
    pub(super) origin: Vec3,
    pub(super) blas: u32,
    pub(super) actor: u32,
}

impl Instance {
    /// `None` for an empty asset.
    pub(super) fn new(meshes: &[Blas], actor: u32, blas: u32, pose: &Rigid) -> Option<(Self, Aabb)> {
        let Blas { low, high, triangles, .. } = &meshes[blas as usize];
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
        // enlarged, so that rounding in the rotation cuts no face off
        let reach = reach + 1e-6 * (centre.abs() + reach) + 1e-5;
        let bounds = Aabb::new((centre - reach).to_array().into(), (centre + reach).to_array().into());
        Some((Self { asset_from_world: world_from_asset.transpose(), origin, blas, actor }, bounds))
    }

    #[inline(always)]
    fn ray_in_asset(&self, ray: &Ray) -> (Vec3, Vec3) {
        (self.asset_from_world * (ray.origin - self.origin), self.asset_from_world * ray.direction)
    }
}

/// The instances and the BVH over their world bounds.
pub(super) struct Tlas {
    pub(super) bvh: CwBvh,
    /// In leaf order.
    pub(super) instances: Vec<Instance>,
}

impl Tlas {
    pub(super) fn new(placed: Vec<(Instance, Aabb)>, quality: BvhBuildParams) -> Self {
        let boxes: Vec<Aabb> = placed.iter().map(|(_, bounds)| *bounds).collect();
        let bvh = build_bvh(&boxes, quality);
        let instances = bvh.primitive_indices.iter().map(|&i| placed[i as usize].0).collect();
        Self { bvh, instances }
    }

    #[inline(always)]
    pub(super) fn cast<B: NodeTest>(&self, meshes: &[Blas], ray: &Ray, mask: RayMask) -> Option<Hit> {
        let mut found: Option<(usize, usize, Vec2)> = None;
        let mut outer = obvhs_ray(ray.origin, ray.direction, ray.t_max);
        traverse_bvh!(B, self.bvh, outer, i => {
            let instance = &self.instances[i];
            let (origin, direction) = instance.ray_in_asset(ray);
            if let Some((t, triangle, corners)) =
                meshes[instance.blas as usize].cast::<B>(origin, direction, ray, outer.tmax, mask)
            {
                outer.tmax = t;
                found = Some((i, triangle, corners));
            }
        });
        let nearest = outer.tmax;
        let (instance, triangle, corners) = found?;
        let instance = &self.instances[instance];
        let met = &meshes[instance.blas as usize].triangles[triangle];
        let normal = instance.asset_from_world.transpose() * met.second.cross(met.third).normalize_or_zero();
        let (asset, triangle) = (instance.blas, met.row & !TRANSPARENT);
        Some(Hit {
            distance: nearest,
            actor: instance.actor,
            asset,
            triangle,
            barycentrics: corners,
            normal: facing_ray(normal, ray.direction),
        })
    }

    #[inline(always)]
    pub(super) fn occludes<B: NodeTest>(&self, meshes: &[Blas], ray: &Ray) -> bool {
        let outer = obvhs_ray(ray.origin, ray.direction, ray.t_max);
        'met: {
            traverse_bvh!(B, self.bvh, outer, i => {
                let instance = &self.instances[i];
                let (origin, direction) = instance.ray_in_asset(ray);
                if meshes[instance.blas as usize].occludes::<B>(origin, direction, ray) {
                    break 'met true;
                }
            });
            false
        }
    }
}

/// The ray in the types of `obvhs`, which uses another version of `glam`. Adding zero turns -0 into +0: `obvhs` takes
/// -0 as negative where it inverts a direction and as positive where it compares, so an axis-aligned ray would hit
/// nothing.
#[inline(always)]
fn obvhs_ray(origin: Vec3, direction: Vec3, to: f32) -> obvhs::ray::Ray {
    let direction = direction + Vec3::ZERO;
    obvhs::ray::Ray::new(origin.to_array().into(), direction.to_array().into(), 0.0, to)
}

fn build_bvh(boxes: &[Aabb], quality: BvhBuildParams) -> CwBvh {
    // obvhs reports its build time here
    let unread = &mut std::time::Duration::default();
    if boxes.is_empty() { CwBvh::default() } else { build_cwbvh(boxes, quality, unread) }
}
