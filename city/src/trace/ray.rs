//! Rays, what they hit and which surfaces they test.

use glam::{Vec2, Vec3};

#[cfg(doc)]
use crate::City;

/// A ray with a unit direction; distances are metres along it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// World metres.
    pub origin: Vec3,
    /// Unit vector.
    pub direction: Vec3,
    /// Surfaces nearer than this are not hit, metres.
    pub t_min: f32,
    /// Surfaces beyond this are not hit, metres.
    pub t_max: f32,
}

impl Ray {
    /// An unbounded ray.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Self { origin, direction, t_min: 0.0, t_max: f32::INFINITY }
    }

    /// The point at a distance.
    pub fn at(&self, distance: f32) -> Vec3 {
        self.origin + distance * self.direction
    }
}

/// Which surfaces a ray tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RayMask {
    /// All surfaces.
    All,
    /// Opaque surfaces only: rays pass through glass.
    Opaque,
}

/// The first surface along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Metres along the ray.
    pub distance: f32,
    /// Row of [`City::actors`].
    pub actor: u32,
    /// Row of [`City::assets`]: the actor's, or the one of its gait.
    pub asset: u32,
    /// Row of the mesh's triangles.
    pub triangle: u32,
    /// Barycentric coordinates of the triangle's second and third corner.
    pub barycentrics: Vec2,
    /// Unit normal in the world, on the side of the ray's origin.
    pub normal: Vec3,
}
