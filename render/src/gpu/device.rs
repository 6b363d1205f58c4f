//! The device: which adapter, with which limits, and how its errors reach the caller.
//!
//! wgpu reports most errors to a handler, not to who caused them. [`Gpu`] keeps the first one, and every operation that
//! waits or submits returns it: a failed device never looks like a result.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::{AnyBitPattern, NoUninit};
use shaders::Stage;

use super::error::{GpuError, one_line, translate};

/// Storage bindings of the stage that has most (`project_backward`).
const STORAGE_BINDINGS: u32 = 12;
/// Workgroup memory of the stage that wants most (`rasterize_backward`), bytes.
const WORKGROUP_BYTES: u32 = 32 << 10;
/// Workgroups in a row before a dispatch gets a second dimension.
const GROUPS_IN_A_ROW: u32 = 1 << 15;

/// An open device.
#[derive(Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    name: String,
    software: bool,
    /// The first error that nobody has been told of yet.
    error: Arc<Mutex<Option<GpuError>>>,
    /// What was compiled, by stage and entry point.
    kernels: Mutex<BTreeMap<(&'static str, &'static str), Kernel>>,
}

impl Gpu {
    /// Opens the adapter whose name contains `PLAT_GPU_ADAPTER` (in any case), else the most powerful one.
    ///
    /// # Errors
    /// Without an adapter, or with one that cannot run the stages.
    pub fn open() -> Result<Arc<Self>, GpuError> {
        let wanted = std::env::var("PLAT_GPU_ADAPTER").ok().filter(|name| !name.is_empty());
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
        if let Some(wanted) = &wanted {
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
            GpuError::NoAdapter(wanted.map_or(String::new(), |name| format!(" named like {name:?} (PLAT_GPU_ADAPTER)")))
        })?;
        Self::on(&adapter).map(Arc::new)
    }

    fn on(adapter: &wgpu::Adapter) -> Result<Self, GpuError> {
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
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("plat"),
            required_features: wgpu::Features::empty(),
            // All that the adapter has: what does not fit is refused with a reason (`room`), not by a smaller default.
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Failed(format!("{}: {e}", info.name)))?;
        let error = Arc::new(Mutex::new(None));
        let keep = |error: &Arc<Mutex<Option<GpuError>>>| {
            let error = Arc::clone(error);
            move |found: GpuError| {
                error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(found);
            }
        };
        let (caught, lost) = (keep(&error), keep(&error));
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| caught(translate(&e))));
        device.set_device_lost_callback(move |reason, message| {
            // Dropping the device ends here too.
            if reason != wgpu::DeviceLostReason::Destroyed {
                lost(GpuError::Lost(one_line(&message)));
            }
        });
        let software = info.device_type == wgpu::DeviceType::Cpu;
        Ok(Self { device, queue, name: name(&info), software, error, kernels: Mutex::default() })
    }

    /// "gpu-vulkan-llvmpipe": the interface and the adapter, without versions.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// True where a CPU pretends to be a GPU.
    pub fn is_software(&self) -> bool {
        self.software
    }

    /// The device, for what the helpers here do not do.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue, likewise.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// The largest buffer that a stage can bind, bytes.
    pub fn room(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// The first error since the last call, if any.
    ///
    /// # Errors
    /// That one.
    pub fn check(&self) -> Result<(), GpuError> {
        self.error.lock().unwrap_or_else(PoisonError::into_inner).take().map_or(Ok(()), Err)
    }

    /// A buffer of zeros that stages may bind, copies may touch and dispatches may read their size from.
    ///
    /// # Errors
    /// Where it is too large, or memory is short.
    pub fn buffer(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer, GpuError> {
        use wgpu::BufferUsages as Usage;
        let size = bytes.max(16).next_multiple_of(4);
        if size > self.room() {
            return Err(GpuError::TooLarge { what: label.to_string(), bytes, most: self.room() });
        }
        let usage = Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST | Usage::INDIRECT;
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage,
            mapped_at_creation: false,
        });
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory(format!("{label}: {bytes} bytes"))),
            None => self.check().map(|()| buffer),
        }
    }

    /// An entry point of a stage, compiled when it is first asked for.
    ///
    /// # Errors
    /// Where the driver refuses it.
    pub fn kernel(&self, stage: &Stage, entry: &'static str) -> Result<Kernel, GpuError> {
        let mut kernels = self.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kernel) = kernels.get(&(stage.name, entry)) {
            return Ok(kernel.clone());
        }
        let kernel = self.compile(stage, entry)?;
        kernels.insert((stage.name, entry), kernel.clone());
        Ok(kernel)
    }

    fn compile(&self, stage: &Stage, entry: &str) -> Result<Kernel, GpuError> {
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(stage.name),
            source: wgpu::ShaderSource::Wgsl(stage.source().into()),
        });
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                // Every stage writes its workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        self.check()?;
        let layout = pipeline.get_bind_group_layout(0);
        Ok(Kernel { pipeline, layout })
    }

    /// An empty list of commands.
    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("plat") })
    }

    /// Hands commands to the device, without waiting.
    ///
    /// # Errors
    /// What went wrong until now.
    pub fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<(), GpuError> {
        self.queue.submit([encoder.finish()]);
        self.check()
    }

    /// Waits for all that was submitted.
    ///
    /// # Errors
    /// What went wrong.
    pub fn wait(&self) -> Result<(), GpuError> {
        let polled = self.device.poll(wgpu::PollType::wait_indefinitely());
        self.check()?;
        polled.map(|_| ()).map_err(|e| GpuError::Failed(one_line(&e.to_string())))
    }

    /// Writes values at a byte offset, in the order of the encoder's commands (`Queue::write_buffer` is before all of them).
    pub fn write<T: NoUninit>(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, offset: u64, values: &[T]) {
        let bytes = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            let from = self.filled("upload", bytes, wgpu::BufferUsages::COPY_SRC);
            encoder.copy_buffer_to_buffer(&from, 0, to, offset, bytes.len() as u64);
        }
    }

    /// A small buffer of constants for one use.
    pub fn uniform<T: NoUninit>(&self, value: &T) -> wgpu::Buffer {
        self.filled("uniform", bytemuck::bytes_of(value), wgpu::BufferUsages::UNIFORM)
    }

    /// A buffer of constants that [`write`](Self::write) changes.
    pub(super) fn constants(&self, label: &str, bytes: usize) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    fn filled(&self, label: &str, bytes: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let size = bytes.len() as u64;
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: true };
        let buffer = self.device.create_buffer(&descriptor);
        // Without memory there is nothing to map; `check` has the error.
        if let Ok(mut view) = buffer.get_mapped_range_mut(..) {
            view.copy_from_slice(bytes);
        }
        buffer.unmap();
        buffer
    }

    /// Entries `first .. first + count` of a buffer, once everything submitted is done.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn read<T: AnyBitPattern + NoUninit>(
        &self,
        from: &wgpu::Buffer,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>, GpuError> {
        if count == 0 {
            return self.wait().map(|()| Vec::new());
        }
        let entry = size_of::<T>() as u64;
        let (offset, size) = (first as u64 * entry, count as u64 * entry);
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let descriptor = wgpu::BufferDescriptor { label: Some("download"), size, usage, mapped_at_creation: false };
        let to = self.device.create_buffer(&descriptor);
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(from, offset, &to, 0, size);
        self.submit(encoder)?;
        to.map_async(wgpu::MapMode::Read, .., |_| ()); // a failure shows in the range below
        self.wait()?;
        let view = to.get_mapped_range(..).map_err(|e| GpuError::Failed(one_line(&e.to_string())))?;
        let mut values = vec![T::zeroed(); count];
        bytemuck::cast_slice_mut(&mut values).copy_from_slice(&view);
        Ok(values)
    }
}

/// A compiled entry point. Its bindings are those of group 0 that its text uses.
#[derive(Debug, Clone)]
pub struct Kernel {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

impl Kernel {
    /// Runs so many workgroups; `linear` in `view.wgsl` numbers their threads.
    pub fn run(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)], groups: u32) {
        self.bind(gpu, pass, bindings);
        let columns = groups.clamp(1, GROUPS_IN_A_ROW);
        pass.dispatch_workgroups(columns, groups.div_ceil(columns), 1);
    }

    /// Runs as many workgroups as entry `place` of `args` says.
    pub fn run_indirect(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        bindings: &[(u32, &wgpu::Buffer)],
        args: &wgpu::Buffer,
        place: u64,
    ) {
        self.bind(gpu, pass, bindings);
        pass.dispatch_workgroups_indirect(args, 12 * place);
    }

    fn bind(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)]) {
        let entries: Vec<_> = (bindings.iter())
            .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
    }
}

/// A buffer that is made anew where it is too small; what it held is then gone.
#[derive(Debug)]
pub struct Growing {
    label: &'static str,
    buffer: wgpu::Buffer,
}

impl Growing {
    /// The smallest one.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, label: &'static str) -> Result<Self, GpuError> {
        Ok(Self { label, buffer: gpu.buffer(label, 0)? })
    }

    /// Room for so many bytes, and an eighth more where it has to be made, if that can be bound.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn fit(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        if bytes > self.buffer.size() {
            let roomy = (bytes + bytes / 8).min(gpu.room()).max(bytes);
            // The old one first: both at once may be more than there is.
            self.buffer = gpu.buffer(self.label, 0)?;
            self.buffer = gpu.buffer(self.label, roomy)?;
        }
        Ok(())
    }
}

impl std::ops::Deref for Growing {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}

fn name(info: &wgpu::AdapterInfo) -> String {
    let model = info.name.split('(').next().unwrap_or_default();
    let words: Vec<String> = (model.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()))
        .map(str::to_ascii_lowercase)
        .collect();
    format!("gpu-{}-{}", info.backend.to_str(), words.join("-"))
}
