//! The stages of the GPU backend as WGSL text, and the layouts that they share with Rust.
//!
//! A [`Stage`] is one file of `wgsl/` with the snippets that it uses before it; several entry points may share a file. Where
//! subgroups do something faster, a snippet has a twin for them: [`SUBGROUPS`] are the stages with those in its place, [`HALF`] those
//! with half precision too.
//! A test parses every stage with naga and compares every structure with its Rust twin.
//!
//! Architecture invariant: text and layouts only; nothing here knows a device.

pub mod train;

use bytemuck::{Pod, Zeroable};

/// Threads of a workgroup, everywhere.
pub const GROUP: u32 = 256;
/// Entries that one workgroup of `scan` adds up.
pub const SCAN_BLOCK: u32 = 1024;
/// Entries that one workgroup of `radix` sorts.
pub const RADIX_BLOCK: u32 = 4096;
/// Values of a radix digit.
pub const DIGITS: u32 = 256;
/// Side of a tile in pixels.
pub const TILE: u32 = 16;
/// Sums that a pair of splat and tile hands to its splat; see `rasterize_backward.wgsl` for their order.
pub const MOMENTS: u32 = 13;
/// Views drawn side by side, at most.
pub const MOST_VIEWS: usize = 16;
/// Splats of one workgroup of `reduce`.
pub const REDUCE_SPLATS: u32 = 16;

/// The text of a module and the names of its entry points.
#[derive(Debug, Clone, Copy)]
pub struct Stage {
    /// The file's name, and the stage's in every backend.
    pub name: &'static str,
    parts: &'static [&'static str],
    /// Compute entry points.
    pub entries: &'static [&'static str],
}

impl Stage {
    /// A stage from snippets and its own text, concatenated in this order.
    pub const fn new(name: &'static str, parts: &'static [&'static str], entries: &'static [&'static str]) -> Self {
        Self { name, parts, entries }
    }

    /// The module's text.
    pub fn source(&self) -> String {
        self.parts.concat()
    }
}

/// The views, the record of a projected splat, the renderer's status and its constants.
pub const VIEW: &str = include_str!("../wgsl/view.wgsl");
/// A snippet for every adapter, and its twin for those with subgroups.
macro_rules! snippet {
    ($name:literal) => {
        [include_str!(concat!("../wgsl/", $name, ".wgsl")), include_str!(concat!("../wgsl/", $name, "_subgroups.wgsl"))]
    };
}

/// Columns of splats in four banks, their EWA projection and their colour's basis.
const SPLAT: &str = include_str!("../wgsl/splat.wgsl");
/// Which tiles an ellipse touches.
const TILES: &str = include_str!("../wgsl/tiles.wgsl");
/// Whose a tile is, and a splat's opacity at a pixel.
const BLEND: &str = include_str!("../wgsl/blend.wgsl");

/// Which thread of its workgroup a thread is.
const THREADS: [&str; 2] = snippet!("threads");
/// Sums over a workgroup.
const SUMS: [&str; 2] = snippet!("sums");
/// Which threads have which digit.
const DIGITS_OF: [&str; 2] = snippet!("digits");
/// Sums over the pixels of a tile.
const PARTS: [&str; 2] = snippet!("parts");
/// Where what pixels say of a pair waits for those who add it up, in single precision or in half.
const TOUCHES: [&str; 2] = [include_str!("../wgsl/touches.wgsl"), include_str!("../wgsl/touches_half.wgsl")];
/// Where the sums of a pair go: to itself.
const IN_ORDER: &str = include_str!("../wgsl/in_order.wgsl");
/// Where the sums of a pair go: to its splat, by atomics.
const BY_ATOMICS: &str = include_str!("../wgsl/by_atomics.wgsl");

macro_rules! stages {
    ($($constant:ident $name:literal [$($part:expr),*] $entries:expr;)*) => {
        $(
            #[doc = concat!("`", $name, ".wgsl`")]
            pub const $constant: Stage =
                Stage::new($name, &[$($part,)* include_str!(concat!("../wgsl/", $name, ".wgsl"))], &$entries);
        )*
        /// Every stage of the renderer.
        pub const STAGES: &[Stage] = &[$($constant),*];
    };
}

stages! {
    PLAN "plan" [VIEW] ["plan_start", "plan_visible", "plan_pairs"];
    PROJECT "project" [VIEW, SPLAT, TILES] ["project"];
    SCAN "scan" [THREADS[0], SUMS[0]] ["scan_blocks", "scan_sums", "scan_apply"];
    COMPACT "compact" [VIEW] ["compact"];
    RADIX "radix" [THREADS[0], DIGITS_OF[0]] ["radix_count", "radix_scatter"];
    GATHER "gather" [VIEW] ["gather"];
    EMIT "emit" [VIEW, TILES] ["emit"];
    RANGES "ranges" [VIEW] ["ranges"];
    RASTERIZE "rasterize" [VIEW, BLEND] ["rasterize"];
    RASTERIZE_BACKWARD "rasterize_backward" [VIEW, BLEND, THREADS[0], TOUCHES[0], PARTS[0], IN_ORDER] ["rasterize_backward"];
    REDUCE "reduce" [VIEW] ["reduce"];
    PROJECT_BACKWARD "project_backward" [VIEW, SPLAT] ["project_backward"];
}

const SCAN_TEXT: &str = include_str!("../wgsl/scan.wgsl");
const RADIX_TEXT: &str = include_str!("../wgsl/radix.wgsl");
const BACKWARD_TEXT: &str = include_str!("../wgsl/rasterize_backward.wgsl");

/// As [`RASTERIZE_BACKWARD`], but a pair's sums are added to its splat's by atomics: what fixed order is measured against.
pub const RASTERIZE_BACKWARD_ATOMICS: Stage = Stage::new(
    "rasterize_backward_atomics",
    &[VIEW, BLEND, THREADS[0], TOUCHES[0], PARTS[0], BY_ATOMICS, BACKWARD_TEXT],
    RASTERIZE_BACKWARD.entries,
);

/// What takes the place of the stages of the same names where the adapter has subgroups, all of one size from 8 to 128.
pub const SUBGROUPS: &[Stage] = &[
    Stage::new(SCAN.name, &[THREADS[1], SUMS[1], SCAN_TEXT], SCAN.entries),
    Stage::new(RADIX.name, &[THREADS[1], DIGITS_OF[1], RADIX_TEXT], RADIX.entries),
    Stage::new(
        RASTERIZE_BACKWARD.name,
        &[VIEW, BLEND, THREADS[1], TOUCHES[0], PARTS[1], IN_ORDER, BACKWARD_TEXT],
        RASTERIZE_BACKWARD.entries,
    ),
    Stage::new(
        RASTERIZE_BACKWARD_ATOMICS.name,
        &[VIEW, BLEND, THREADS[1], TOUCHES[0], PARTS[1], BY_ATOMICS, BACKWARD_TEXT],
        RASTERIZE_BACKWARD_ATOMICS.entries,
    ),
];

/// What takes the place of those of [`SUBGROUPS`] of the same names where half precision is asked for. Pictures have the same bits, sums
/// of gradients fewer right ones.
pub const HALF: &[Stage] = &[Stage::new(
    RASTERIZE_BACKWARD.name,
    &[VIEW, BLEND, THREADS[1], TOUCHES[1], PARTS[1], IN_ORDER, BACKWARD_TEXT],
    RASTERIZE_BACKWARD.entries,
)];

/// A camera in single precision with what the stages want of it, and where its share of the buffers begins.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct View {
    /// Rows of the rotation from world to camera, each with its component of the translation.
    pub rows: [[f32; 4]; 3],
    /// Optical centre in the world; the last entry is not used.
    pub centre: [f32; 4],
    /// Focal lengths, pixels.
    pub focal: [f32; 2],
    /// Principal point, pixels.
    pub principal: [f32; 2],
    /// Bounds of x/z and y/z within which the Jacobian is taken.
    pub cone_min: [f32; 2],
    /// See `cone_min`.
    pub cone_max: [f32; 2],
    /// Width and height.
    pub pixels: [u32; 2],
    /// Width and height in tiles.
    pub tiles: [u32; 2],
    /// Tiles of the views before this one.
    pub first_tile: u32,
    /// Pixels of the views before this one.
    pub first_pixel: u32,
    /// Not used.
    pub padding: [u32; 2],
}

/// Views that are drawn side by side, and the sizes of what they draw. What a splat is in a view is an entry; those of a splat are
/// neighbours, view after view. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Views {
    /// Colour behind everything; the last entry is not used.
    pub background: [f32; 4],
    /// How many there are.
    pub count: u32,
    /// Tiles of all.
    pub tiles: u32,
    /// Pixels of all.
    pub pixels: u32,
    /// Entries of trainable splats.
    pub own: u32,
    /// Entries of trainable splats and context.
    pub total: u32,
    /// Pairs of splat and tile for which there is room.
    pub pair_capacity: u32,
    /// 1: opacity compensated for the blur.
    pub antialiased: u32,
    /// 1: depth and own are wanted.
    pub extras: u32,
    /// Each; those past `count` mean nothing.
    pub each: [View; MOST_VIEWS],
}

/// The splats that a dispatch works on. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Set {
    /// Place of the first among all splats.
    pub first: u32,
    /// Their number.
    pub count: u32,
    /// Entries from a column to the next.
    pub stride: u32,
    /// SH degree in use.
    pub sh_degree: u32,
}

/// Which planes of the upstream gradient mean anything. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Planes {
    /// 1: dL/d transmittance is read, else taken as zero.
    pub transmittance: u32,
    /// 1: dL/d depth is read, else taken as zero.
    pub depth: u32,
    /// Not used.
    pub padding: [u32; 2],
}

/// One pass of `radix`, or one `scan`. Uniform.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Pass {
    /// Which word of [`Status`] says how many entries there are.
    pub slot: u32,
    /// Lowest bit of the digit; of `scan` not used.
    pub shift: u32,
    /// Not used.
    pub padding: [u32; 2],
}

/// What the device knows of the views and the host only when it asks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Status {
    /// 1: views had more pairs than there is room for. Stays until the host clears it; until then nothing is drawn, and
    /// no gradient is made.
    pub overflow: u32,
    /// 1: the device counted a splat's tiles once so and once otherwise. Never seen; an error if it is.
    pub fault: u32,
    /// Pairs of the last views that were drawn.
    pub pairs: u32,
    /// Most pairs of views, drawn or not, since the host cleared it.
    pub most_pairs: u32,
    /// Visible entries of the last views, own and context.
    pub visible: u32,
    /// Those of trainable splats.
    pub seen: u32,
    /// All entries and one: what the first scan adds up.
    pub splat_slots: u32,
    /// Visible entries and one: what the second scan adds up.
    pub visible_slots: u32,
    /// Entries of the histogram of visible ones.
    pub visible_digits: u32,
    /// Entries of the histogram of pairs.
    pub pair_digits: u32,
}

/// Places of the indirect dispatches in the renderer's `args` buffer, three words each.
pub mod args {
    /// A thread for each visible entry.
    pub const VISIBLE: u64 = 0;
    /// A workgroup of `radix` for each block of visible entries.
    pub const VISIBLE_SORT: u64 = 1;
    /// A workgroup of `scan` for each block of their histogram.
    pub const VISIBLE_DIGITS: u64 = 2;
    /// A workgroup of `scan` for each block of their tile counts.
    pub const VISIBLE_SLOTS: u64 = 3;
    /// A thread for each pair.
    pub const PAIRS: u64 = 4;
    /// A workgroup of `radix` for each block of pairs.
    pub const PAIR_SORT: u64 = 5;
    /// A workgroup of `scan` for each block of their histogram.
    pub const PAIR_DIGITS: u64 = 6;
    /// A thread for each visible entry of a trainable splat.
    pub const SEEN: u64 = 7;
    /// A workgroup of `reduce` for each sixteen of them.
    pub const SEEN_REDUCE: u64 = 8;
    /// How many there are.
    pub const COUNT: u64 = 9;
}

/// A word of [`Status`] as a slot of [`Pass`].
pub mod slot {
    use super::Status;
    use std::mem::offset_of;

    /// Pairs.
    pub const PAIRS: u32 = (offset_of!(Status, pairs) / 4) as u32;
    /// Visible splats.
    pub const VISIBLE: u32 = (offset_of!(Status, visible) / 4) as u32;
    /// All splats and one.
    pub const SPLAT_SLOTS: u32 = (offset_of!(Status, splat_slots) / 4) as u32;
    /// Visible splats and one.
    pub const VISIBLE_SLOTS: u32 = (offset_of!(Status, visible_slots) / 4) as u32;
    /// Histogram of visible splats.
    pub const VISIBLE_DIGITS: u32 = (offset_of!(Status, visible_digits) / 4) as u32;
    /// Histogram of pairs.
    pub const PAIR_DIGITS: u32 = (offset_of!(Status, pair_digits) / 4) as u32;
}
