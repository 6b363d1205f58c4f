//! The interface between the training loop and a device, and the inputs of one step.
//!
//! The loop decides on the host (views, mips, densification) from a [`State`]; a [`TrainDevice`] computes the steps.
//! The CPU works on the state in place. A GPU keeps its own copy and runs ahead of the host. [`TrainDevice::download`]
//! brings the host's state up to date. When and how often it is called does not change the result, bit for bit.

use std::sync::Arc;

use render::Options;
use scene::{Camera, Exposure, Pixels, Rect, Rigid};

use crate::checkpoint::State;
use crate::error::TrainError;
use crate::optimiser::LearningRates;
use crate::pose::PoseRates;
use crate::swing::SwingStep;

/// Largest number of views in one optimiser step.
pub const MAX_VIEWS_PER_STEP: u32 = 16;

/// One optimiser step on the sum of the gradients of its samples.
#[derive(Debug, Clone)]
pub(crate) struct Step {
    /// 1 to [`MAX_VIEWS_PER_STEP`] samples, no view twice.
    pub(crate) samples: Vec<ViewSample>,
    pub(crate) options: Options,
    /// `None`: the splats are frozen, and only poses are trained.
    pub(crate) rates: Option<LearningRates>,
    /// Weight of the depth loss. Above 0 a sample has target depths and the options ask for the planes that they need.
    pub(crate) depth_weight: f32,
    /// Weight of the silhouette loss. Above 0 the options ask for the plane that it needs.
    pub(crate) silhouette_weight: f32,
    /// Weight of the picture loss; 0 leaves it out.
    pub(crate) picture_weight: f32,
    /// What is done with the swing, where splats swing.
    pub(crate) swing: Option<SwingStep>,
    /// Learning rate of exposures, where they are trained.
    pub(crate) exposure_rate: f32,
    /// Rates of poses, where they are trained in this step.
    pub(crate) pose_rates: Option<PoseRates>,
}

/// A rectangular crop (window) of one mip of a view's photo.
#[derive(Debug, Clone)]
pub(crate) struct ViewSample {
    /// Index of the view in the capture.
    pub(crate) view: u32,
    /// Mip of the window.
    pub(crate) mip: u8,
    /// The window, in pixels of that mip.
    pub(crate) rect: Rect,
    /// Pixels of the window.
    pub(crate) photo: Arc<Pixels>,
    /// Camera of the window, with the given pose.
    pub(crate) camera: Camera,
    /// As in [`TrainView`](crate::TrainView).
    pub(crate) camera_from_context: Option<Rigid>,
    /// Exposure of the view where exposures are given and fixed; `None` if they are trained or not used.
    pub(crate) exposure: Option<Exposure>,
}

/// A part of the [`State`]; each includes the parts before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum StatePart {
    /// Last loss, errors of the epoch, number of skipped steps.
    Tally,
    /// The splats, and the exposures and poses in training.
    Splats,
    /// The densification statistics.
    Densification,
    /// Everything that the next step depends on.
    All,
}

/// Computes training steps. A step whose loss is not finite sets the last loss and the count of skipped steps, and changes
/// nothing else.
pub(crate) trait TrainDevice {
    /// Starts a step. It may still be running when this returns.
    fn step(&mut self, state: &mut State, step: Step) -> Result<(), TrainError>;

    /// Waits for the started steps and copies a part of the state to the host.
    fn download(&mut self, state: &mut State, part: StatePart) -> Result<(), TrainError>;

    /// Copies a part of the state to the device. The host has downloaded the same part before, with no step in between, and then
    /// changed it.
    fn upload(&mut self, state: &State, part: StatePart) -> Result<(), TrainError>;

    /// Takes over the state's splats and densification statistics, which the host has refined since it downloaded
    /// [`StatePart::Densification`], with no step in between. Row `i` of the splats keeps the Adam moments of old row
    /// `rows[i]`, or begins with zeros for `None`. Moments are two thirds of a state's bytes, and stay on the device.
    fn rearrange(&mut self, state: &mut State, rows: &[Option<u32>]) -> Result<(), TrainError>;
}
