//! What a camera in the city sees, by casting rays at its triangles: colours in sunlight and the truth behind them.
//!
//! ```text
//! City ──World::new──▶ World ──at(seconds)──▶ Moment ──cast──▶ Hit ──shade──▶ light
//!                                    Shot, Options ──frame──▶ Frame: RGB, depth, normals, labels, what is behind glass
//! ```
//! Light is linear RGB where 1 is a white wall in full sun; one gain ([`crate::sense::Shot::exposure`]) and sRGB's curve
//! make bytes of it. Surfaces are matt but for glass, paint and metal, which mirror what stands before them.

pub mod frame;
mod index;
mod lamps;
pub mod motion;
pub(crate) mod pattern;
pub mod shade;
#[cfg(test)]
mod tests;
mod walk;
pub mod world;

pub use frame::{Frame, FrameError, Layer, Options, frame};
pub use shade::Light;
pub use world::{Hit, Meets, Moment, Ray, World, WorldError};
