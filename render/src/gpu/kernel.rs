//! Compiled entry points and their dispatch.

use shaders::Stage;

use super::device::Gpu;
use super::error::GpuError;
use super::options::Path;
use super::pipeline::Pipeline;

/// Workgroups in x before a dispatch uses y too; WebGPU allows 65,535 per dimension.
const MAX_GROUPS_X: u32 = 1 << 15;

impl Gpu {
    /// An entry point of a stage, or of its replacement on this device's [`Path`]. Compiled on first use.
    ///
    /// # Errors
    /// If the driver rejects the shader.
    pub fn kernel(&self, stage: &Stage, entry: &'static str) -> Result<Kernel, GpuError> {
        let replacements = match self.path() {
            Path::Portable => [&[][..], &[]],
            Path::Fast => [&[], shaders::SUBGROUPS],
            Path::Half => [shaders::HALF, shaders::SUBGROUPS],
        };
        let pipeline = self.pipelines().get_or_compile(stage.name, entry, || {
            let replacement = replacements.into_iter().flatten().find(|replacement| replacement.name == stage.name);
            self.compile(replacement.unwrap_or(stage), entry)
        })?;
        Ok(Kernel { entry, pipeline })
    }

    fn compile(&self, stage: &Stage, entry: &'static str) -> Result<Pipeline, GpuError> {
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
        Ok(Pipeline { pipeline, layout })
    }
}

/// A compiled entry point. Its bindings are those of group 0 that its WGSL uses.
#[derive(Debug, Clone)]
pub struct Kernel {
    entry: &'static str,
    pipeline: Pipeline,
}

impl Kernel {
    /// Dispatches this many workgroups; `thread_number` in `view.wgsl` numbers their threads.
    pub fn run(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)], groups: u32) {
        self.bind(gpu, pass, bindings);
        let columns = groups.clamp(1, MAX_GROUPS_X);
        let rows = groups.div_ceil(columns);
        gpu.timestamps().dispatch(pass, self.entry, |pass| pass.dispatch_workgroups(columns, rows, 1));
    }

    /// Dispatches indirectly: the workgroup counts are entry `dispatch` of `args`, see [`shaders::args`].
    pub fn run_indirect(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        bindings: &[(u32, &wgpu::Buffer)],
        args: &wgpu::Buffer,
        dispatch: u64,
    ) {
        self.bind(gpu, pass, bindings);
        gpu.timestamps().dispatch(pass, self.entry, |pass| pass.dispatch_workgroups_indirect(args, 12 * dispatch));
    }

    fn bind(&self, gpu: &Gpu, pass: &mut wgpu::ComputePass, bindings: &[(u32, &wgpu::Buffer)]) {
        let entries: Vec<_> = (bindings.iter())
            .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let group = gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.pipeline.layout,
            entries: &entries,
        });
        pass.set_pipeline(&self.pipeline.pipeline);
        pass.set_bind_group(0, &group, &[]);
    }
}
