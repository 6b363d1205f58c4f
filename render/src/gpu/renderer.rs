//! The GPU renderer: its kernels and the buffers that it keeps from pass to pass.

use std::sync::Arc;

use shaders::{MAX_VIEWS, MOMENTS, POSE_BLOCKS, SplatSet, Status, Views, args};

use super::buffer::{Buffer, GrowableBuffer};
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::Kernel;
use super::sizes::Sizes;
use super::sort::{SortBuffers, Sorter};
use super::splats::{Columns, GpuSplats};

/// Capacity of the pair buffers at first.
const INITIAL_PAIRS: usize = 1 << 18;

/// Which optional planes of the upstream gradient are present; absent ones are zero. Colour is always present.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct UpstreamPlanes {
    /// dL/d transmittance.
    pub transmittance: bool,
    /// dL/d depth.
    pub depth: bool,
}

/// Rigid motions and focal lengths of the cameras of a forward pass, on the device.
#[derive(Debug, Clone, Copy)]
pub struct Displacements<'a> {
    /// Rows of eight floats: translation in metres and rotation vector in radians, in the camera's axes; what ln(focal
    /// length) is greater by; padding.
    pub rows: &'a wgpu::Buffer,
    /// Row of each camera; `None` leaves it where it is.
    pub of_camera: &'a [Option<u32>],
}

/// A renderer that reuses its buffers from pass to pass.
#[derive(Debug)]
pub struct GpuRenderer {
    pub(super) gpu: Arc<Gpu>,
    pub(super) kernels: Kernels,
    pub(super) sorter: Sorter,
    pub(super) views: wgpu::Buffer,
    pub(super) status: Buffer,
    pub(super) args: Buffer,
    pub(super) entries: EntryBuffers,
    pub(super) pairs: PairBuffers,
    pub(super) pair_capacity: usize,
    pub(super) tile_ranges: GrowableBuffer,
    pub(super) last_pair: GrowableBuffer,
    pub(super) frame: GrowableBuffer,
    pub(super) upstream: GrowableBuffer,
    /// Moments of each visible trainable entry.
    pub(super) sums: GrowableBuffer,
    pub(super) gradients: Columns,
    pub(super) statistics: GrowableBuffer,
    /// Sums of the pose gradient, two vectors per workgroup of `reduce_pose`.
    pub(super) pose_partials: Buffer,
    pub(super) pose_gradients: Buffer,
    pub(super) last_forward: Option<LastForward>,
}

/// The inputs of the last forward pass that the backward pass and readback need.
#[derive(Debug, Clone, Copy)]
pub(super) struct LastForward {
    pub(super) views: Views,
    pub(super) set: SplatSet,
    /// Index of the ping-pong buffer that holds the sorted pairs.
    pub(super) sorted: usize,
}

/// Buffers with an element per entry: a splat, trainable or context, in a view.
#[derive(Debug)]
pub(super) struct EntryBuffers {
    pub(super) records: GrowableBuffer,
    /// 1 where the entry is visible.
    pub(super) is_visible: GrowableBuffer,
    /// Input and output of the prefix sums: over `is_visible`, then over tile counts.
    pub(super) sums: GrowableBuffer,
    pub(super) tiles: GrowableBuffer,
    pub(super) first_pair: GrowableBuffer,
    pub(super) visible: GrowableBuffer,
    pub(super) sort: SortBuffers,
}

/// Buffers with an element per pair of entry and tile.
#[derive(Debug)]
pub(super) struct PairBuffers {
    /// Entry of each pair.
    pub(super) entry: GrowableBuffer,
    pub(super) sort: SortBuffers,
    pub(super) moments: GrowableBuffer,
}

#[derive(Debug)]
pub(super) struct Kernels {
    pub(super) plan_start: Kernel,
    pub(super) plan_visible: Kernel,
    pub(super) plan_pairs: Kernel,
    pub(super) project: Kernel,
    pub(super) compact: Kernel,
    pub(super) gather: Kernel,
    pub(super) emit: Kernel,
    pub(super) ranges: Kernel,
    pub(super) rasterize: Kernel,
    pub(super) rasterize_backward: Kernel,
    pub(super) reduce: Kernel,
    pub(super) project_backward: Kernel,
    pub(super) displace: Kernel,
    pub(super) reduce_pose: Kernel,
    pub(super) finish_pose: Kernel,
}

impl Kernels {
    fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            plan_start: gpu.kernel(&shaders::PLAN, "plan_start")?,
            plan_visible: gpu.kernel(&shaders::PLAN, "plan_visible")?,
            plan_pairs: gpu.kernel(&shaders::PLAN, "plan_pairs")?,
            project: gpu.kernel(&shaders::PROJECT, "project")?,
            compact: gpu.kernel(&shaders::COMPACT, "compact")?,
            gather: gpu.kernel(&shaders::GATHER, "gather")?,
            emit: gpu.kernel(&shaders::EMIT, "emit")?,
            ranges: gpu.kernel(&shaders::RANGES, "ranges")?,
            rasterize: gpu.kernel(&shaders::RASTERIZE, "rasterize")?,
            rasterize_backward: gpu.kernel(&shaders::RASTERIZE_BACKWARD, "rasterize_backward")?,
            reduce: gpu.kernel(&shaders::REDUCE, "reduce")?,
            project_backward: gpu.kernel(&shaders::PROJECT_BACKWARD, "project_backward")?,
            displace: gpu.kernel(&shaders::DISPLACE, "displace")?,
            reduce_pose: gpu.kernel(&shaders::REDUCE_POSE, "reduce_pose")?,
            finish_pose: gpu.kernel(&shaders::REDUCE_POSE, "finish_pose")?,
        })
    }
}

impl GpuRenderer {
    /// A renderer on this device.
    ///
    /// # Errors
    /// If the driver rejects a stage, or a buffer cannot be allocated.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        let g = &*gpu;
        let entries = EntryBuffers {
            records: GrowableBuffer::new(g, "records")?,
            is_visible: GrowableBuffer::new(g, "visibility flags")?,
            sums: GrowableBuffer::new(g, "prefix sums")?,
            tiles: GrowableBuffer::new(g, "tile counts")?,
            first_pair: GrowableBuffer::new(g, "first pairs")?,
            visible: GrowableBuffer::new(g, "visible")?,
            sort: SortBuffers::new(g)?,
        };
        let pairs = PairBuffers {
            entry: GrowableBuffer::new(g, "pairs")?,
            sort: SortBuffers::new(g)?,
            moments: GrowableBuffer::new(g, "moments")?,
        };
        Ok(Self {
            kernels: Kernels::new(g)?,
            sorter: Sorter::new(g)?,
            views: g.writable_uniform("views", size_of::<Views>()),
            status: g.buffer("status", size_of::<Status>() as u64)?,
            args: g.buffer("args", 12 * args::COUNT)?,
            entries,
            pairs,
            pair_capacity: INITIAL_PAIRS,
            tile_ranges: GrowableBuffer::new(g, "tile ranges")?,
            last_pair: GrowableBuffer::new(g, "last pairs")?,
            frame: GrowableBuffer::new(g, "frame")?,
            upstream: GrowableBuffer::new(g, "upstream")?,
            sums: GrowableBuffer::new(g, "moments of splats")?,
            gradients: Columns::new(g, "gradients", 0, 0)?,
            statistics: GrowableBuffer::new(g, "statistics")?,
            pose_partials: g.buffer("sums of pose gradients", 32 * MAX_VIEWS as u64 * u64::from(POSE_BLOCKS))?,
            pose_gradients: g.buffer("pose gradients", 32 * MAX_VIEWS as u64)?,
            last_forward: None,
            gpu,
        })
    }

    /// The backend's name, as [`Gpu::name`].
    pub fn name(&self) -> String {
        self.gpu.name().to_string()
    }

    /// Pixels of the frame, for each view consecutive planes of `width · height` floats: red, green, blue,
    /// transmittance and, with [`Options::extras`](crate::Options::extras), depth and trainable alpha; as in
    /// [`Frame`](crate::Frame).
    pub fn frame(&self) -> &wgpu::Buffer {
        &self.frame
    }

    /// Input of [`backward`](Self::backward): for each view the planes of [`Upstream`](crate::Upstream), that is three
    /// of colour, transmittance, depth; all five have space. Allocated by `forward`.
    pub fn upstream(&self) -> &wgpu::Buffer {
        &self.upstream
    }

    /// Gradients, in columns like the splats' and with their stride. Only rows of visible splats are defined.
    pub fn gradients(&self) -> &Columns {
        &self.gradients
    }

    /// The same columns, to exchange them for others of their stride and degree: the next backward pass overwrites them.
    pub fn gradients_mut(&mut self) -> &mut Columns {
        &mut self.gradients
    }

    /// For each visible entry of a trainable splat four floats: `screen_gradient`, `screen_gradient_abs` and `weight`
    /// of [`Gradients`](crate::Gradients) in that view, and the view's number of pixels.
    pub fn statistics(&self) -> &wgpu::Buffer {
        &self.statistics
    }

    /// For each view of the last [`forward_displaced`](Self::forward_displaced) eight floats: the gradients of its pose
    /// and its focal length as in [`Gradients`](crate::Gradients), at the displaced camera, and padding. Zero for a view without a displacement.
    pub fn pose_gradients(&self) -> &wgpu::Buffer {
        &self.pose_gradients
    }

    /// Indices of the visible entries, ascending; the first [`Status::visible_trainable`] belong to trainable splats.
    /// Entry `i` of `n` views is splat `i / n` in view `i % n`.
    pub fn visible(&self) -> &wgpu::Buffer {
        &self.entries.visible
    }

    /// A word per entry, trainable splats first: 1 where it is visible.
    pub fn visibility_flags(&self) -> &wgpu::Buffer {
        &self.entries.is_visible
    }

    /// Arguments of the indirect dispatches, see [`shaders::args`].
    pub fn args(&self) -> &wgpu::Buffer {
        &self.args
    }

    /// The [`Status`] on the device.
    pub fn status_buffer(&self) -> &wgpu::Buffer {
        &self.status
    }

    /// Waits for all submitted work and reads the status.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn status(&self) -> Result<Status, GpuError> {
        let status: Status = self.gpu.read(&self.status, 0, 1)?[0];
        if status.fault != 0 {
            return Err(GpuError::Failed("stages `project` and `emit` count different tiles of a splat".into()));
        }
        Ok(status)
    }

    /// Waits for all submitted work; after an overflow, grows the pair buffers and clears the flag. Returns whether
    /// there was an overflow: then that pass and all later ones had no effect and must be repeated.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn grow_after_overflow(&mut self) -> Result<bool, GpuError> {
        let status = self.status()?;
        if status.overflow == 0 {
            return Ok(false);
        }
        self.pair_capacity = self.pair_capacity_for(status.max_pairs as usize);
        self.gpu.upload(&self.status, 0, &[Status::default()])?;
        Ok(true)
    }

    /// Half more than `pairs`, as far as a binding allows, so that a slightly larger view does not overflow again.
    fn pair_capacity_for(&self, pairs: usize) -> usize {
        let bound = (self.gpu.max_binding_bytes() / (4 * u64::from(MOMENTS))) as usize;
        (pairs + pairs / 2).next_multiple_of(1 << 16).min(bound).max(pairs)
    }

    /// Allocates every buffer for these views. Buffers never shrink.
    pub(super) fn reserve(&mut self, views: &Views, splats: &GpuSplats) -> Result<(), GpuError> {
        let gpu = &*self.gpu;
        let (stride, sh_degree) = (splats.columns().stride(), splats.sh_degree());
        let sizes = Sizes::of(views);
        let entries = &mut self.entries;
        entries.records.reserve(gpu, sizes.records)?;
        entries.sums.reserve(gpu, sizes.entry_sums)?;
        for buffer in [&mut entries.is_visible, &mut entries.tiles, &mut entries.first_pair, &mut entries.visible] {
            buffer.reserve(gpu, sizes.entry_words)?;
        }
        entries.sort.reserve(gpu, sizes.entry_words)?;
        let pairs = &mut self.pairs;
        pairs.entry.reserve(gpu, sizes.pair_words)?;
        pairs.sort.reserve(gpu, sizes.pair_words)?;
        pairs.moments.reserve(gpu, sizes.moments)?;
        self.sorter.reserve(gpu, sizes.histogram, sizes.block_sums)?;
        self.tile_ranges.reserve(gpu, sizes.tile_ranges)?;
        self.last_pair.reserve(gpu, sizes.last_pair)?;
        self.frame.reserve(gpu, sizes.frame)?;
        self.upstream.reserve(gpu, sizes.upstream)?;
        self.sums.reserve(gpu, sizes.splat_moments)?;
        self.statistics.reserve(gpu, sizes.statistics)?;
        if self.gradients.stride() != stride || self.gradients.sh_degree() != sh_degree {
            // Frees the old columns first: both at once may not fit.
            self.gradients = Columns::new(gpu, "gradients", 0, 0)?;
            self.gradients = Columns::new(gpu, "gradients", sh_degree, stride)?;
        }
        Ok(())
    }
}
