//! Procedural cities with ground truth: synthetic captures for tests, and for planning a real capture.
//!
//! ```text
//! settings ──generate──▶ City: actors (asset, pose, trajectory), materials ──trace, sense──▶ images, sweeps, ground truth
//! ```
//! A city is a list of **actors**: each has an asset, a rigid transform and optionally a trajectory (the scene model of
//! CarlaOcc, supplement A). An **asset** is a mesh in its own frame, shared by its actors. The same settings give the
//! same city for any number of threads.
//!
//! Architecture invariant: no files, no clock; random numbers come from the seed (see [`random`]). World coordinates
//! are metres, z up, with the city centred on the origin.

mod build;
mod deck;
pub mod faults;
mod generate;
mod lattice;
mod materials;
pub mod occupancy;
mod parcels;
mod props;
pub mod random;
mod roads;
pub mod sense;
pub mod settings;
mod street_furniture;
mod terrain;
pub mod test_scene;
pub mod trace;
mod traffic;
pub mod types;

pub use settings::{CitySettings, Layout, Traffic};
pub use types::{Actor, Asset, City, Class, Material, Mesh, Pattern, Trajectory, Waypoint};
