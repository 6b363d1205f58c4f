//! Target depths of windows: measured ones from the store, and those of sparse points.

use std::sync::{Arc, Mutex};

use scene::{Capture, CodecError, Rect};
use store::{BlockingStore, StoreError};

use super::locks::lock;
use super::sparse_depth::SparseDepth;
use crate::byte_lru::ByteLru;
use crate::depth_samples::{self, DepthSamples};

/// Room for the measured depths of some hundred views.
const CACHE_BYTES: usize = 32 << 20;

/// Depths that could not be read.
pub(super) enum DepthError {
    Damaged(CodecError),
    Store(StoreError),
}

/// Target depths of all views.
#[derive(Debug)]
pub(super) struct TargetDepth {
    sparse: SparseDepth,
    /// Measured depths by view.
    measured: Mutex<ByteLru<u32, Arc<DepthSamples>>>,
}

impl TargetDepth {
    pub(super) fn new(capture: &Capture) -> Self {
        Self { sparse: SparseDepth::new(capture), measured: Mutex::new(ByteLru::new(CACHE_BYTES)) }
    }

    /// Target depths of a window in metres, 0 = none; `None` if it has none at all.
    pub(super) fn plane(
        &self,
        capture: &Capture,
        store: &BlockingStore,
        view: u32,
        mip: u8,
        rect: Rect,
    ) -> Result<Option<Vec<f32>>, DepthError> {
        let mut plane = self.sparse.plane(capture, view, mip, rect);
        if let Some(measured) = self.measured(capture, store, view)? {
            measured.merge_into(&mut plane, mip, rect);
        }
        Ok((!plane.is_empty()).then_some(plane))
    }

    fn measured(
        &self,
        capture: &Capture,
        store: &BlockingStore,
        number: u32,
    ) -> Result<Option<Arc<DepthSamples>>, DepthError> {
        let view = &capture.views[number as usize];
        let Some(id) = view.depth else { return Ok(None) };
        if let Some(cached) = lock(&self.measured).get(&number) {
            return Ok(Some(Arc::clone(cached)));
        }
        let damaged = |error: CodecError| DepthError::Damaged(CodecError::new(format!("artefact {id}: {error}")));
        if store.size(id).map_err(DepthError::Store)?.is_some_and(|bytes| bytes > depth_samples::MAX_BYTES) {
            return Err(damaged(CodecError::new("too large for depths of a view")));
        }
        let bytes = store.get(id).map_err(DepthError::Store)?;
        let (width, height) = (view.camera.pinhole.width, view.camera.pinhole.height);
        let samples = Arc::new(DepthSamples::decode(&bytes, width, height).map_err(damaged)?);
        lock(&self.measured).insert_if_absent(number, Arc::clone(&samples), samples.memory_bytes());
        Ok(Some(samples))
    }
}
