//! Opens the backend that `--backend` names.

use std::sync::Arc;

use render::gpu::Gpu;
use scene::BadInput;

use crate::args::Backend;

/// The backend of this choice. `auto` is the CPU: GPUs have not been measured against it yet.
pub(crate) fn open(backend: Backend) -> Result<train::Backend, BadInput> {
    match backend {
        Backend::Auto | Backend::Cpu => Ok(train::Backend::Cpu),
        Backend::Gpu => open_gpu().map(train::Backend::Gpu),
    }
}

/// The adapter that the environment chooses.
pub(crate) fn open_gpu() -> Result<Arc<Gpu>, BadInput> {
    Gpu::open().map_err(|error| {
        BadInput::new("--backend", error.to_string(), "give --backend cpu, or name an adapter by PLAT_GPU_ADAPTER")
    })
}
