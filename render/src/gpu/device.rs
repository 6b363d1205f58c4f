//! The wgpu device: adapter choice, limits, submission and error reporting.
//!
//! wgpu reports most errors to a handler instead of the call that caused them. [`Gpu`] collects them, and every
//! operation that submits or waits returns them.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use super::error::{DeviceErrors, GpuError, one_line};
use super::memory_cap::MemoryCap;
use super::options::{GpuOptions, Path};
use super::pipeline::PipelineCache;
use super::timestamp_recorder::{TIMESTAMP_FEATURES, TimestampRecorder};

/// Storage bindings of `project_backward`, the stage with the most.
const STORAGE_BINDINGS: u32 = 12;
/// Workgroup memory of `rasterize_backward`, the stage with the most, bytes.
const WORKGROUP_BYTES: u32 = 32 << 10;

/// An open device.
#[derive(Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    name: String,
    class: &'static str,
    path: Path,
    errors: Arc<DeviceErrors>,
    memory_cap: Arc<MemoryCap>,
    /// Bytes passed to [`Gpu::upload`] that may still wait in host staging memory.
    staged: AtomicU64,
    pipelines: PipelineCache,
    timestamps: TimestampRecorder,
}

impl Gpu {
    /// Opens a device with the options of the environment, see [`GpuOptions::from_env`].
    ///
    /// # Errors
    /// As [`open_with`](Self::open_with), or an invalid environment variable.
    pub fn open() -> Result<Arc<Self>, GpuError> {
        Self::open_with(&GpuOptions::from_env()?)
    }

    /// Opens a device.
    ///
    /// # Errors
    /// If no adapter matches, or the adapter's limits are too small for the stages.
    pub fn open_with(options: &GpuOptions) -> Result<Arc<Self>, GpuError> {
        Self::open_one_of(options, |_| true)
    }

    /// Opens a device with the options of the environment on a GPU that has memory of its own, also where the machine is a virtual one.
    ///
    /// # Errors
    /// As [`open`](Self::open); without such a GPU, that no adapter matches.
    pub fn open_dedicated() -> Result<Arc<Self>, GpuError> {
        use wgpu::DeviceType::{DiscreteGpu, VirtualGpu};
        Self::open_one_of(&GpuOptions::from_env()?, |kind| matches!(kind, DiscreteGpu | VirtualGpu))
    }

    fn open_one_of(options: &GpuOptions, suits: fn(wgpu::DeviceType) -> bool) -> Result<Arc<Self>, GpuError> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
        if let Some(wanted) = &options.adapter {
            adapters.retain(|adapter| adapter.get_info().name.to_lowercase().contains(&wanted.to_lowercase()));
        }
        adapters.retain(|adapter| suits(adapter.get_info().device_type));
        let power = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
            wgpu::DeviceType::DiscreteGpu => 0,
            wgpu::DeviceType::VirtualGpu => 1,
            wgpu::DeviceType::IntegratedGpu => 2,
            wgpu::DeviceType::Other => 3,
            wgpu::DeviceType::Cpu => 4,
        };
        // A stable sort: the same machine always yields the same adapter.
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
        for (what, limit, required) in [
            ("storage bindings", limits.max_storage_buffers_per_shader_stage, STORAGE_BINDINGS),
            ("bytes of workgroup memory", limits.max_compute_workgroup_storage_size, WORKGROUP_BYTES),
            ("threads in a workgroup", limits.max_compute_invocations_per_workgroup, shaders::WORKGROUP_SIZE),
        ] {
            if limit < required {
                let (limit, required) = (limit.into(), required.into());
                return Err(GpuError::TooSmall { adapter: info.name, what, limit, required });
            }
        }
        let subgroups = options.path != Path::Portable && has_subgroups(adapter.features(), &info);
        // The stages only pack and unpack halves; SHADER_F16 selects the adapters that do so in hardware.
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
            required_features: adapter.features() & TIMESTAMP_FEATURES
                | if subgroups { wgpu::Features::SUBGROUP } else { wgpu::Features::empty() },
            // The adapter's full limits: `max_binding_bytes` reports what does not fit with a reason.
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Failed(format!("{}: {e}", info.name)))?;
        let errors = Arc::<DeviceErrors>::default();
        let (uncaptured, lost) = (Arc::clone(&errors), Arc::clone(&errors));
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| uncaptured.record(&error)));
        device.set_device_lost_callback(move |_, message| lost.record_loss(&message));
        Ok(Self {
            name: name(&info, path),
            class: class(info.device_type),
            path,
            errors,
            memory_cap: MemoryCap::new(options.memory_bytes),
            staged: AtomicU64::new(0),
            pipelines: PipelineCache::default(),
            timestamps: TimestampRecorder::default(),
            device,
            queue,
        })
    }

    /// The backend's name, such as "gpu-vulkan-llvmpipe-subgroups": API, adapter without versions, and the path unless
    /// it is the portable one. Results are bit-identical only under the same name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether the adapter is a software rasterizer on the CPU.
    pub fn is_software(&self) -> bool {
        self.class == class(wgpu::DeviceType::Cpu)
    }

    /// The adapter class: `discrete`, `integrated`, `virtual`, `software` (runs on the CPU) or `other`.
    pub fn class(&self) -> &'static str {
        self.class
    }

    /// Whether the stages of [`shaders::SUBGROUPS`] run.
    pub fn has_subgroups(&self) -> bool {
        self.path != Path::Portable
    }

    /// The variant of the stages that runs.
    pub fn path(&self) -> Path {
        self.path
    }

    /// The wgpu device.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The wgpu queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    pub(super) fn memory_cap(&self) -> &Arc<MemoryCap> {
        &self.memory_cap
    }

    pub(super) fn staged(&self) -> &AtomicU64 {
        &self.staged
    }

    pub(super) fn pipelines(&self) -> &PipelineCache {
        &self.pipelines
    }

    pub(super) fn timestamps(&self) -> &TimestampRecorder {
        &self.timestamps
    }

    /// Returns and clears the first error that this thread caused since its last call. The loss of the device is
    /// returned at every call.
    ///
    /// # Errors
    /// That error.
    pub fn check(&self) -> Result<(), GpuError> {
        self.errors.take().map_err(|error| match error {
            // A device that is being lost causes other errors first; wgpu reports the loss only in `poll`.
            GpuError::Failed(_) => {
                let _ = catch_unwind(AssertUnwindSafe(|| self.device.poll(wgpu::PollType::Poll)));
                self.errors.loss().unwrap_or(error)
            }
            error => error,
        })
    }

    /// An empty command encoder.
    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("plat") })
    }

    /// Submits commands without waiting. [`wait_for`](Self::wait_for) waits for the returned index.
    ///
    /// # Errors
    /// A pending error of the device.
    pub fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<wgpu::SubmissionIndex, GpuError> {
        let index = self.queue.submit([encoder.finish()]);
        self.check().map(|()| index)
    }

    /// Waits for all submitted work.
    ///
    /// # Errors
    /// Any error of that work.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::wait_indefinitely())
    }

    /// Waits for one submission.
    ///
    /// # Errors
    /// Any error until then.
    pub fn wait_for(&self, index: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None })
    }

    fn poll(&self, until: wgpu::PollType) -> Result<(), GpuError> {
        // wgpu panics if a wait finds the device lost, after it has called the device-lost handler.
        let polled = catch_unwind(AssertUnwindSafe(|| self.device.poll(until)));
        self.check()?;
        match polled {
            Ok(polled) => polled.map(|_| ()).map_err(|e| GpuError::Failed(one_line(&e.to_string()))),
            Err(_) => Err(GpuError::Lost("it did not finish the submitted work".into())),
        }
    }
}

/// Whether the adapter has subgroups as the stages need them: one fixed size (WebGPU does not tell which of several
/// sizes a pipeline gets), a power of two from 8 to 128.
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
