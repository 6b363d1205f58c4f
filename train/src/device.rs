//! Selects the device that computes training steps: the CPU or a GPU.

mod cpu;
#[cfg(feature = "gpu")]
mod gpu;
pub(crate) mod step;

use std::sync::Arc;

use render::cpu::Isa;
#[cfg(feature = "gpu")]
use render::gpu::Gpu;
use scene::Splats;

use self::step::TrainDevice;
use crate::checkpoint::State;
use crate::error::TrainError;
use crate::picture_loss::PictureLoss;
use crate::pose::GivenPoses;

/// Which device computes training steps. Equal names give equal bits.
#[derive(Debug, Clone, Default)]
pub enum Backend {
    /// The CPU, with SIMD and threads.
    #[default]
    Cpu,
    /// A GPU, or a software adapter.
    #[cfg(feature = "gpu")]
    Gpu(Arc<Gpu>),
}

impl Backend {
    /// Full name with the instruction set or adapter. Results of backends with different names may differ in the last bits.
    pub fn name(&self) -> String {
        match self {
            Self::Cpu => format!("cpu-{}", Isa::detect().name()),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.name().to_owned(),
        }
    }

    /// Sets up a device that continues from `state`; the CPU works on the host's state directly. `lambda` is the weight of D-SSIM
    /// in the loss, `picture_loss` another loss beside it. `context` are frozen splats of other blocks, rendered but not trained.
    /// `given` are the poses that displacements of the state refer to.
    ///
    /// # Errors
    /// A GPU that fails or has too little memory.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub(crate) fn open<'a>(
        &self,
        state: &State,
        lambda: f32,
        picture_loss: Option<&'a dyn PictureLoss>,
        context: Option<&'a Splats>,
        given: &Arc<GivenPoses>,
    ) -> Result<Box<dyn TrainDevice + 'a>, TrainError> {
        Ok(match self {
            Self::Cpu => Box::new(cpu::CpuDevice::new(lambda, picture_loss, context, given)),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => Box::new(gpu::GpuDevice::new(gpu, state, lambda, picture_loss, context, given)?),
        })
    }
}
