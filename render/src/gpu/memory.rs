//! The device's memory: buffers, which count against a cap for as long as they live, and what goes into them and comes back.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::{AnyBitPattern, NoUninit};

use super::device::Gpu;
use super::error::{GpuError, one_line};

/// Bytes that may wait on the host to be copied to the device.
const STAGED_BYTES: u64 = 16 << 20;

/// Bytes of all buffers of a device, and how many they may be. Not counted are small constants and what commands in flight
/// still use of buffers that are gone.
#[derive(Debug)]
pub(super) struct Meter {
    most: u64,
    used: AtomicU64,
    peak: AtomicU64,
}

impl Meter {
    pub(super) fn new(most: Option<u64>) -> Arc<Self> {
        Arc::new(Self { most: most.unwrap_or(u64::MAX), used: AtomicU64::new(0), peak: AtomicU64::new(0) })
    }

    fn take(self: &Arc<Self>, what: &str, bytes: u64) -> Result<Share, GpuError> {
        let fits = |used: u64| used.checked_add(bytes).filter(|sum| *sum <= self.most);
        match self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(used) => {
                self.peak.fetch_max(used + bytes, Ordering::Relaxed);
                Ok(Share { meter: Arc::clone(self), bytes })
            }
            Err(used) => Err(GpuError::OverCap { what: what.to_string(), bytes, used, most: self.most }),
        }
    }
}

/// What a buffer takes of the cap.
#[derive(Debug)]
struct Share {
    meter: Arc<Meter>,
    bytes: u64,
}

impl Drop for Share {
    fn drop(&mut self) {
        self.meter.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// A buffer on the device.
#[derive(Debug)]
pub struct Buffer {
    buffer: wgpu::Buffer,
    _share: Share,
}

impl std::ops::Deref for Buffer {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}

impl Gpu {
    /// The largest buffer that a stage can bind, bytes.
    pub fn room(&self) -> u64 {
        let limits = self.device().limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Bytes of all buffers that there are, and the most that there ever were at once.
    pub fn memory_bytes(&self) -> [u64; 2] {
        [&self.meter().used, &self.meter().peak].map(|bytes| bytes.load(Ordering::Relaxed))
    }

    /// A buffer of zeros that stages may bind, copies may touch and dispatches may read their size from.
    ///
    /// # Errors
    /// Where it is too large, or memory is short.
    pub fn buffer(&self, label: &str, bytes: u64) -> Result<Buffer, GpuError> {
        use wgpu::BufferUsages as Usage;
        // Sizes are multiples of four; so, then, is the largest.
        let most = self.room() / 4 * 4;
        if bytes > most {
            return Err(GpuError::TooLarge { what: label.to_string(), bytes, most });
        }
        let size = bytes.max(16).next_multiple_of(4);
        self.allocated(label, size, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST | Usage::INDIRECT)
    }

    fn allocated(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> Result<Buffer, GpuError> {
        let share = self.meter().take(label, size)?;
        let scope = self.device().push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        let buffer = self.device().create_buffer(&descriptor);
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory(format!("{label}: {size} bytes"))),
            None => self.check().map(|()| Buffer { buffer, _share: share }),
        }
    }

    /// Overwrites bytes from an offset on, before whatever is submitted next. Of all that is to be written only so much waits on
    /// the host at once, whatever its size.
    ///
    /// # Errors
    /// What went wrong until now.
    pub fn upload<T: NoUninit>(&self, to: &wgpu::Buffer, offset: u64, values: &[T]) -> Result<(), GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        for (n, piece) in bytes.chunks(STAGED_BYTES as usize).enumerate() {
            let size = piece.len() as u64;
            if self.staged().load(Ordering::Relaxed) + size > STAGED_BYTES {
                // What waits to be copied goes with the next submission, and its memory once that is done.
                self.submit(self.encoder())?;
                self.wait()?;
                self.staged().store(0, Ordering::Relaxed);
            }
            self.staged().fetch_add(size, Ordering::Relaxed);
            self.queue().write_buffer(to, offset + n as u64 * STAGED_BYTES, piece);
        }
        self.check()
    }

    /// Writes values at a byte offset, in the order of the encoder's commands ([`upload`](Self::upload) is before all of them).
    pub fn write<T: NoUninit>(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, offset: u64, values: &[T]) {
        let bytes = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            let from = self.filled("upload", bytes, wgpu::BufferUsages::COPY_SRC);
            encoder.copy_buffer_to_buffer(&from, 0, to, offset, bytes.len() as u64);
        }
    }

    /// A small buffer of constants for one use.
    pub fn uniform<T: NoUninit>(&self, value: &T) -> wgpu::Buffer {
        self.filled("uniform", bytemuck::bytes_of(value), wgpu::BufferUsages::UNIFORM)
    }

    /// A buffer of constants that [`write`](Self::write) changes.
    pub(super) fn constants(&self, label: &str, bytes: usize) -> wgpu::Buffer {
        self.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    fn filled(&self, label: &str, bytes: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let size = bytes.len() as u64;
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: true };
        let buffer = self.device().create_buffer(&descriptor);
        // Without memory, or without a device, there is nothing to map; `check` has the error.
        if let Ok(mut view) = buffer.get_mapped_range_mut(..) {
            view.copy_from_slice(bytes);
            drop(view);
            buffer.unmap();
        }
        buffer
    }

    /// Entries `first .. first + count` of a buffer, once everything submitted is done.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn read<T: AnyBitPattern + NoUninit>(
        &self,
        from: &wgpu::Buffer,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>, GpuError> {
        let mut values = vec![T::zeroed(); count];
        let entry = size_of::<T>();
        // By pieces, so that what is copied takes little memory beside the values.
        let entries = (STAGED_BYTES as usize / entry).max(1);
        for (n, piece) in values.chunks_mut(entries).enumerate() {
            self.read_piece(from, ((first + n * entries) * entry) as u64, bytemuck::cast_slice_mut(piece))?;
        }
        self.wait().map(|()| values)
    }

    fn read_piece(&self, from: &wgpu::Buffer, offset: u64, bytes: &mut [u8]) -> Result<(), GpuError> {
        let size = bytes.len() as u64;
        let to = self.allocated("download", size, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)?;
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(from, offset, &to, 0, size);
        self.submit(encoder)?;
        to.map_async(wgpu::MapMode::Read, .., |_| ()); // a failure shows in the range below
        self.wait()?;
        let view = to.get_mapped_range(..).map_err(|e| GpuError::Failed(one_line(&e.to_string())))?;
        bytes.copy_from_slice(&view);
        Ok(())
    }
}

/// A buffer that is made anew where it is too small; what it held is then gone.
#[derive(Debug)]
pub struct Growing {
    label: &'static str,
    buffer: Buffer,
}

impl Growing {
    /// The smallest one.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, label: &'static str) -> Result<Self, GpuError> {
        Ok(Self { label, buffer: gpu.buffer(label, 0)? })
    }

    /// Room for so many bytes, and an eighth more where it has to be made, if there is so much.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn fit(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        if bytes > self.buffer.size() {
            // The old one first: both at once may be more than there is.
            self.buffer = gpu.buffer(self.label, 0)?;
            self.buffer =
                gpu.buffer(self.label, bytes.saturating_add(bytes / 8)).or_else(|_| gpu.buffer(self.label, bytes))?;
        }
        Ok(())
    }
}

impl std::ops::Deref for Growing {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}
