//! Why the GPU did not do what it was asked, in one line that says what to do; and how wgpu's errors, which go to handlers, reach
//! whoever asks.

use std::collections::HashMap;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread::{self, ThreadId};

/// Why the GPU did not do what it was asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No adapter, or none of the name asked for.
    #[error("no GPU adapter{0}: install a Vulkan, Metal or DirectX 12 driver, or use --backend cpu")]
    NoAdapter(String),
    /// A variable of the environment means nothing.
    #[error("{name} is {value:?}: set it to {wanted}, or leave it")]
    Setting {
        /// Its name.
        name: &'static str,
        /// What it says.
        value: String,
        /// What it may say.
        wanted: &'static str,
    },
    /// Half precision was asked for, and an adapter of this name has none, or no subgroups of one size.
    #[error("the GPU {0} has no half precision, or no subgroups of one size: set PLAT_GPU_PATH to fast, or leave it")]
    NoHalf(String),
    /// The adapter cannot run the stages.
    #[error("the GPU {adapter} has {what} {has} where {needs} are needed: use --backend cpu")]
    TooSmall {
        /// Its name.
        adapter: String,
        /// The limit's name.
        what: &'static str,
        /// What it has.
        has: u64,
        /// What is needed.
        needs: u64,
    },
    /// A buffer is larger than the adapter can bind.
    #[error("{what} would take {bytes} bytes in one buffer, the GPU binds {most}: use smaller blocks or fewer splats")]
    TooLarge {
        /// What the buffer is for.
        what: String,
        /// Its size.
        bytes: u64,
        /// The adapter's limit.
        most: u64,
    },
    /// More splats than fit into the adapter's bindings.
    #[error("{count} splats do not fit into the GPU's bindings, {fit} do: use smaller blocks or a smaller budget")]
    TooManySplats {
        /// Splats asked for.
        count: usize,
        /// Splats that fit.
        fit: usize,
    },
    /// A buffer would take more than the host allows.
    #[error(
        "{what} would take {bytes} bytes of GPU memory beside {used} in use, of {most} that PLAT_GPU_MEMORY allows: raise it, or use \
         smaller blocks or fewer splats"
    )]
    OverCap {
        /// What the buffer is for.
        what: String,
        /// Its size.
        bytes: u64,
        /// Bytes of the buffers that there are.
        used: u64,
        /// The cap.
        most: u64,
    },
    /// The device has no memory left.
    #[error("the GPU is out of memory ({0}): use smaller blocks, fewer splats or smaller images")]
    OutOfMemory(String),
    /// The device is gone.
    #[error("the GPU was lost ({0}): the same command goes on from the last checkpoint, or use --backend cpu")]
    Lost(String),
    /// A validation or internal error: a bug in plat or in the driver.
    #[error("the GPU failed: {0}")]
    Failed(String),
}

impl GpuError {
    /// Would the same work do on a device with more memory, or larger bindings?
    pub fn is_memory(&self) -> bool {
        use GpuError::{OutOfMemory, OverCap, TooLarge, TooManySplats};
        matches!(self, TooLarge { .. } | TooManySplats { .. } | OverCap { .. } | OutOfMemory(_))
    }
}

/// What went wrong and nobody has been told of yet. wgpu reports to handlers, which leave it here.
#[derive(Debug, Default)]
pub(super) struct Faults {
    /// The first of each thread since it was told its last one. wgpu calls handlers on the thread that causes the error, and a thread
    /// works at one task: no task is told another's.
    first: Mutex<HashMap<ThreadId, GpuError>>,
    /// Why there is no device any more. Stays: whatever is asked of a lost device fails, and wgpu says no more of it.
    lost: OnceLock<GpuError>,
}

impl Faults {
    /// Of an error that no scope caught.
    pub(super) fn caught(&self, error: &wgpu::Error) {
        let error = match error {
            wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(one_line(&source.to_string())),
            wgpu::Error::Validation { description, .. } | wgpu::Error::Internal { description, .. } => {
                GpuError::Failed(one_line(description))
            }
        };
        let mut first = self.first.lock().unwrap_or_else(PoisonError::into_inner);
        first.entry(thread::current().id()).or_insert(error);
    }

    /// Of a device that is gone.
    pub(super) fn lost(&self, message: &str) {
        let message = one_line(message);
        // wgpu gives a device up where a submission finds no memory.
        let error = match message.to_lowercase().contains("out of memory") {
            true => GpuError::OutOfMemory(message),
            false if message.is_empty() => GpuError::Lost("it was destroyed".into()),
            false => GpuError::Lost(message),
        };
        self.lost.get_or_init(|| error);
    }

    /// The loss of the device, if it is lost.
    pub(super) fn loss(&self) -> Option<GpuError> {
        self.lost.get().cloned()
    }

    /// Tells this thread, of the loss of the device before all.
    pub(super) fn tell(&self) -> Result<(), GpuError> {
        let first = self.first.lock().unwrap_or_else(PoisonError::into_inner).remove(&thread::current().id());
        self.loss().or(first).map_or(Ok(()), Err)
    }
}

/// Without line breaks: errors are one line.
pub(super) fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lost_device_stays_lost_and_other_errors_are_told_once() {
        let faults = Faults::default();
        let source = || Box::<dyn std::error::Error + Send + Sync>::from("no room\nfor this");
        faults.caught(&wgpu::Error::OutOfMemory { source: source() });
        faults.caught(&wgpu::Error::Validation { source: source(), description: "of what came of it".into() });
        let elsewhere = thread::scope(|scope| scope.spawn(|| faults.tell()).join());
        assert_eq!(elsewhere.expect("no panic"), Ok(()), "it is no other thread's");
        assert_eq!(faults.tell(), Err(GpuError::OutOfMemory("no room for this".into())));
        assert_eq!(faults.tell(), Ok(()));
        faults.lost("Device is lost");
        faults.lost("");
        for _ in 0..2 {
            assert_eq!(faults.tell(), Err(GpuError::Lost("Device is lost".into())));
        }
        let starved = Faults::default();
        starved.lost("Out of memory");
        assert!(starved.tell().is_err_and(|error| error.is_memory()));
    }
}
