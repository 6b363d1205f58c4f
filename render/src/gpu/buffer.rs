//! Device buffers: allocation under the memory cap, upload, readback.

use std::sync::atomic::Ordering;

use bytemuck::{AnyBitPattern, NoUninit};

use super::device::Gpu;
use super::error::{GpuError, one_line};
use super::memory_cap::Allocation;

/// Bound of the bytes that wait in host staging memory for their copy to the device.
const MAX_STAGED_BYTES: u64 = 16 << 20;

/// A buffer on the device; it counts against the memory cap until it is dropped.
#[derive(Debug)]
pub struct Buffer {
    buffer: wgpu::Buffer,
    _allocation: Allocation,
}

impl std::ops::Deref for Buffer {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}

impl Gpu {
    /// The largest buffer that a stage can bind, bytes.
    pub fn max_binding_bytes(&self) -> u64 {
        let limits = self.device().limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Bytes of all live buffers, and the peak so far.
    pub fn memory_bytes(&self) -> [u64; 2] {
        self.memory_cap().used_and_peak()
    }

    /// A zeroed buffer, usable as a storage binding, as source and destination of copies and for indirect dispatch.
    ///
    /// # Errors
    /// If it exceeds the binding limit or the memory cap, or the device is out of memory.
    pub fn buffer(&self, label: &str, bytes: u64) -> Result<Buffer, GpuError> {
        use wgpu::BufferUsages as Usage;
        // Sizes are rounded up to multiples of four, so the limit is rounded down to one.
        let limit = self.max_binding_bytes() / 4 * 4;
        if bytes > limit {
            return Err(GpuError::TooLarge { what: label.to_string(), bytes, limit });
        }
        let size = bytes.max(16).next_multiple_of(4);
        self.allocate(label, size, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST | Usage::INDIRECT)
    }

    fn allocate(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> Result<Buffer, GpuError> {
        let allocation = self.memory_cap().allocate(label, size)?;
        let scope = self.device().push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        let buffer = self.device().create_buffer(&descriptor);
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory(format!("{label}: {size} bytes"))),
            None => self.check().map(|()| Buffer { buffer, _allocation: allocation }),
        }
    }

    /// Writes values at a byte offset, ahead of the next submission. At most 16 MiB wait in host staging memory at
    /// once, whatever the size of `values`.
    ///
    /// # Errors
    /// A pending error of the device.
    pub fn upload<T: NoUninit>(&self, to: &wgpu::Buffer, offset: u64, values: &[T]) -> Result<(), GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        for (n, piece) in bytes.chunks(MAX_STAGED_BYTES as usize).enumerate() {
            let size = piece.len() as u64;
            if self.staged().load(Ordering::Relaxed) + size > MAX_STAGED_BYTES {
                // wgpu copies staged bytes with the next submission, and frees them once that is done.
                self.submit(self.encoder())?;
                self.wait()?;
                self.staged().store(0, Ordering::Relaxed);
            }
            self.staged().fetch_add(size, Ordering::Relaxed);
            self.queue().write_buffer(to, offset + n as u64 * MAX_STAGED_BYTES, piece);
        }
        self.check()
    }

    /// Writes values at a byte offset, in the order of the encoder's commands; [`upload`](Self::upload) precedes all of
    /// them.
    pub fn write<T: NoUninit>(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, offset: u64, values: &[T]) {
        let bytes = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            let from = self.initialised("upload", bytes, wgpu::BufferUsages::COPY_SRC);
            encoder.copy_buffer_to_buffer(&from, 0, to, offset, bytes.len() as u64);
        }
    }

    /// A uniform buffer with this content.
    pub fn uniform<T: NoUninit>(&self, value: &T) -> wgpu::Buffer {
        self.initialised("uniform", bytemuck::bytes_of(value), wgpu::BufferUsages::UNIFORM)
    }

    /// A uniform buffer that [`write`](Self::write) fills and a stage may change.
    pub(super) fn writable_uniform(&self, label: &str, bytes: usize) -> wgpu::Buffer {
        self.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    fn initialised(&self, label: &str, bytes: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let size = bytes.len() as u64;
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: true };
        let buffer = self.device().create_buffer(&descriptor);
        // Mapping fails if the device is lost or out of memory; `check` reports that error.
        if let Ok(mut view) = buffer.get_mapped_range_mut(..) {
            view.copy_from_slice(bytes);
            drop(view);
            buffer.unmap();
        }
        buffer
    }

    /// Waits for all submitted work and reads entries `first .. first + count` of a buffer.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn read<T: AnyBitPattern + NoUninit>(
        &self,
        from: &wgpu::Buffer,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>, GpuError> {
        let mut values = vec![T::zeroed(); count];
        let entry = size_of::<T>();
        // In pieces, which bounds the memory of the staging buffer.
        let entries = (MAX_STAGED_BYTES as usize / entry).max(1);
        for (n, piece) in values.chunks_mut(entries).enumerate() {
            self.read_piece(from, ((first + n * entries) * entry) as u64, bytemuck::cast_slice_mut(piece))?;
        }
        self.wait().map(|()| values)
    }

    fn read_piece(&self, from: &wgpu::Buffer, offset: u64, bytes: &mut [u8]) -> Result<(), GpuError> {
        let size = bytes.len() as u64;
        let to = self.allocate("download", size, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)?;
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(from, offset, &to, 0, size);
        self.submit(encoder)?;
        to.map_async(wgpu::MapMode::Read, .., |_| ()); // a failure surfaces in `get_mapped_range` below
        self.wait()?;
        let view = to.get_mapped_range(..).map_err(|e| GpuError::Failed(one_line(&e.to_string())))?;
        bytes.copy_from_slice(&view);
        Ok(())
    }
}

/// A buffer that is reallocated when it is too small. Reallocation discards its content.
#[derive(Debug)]
pub struct GrowableBuffer {
    label: &'static str,
    buffer: Buffer,
}

impl GrowableBuffer {
    /// A buffer of the minimum size.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, label: &'static str) -> Result<Self, GpuError> {
        Ok(Self { label, buffer: gpu.buffer(label, 0)? })
    }

    /// Ensures a capacity of `bytes`. A reallocation adds an eighth if that fits. The content may be lost.
    ///
    /// # Errors
    /// See [`Gpu::buffer`].
    pub fn reserve(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        if bytes > self.buffer.size() {
            // Frees the old buffer first: both at once may not fit.
            self.buffer = gpu.buffer(self.label, 0)?;
            self.buffer =
                gpu.buffer(self.label, bytes.saturating_add(bytes / 8)).or_else(|_| gpu.buffer(self.label, bytes))?;
        }
        Ok(())
    }
}

impl std::ops::Deref for GrowableBuffer {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}
