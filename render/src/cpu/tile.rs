//! A tile for the rasterizer kernels: its pixels in blocks of lanes, its pairs, and the evaluation of α.

use std::ops::{Index, IndexMut};

use super::bin::{Pair, TILE};
use super::project::{Projected, at};
use super::simd::{Lanes, prefetch};
use crate::{ALPHA_MAX, ALPHA_MIN};

/// Number of pairs ahead whose records are prefetched.
pub(crate) const PREFETCH_DISTANCE: usize = 12;
/// Blocks of a tile; also lanes of a block.
pub(crate) const BLOCKS: usize = 16;

/// Left column and top row of each block in its tile.
const BLOCK_X: [f32; BLOCKS] = [0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0];
const BLOCK_Y: [f32; BLOCKS] = [0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 4.0, 4.0, 8.0, 8.0, 8.0, 8.0, 12.0, 12.0, 12.0, 12.0];

/// One value per pixel of a tile: sixteen blocks of sixteen lanes. Each block is one cache line, as a load across two
/// lines is slow.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(crate) struct Plane([[f32; 16]; BLOCKS]);

impl Plane {
    pub(crate) fn filled(value: f32) -> Self {
        Self([[value; 16]; BLOCKS])
    }
}

impl Index<usize> for Plane {
    type Output = [f32; 16];
    #[inline(always)]
    fn index(&self, block: usize) -> &[f32; 16] {
        &self.0[block]
    }
}

impl IndexMut<usize> for Plane {
    #[inline(always)]
    fn index_mut(&mut self, block: usize) -> &mut [f32; 16] {
        &mut self.0[block]
    }
}

/// Indices of the moments of a pair: sums over pixels of `v = α dL/dα` and `w = αT`, times offsets from the mean or
/// upstream gradients.
pub(crate) mod moment {
    pub(crate) const V: usize = 0;
    pub(crate) const VX: usize = 1;
    pub(crate) const VY: usize = 2;
    pub(crate) const VXX: usize = 3;
    pub(crate) const VXY: usize = 4;
    pub(crate) const VYY: usize = 5;
    pub(crate) const RED: usize = 6;
    pub(crate) const GREEN: usize = 7;
    pub(crate) const BLUE: usize = 8;
    pub(crate) const Z: usize = 9;
    pub(crate) const WEIGHT: usize = 10;
    pub(crate) const ABS_X: usize = 11;
    pub(crate) const ABS_Y: usize = 12;
}

/// The moments of a pair, see [`moment`]: one cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct Moments(pub(crate) [f32; 16]);

/// The input of a tile's kernel.
pub(crate) struct TileInput<'a> {
    pub(crate) ranked: &'a [Projected],
    pub(crate) pairs: &'a [Pair],
    /// Left edge, pixels.
    pub(crate) x: usize,
    /// Top edge, pixels.
    pub(crate) y: usize,
    /// Width of the image, pixels.
    pub(crate) width: usize,
    /// Height of the image, pixels.
    pub(crate) height: usize,
}

impl TileInput<'_> {
    /// Calls `f(block, lane, count, offset in the tile row's planes)` for each row of a block, that is up to four
    /// pixels, inside the image.
    #[inline(always)]
    pub(crate) fn for_each_run(&self, mut f: impl FnMut(usize, usize, usize, usize)) {
        let columns = (self.width - self.x).min(TILE);
        let rows = (self.height - self.y).min(TILE);
        for y in 0..rows {
            for x in (0..columns).step_by(4) {
                let block = y / 4 * 4 + x / 4;
                f(block, y % 4 * 4, (columns - x).min(4), y * self.width + self.x + x);
            }
        }
    }

    /// Prefetches the record of a pair; records are in depth order, so a tile's are scattered.
    #[inline(always)]
    pub(crate) fn prefetch_pair(&self, pair: usize) {
        let record = self.pairs.get(pair).and_then(|pair| self.ranked.get(pair.rank as usize));
        record.into_iter().for_each(prefetch);
    }

    /// Reads a plane of the tile row into blocks, times `scale`.
    #[inline(always)]
    pub(crate) fn gather(&self, plane: &[f32], scale: f32, out: &mut Plane) {
        if plane.is_empty() {
            return;
        }
        self.for_each_run(|block, lane, count, offset| {
            for k in 0..count {
                out[block][lane + k] = plane[offset + k] * scale;
            }
        });
    }

    /// Writes blocks to a plane of the tile row.
    #[inline(always)]
    pub(crate) fn scatter(&self, from: &Plane, plane: &mut [f32]) {
        self.for_each_run(|block, lane, count, offset| {
            let from = &from[block][lane..lane + 4];
            match plane.get_mut(offset..offset + 4).filter(|_| count == 4) {
                // A constant length compiles to a move instead of a call of memcpy.
                Some(whole) => whole.copy_from_slice(from),
                None => plane[offset..offset + count].copy_from_slice(&from[..count]),
            }
        });
    }

    /// Initial transmittance, and a mask of the blocks with pixels: 1 inside the image, 0 outside, so that outside
    /// pixels count as finished.
    #[inline(always)]
    pub(crate) fn start(&self) -> (Plane, u32) {
        let mut live = Plane::filled(0.0);
        self.for_each_run(|block, lane, count, _| live[block][lane..lane + count].fill(1.0));
        let alive = live.0.iter().enumerate().fold(0, |mask, (b, lanes)| mask | (u32::from(lanes[0] > 0.0) << b));
        (live, alive)
    }
}

/// A projected splat broadcast to all lanes.
pub(crate) struct SplatLanes<L> {
    a: L,
    b: L,
    c: L,
    log2_opacity: L,
    x: f32,
    y: f32,
}

impl<L: Lanes> SplatLanes<L> {
    /// `x` and `y` are relative to the tile's first pixel centre.
    #[inline(always)]
    pub(crate) fn new(r: &[f32; 16], tile: &TileInput) -> Self {
        Self {
            a: L::splat(r[at::A]),
            b: L::splat(r[at::B]),
            c: L::splat(r[at::C]),
            log2_opacity: L::splat(r[at::LOG2_OPACITY]),
            x: tile.x as f32 + 0.5 - r[at::X],
            y: tile.y as f32 + 0.5 - r[at::Y],
        }
    }

    /// Offsets dx, dy of a block's pixels from the mean.
    #[inline(always)]
    pub(crate) fn offset(&self, block: usize, lane_x: L, lane_y: L) -> (L, L) {
        (lane_x + L::splat(self.x + BLOCK_X[block]), lane_y + L::splat(self.y + BLOCK_Y[block]))
    }

    /// α of the pixels of some blocks, zero where the splat is skipped. This loop is separate from blending: its
    /// iterations are independent, so a core overlaps several blocks; the dependency chain of α and blending together
    /// is too long for that.
    #[inline(always)]
    pub(crate) fn alphas(&self, mut blocks: u32, lane_x: L, lane_y: L, out: &mut Plane) {
        while blocks != 0 {
            let b = blocks.trailing_zeros() as usize & (BLOCKS - 1);
            blocks &= blocks - 1;
            let (dx, dy) = self.offset(b, lane_x, lane_y);
            let (u, v) = (self.a.fma(dx, self.b * dy), self.c * dy);
            let exponent = (-u).fma(u, (-v).fma(v, self.log2_opacity));
            let raw = exponent.exp2_at_most();
            raw.min(L::splat(ALPHA_MAX)).where_le(L::splat(ALPHA_MIN), raw).store(&mut out[b]);
        }
    }
}

/// Column and row of each lane in its block.
#[inline(always)]
pub(crate) fn lane_offsets<L: Lanes>() -> (L, L) {
    (L::load(&std::array::from_fn(|i| (i % 4) as f32)), L::load(&std::array::from_fn(|i| (i / 4) as f32)))
}
