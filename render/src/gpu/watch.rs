//! When the stages of a view end, for whoever measures them: by the device's own clock, where it can be read within a pass.
//! Where it cannot, passes can be made to end early, so that a clock outside sees how much later each stage ends.
//!
//! Nothing of this is on unless asked for, and nothing drawn depends on it.

use std::sync::PoisonError;

use super::device::Gpu;
use super::error::GpuError;
use crate::cpu::Stage;

/// What a device needs, for its clock to be read between two dispatches.
pub(super) const CLOCK: wgpu::Features =
    wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES);
/// Dispatches whose ends there is room for; forward and backward have about sixty.
const MOST: u32 = 1024;

/// What is noted.
#[derive(Debug)]
pub(super) struct Watch {
    entries: Vec<&'static str>,
    /// Dispatches that run; those after them are left out.
    most: usize,
    queries: Option<wgpu::QuerySet>,
}

/// A dispatch that ran.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dispatched {
    /// Whose work it is. Scans and sorts belong to the stage that they are in.
    pub stage: Stage,
    /// Nanoseconds since the first one began, by the device's clock; `None` where it has none.
    pub ended_nanos: Option<f64>,
}

impl Gpu {
    /// Whether the device's clock can be read between two dispatches.
    pub fn has_clock(&self) -> bool {
        self.device().features().contains(CLOCK)
    }

    /// From now on, until [`watched`](Self::watched), only so many dispatches are recorded, and when they end is noted.
    pub fn watch(&self, most: usize) {
        let descriptor = wgpu::QuerySetDescriptor { label: Some("watch"), ty: wgpu::QueryType::Timestamp, count: MOST };
        let queries = self.has_clock().then(|| self.device().create_query_set(&descriptor));
        let most = most.min(MOST as usize - 1);
        *self.watch.lock().unwrap_or_else(PoisonError::into_inner) = Some(Watch { entries: Vec::new(), most, queries });
    }

    /// Ends watching, once everything submitted is done: the dispatches since it began, in their order.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn watched(&self) -> Result<Vec<Dispatched>, GpuError> {
        let Some(watch) = self.watch.lock().unwrap_or_else(PoisonError::into_inner).take() else {
            return self.wait().map(|()| Vec::new());
        };
        let mut ticks: Vec<u64> = Vec::new();
        if let Some(queries) = watch.queries.filter(|_| !watch.entries.is_empty()) {
            let count = watch.entries.len() as u32 + 1;
            let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
            let size = 8 * u64::from(count);
            let descriptor = wgpu::BufferDescriptor { label: Some("watch"), size, usage, mapped_at_creation: false };
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
        let dispatched = watch.entries.iter().enumerate().map(|(n, entry)| {
            stage = begins(entry).unwrap_or(stage);
            Dispatched { stage, ended_nanos: nanos(n) }
        });
        Ok(dispatched.collect())
    }

    /// Records a dispatch, unless it is one too many.
    pub(super) fn dispatch(
        &self,
        pass: &mut wgpu::ComputePass,
        entry: &'static str,
        record: impl FnOnce(&mut wgpu::ComputePass),
    ) {
        let mut watch = self.watch.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(watch) = &mut *watch else { return record(pass) };
        let n = watch.entries.len();
        if n >= watch.most {
            return;
        }
        if let Some(queries) = watch.queries.as_ref().filter(|_| n == 0) {
            pass.write_timestamp(queries, 0);
        }
        record(pass);
        watch.entries.push(entry);
        if let Some(queries) = &watch.queries {
            pass.write_timestamp(queries, n as u32 + 1);
        }
    }
}

/// The stage that begins with this entry point; the others go on with the one under way.
fn begins(entry: &str) -> Option<Stage> {
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
