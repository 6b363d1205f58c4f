//! The city as a ray tracing scene with a two-level BVH.
//!
//! Each shared asset has a BVH over its triangles in its own frame (BLAS). A BVH over the bounds of the actors (TLAS)
//! holds their instances. Static actors are indexed once ([`World`]), moving ones once per time ([`Moment`]), so a new
//! time costs one BVH build over some hundred boxes.
//!
//! Coordinates are f32: at 2.5 km from the origin they are exact to 0.25 mm, at 500 m to 0.06 mm.

use glam::Vec3;
use obvhs::BvhBuildParams;
use rayon::prelude::*;
use scene::Rigid;

#[cfg(target_arch = "x86_64")]
use super::traversal::Avx2;
use super::{
    bvh::{Blas, Instance, SHARED_QUALITY, TRANSPARENT, Tlas, Triangle, facing_ray, local_triangles, rotation},
    lamps::Lamps,
    motion,
    ray::{Hit, Ray, RayMask},
    traversal::{NodeTest, Portable},
};
use crate::{Actor, Asset, City, Class, Material, Mesh};

/// Largest coordinate that is accepted, metres.
const MAX_COORDINATE: f32 = 1e7;

/// A city with inconsistent lists.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum WorldError {
    /// An asset's lists differ in length, or an index of a corner or material is out of range.
    #[error("asset {0}: its lists differ in length or an index is out of range")]
    Asset(usize),
    /// An asset has a coordinate that is not finite or beyond 10,000 km.
    #[error("asset {0}: a coordinate is not finite or too large")]
    Coordinate(usize),
    /// An actor's asset index is out of range, or its pose or trajectory is not valid.
    #[error("actor {0}: its asset index, pose or trajectory is not valid")]
    Actor(usize),
    /// With this asset there are more triangles than 31 bits can count.
    #[error("asset {0}: the city has too many triangles")]
    TooLarge(usize),
}

/// A city with acceleration structures for ray casting.
pub struct World<'a> {
    city: &'a City,
    /// One per asset; empty for assets of a single static actor.
    blas: Vec<Blas>,
    static_tlas: Tlas,
    /// All static actors that do not share their asset, mostly ground, as one mesh in world coordinates. Their bounds
    /// are large and overlap, so as instances a ray would have to enter most of them.
    ground: Blas,
    /// Actor row and mesh triangle row of each triangle of the ground.
    owners: Vec<(u32, u32)>,
    /// Rows of the actors with a trajectory.
    moving_actors: Vec<u32>,
    lamps: Lamps,
}

/// The city at one time: static actors, and moving actors at their poses.
pub struct Moment<'a> {
    world: &'a World<'a>,
    moving_tlas: Tlas,
    /// City time, seconds.
    pub seconds: f64,
}

impl<'a> World<'a> {
    /// Builds the acceleration structures of a city.
    ///
    /// # Errors
    /// [`WorldError`] for inconsistent lists.
    pub fn new(city: &'a City) -> Result<Self, WorldError> {
        check(city)?;
        let row = |(i, _): (usize, &Actor)| i as u32;
        let moving_actors: Vec<u32> =
            city.actors.iter().enumerate().filter(|(_, a)| a.trajectory.is_some()).map(row).collect();
        let shared = shared(city);
        let build = |(asset, &shared): (&Asset, &bool)| {
            if shared {
                Blas::new(local_triangles(&asset.mesh, &city.materials), SHARED_QUALITY)
            } else {
                Blas::default()
            }
        };
        let blas: Vec<Blas> = city.assets.par_iter().zip(&shared).map(build).collect();
        let static_actors = || city.actors.iter().enumerate().filter(|(_, a)| a.trajectory.is_none());
        let instances =
            static_actors().filter_map(|(i, a)| Instance::new(&blas, i as u32, a.asset, &a.world_from_asset)).collect();
        let static_tlas = Tlas::new(instances, BvhBuildParams::slow_build());
        let alone = static_actors().filter(|(_, a)| !shared[a.asset as usize]);
        let (ground, owners) = flatten(city, alone.map(|(i, _)| i as u32).collect());
        Ok(Self { city, blas, static_tlas, ground, owners, moving_actors, lamps: Lamps::new(city) })
    }

    /// The city.
    pub fn city(&self) -> &'a City {
        self.city
    }

    #[inline(always)]
    fn ground_hit<B: NodeTest>(&self, ray: &Ray, mask: RayMask) -> Option<Hit> {
        let (distance, i, barycentrics) = self.ground.cast::<B>(ray.origin, ray.direction, ray, ray.t_max, mask)?;
        let met = &self.ground.triangles[i];
        let (actor, triangle) = self.owners[(met.row & !TRANSPARENT) as usize];
        let normal = facing_ray(met.second.cross(met.third).normalize_or_zero(), ray.direction);
        let asset = self.city.actors[actor as usize].asset;
        Some(Hit { distance, actor, asset, triangle, barycentrics, normal })
    }

    /// The city at a time, seconds.
    pub fn at(&'a self, seconds: f64) -> Moment<'a> {
        let instance = |&row: &u32| {
            let actor = &self.city.actors[row as usize];
            Instance::new(&self.blas, row, motion::asset_at(actor, seconds), &motion::pose_at(actor, seconds))
        };
        let instances = self.moving_actors.iter().filter_map(instance).collect();
        Moment { world: self, moving_tlas: Tlas::new(instances, BvhBuildParams::fast_build()), seconds }
    }
}

impl<'a> Moment<'a> {
    /// The city.
    pub fn city(&self) -> &'a City {
        self.world.city
    }

    /// The first surface along a ray.
    pub fn cast(&self, ray: &Ray, mask: RayMask) -> Option<Hit> {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
            fn avx2(moment: &Moment, ray: &Ray, mask: RayMask) -> Option<Hit> {
                moment.cast_by::<Avx2>(ray, mask)
            }
            if has_avx2() {
                // SAFETY: `has_avx2` has checked that the CPU supports the enabled features.
                return unsafe { avx2(self, ray, mask) };
            }
        }
        self.cast_by::<Portable>(ray, mask)
    }

    /// Whether an opaque surface lies on the ray.
    pub fn is_occluded(&self, ray: &Ray) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
            fn avx2(moment: &Moment, ray: &Ray) -> bool {
                moment.is_occluded_by::<Avx2>(ray)
            }
            if has_avx2() {
                // SAFETY: `has_avx2` has checked that the CPU supports the enabled features.
                return unsafe { avx2(self, ray) };
            }
        }
        self.is_occluded_by::<Portable>(ray)
    }

    #[inline(always)]
    pub(super) fn cast_by<B: NodeTest>(&self, ray: &Ray, mask: RayMask) -> Option<Hit> {
        let world = self.world;
        let ground = world.ground_hit::<B>(ray, mask);
        let until = |hit: &Option<Hit>| Ray { t_max: hit.map_or(ray.t_max, |hit| hit.distance), ..*ray };
        let fixed = world.static_tlas.cast::<B>(&world.blas, &until(&ground), mask).or(ground);
        if self.moving_tlas.instances.is_empty() {
            return fixed;
        }
        self.moving_tlas.cast::<B>(&world.blas, &until(&fixed), mask).or(fixed)
    }

    #[inline(always)]
    pub(super) fn is_occluded_by<B: NodeTest>(&self, ray: &Ray) -> bool {
        let World { blas, ground, static_tlas, .. } = self.world;
        static_tlas.occludes::<B>(blas, ray)
            || (!self.moving_tlas.instances.is_empty() && self.moving_tlas.occludes::<B>(blas, ray))
            || ground.occludes::<B>(ray.origin, ray.direction, ray)
    }

    /// The light sources.
    pub(crate) fn lamps(&self) -> &'a Lamps {
        &self.world.lamps
    }

    /// The actor of a hit.
    pub fn actor(&self, hit: &Hit) -> &'a Actor {
        &self.world.city.actors[hit.actor as usize]
    }

    /// The mesh of a hit.
    pub fn mesh(&self, hit: &Hit) -> &'a Mesh {
        &self.world.city.assets[hit.asset as usize].mesh
    }

    /// The class of the hit triangle.
    pub fn class(&self, hit: &Hit) -> Class {
        self.mesh(hit).classes[hit.triangle as usize]
    }

    /// The hit triangle's material and its row.
    pub fn material(&self, hit: &Hit) -> (u16, &'a Material) {
        let row = self.mesh(hit).materials[hit.triangle as usize];
        (row, &self.world.city.materials[usize::from(row)])
    }
}

/// Whether the CPU has the instructions that [`Avx2`] needs.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn has_avx2() -> bool {
    // each check reads a cached flag
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("lzcnt")
        && is_x86_feature_detected!("popcnt")
}

/// Which assets get a BVH of their own: those of several actors or of a moving one.
fn shared(city: &City) -> Vec<bool> {
    let mut uses = vec![0u32; city.assets.len()];
    for actor in &city.actors {
        let moves = actor.trajectory.is_some();
        uses[actor.asset as usize] += if moves { 2 } else { 1 };
        actor.trajectory.iter().flat_map(|t| &t.gait).for_each(|&asset| uses[asset as usize] += 2);
    }
    uses.into_iter().map(|uses| uses > 1).collect()
}

/// Merges static actors into one mesh in world coordinates, and lists the owner of each triangle.
fn flatten(city: &City, actors: Vec<u32>) -> (Blas, Vec<(u32, u32)>) {
    let (mut triangles, mut owners) = (Vec::new(), Vec::new());
    for row in actors {
        let actor = &city.actors[row as usize];
        let pose = &actor.world_from_asset;
        let (turn, origin) = (rotation(pose), pose.translation.as_vec3());
        for triangle in local_triangles(&city.assets[actor.asset as usize].mesh, &city.materials) {
            let name = owners.len() as u32 | (triangle.row & TRANSPARENT);
            owners.push((row, triangle.row & !TRANSPARENT));
            let (second, third) = (turn * triangle.second, turn * triangle.third);
            triangles.push(Triangle { corner: turn * triangle.corner + origin, second, third, row: name });
        }
    }
    (Blas::new(triangles, BvhBuildParams::medium_build()), owners)
}

fn check(city: &City) -> Result<(), WorldError> {
    for (i, asset) in city.assets.iter().enumerate() {
        let mesh = &asset.mesh;
        let count = mesh.triangles.len();
        let corners = mesh.positions.len();
        let fits = mesh.uvs.len() == corners && mesh.materials.len() == count && mesh.classes.len() == count;
        let named = mesh.triangles.iter().flatten().all(|&c| (c as usize) < corners);
        if !fits || !named || mesh.materials.iter().any(|&m| usize::from(m) >= city.materials.len()) {
            return Err(WorldError::Asset(i));
        }
        let real = |p: &Vec3| p.abs().max_element() < MAX_COORDINATE && p.is_finite();
        if !mesh.positions.iter().all(real) || !mesh.uvs.iter().all(|uv| uv.is_finite()) {
            return Err(WorldError::Coordinate(i));
        }
    }
    let mut triangles = 0;
    for (i, asset) in city.assets.iter().enumerate() {
        triangles += asset.mesh.triangles.len();
        if triangles >= TRANSPARENT as usize {
            return Err(WorldError::TooLarge(i));
        }
    }
    let is_valid = |pose: &Rigid| pose.is_sane() && pose.translation.abs().max_element() < f64::from(MAX_COORDINATE);
    for (i, actor) in city.actors.iter().enumerate() {
        let there = |&asset: &u32| (asset as usize) < city.assets.len();
        let moves = actor.trajectory.as_ref().is_none_or(|t| {
            t.gait.iter().all(there)
                && t.waypoints.iter().all(|w| is_valid(&w.world_from_asset) && w.seconds.is_finite())
        });
        if !there(&actor.asset) || !is_valid(&actor.world_from_asset) || !moves {
            return Err(WorldError::Actor(i));
        }
    }
    Ok(())
}
