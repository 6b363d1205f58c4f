//! Compiled entry points, and how they are run.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use shaders::Stage;

use super::device::Gpu;
use super::error::GpuError;
use super::options::Path;

/// Workgroups in a row before a dispatch gets a second dimension.
const GROUPS_IN_A_ROW: u32 = 1 << 15;

/// What was compiled, by stage and entry point.
pub(super) type Kernels = Mutex<BTreeMap<(&'static str, &'static str), Kernel>>;

impl Gpu {
    /// An entry point of a stage, or of what takes its place on this device, compiled when it is first asked for.
    ///
    /// # Errors
    /// Where the driver refuses it.
    pub fn kernel(&self, stage: &Stage, entry: &'static str) -> Result<Kernel, GpuError> {
        let mut kernels = self.kernels().lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kernel) = kernels.get(&(stage.name, entry)) {
            return Ok(kernel.clone());
        }
        let twins = match self.path() {
            Path::Portable => [&[][..], &[]],
            Path::Fast => [&[], shaders::SUBGROUPS],
            Path::Half => [shaders::HALF, shaders::SUBGROUPS],
        };
        let faster = twins.into_iter().flatten().find(|faster| faster.name == stage.name);
        let kernel = self.compile(faster.unwrap_or(stage), entry)?;
        kernels.insert((stage.name, entry), kernel.clone());
        Ok(kernel)
    }

    fn compile(&self, stage: &Stage, entry: &'static str) -> Result<Kernel, GpuError> {
        let module = self.device().create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(stage.name),
            source: wgpu::ShaderSource::Wgsl(stage.source().into()),
        });
        let pipeline = self.device().create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
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
        Ok(Kernel { entry, pipeline, layout })
    }
}

/// A compiled entry point. Its bindings are those of group 0 that its text uses.
#[derive(Debug, Clone)]
pub struct Kernel {
    entry: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

impl Kernel {
    /// Runs so many workgroups; `linear` in `view.wgsl` numbers their threads.
    pub fn run(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)], groups: u32) {
        self.bind(gpu, pass, bindings);
        let columns = groups.clamp(1, GROUPS_IN_A_ROW);
        gpu.dispatch(pass, self.entry, |pass| pass.dispatch_workgroups(columns, groups.div_ceil(columns), 1));
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
        gpu.dispatch(pass, self.entry, |pass| pass.dispatch_workgroups_indirect(args, 12 * place));
    }

    fn bind(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)]) {
        let entries: Vec<_> = (bindings.iter())
            .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let group = gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
    }
}
