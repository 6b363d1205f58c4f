//! Timestamp queries around the dispatches of a pass.

use std::sync::{Mutex, PoisonError};

/// Features that timestamp queries between dispatches need.
pub(super) const TIMESTAMP_FEATURES: wgpu::Features =
    wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES);
/// Capacity of the query set; forward and backward have about sixty dispatches.
const MAX_QUERIES: u32 = 1024;

/// Counts and times dispatches while a recording is active; otherwise it passes them through.
#[derive(Debug, Default)]
pub(super) struct TimestampRecorder(Mutex<Option<Recording>>);

/// The dispatches of one recording.
#[derive(Debug)]
pub(super) struct Recording {
    /// Entry points, in the order of their dispatches.
    pub(super) entries: Vec<&'static str>,
    /// Dispatches that run; later ones are dropped.
    max_dispatches: usize,
    /// Query 0 is the start of the first dispatch, query n + 1 the end of dispatch n. `None` without timestamp queries.
    pub(super) queries: Option<wgpu::QuerySet>,
}

impl TimestampRecorder {
    /// Begins a recording of at most so many dispatches.
    pub(super) fn start(&self, device: &wgpu::Device, max_dispatches: usize) {
        let descriptor =
            wgpu::QuerySetDescriptor { label: Some("timestamps"), ty: wgpu::QueryType::Timestamp, count: MAX_QUERIES };
        let queries = device.features().contains(TIMESTAMP_FEATURES).then(|| device.create_query_set(&descriptor));
        let max_dispatches = max_dispatches.min(MAX_QUERIES as usize - 1);
        let recording = Recording { entries: Vec::new(), max_dispatches, queries };
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(recording);
    }

    /// Ends the recording.
    pub(super) fn finish(&self) -> Option<Recording> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Encodes a dispatch, unless the recording has reached its limit.
    pub(super) fn dispatch(
        &self,
        pass: &mut wgpu::ComputePass,
        entry: &'static str,
        encode: impl FnOnce(&mut wgpu::ComputePass),
    ) {
        let mut recording = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(recording) = &mut *recording else { return encode(pass) };
        let n = recording.entries.len();
        if n >= recording.max_dispatches {
            return;
        }
        if let Some(queries) = recording.queries.as_ref().filter(|_| n == 0) {
            pass.write_timestamp(queries, 0);
        }
        encode(pass);
        recording.entries.push(entry);
        if let Some(queries) = &recording.queries {
            pass.write_timestamp(queries, n as u32 + 1);
        }
    }
}
