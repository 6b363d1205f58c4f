//! Time of each pipeline stage, by GPU timestamp queries.
//!
//! Without timestamp queries a recording can be cut off after n dispatches, so that a host clock measures how much
//! later each stage ends. Recording is off by default and does not change results.

use super::device::Gpu;
use super::error::GpuError;
use super::timestamp_recorder::TIMESTAMP_FEATURES;
use crate::cpu::Stage;

/// A dispatch of a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedDispatch {
    /// The pipeline stage that it belongs to. Scans and sorts belong to the stage that runs them.
    pub stage: Stage,
    /// Nanoseconds from the start of the first dispatch to the end of this one; `None` without timestamp queries.
    pub ended_nanos: Option<f64>,
}

impl Gpu {
    /// Whether the device has timestamp queries between dispatches.
    pub fn has_timestamps(&self) -> bool {
        self.device().features().contains(TIMESTAMP_FEATURES)
    }

    /// Starts a recording: until [`finish_timing`](Self::finish_timing) only the next `max_dispatches` dispatches are
    /// encoded, and the end of each is timed.
    pub fn start_timing(&self, max_dispatches: usize) {
        self.timestamps().start(self.device(), max_dispatches);
    }

    /// Waits for all submitted work and ends the recording; returns its dispatches in order.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn finish_timing(&self) -> Result<Vec<TimedDispatch>, GpuError> {
        let Some(recording) = self.timestamps().finish() else {
            return self.wait().map(|()| Vec::new());
        };
        let mut ticks: Vec<u64> = Vec::new();
        if let Some(queries) = recording.queries.filter(|_| !recording.entries.is_empty()) {
            let count = recording.entries.len() as u32 + 1;
            let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
            let size = 8 * u64::from(count);
            let descriptor =
                wgpu::BufferDescriptor { label: Some("timestamps"), size, usage, mapped_at_creation: false };
            let to = self.device().create_buffer(&descriptor);
            let mut encoder = self.encoder();
            encoder.resolve_query_set(&queries, 0..count, &to, 0);
            self.submit(encoder)?;
            ticks = self.read(&to, 0, count as usize)?;
        }
        self.wait()?;
        let period = f64::from(self.queue().get_timestamp_period());
        let nanos = |n: usize| Some(ticks.get(n + 1)?.saturating_sub(ticks[0]) as f64 * period);
        let mut stage = Stage::Project;
        let dispatches = recording.entries.iter().enumerate().map(|(n, entry)| {
            stage = first_stage_of(entry).unwrap_or(stage);
            TimedDispatch { stage, ended_nanos: nanos(n) }
        });
        Ok(dispatches.collect())
    }
}

/// The stage that begins with this entry point; `None`: the current stage continues.
fn first_stage_of(entry: &str) -> Option<Stage> {
    Some(match entry {
        "plan_start" => Stage::Project,
        "compact" => Stage::Sort,
        "gather" => Stage::Bin,
        "rasterize" => Stage::Rasterize,
        "rasterize_backward" => Stage::RasterizeBackward,
        "reduce" => Stage::Reduce,
        "project_backward" => Stage::ProjectBackward,
        _ => return None,
    })
}
