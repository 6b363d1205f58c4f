//! Opens the backend that `--backend` names.

use std::sync::Arc;

use render::gpu::{Gpu, GpuError};
use scene::BadInput;

use crate::args::Backend;

/// The backend of this choice. `auto` is a GPU with memory of its own, else the CPU: software adapters are far slower than its SIMD
/// (docs/src/performance.md), and no GPU that shares the CPU's memory has been measured.
pub(crate) fn open(backend: Backend) -> Result<train::Backend, BadInput> {
    match backend {
        Backend::Auto => match Gpu::open_dedicated() {
            Err(error @ GpuError::Setting { .. }) => Err(unusable(&error)),
            opened => Ok(opened.map_or(train::Backend::Cpu, train::Backend::Gpu)),
        },
        Backend::Cpu => Ok(train::Backend::Cpu),
        Backend::Gpu => open_gpu().map(train::Backend::Gpu),
    }
}

/// The adapter that the environment chooses.
pub(crate) fn open_gpu() -> Result<Arc<Gpu>, BadInput> {
    Gpu::open().map_err(|error| unusable(&error))
}

fn unusable(error: &GpuError) -> BadInput {
    BadInput::new("--backend", error.to_string(), "give --backend cpu, or name an adapter by PLAT_GPU_ADAPTER")
}
