//! Accounting of the device's buffer memory against a cap.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::error::GpuError;

/// Bytes of a device's buffers, and their cap. Excludes small uniforms, and dropped buffers that commands in flight
/// still use.
#[derive(Debug)]
pub(super) struct MemoryCap {
    limit: u64,
    used: AtomicU64,
    peak: AtomicU64,
}

impl MemoryCap {
    /// A cap of `limit` bytes; `None`: unlimited.
    pub(super) fn new(limit: Option<u64>) -> Arc<Self> {
        Arc::new(Self { limit: limit.unwrap_or(u64::MAX), used: AtomicU64::new(0), peak: AtomicU64::new(0) })
    }

    /// Reserves bytes for a buffer named `what` until the allocation is dropped.
    pub(super) fn allocate(self: &Arc<Self>, what: &str, bytes: u64) -> Result<Allocation, GpuError> {
        let fits = |used: u64| used.checked_add(bytes).filter(|sum| *sum <= self.limit);
        match self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(used) => {
                self.peak.fetch_max(used + bytes, Ordering::Relaxed);
                Ok(Allocation { cap: Arc::clone(self), bytes })
            }
            Err(used) => Err(GpuError::OverCap { what: what.to_string(), bytes, used, limit: self.limit }),
        }
    }

    /// Bytes in use, and the peak.
    pub(super) fn used_and_peak(&self) -> [u64; 2] {
        [&self.used, &self.peak].map(|bytes| bytes.load(Ordering::Relaxed))
    }
}

/// The bytes of one buffer; dropping it returns them to the cap.
#[derive(Debug)]
pub(super) struct Allocation {
    cap: Arc<MemoryCap>,
    bytes: u64,
}

impl Drop for Allocation {
    fn drop(&mut self) {
        self.cap.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}
