//! The description of a training job: splats, views, limits and recipe.

use glam::Vec3;
use scene::sensors::Taken;
use scene::{Exposures, Splats};

use crate::device::Backend;
use crate::free_space::FreeSpace;
use crate::picture_loss::PictureLoss;
use crate::pose::path::ObjectTimes;
use crate::recipe::Recipe;
use crate::source::WindowSource;
use crate::view::TrainView;

/// The splats to train, the views to train them on, and how.
pub struct Job<'a> {
    /// Initial splats.
    pub initial: Splats,
    /// Frozen splats outside the block: rendered but not trained.
    pub context: Option<&'a Splats>,
    /// Windows to train on, in the capture's order.
    pub views: &'a [TrainView],
    /// True where a splat counts against the budget (the block's core).
    pub counts: &'a (dyn Fn(Vec3) -> bool + Sync),
    /// True where a splat may be. Densification removes splats that drift elsewhere, as the context covers that place.
    pub keeps: &'a (dyn Fn(Vec3) -> bool + Sync),
    /// Space that splats keep out of, if it is known. As `keeps`, it takes effect at refinements only.
    pub free_space: Option<&'a FreeSpace>,
    /// Number of counted splats to reach at the end.
    pub budget: usize,
    /// Number of training steps, counted in views.
    pub steps: u32,
    /// Compensates opacity for the low-pass filter (anti-aliased mode).
    pub antialiased: bool,
    /// Key of all random numbers.
    pub seed: u64,
    /// Smallest and largest standard deviation of a splat, metres.
    pub size_bounds_metres: [f32; 2],
    /// Fixed exposures of the views. Views without one are rendered as they are.
    pub exposures: Option<&'a Exposures>,
    /// Trains exposures, starting from the identity, instead of using `exposures`.
    pub trains_exposures: bool,
    /// Refines the poses of the views' cameras, which are the start.
    pub trains_poses: bool,
    /// The sensor of each view of the capture, whose mounts, focal lengths and clocks are refined; `None`: they are not.
    pub sensors: Option<&'a [Taken]>,
    /// When the views see the object that is trained, whose path is refined, on the CPU only; `None`: it is not.
    pub path: Option<&'a ObjectTimes>,
    /// Hyperparameters.
    pub recipe: &'a Recipe,
    /// Photos.
    pub source: &'a dyn WindowSource,
    /// A loss of the windows' pictures beside the photometric one, with the recipe's weight.
    pub picture_loss: Option<&'a dyn PictureLoss>,
    /// Device.
    pub backend: &'a Backend,
}

/// A progress report's decision.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// Train on.
    Continue,
    /// Stop here: the current splats are the result.
    Stop,
}
