//! Where the arithmetic of a training step happens: on the CPU, or on a GPU.
//!
//! [`State`] is what the host knows of a training. The loop decides from it (which view, which mip, when to grow), a side does the
//! steps. The CPU's side works on the state itself. A GPU's side keeps a copy of its own that runs ahead of the host, and brings
//! the state up to date when asked: asking costs time, and changes no bit of the result.

mod cpu;
#[cfg(feature = "gpu")]
mod gpu;

use std::sync::Arc;

use render::Options;
use render::cpu::Isa;
#[cfg(feature = "gpu")]
use render::gpu::Gpu;
use scene::{Camera, Exposure, Pixels, Splats};

use crate::optimiser::Rates;
use crate::{State, TrainError};

/// Views that a step of the optimiser may take.
pub const MOST_VIEWS_PER_STEP: u32 = 16;

/// What computes.
#[derive(Debug, Clone, Default)]
pub enum Backend {
    /// SIMD and threads.
    #[default]
    Cpu,
    /// A GPU, or what pretends to be one.
    #[cfg(feature = "gpu")]
    Gpu(Arc<Gpu>),
}

impl Backend {
    /// Its full name, with the instruction set or the adapter: what computed elsewhere may differ in the last bits.
    pub fn name(&self) -> String {
        match self {
            Self::Cpu => format!("cpu-{}", Isa::detect().name()),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.name().to_owned(),
        }
    }

    /// Not the CPU.
    pub(crate) fn is_gpu(&self) -> bool {
        !matches!(self, Self::Cpu)
    }

    /// A training's place, from where it stands; λ weighs 1 - SSIM in the loss.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub(crate) fn side<'a>(
        &self,
        now: &State,
        lambda: f32,
        context: Option<&'a Splats>,
    ) -> Result<Box<dyn Side + 'a>, TrainError> {
        Ok(match self {
            Self::Cpu => Box::new(cpu::CpuSide::new(lambda, context)),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => Box::new(gpu::GpuSide::new(gpu, now, lambda, context)?),
        })
    }
}

/// One step of training: splats move along the sum of what its looks say.
#[derive(Debug, Clone)]
pub(crate) struct Step {
    /// One to [`MOST_VIEWS_PER_STEP`], of different views.
    pub(crate) looks: Vec<Look>,
    pub(crate) options: Options,
    pub(crate) rates: Rates,
    /// Step of exposures, where they are trained.
    pub(crate) exposure_rate: f32,
}

/// A window of a view, to be drawn beside its photo.
#[derive(Debug, Clone)]
pub(crate) struct Look {
    /// Index of the view in the capture.
    pub(crate) view: u32,
    /// What it shows.
    pub(crate) photo: Arc<Pixels>,
    /// Of the window that the photo is.
    pub(crate) camera: Camera,
    /// Of the view, where exposures are given, not trained.
    pub(crate) exposure: Option<Exposure>,
}

/// What of the state is meant; each holds the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Part {
    /// The last loss, the epoch's errors, the steps that were left out.
    Tally,
    /// And the splats.
    Splats,
    /// And all that the next step depends on.
    All,
}

/// Carries out steps. A step with a loss that is not finite changes nothing but its count.
pub(crate) trait Side {
    /// Begins a step; it may end after this returns.
    fn step(&mut self, now: &mut State, step: Step) -> Result<(), TrainError>;

    /// Brings a part of the state up to date with the steps begun.
    fn fetch(&mut self, now: &mut State, part: Part) -> Result<(), TrainError>;

    /// Goes on from this part of the state, which the host has changed since it fetched it.
    fn give(&mut self, now: &State, part: Part) -> Result<(), TrainError>;
}
