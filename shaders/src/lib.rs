//! The WGSL of the GPU backend, and the `repr(C)` layouts that WGSL and Rust share.
//!
//! A [`Stage`] is one shader module: a file of `wgsl/` with the snippets that it uses concatenated before it. A module
//! may have several entry points. Snippets that profit from subgroups exist twice; [`SUBGROUPS`] lists the modules
//! built from the subgroup versions, and [`HALF`] those that also store pixel terms in half precision. A test parses
//! every module with naga and compares every struct with its Rust counterpart.
//!
//! Architecture invariant: text and layouts only; no dependency on wgpu or on a device.

pub mod train;

use bytemuck::{Pod, Zeroable};

/// Threads of a workgroup, in every entry point that has more than one.
pub const WORKGROUP_SIZE: u32 = 256;
/// Entries that one workgroup of `scan` sums.
pub const SCAN_BLOCK: u32 = 1024;
/// Entries that one workgroup of `radix` sorts.
pub const RADIX_BLOCK: u32 = 4096;
/// Values of a radix digit (8 bits).
pub const RADIX_BINS: u32 = 256;
/// Side of a tile, pixels.
pub const TILE: u32 = 16;
/// Floats of the gradient moments of a (splat, tile) pair; `rasterize_backward.wgsl` defines their order.
pub const MOMENTS: u32 = 13;
/// Largest number of views in one dispatch.
pub const MAX_VIEWS: usize = 16;
/// Workgroups that sum the pose gradient of a view.
pub const POSE_BLOCKS: u32 = 64;
/// Entries that one workgroup of `reduce` handles.
pub const REDUCE_SPLATS: u32 = 16;

/// A shader module: its WGSL and its entry points.
#[derive(Debug, Clone, Copy)]
pub struct Stage {
    /// The file's name, and the stage's name in every backend.
    pub name: &'static str,
    sources: &'static [&'static str],
    /// Compute entry points.
    pub entries: &'static [&'static str],
}

impl Stage {
    /// A module made of snippets and its own text, concatenated in this order.
    pub const fn new(name: &'static str, sources: &'static [&'static str], entries: &'static [&'static str]) -> Self {
        Self { name, sources, entries }
    }

    /// The module's WGSL.
    pub fn source(&self) -> String {
        self.sources.concat()
    }
}

/// Constants, and the structs of views, projected splats and the renderer's status.
pub const VIEW: &str = include_str!("../wgsl/view.wgsl");
/// A snippet in two versions: portable, and with subgroup operations.
macro_rules! snippet {
    ($name:literal) => {
        [include_str!(concat!("../wgsl/", $name, ".wgsl")), include_str!(concat!("../wgsl/", $name, "_subgroups.wgsl"))]
    };
}

/// Splat columns in four banks, the EWA projection and the SH basis.
const SPLAT: &str = include_str!("../wgsl/splat.wgsl");
/// The exact test of an ellipse against a tile.
const TILES: &str = include_str!("../wgsl/tiles.wgsl");
/// The view of a tile, and alpha of a splat at a pixel.
const BLEND: &str = include_str!("../wgsl/blend.wgsl");

/// The sum over a workgroup.
const SUM: &str = include_str!("../wgsl/workgroup_sum.wgsl");
/// A thread's index in its workgroup.
const THREAD_INDEX: [&str; 2] = snippet!("thread_index");
/// The exclusive prefix sum over a workgroup.
const WORKGROUP_SCAN: [&str; 2] = snippet!("workgroup_scan");
/// Counts and bit masks of the threads that have the same digit.
const DIGIT_MATCH: [&str; 2] = snippet!("digit_match");
/// The sum of the 32 partial moments of a pair.
const REDUCE_PARTS: [&str; 2] = snippet!("reduce_parts");
/// Workgroup memory for the per-pixel terms of a pair, in single and in half precision.
const PIXEL_TERMS: [&str; 2] =
    [include_str!("../wgsl/pixel_terms.wgsl"), include_str!("../wgsl/pixel_terms_half.wgsl")];
/// Output of the moments per pair, for an ordered reduction.
const MOMENTS_PER_PAIR: &str = include_str!("../wgsl/moments_per_pair.wgsl");
/// Output of the moments per splat, by atomic addition.
const MOMENTS_ATOMIC: &str = include_str!("../wgsl/moments_atomic.wgsl");

macro_rules! stages {
    ($($constant:ident $name:literal [$($source:expr),*] $entries:expr;)*) => {
        $(
            #[doc = concat!("`", $name, ".wgsl`")]
            pub const $constant: Stage =
                Stage::new($name, &[$($source,)* include_str!(concat!("../wgsl/", $name, ".wgsl"))], &$entries);
        )*
        /// Every stage of the renderer.
        pub const STAGES: &[Stage] = &[$($constant),*];
    };
}

stages! {
    PLAN "plan" [VIEW] ["plan_start", "plan_visible", "plan_pairs"];
    PROJECT "project" [VIEW, SPLAT, TILES] ["project"];
    SCAN "scan" [THREAD_INDEX[0], WORKGROUP_SCAN[0]] ["scan_blocks", "scan_sums", "scan_apply"];
    COMPACT "compact" [VIEW] ["compact"];
    RADIX "radix" [THREAD_INDEX[0], DIGIT_MATCH[0]] ["radix_count", "radix_scatter"];
    GATHER "gather" [VIEW] ["gather"];
    EMIT "emit" [VIEW, TILES] ["emit"];
    RANGES "ranges" [VIEW] ["ranges"];
    RASTERIZE "rasterize" [VIEW, BLEND] ["rasterize"];
    RASTERIZE_BACKWARD "rasterize_backward"
        [VIEW, BLEND, THREAD_INDEX[0], PIXEL_TERMS[0], REDUCE_PARTS[0], MOMENTS_PER_PAIR] ["rasterize_backward"];
    REDUCE "reduce" [VIEW] ["reduce"];
    PROJECT_BACKWARD "project_backward" [VIEW, SPLAT] ["project_backward"];
    DISPLACE "displace" [VIEW] ["displace"];
    REDUCE_POSE "reduce_pose" [VIEW, SUM] ["reduce_pose", "finish_pose"];
}

const SCAN_TEXT: &str = include_str!("../wgsl/scan.wgsl");
const RADIX_TEXT: &str = include_str!("../wgsl/radix.wgsl");
const BACKWARD_TEXT: &str = include_str!("../wgsl/rasterize_backward.wgsl");

/// As [`RASTERIZE_BACKWARD`], but with the moments of a pair added atomically to its splat's: the baseline that the
/// ordered reduction is measured against.
pub const RASTERIZE_BACKWARD_ATOMICS: Stage = Stage::new(
    "rasterize_backward_atomics",
    &[VIEW, BLEND, THREAD_INDEX[0], PIXEL_TERMS[0], REDUCE_PARTS[0], MOMENTS_ATOMIC, BACKWARD_TEXT],
    RASTERIZE_BACKWARD.entries,
);

/// Replacements of the stages of the same names on adapters with subgroups, all of one size from 8 to 128.
pub const SUBGROUPS: &[Stage] = &[
    Stage::new(SCAN.name, &[THREAD_INDEX[1], WORKGROUP_SCAN[1], SCAN_TEXT], SCAN.entries),
    Stage::new(RADIX.name, &[THREAD_INDEX[1], DIGIT_MATCH[1], RADIX_TEXT], RADIX.entries),
    Stage::new(
        RASTERIZE_BACKWARD.name,
        &[VIEW, BLEND, THREAD_INDEX[1], PIXEL_TERMS[0], REDUCE_PARTS[1], MOMENTS_PER_PAIR, BACKWARD_TEXT],
        RASTERIZE_BACKWARD.entries,
    ),
    Stage::new(
        RASTERIZE_BACKWARD_ATOMICS.name,
        &[VIEW, BLEND, THREAD_INDEX[1], PIXEL_TERMS[0], REDUCE_PARTS[1], MOMENTS_ATOMIC, BACKWARD_TEXT],
        RASTERIZE_BACKWARD_ATOMICS.entries,
    ),
];

/// Replacements of stages of [`SUBGROUPS`] where half precision is requested. Frames stay bit-identical; gradients lose
/// precision.
pub const HALF: &[Stage] = &[Stage::new(
    RASTERIZE_BACKWARD.name,
    &[VIEW, BLEND, THREAD_INDEX[1], PIXEL_TERMS[1], REDUCE_PARTS[1], MOMENTS_PER_PAIR, BACKWARD_TEXT],
    RASTERIZE_BACKWARD.entries,
)];

/// A camera in single precision, and the offsets of its view in the buffers that all views share.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct View {
    /// Rows of the rotation from world to camera, each with its component of the translation.
    pub rows: [[f32; 4]; 3],
    /// Optical centre in the world; the last entry is padding.
    pub centre: [f32; 4],
    /// Focal lengths, pixels.
    pub focal: [f32; 2],
    /// Principal point, pixels.
    pub principal: [f32; 2],
    /// Lower bounds of x/z and y/z in the projection's Jacobian.
    pub cone_min: [f32; 2],
    /// Upper bounds of x/z and y/z in the projection's Jacobian.
    pub cone_max: [f32; 2],
    /// Width and height.
    pub pixels: [u32; 2],
    /// Width and height in tiles.
    pub tiles: [u32; 2],
    /// Number of tiles of the views before this one.
    pub first_tile: u32,
    /// Number of pixels of the views before this one.
    pub first_pixel: u32,
    /// Number of the camera's displacement, from 1; 0: it is not displaced, and there is no gradient of its pose.
    pub displacement: u32,
    /// Padding.
    pub padding: u32,
}

/// The views of one dispatch and the sizes of their buffers. Uniform.
///
/// An entry is one splat in one view; the entries of a splat are adjacent, in the order of the views.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Views {
    /// Background colour; the last entry is padding.
    pub background: [f32; 4],
    /// Number of views.
    pub count: u32,
    /// Tiles of all views.
    pub tiles: u32,
    /// Pixels of all views.
    pub pixels: u32,
    /// Entries of trainable splats.
    pub trainable_entries: u32,
    /// Entries of trainable splats and of the context.
    pub entries: u32,
    /// Capacity of the pair buffers.
    pub pair_capacity: u32,
    /// 1: opacity is compensated for the dilation.
    pub antialiased: u32,
    /// 1 and 2: the frame has the planes depth and trainable alpha; 2: the former of inverse depths.
    pub extras: u32,
    /// The views; only the first `count` are defined.
    pub view: [View; MAX_VIEWS],
}

/// The splats that a dispatch works on. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct SplatSet {
    /// Index of the first one among all splats.
    pub first: u32,
    /// Number of splats.
    pub count: u32,
    /// Entries from one column to the next.
    pub stride: u32,
    /// SH degree in use.
    pub sh_degree: u32,
}

/// Which optional planes of the upstream gradient are present. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct UpstreamPlanes {
    /// 1: dL/d transmittance is read; 0: it is zero.
    pub transmittance: u32,
    /// 1: dL/d depth is read; 0: it is zero.
    pub depth: u32,
    /// Padding.
    pub padding: [u32; 2],
}

/// Constants of one pass of `radix`, or of one `scan`. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct PassConstants {
    /// Word of [`Status`] that holds the number of entries; see [`status_word`].
    pub len_word: u32,
    /// Lowest bit of the digit; unused by `scan`.
    pub shift: u32,
    /// Padding.
    pub padding: [u32; 2],
}

/// Counts that only the device knows; the host reads them back on demand.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Status {
    /// 1: a forward pass had more pairs than the buffers hold. Sticky: until the host clears it, nothing is drawn and
    /// no gradient is computed.
    pub overflow: u32,
    /// 1: `project` and `emit` counted different tiles for a splat. An internal error.
    pub fault: u32,
    /// Pairs of the last forward pass that was drawn.
    pub pairs: u32,
    /// Largest number of pairs of any forward pass, drawn or not, since the host cleared it.
    pub max_pairs: u32,
    /// Visible entries of the last forward pass, trainable splats and context.
    pub visible: u32,
    /// Visible entries of trainable splats.
    pub visible_trainable: u32,
    /// Length of the first scan: all entries and one more.
    pub entry_scan_len: u32,
    /// Length of the second scan: visible entries and one more.
    pub visible_scan_len: u32,
    /// Length of the radix histogram of visible entries.
    pub visible_histogram_len: u32,
    /// Length of the radix histogram of pairs.
    pub pair_histogram_len: u32,
}

/// Indices of the indirect dispatches in the renderer's `args` buffer, three words each.
pub mod args {
    /// One thread per visible entry.
    pub const VISIBLE: u64 = 0;
    /// One workgroup of `radix` per block of visible entries.
    pub const VISIBLE_SORT: u64 = 1;
    /// One workgroup of `scan` per block of the histogram of visible entries.
    pub const VISIBLE_HISTOGRAM: u64 = 2;
    /// One workgroup of `scan` per block of the tile counts of visible entries.
    pub const VISIBLE_SCAN: u64 = 3;
    /// One thread per pair.
    pub const PAIRS: u64 = 4;
    /// One workgroup of `radix` per block of pairs.
    pub const PAIR_SORT: u64 = 5;
    /// One workgroup of `scan` per block of the histogram of pairs.
    pub const PAIR_HISTOGRAM: u64 = 6;
    /// One thread per visible entry of a trainable splat.
    pub const VISIBLE_TRAINABLE: u64 = 7;
    /// One workgroup of `reduce` per [`REDUCE_SPLATS`](super::REDUCE_SPLATS) visible entries of trainable splats.
    pub const REDUCE: u64 = 8;
    /// Number of indirect dispatches.
    pub const COUNT: u64 = 9;
}

/// Word offsets of the counts in [`Status`], for [`PassConstants::len_word`].
pub mod status_word {
    use super::Status;
    use std::mem::offset_of;

    /// Pairs.
    pub const PAIRS: u32 = (offset_of!(Status, pairs) / 4) as u32;
    /// Visible entries.
    pub const VISIBLE: u32 = (offset_of!(Status, visible) / 4) as u32;
    /// Length of the scan over all entries.
    pub const ENTRY_SCAN: u32 = (offset_of!(Status, entry_scan_len) / 4) as u32;
    /// Length of the scan over visible entries.
    pub const VISIBLE_SCAN: u32 = (offset_of!(Status, visible_scan_len) / 4) as u32;
    /// Length of the histogram of visible entries.
    pub const VISIBLE_HISTOGRAM: u32 = (offset_of!(Status, visible_histogram_len) / 4) as u32;
    /// Length of the histogram of pairs.
    pub const PAIR_HISTOGRAM: u32 = (offset_of!(Status, pair_histogram_len) / 4) as u32;
}
