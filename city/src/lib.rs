//! Procedural cities with ground truth: the project's test bed, and a rehearsal of a capture before anybody pays for it.
//!
//! ```text
//! settings ──generate──▶ City: actors (asset, pose, trajectory), materials ──trace──▶ what a sensor sees, and its truth
//! ```
//! A city is a list of **actors**, each an asset, a rigid transform and perhaps a trajectory (as CarlaOcc's
//! scenes are, supplement A); an **asset** is a mesh in its own frame, shared by all its actors. The same settings give
//! the same city, whatever the number of threads.
//!
//! Architecture invariant: no files, no clock; randomness comes from the seed (see [`random`]). World metres, z up, the
//! city centred on the origin.

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
