//! Ray tracing of a city: RGB images in sunlight with per-pixel ground truth.
//!
//! ```text
//! City ──World::new──▶ World ──at(seconds)──▶ Moment ──cast──▶ Hit ──shade──▶ radiance
//!                      Shot, RenderOptions ──render_frame──▶ Frame: RGB, depth, normals, labels, layer behind glass
//! ```
//! Radiance is linear RGB, where 1 is a white wall in full sun. The gain ([`crate::sense::Shot::exposure`]) and the
//! sRGB curve turn it into bytes. Surfaces are diffuse, except for glass, car paint and metal, which have reflections.

mod bvh;
pub(crate) mod degrade;
pub mod frame;
mod lamps;
pub mod motion;
pub(crate) mod pattern;
mod ray;
pub mod shade;
#[cfg(test)]
mod tests;
mod traversal;
pub mod world;

pub use frame::{Frame, FrameError, Layer, RenderOptions, render_frame};
pub use ray::{Hit, Ray, RayMask};
pub use shade::Light;
pub use world::{Moment, World, WorldError};
