//! Errors of the GPU backend, and the collection of wgpu's asynchronous errors.

use std::collections::HashMap;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread::{self, ThreadId};

/// An error of the GPU backend; its message is one line that ends with a remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No adapter, or none whose name matches.
    #[error("no GPU adapter{0}: install a Vulkan, Metal or DirectX 12 driver, or use --backend cpu")]
    NoAdapter(String),
    /// An environment variable has an invalid value.
    #[error("{name} is {value:?}: set it to {wanted}, or unset it")]
    Setting {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: String,
        /// The allowed values.
        wanted: &'static str,
    },
    /// Half precision was requested, and this adapter lacks it or has no subgroups of one fixed size.
    #[error("the GPU {0} has no half precision, or no subgroups of one size: set PLAT_GPU_PATH to fast, or unset it")]
    NoHalf(String),
    /// The adapter cannot run the stages.
    #[error("the GPU {adapter} allows {limit} {what}, {required} are needed: use --backend cpu")]
    TooSmall {
        /// Its name.
        adapter: String,
        /// The limit's name.
        what: &'static str,
        /// The adapter's limit.
        limit: u64,
        /// The stages' requirement.
        required: u64,
    },
    /// A buffer is larger than the adapter can bind.
    #[error("{what} would take {bytes} bytes in one buffer, the GPU binds {limit}: use smaller blocks or fewer splats")]
    TooLarge {
        /// What the buffer is for.
        what: String,
        /// Its size.
        bytes: u64,
        /// The adapter's limit.
        limit: u64,
    },
    /// More splats than fit into one binding of the adapter.
    #[error("{count} splats do not fit into the GPU's bindings, {fit} do: use smaller blocks or a smaller budget")]
    TooManySplats {
        /// Splats requested.
        count: usize,
        /// Splats that fit.
        fit: usize,
    },
    /// A buffer would exceed the memory cap.
    #[error(
        "{what} would take {bytes} bytes of GPU memory beside {used} in use, PLAT_GPU_MEMORY allows {limit}: raise it, or use \
         smaller blocks or fewer splats"
    )]
    OverCap {
        /// What the buffer is for.
        what: String,
        /// Its size.
        bytes: u64,
        /// Bytes of the live buffers.
        used: u64,
        /// The cap.
        limit: u64,
    },
    /// The device is out of memory.
    #[error("the GPU is out of memory ({0}): use smaller blocks, fewer splats or smaller images")]
    OutOfMemory(String),
    /// The device is lost.
    #[error("the GPU was lost ({0}): rerun the command to resume from the last checkpoint, or use --backend cpu")]
    Lost(String),
    /// A validation or internal error: a bug in plat or in the driver.
    #[error("the GPU failed: {0}")]
    Failed(String),
}

impl GpuError {
    /// Whether a device with more memory or larger bindings could do the work.
    pub fn is_out_of_memory(&self) -> bool {
        use GpuError::{OutOfMemory, OverCap, TooLarge, TooManySplats};
        matches!(self, TooLarge { .. } | TooManySplats { .. } | OverCap { .. } | OutOfMemory(_))
    }
}

/// Errors that wgpu's handlers recorded and that no call has returned yet.
#[derive(Debug, Default)]
pub(super) struct DeviceErrors {
    /// The first unreturned error of each thread. wgpu calls the handler on the thread that causes the error, and a
    /// thread works on one task at a time, so no task receives another's error.
    first: Mutex<HashMap<ThreadId, GpuError>>,
    /// The loss of the device. Permanent: later operations fail, and wgpu does not report the loss again.
    lost: OnceLock<GpuError>,
}

impl DeviceErrors {
    /// Records an error that no error scope captured.
    pub(super) fn record(&self, error: &wgpu::Error) {
        let error = match error {
            wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(one_line(&source.to_string())),
            wgpu::Error::Validation { description, .. } | wgpu::Error::Internal { description, .. } => {
                GpuError::Failed(one_line(description))
            }
        };
        let mut first = self.first.lock().unwrap_or_else(PoisonError::into_inner);
        first.entry(thread::current().id()).or_insert(error);
    }

    /// Records the loss of the device.
    pub(super) fn record_loss(&self, message: &str) {
        let message = one_line(message);
        // wgpu drops the device if a submission runs out of memory.
        let error = match message.to_lowercase().contains("out of memory") {
            true => GpuError::OutOfMemory(message),
            false if message.is_empty() => GpuError::Lost("it was destroyed".into()),
            false => GpuError::Lost(message),
        };
        self.lost.get_or_init(|| error);
    }

    /// The loss of the device, if any.
    pub(super) fn loss(&self) -> Option<GpuError> {
        self.lost.get().cloned()
    }

    /// Returns the loss of the device, else returns and clears this thread's first error.
    pub(super) fn take(&self) -> Result<(), GpuError> {
        let first = self.first.lock().unwrap_or_else(PoisonError::into_inner).remove(&thread::current().id());
        self.loss().or(first).map_or(Ok(()), Err)
    }
}

/// The text without line breaks, as error messages are one line.
pub(super) fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_permanent_and_other_errors_are_returned_once_to_their_thread() {
        let errors = DeviceErrors::default();
        let source = || Box::<dyn std::error::Error + Send + Sync>::from("no space\nfor this");
        errors.record(&wgpu::Error::OutOfMemory { source: source() });
        errors.record(&wgpu::Error::Validation { source: source(), description: "a later error".into() });
        let other_thread = thread::scope(|scope| scope.spawn(|| errors.take()).join());
        assert_eq!(other_thread.expect("no panic"), Ok(()), "another thread got this thread's error");
        assert_eq!(errors.take(), Err(GpuError::OutOfMemory("no space for this".into())));
        assert_eq!(errors.take(), Ok(()));
        errors.record_loss("Device is lost");
        errors.record_loss("");
        for _ in 0..2 {
            assert_eq!(errors.take(), Err(GpuError::Lost("Device is lost".into())));
        }
        let out_of_memory = DeviceErrors::default();
        out_of_memory.record_loss("Out of memory");
        assert!(out_of_memory.take().is_err_and(|error| error.is_out_of_memory()));
    }
}
