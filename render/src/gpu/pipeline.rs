//! Compiled compute pipelines, cached by stage and entry point.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use super::error::GpuError;

/// A compiled entry point and the layout of its bind group 0.
#[derive(Debug, Clone)]
pub(super) struct Pipeline {
    pub(super) pipeline: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
}

/// The pipelines of a device.
#[derive(Debug, Default)]
pub(super) struct PipelineCache(Mutex<BTreeMap<(&'static str, &'static str), Pipeline>>);

impl PipelineCache {
    /// The pipeline of an entry point of a stage; `compile` runs on its first use.
    pub(super) fn get_or_compile(
        &self,
        stage: &'static str,
        entry: &'static str,
        compile: impl FnOnce() -> Result<Pipeline, GpuError>,
    ) -> Result<Pipeline, GpuError> {
        let mut pipelines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(pipeline) = pipelines.get(&(stage, entry)) {
            return Ok(pipeline.clone());
        }
        let pipeline = compile()?;
        pipelines.insert((stage, entry), pipeline.clone());
        Ok(pipeline)
    }
}
