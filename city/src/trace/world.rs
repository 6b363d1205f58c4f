//! The city as rays meet it, in two levels: a tree over each asset's triangles in the asset's own frame, shared by all
//! its actors, and a tree over the actors' bounds. What stands is indexed once ([`World`]), what moves once for every
//! moment ([`Moment`]), so that a minute of traffic costs a second index over some thousand boxes and nothing else.
//!
//! Numbers are f32: at 2.5 km from the origin a coordinate is exact to 0.25 mm, at 500 m to 0.06 mm.

use glam::{Vec2, Vec3};
use obvhs::BvhBuildParams;
use rayon::prelude::*;
use scene::Rigid;

#[cfg(target_arch = "x86_64")]
use super::walk::Avx2;
use super::{
    index::{CLEAR, Level, Place, SHARED, Solid, Triangle, local, rotation, turned},
    lamps::Lamps,
    motion,
    walk::{Boxes, Portable},
};
use crate::{Actor, Asset, City, Class, Material, Mesh};

/// Coordinates beyond this are a mistake, metres.
const FARTHEST: f32 = 1e7;

/// A city that rays cannot be cast into.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum WorldError {
    /// An asset's lists differ in length, or name corners or materials that there are not.
    #[error("asset {0}: its triangles name what is not there")]
    Asset(usize),
    /// An asset has a coordinate that is no number or out of this world.
    #[error("asset {0}: a coordinate is not finite")]
    Coordinate(usize),
    /// An actor's asset is not there, or its pose or trajectory is not one.
    #[error("actor {0}: its asset or its pose is not there")]
    Actor(usize),
    /// More triangles than can be counted in 31 bits, with this asset's.
    #[error("too many triangles with those of asset {0}")]
    TooLarge(usize),
}

/// What a ray asks for: metres from its origin along a unit direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// World metres.
    pub origin: Vec3,
    /// Unit vector.
    pub direction: Vec3,
    /// Nothing nearer is met, metres.
    pub from: f32,
    /// Nothing farther is met, metres.
    pub to: f32,
}

impl Ray {
    /// A ray without an end.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Self { origin, direction, from: 0.0, to: f32::INFINITY }
    }

    /// The point at a distance.
    pub fn at(&self, distance: f32) -> Vec3 {
        self.origin + distance * self.direction
    }
}

/// Which surfaces a ray meets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Meets {
    /// All of them.
    Everything,
    /// Those that no light goes through: glass is not there.
    Opaque,
}

/// Where a ray first meets the city.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Metres along the ray.
    pub distance: f32,
    /// Row of [`City::actors`].
    pub actor: u32,
    /// Row of [`City::assets`]: the actor's, or that of its gait.
    pub asset: u32,
    /// Row of the mesh's triangles.
    pub triangle: u32,
    /// Shares of the triangle's second and third corner.
    pub corners: Vec2,
    /// Unit normal in the world, turned to where the ray came from.
    pub normal: Vec3,
}

/// What stands in a city, indexed for rays.
pub struct World<'a> {
    city: &'a City,
    /// One for each asset; empty for those that one actor has for itself.
    solids: Vec<Solid>,
    standing: Level,
    /// All standing actors that share their asset with nobody, ground above all, as one mesh in the world: their bounds
    /// are wide and lie over each other, and a ray would have to enter most of them.
    ground: Solid,
    /// Of the ground's triangles by their row: the actor's row and the row in its mesh.
    owners: Vec<(u32, u32)>,
    /// Rows of the actors that have a trajectory.
    movers: Vec<u32>,
    lamps: Lamps,
}

/// The city at a moment: what stands, and what moves where it then is.
pub struct Moment<'a> {
    world: &'a World<'a>,
    moving: Level,
    /// Seconds of the city's clock.
    pub seconds: f64,
}

impl<'a> World<'a> {
    /// Indexes a city.
    ///
    /// # Errors
    /// [`WorldError`] where the city's lists do not fit together.
    pub fn new(city: &'a City) -> Result<Self, WorldError> {
        check(city)?;
        let row = |(i, _): (usize, &Actor)| i as u32;
        let movers: Vec<u32> =
            city.actors.iter().enumerate().filter(|(_, a)| a.trajectory.is_some()).map(row).collect();
        let shared = shared(city);
        let solid = |(asset, &shared): (&Asset, &bool)| {
            if shared { Solid::new(local(&asset.mesh, &city.materials), SHARED) } else { Solid::default() }
        };
        let solids: Vec<Solid> = city.assets.par_iter().zip(&shared).map(solid).collect();
        let still = || city.actors.iter().enumerate().filter(|(_, a)| a.trajectory.is_none());
        let places = still().filter_map(|(i, a)| Place::new(&solids, i as u32, a.asset, &a.world_from_asset)).collect();
        let standing = Level::new(places, BvhBuildParams::slow_build());
        let alone = still().filter(|(_, a)| !shared[a.asset as usize]);
        let (ground, owners) = flat(city, alone.map(|(i, _)| i as u32).collect());
        Ok(Self { city, solids, standing, ground, owners, movers, lamps: Lamps::new(city) })
    }

    /// The city this is of.
    pub fn city(&self) -> &'a City {
        self.city
    }

    #[inline(always)]
    fn ground_hit<B: Boxes>(&self, ray: &Ray, meets: Meets) -> Option<Hit> {
        let (distance, i, corners) = self.ground.cast::<B>(ray.origin, ray.direction, ray, ray.to, meets)?;
        let met = &self.ground.triangles[i];
        let (actor, triangle) = self.owners[(met.row & !CLEAR) as usize];
        let normal = turned(met.second.cross(met.third).normalize_or_zero(), ray.direction);
        let asset = self.city.actors[actor as usize].asset;
        Some(Hit { distance, actor, asset, triangle, corners, normal })
    }

    /// The city at a moment.
    pub fn at(&'a self, seconds: f64) -> Moment<'a> {
        let place = |&row: &u32| {
            let actor = &self.city.actors[row as usize];
            Place::new(&self.solids, row, motion::asset_at(actor, seconds), &motion::pose_at(actor, seconds))
        };
        let places = self.movers.iter().filter_map(place).collect();
        Moment { world: self, moving: Level::new(places, BvhBuildParams::fast_build()), seconds }
    }
}

impl<'a> Moment<'a> {
    /// The city this is of.
    pub fn city(&self) -> &'a City {
        self.world.city
    }

    /// The first surface along a ray.
    pub fn cast(&self, ray: &Ray, meets: Meets) -> Option<Hit> {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
            fn avx2(moment: &Moment, ray: &Ray, meets: Meets) -> Option<Hit> {
                moment.cast_by::<Avx2>(ray, meets)
            }
            if is_wide() {
                // SAFETY: the instructions are there.
                return unsafe { avx2(self, ray, meets) };
            }
        }
        self.cast_by::<Portable>(ray, meets)
    }

    /// True where something opaque lies on the ray: its light does not arrive.
    pub fn is_blocked(&self, ray: &Ray) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
            fn avx2(moment: &Moment, ray: &Ray) -> bool {
                moment.is_blocked_by::<Avx2>(ray)
            }
            if is_wide() {
                // SAFETY: the instructions are there.
                return unsafe { avx2(self, ray) };
            }
        }
        self.is_blocked_by::<Portable>(ray)
    }

    #[inline(always)]
    pub(super) fn cast_by<B: Boxes>(&self, ray: &Ray, meets: Meets) -> Option<Hit> {
        let world = self.world;
        let ground = world.ground_hit::<B>(ray, meets);
        let until = |hit: &Option<Hit>| Ray { to: hit.map_or(ray.to, |hit| hit.distance), ..*ray };
        let still = world.standing.cast::<B>(&world.solids, &until(&ground), meets).or(ground);
        if self.moving.places.is_empty() {
            return still;
        }
        self.moving.cast::<B>(&world.solids, &until(&still), meets).or(still)
    }

    #[inline(always)]
    pub(super) fn is_blocked_by<B: Boxes>(&self, ray: &Ray) -> bool {
        let World { solids, ground, standing, .. } = self.world;
        standing.blocks::<B>(solids, ray)
            || (!self.moving.places.is_empty() && self.moving.blocks::<B>(solids, ray))
            || ground.blocks::<B>(ray.origin, ray.direction, ray)
    }

    /// What shines at night.
    pub(crate) fn lamps(&self) -> &'a Lamps {
        &self.world.lamps
    }

    /// The actor that was hit.
    pub fn actor(&self, hit: &Hit) -> &'a Actor {
        &self.world.city.actors[hit.actor as usize]
    }

    /// The mesh that was hit.
    pub fn mesh(&self, hit: &Hit) -> &'a Mesh {
        &self.world.city.assets[hit.asset as usize].mesh
    }

    /// The class of the triangle that was hit.
    pub fn class(&self, hit: &Hit) -> Class {
        self.mesh(hit).classes[hit.triangle as usize]
    }

    /// The material that was hit and its row.
    pub fn material(&self, hit: &Hit) -> (u16, &'a Material) {
        let row = self.mesh(hit).materials[hit.triangle as usize];
        (row, &self.world.city.materials[usize::from(row)])
    }
}

/// Whether this machine has the instructions of [`Avx2`].
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn is_wide() -> bool {
    // Each is one bit of a word that is read from memory; all five came with one generation.
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("lzcnt")
        && is_x86_feature_detected!("popcnt")
}

/// Which assets more than one actor has, or one that moves.
fn shared(city: &City) -> Vec<bool> {
    let mut worn = vec![0u32; city.assets.len()];
    for actor in &city.actors {
        let moves = actor.trajectory.is_some();
        worn[actor.asset as usize] += if moves { 2 } else { 1 };
        actor.trajectory.iter().flat_map(|t| &t.gait).for_each(|&asset| worn[asset as usize] += 2);
    }
    worn.into_iter().map(|worn| worn > 1).collect()
}

/// Some standing actors as one mesh in the world, and whose each triangle is.
fn flat(city: &City, actors: Vec<u32>) -> (Solid, Vec<(u32, u32)>) {
    let (mut triangles, mut owners) = (Vec::new(), Vec::new());
    for row in actors {
        let actor = &city.actors[row as usize];
        let pose = &actor.world_from_asset;
        let (turn, origin) = (rotation(pose), pose.translation.as_vec3());
        for triangle in local(&city.assets[actor.asset as usize].mesh, &city.materials) {
            let name = owners.len() as u32 | (triangle.row & CLEAR);
            owners.push((row, triangle.row & !CLEAR));
            let (second, third) = (turn * triangle.second, turn * triangle.third);
            triangles.push(Triangle { corner: turn * triangle.corner + origin, second, third, row: name });
        }
    }
    (Solid::new(triangles, BvhBuildParams::medium_build()), owners)
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
        let real = |p: &Vec3| p.abs().max_element() < FARTHEST && p.is_finite();
        if !mesh.positions.iter().all(real) || !mesh.uvs.iter().all(|uv| uv.is_finite()) {
            return Err(WorldError::Coordinate(i));
        }
    }
    let mut triangles = 0;
    for (i, asset) in city.assets.iter().enumerate() {
        triangles += asset.mesh.triangles.len();
        if triangles >= CLEAR as usize {
            return Err(WorldError::TooLarge(i));
        }
    }
    let sane = |pose: &Rigid| pose.is_sane() && pose.translation.abs().max_element() < f64::from(FARTHEST);
    for (i, actor) in city.actors.iter().enumerate() {
        let there = |&asset: &u32| (asset as usize) < city.assets.len();
        let moves = actor.trajectory.as_ref().is_none_or(|t| {
            t.gait.iter().all(there) && t.waypoints.iter().all(|w| sane(&w.world_from_asset) && w.seconds.is_finite())
        });
        if !there(&actor.asset) || !sane(&actor.world_from_asset) || !moves {
            return Err(WorldError::Actor(i));
        }
    }
    Ok(())
}
