//! The device: which adapter, with which limits, and how its errors reach the caller.
//!
//! wgpu reports most errors to a handler, not to who caused them. [`Gpu`] keeps them, and every operation that waits or submits
//! returns them: a failed device never looks like a result.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use super::error::{Faults, GpuError, one_line};
use super::kernel::Kernels;
use super::memory::Meter;
use super::options::{GpuOptions, Path};
use super::watch::{CLOCK, Watch};

/// Storage bindings of the stage that has most (`project_backward`).
const STORAGE_BINDINGS: u32 = 12;
/// Workgroup memory of the stage that wants most (`rasterize_backward`), bytes.
const WORKGROUP_BYTES: u32 = 32 << 10;

/// An open device.
#[derive(Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    name: String,
    class: &'static str,
    path: Path,
    faults: Arc<Faults>,
    meter: Arc<Meter>,
    /// Bytes handed to [`Gpu::upload`] that may still wait on the host.
    staged: AtomicU64,
    kernels: Kernels,
    /// Who looks at the clock.
    pub(super) watch: Mutex<Option<Watch>>,
}

impl Gpu {
    /// Opens a device as the environment says, see [`GpuOptions::from_env`].
    ///
    /// # Errors
    /// Without an adapter, with one that cannot run the stages, or where the environment says what means nothing.
    pub fn open() -> Result<Arc<Self>, GpuError> {
        Self::open_with(&GpuOptions::from_env()?)
    }

    /// Opens a device.
    ///
    /// # Errors
    /// Without an adapter, or with one that cannot run the stages.
    pub fn open_with(options: &GpuOptions) -> Result<Arc<Self>, GpuError> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
        if let Some(wanted) = &options.adapter {
            adapters.retain(|adapter| adapter.get_info().name.to_lowercase().contains(&wanted.to_lowercase()));
        }
        let power = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
            wgpu::DeviceType::DiscreteGpu => 0,
            wgpu::DeviceType::VirtualGpu => 1,
            wgpu::DeviceType::IntegratedGpu => 2,
            wgpu::DeviceType::Other => 3,
            wgpu::DeviceType::Cpu => 4,
        };
        // Stable: of equals the first, so that the same machine gives the same adapter.
        adapters.sort_by_key(power);
        let adapter = adapters.into_iter().next().ok_or_else(|| {
            let wanted = options.adapter.as_ref();
            GpuError::NoAdapter(wanted.map_or(String::new(), |name| format!(" named like {name:?} (PLAT_GPU_ADAPTER)")))
        })?;
        Self::on(&adapter, options).map(Arc::new)
    }

    fn on(adapter: &wgpu::Adapter, options: &GpuOptions) -> Result<Self, GpuError> {
        let info = adapter.get_info();
        let limits = adapter.limits();
        for (what, has, needs) in [
            ("storage bindings", limits.max_storage_buffers_per_shader_stage, STORAGE_BINDINGS),
            ("bytes of workgroup memory", limits.max_compute_workgroup_storage_size, WORKGROUP_BYTES),
            ("threads in a workgroup", limits.max_compute_invocations_per_workgroup, shaders::GROUP),
        ] {
            if has < needs {
                return Err(GpuError::TooSmall { adapter: info.name, what, has: has.into(), needs: needs.into() });
            }
        }
        let subgroups = options.path != Path::Portable && has_subgroups(adapter.features(), &info);
        // Halves are packed, which nearly all can, and quickly those that compute with them.
        let half = adapter.features().contains(wgpu::Features::SHADER_F16)
            && adapter.get_downlevel_capabilities().flags.contains(wgpu::DownlevelFlags::SHADER_F16_IN_F32);
        let path = match (options.path, subgroups) {
            (Path::Half, true) if half => Path::Half,
            (Path::Half, _) => return Err(GpuError::NoHalf(info.name)),
            (_, true) => Path::Fast,
            (_, false) => Path::Portable,
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("plat"),
            required_features: adapter.features() & CLOCK
                | if subgroups { wgpu::Features::SUBGROUP } else { wgpu::Features::empty() },
            // All that the adapter has: what does not fit is refused with a reason (`room`), not by a smaller default.
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Failed(format!("{}: {e}", info.name)))?;
        let faults = Arc::<Faults>::default();
        let (of_errors, of_loss) = (Arc::clone(&faults), Arc::clone(&faults));
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| of_errors.caught(&error)));
        device.set_device_lost_callback(move |_, message| of_loss.lost(&message));
        Ok(Self {
            name: name(&info, path),
            class: class(info.device_type),
            path,
            faults,
            meter: Meter::new(options.memory_bytes),
            staged: AtomicU64::new(0),
            kernels: Kernels::default(),
            watch: Mutex::default(),
            device,
            queue,
        })
    }

    /// "gpu-vulkan-llvmpipe-subgroups": the interface, the adapter without versions, and which stages run where not the portable
    /// ones do: those have other bits.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// True where a CPU pretends to be a GPU.
    pub fn is_software(&self) -> bool {
        self.class == class(wgpu::DeviceType::Cpu)
    }

    /// What sort of adapter it is: `discrete`, `integrated`, `virtual`, `software` (a CPU pretends to be a GPU) or `other`.
    pub fn class(&self) -> &'static str {
        self.class
    }

    /// True where [`shaders::SUBGROUPS`] run.
    pub fn has_subgroups(&self) -> bool {
        self.path != Path::Portable
    }

    /// Which stages run.
    pub fn path(&self) -> Path {
        self.path
    }

    /// The device, for what the helpers here do not do.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue, likewise.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    pub(super) fn meter(&self) -> &Arc<Meter> {
        &self.meter
    }

    pub(super) fn staged(&self) -> &AtomicU64 {
        &self.staged
    }

    pub(super) fn kernels(&self) -> &Kernels {
        &self.kernels
    }

    /// The first error that this thread has caused since its last call, if any; a lost device's at every call.
    ///
    /// # Errors
    /// That one.
    pub fn check(&self) -> Result<(), GpuError> {
        self.faults.tell().map_err(|error| match error {
            // A device that is going makes errors of all sorts before wgpu says that it is gone, which is when it is polled.
            GpuError::Failed(_) => {
                let _ = catch_unwind(AssertUnwindSafe(|| self.device.poll(wgpu::PollType::Poll)));
                self.faults.loss().unwrap_or(error)
            }
            error => error,
        })
    }

    /// An empty list of commands.
    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("plat") })
    }

    /// Hands commands to the device, without waiting. Returns what to [wait](Self::wait_for) for.
    ///
    /// # Errors
    /// What went wrong until now.
    pub fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<wgpu::SubmissionIndex, GpuError> {
        let index = self.queue.submit([encoder.finish()]);
        self.check().map(|()| index)
    }

    /// Waits for all that was submitted.
    ///
    /// # Errors
    /// What went wrong.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::wait_indefinitely())
    }

    /// Waits for a submission.
    ///
    /// # Errors
    /// What went wrong.
    pub fn wait_for(&self, index: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None })
    }

    fn poll(&self, until: wgpu::PollType) -> Result<(), GpuError> {
        // wgpu panics where a wait finds that the device is gone, after it has called the handler of that.
        let polled = catch_unwind(AssertUnwindSafe(|| self.device.poll(until)));
        self.check()?;
        match polled {
            Ok(polled) => polled.map(|_| ()).map_err(|e| GpuError::Failed(one_line(&e.to_string()))),
            Err(_) => Err(GpuError::Lost("it did not end what it was given".into())),
        }
    }
}

/// Subgroups as the stages need them: of one size, as nothing says which of several a stage will have, and of at least eight lanes.
fn has_subgroups(features: wgpu::Features, info: &wgpu::AdapterInfo) -> bool {
    let size = info.subgroup_min_size;
    features.contains(wgpu::Features::SUBGROUP)
        && size == info.subgroup_max_size
        && (8..=128).contains(&size)
        && size.is_power_of_two()
}

fn class(kind: wgpu::DeviceType) -> &'static str {
    match kind {
        wgpu::DeviceType::DiscreteGpu => "discrete",
        wgpu::DeviceType::IntegratedGpu => "integrated",
        wgpu::DeviceType::VirtualGpu => "virtual",
        wgpu::DeviceType::Cpu => "software",
        wgpu::DeviceType::Other => "other",
    }
}

fn name(info: &wgpu::AdapterInfo, path: Path) -> String {
    let model = info.name.split('(').next().unwrap_or_default();
    let words = model.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    let mut words: Vec<String> = words.map(str::to_ascii_lowercase).collect();
    words.extend(match path {
        Path::Portable => None,
        Path::Fast => Some("subgroups".into()),
        Path::Half => Some("subgroups-half".into()),
    });
    format!("gpu-{}-{}", info.backend.to_str(), words.join("-"))
}
