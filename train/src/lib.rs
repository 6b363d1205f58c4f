//! Trains the splats of one block: losses, optimiser, densification, pruning and image metrics.
//!
//! Architecture invariant: no files, no network, no clock. Pixels come through [`WindowSource`]. Random numbers are
//! counter-based ([`random`]), so a job gives the same splats for any number of threads.

pub mod changes;
pub mod checkpoint;
pub mod coarse_to_fine;
mod depth_loss;
mod device;
mod error;
pub mod exposure;
mod find_pose;
mod free_space;
pub mod growth;
pub mod importance;
pub mod init;
mod job;
pub mod loss;
pub mod low_pass;
pub mod metrics;
pub mod optimiser;
mod picture_loss;
mod pose;
pub mod prune;
pub mod random;
mod recipe;
mod road_poses;
mod silhouette_loss;
mod size_limit;
pub mod source;
mod swing;
mod trainer;
mod view;
pub mod visibility;

pub use checkpoint::State;
pub use device::Backend;
pub use device::step::MAX_VIEWS_PER_STEP;
pub use error::TrainError;
pub use find_pose::PoseFinder;
pub use free_space::FreeSpace;
pub use job::{Flow, Job};
pub use picture_loss::PictureLoss;
pub use pose::path::ObjectTimes;
pub use recipe::Recipe;
pub use road_poses::{Positions, RoadPoses, road_poses};
pub use source::WindowSource;
pub use swing::Walk;
pub use trainer::{Progress, Trained, train, train_from};
pub use view::TrainView;
