//! Devices for the unit tests of this backend.

use std::sync::Arc;

use super::device::Gpu;
use super::options::{GpuOptions, Path};

/// Opens a device, with the portable stages if `portable`. Without an adapter it prints "skipped" and returns `None`,
/// or panics if `PLAT_GPU=required`.
pub(super) fn gpu(portable: bool) -> Option<Arc<Gpu>> {
    let required = std::env::var("PLAT_GPU").is_ok_and(|value| value == "required");
    let options = GpuOptions {
        path: if portable { Path::Portable } else { Path::Fast },
        ..GpuOptions::from_env().expect("valid environment variables")
    };
    match Gpu::open_with(&options) {
        Ok(gpu) => Some(gpu),
        Err(e) if required => panic!("PLAT_GPU=required, but {e}"),
        Err(_) => {
            println!("skipped: no adapter");
            None
        }
    }
}
