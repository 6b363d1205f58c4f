//! Why the GPU did not do what it was asked, in one line that says what to do.

/// Why the GPU did not do what it was asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No adapter, or none of the name asked for.
    #[error("no GPU adapter{0}: install a Vulkan, Metal or DirectX 12 driver, or use --backend cpu")]
    NoAdapter(String),
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
    /// The device has no memory left.
    #[error("the GPU is out of memory ({0}): use smaller blocks, fewer splats or smaller images")]
    OutOfMemory(String),
    /// The device is gone.
    #[error("the GPU was lost: {0}")]
    Lost(String),
    /// A validation or internal error: a bug in plat or in the driver.
    #[error("the GPU failed: {0}")]
    Failed(String),
}

/// wgpu's errors as ours.
pub(super) fn translate(error: &wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(one_line(&source.to_string())),
        wgpu::Error::Validation { description, .. } | wgpu::Error::Internal { description, .. } => {
            GpuError::Failed(one_line(description))
        }
    }
}

/// Without line breaks: errors are one line.
pub(super) fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
