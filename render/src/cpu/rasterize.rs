//! Stages `rasterize` and `rasterize_backward`: one tile at a time, sixteen pixels (a 4×4 block) at a time.
//!
//! Forward blends front to back until every pixel of the tile is finished. Backward walks the same list in the same
//! direction: with the colour behind a splat known as "final minus what was seen so far", no list per pixel and no
//! back-to-front pass is needed (the replay of Taming-3DGS and Brush, on lanes instead of threads). A pair's gradient is
//! the sums over its pixels of a few moments; the conic's and the mean's gradients are linear in them.

use std::hint::cold_path;
use std::ops::{Index, IndexMut};

use super::bin::{Pair, TILE};
use super::project::{Projected, at};
use super::simd::{Lanes, prefetch};
use crate::{ALPHA_MAX, ALPHA_MIN, Frame, TRANSMITTANCE_MIN, Upstream, kernel};

/// Pairs ahead whose records are fetched.
pub(crate) const AHEAD: usize = 12;
/// Blocks in a tile, lanes in a block.
pub(crate) const BLOCKS: usize = 16;

/// Left column and top row of each block in its tile.
const BLOCK_X: [f32; BLOCKS] = [0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0, 0.0, 4.0, 8.0, 12.0];
const BLOCK_Y: [f32; BLOCKS] = [0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 4.0, 4.0, 8.0, 8.0, 8.0, 8.0, 12.0, 12.0, 12.0, 12.0];

/// Sixteen blocks of sixteen pixels, each a cache line of its own: a register's load that crosses two costs twice.
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

/// Places of the moments in a pair's gradient; `v = dL/dα · α`, `w = α T`.
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

/// A pair's gradient, see [`moment`]: one cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct Moments(pub(crate) [f32; 16]);

/// A band of tiles: sixteen rows of every plane of a frame.
pub(crate) struct Band<'a> {
    pub(crate) colour: [&'a mut [f32]; 3],
    pub(crate) transmittance: &'a mut [f32],
    /// Empty without extras.
    pub(crate) depth: &'a mut [f32],
    /// Empty without extras.
    pub(crate) own: &'a mut [f32],
}

/// What a tile is drawn from.
pub(crate) struct TileInput<'a> {
    pub(crate) ranked: &'a [Projected],
    pub(crate) pairs: &'a [Pair],
    /// Left edge in pixels; the band's top edge in pixels.
    pub(crate) x: usize,
    pub(crate) y: usize,
    /// Size of the whole image.
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl TileInput<'_> {
    /// Calls `f(block, lane, count, offset in the band's planes)` for each run of up to four pixels inside the image.
    #[inline(always)]
    fn runs(&self, mut f: impl FnMut(usize, usize, usize, usize)) {
        let columns = (self.width - self.x).min(TILE);
        let rows = (self.height - self.y).min(TILE);
        for y in 0..rows {
            for x in (0..columns).step_by(4) {
                let block = y / 4 * 4 + x / 4;
                f(block, y % 4 * 4, (columns - x).min(4), y * self.width + self.x + x);
            }
        }
    }

    /// Begins to bring the record of a pair from memory: in depth order they lie anywhere.
    #[inline(always)]
    pub(crate) fn fetch(&self, pair: usize) {
        let record = self.pairs.get(pair).and_then(|pair| self.ranked.get(pair.rank as usize));
        record.into_iter().for_each(prefetch);
    }

    #[inline(always)]
    pub(crate) fn gather(&self, plane: &[f32], scale: f32, out: &mut Plane) {
        if plane.is_empty() {
            return;
        }
        self.runs(|block, lane, count, offset| {
            for k in 0..count {
                out[block][lane + k] = plane[offset + k] * scale;
            }
        });
    }

    #[inline(always)]
    fn scatter(&self, from: &Plane, plane: &mut [f32]) {
        self.runs(|block, lane, count, offset| {
            let from = &from[block][lane..lane + 4];
            match plane.get_mut(offset..offset + 4).filter(|_| count == 4) {
                // Of a length that is known, so no call.
                Some(whole) => whole.copy_from_slice(from),
                None => plane[offset..offset + count].copy_from_slice(&from[..count]),
            }
        });
    }

    /// Transmittance one inside the image, zero outside: pixels that do not exist are finished from the start.
    #[inline(always)]
    pub(crate) fn start(&self) -> (Plane, u32) {
        let mut live = Plane::filled(0.0);
        self.runs(|block, lane, count, _| live[block][lane..lane + count].fill(1.0));
        let alive = live.0.iter().enumerate().fold(0, |mask, (b, lanes)| mask | (u32::from(lanes[0] > 0.0) << b));
        (live, alive)
    }
}

/// After which pairs which blocks are of no gradient any more: what lies behind the last splat under training that touches a
/// block, or where there is none. Ascending, and ended by a pair that is never reached; and the mask of the blocks that have one.
pub(crate) fn ends_of_own(pairs: &[Pair]) -> ([(u32, u32); BLOCKS + 1], u32) {
    let (mut ends, mut first, mut found) = ([(u32::MAX, 0); BLOCKS + 1], BLOCKS, 0);
    for (n, pair) in pairs.iter().enumerate().rev().filter(|(_, pair)| pair.own) {
        let blocks = u32::from(pair.blocks) & !found;
        if blocks != 0 {
            found |= blocks;
            first -= 1;
            ends[first] = (n as u32, blocks);
        }
        if found == 0xffff {
            break;
        }
    }
    ends.rotate_left(first);
    (ends, found)
}

/// What a tile's pixels took before all of them were finished.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Visited {
    /// Pairs.
    pub(crate) pairs: u32,
    /// Blocks of pixels, each for one pair.
    pub(crate) blocks: u32,
}

/// A splat's record spread over lanes.
pub(crate) struct Spread<L> {
    a: L,
    b: L,
    c: L,
    log2_opacity: L,
    x: f32,
    y: f32,
}

impl<L: Lanes> Spread<L> {
    /// Relative to the tile's first pixel centre.
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

    /// dx, dy of a block's pixels from the mean.
    #[inline(always)]
    pub(crate) fn offset(&self, block: usize, lane_x: L, lane_y: L) -> (L, L) {
        (lane_x + L::splat(self.x + BLOCK_X[block]), lane_y + L::splat(self.y + BLOCK_Y[block]))
    }

    /// α of the pixels of some blocks, zero where the splat is skipped. A loop of its own: nothing in it waits for what came before,
    /// so a core works at several blocks at once. With the blending in one loop the chain of a block is so long that it did not.
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

kernel!(
    /// Draws a tile into its band.
    pub(crate) fn rasterize(tile: &TileInput, background: &[f32; 3], extras: bool, band: &mut Band) -> Visited
        = rasterize_lanes
);

#[inline(always)]
fn rasterize_lanes<L: Lanes>(tile: &TileInput, background: &[f32; 3], extras: bool, band: &mut Band) -> Visited {
    if extras {
        rasterize_tile::<L, true>(tile, background, band)
    } else {
        rasterize_tile::<L, false>(tile, background, band)
    }
}

#[inline(always)]
fn rasterize_tile<L: Lanes, const EXTRAS: bool>(tile: &TileInput, background: &[f32; 3], band: &mut Band) -> Visited {
    // Of each pixel its transmittance; negative once the pixel is finished, and then what it is to end with.
    let (mut live, mut alive) = tile.start();
    let mut colour = [Plane::filled(0.0); 3];
    let mut depth = Plane::filled(0.0);
    let mut own = Plane::filled(0.0);
    let mut alphas = Plane::filled(0.0);
    let (lane_x, lane_y) = lane_offsets::<L>();

    let mut visited = Visited::default();
    for (n, pair) in tile.pairs.iter().enumerate() {
        if alive == 0 {
            break;
        }
        tile.fetch(n + AHEAD);
        visited.pairs += 1;
        let mut blocks = u32::from(pair.blocks) & alive;
        visited.blocks += blocks.count_ones();
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let spread = Spread::<L>::new(r, tile);
        spread.alphas(blocks, lane_x, lane_y, &mut alphas);
        while blocks != 0 {
            let b = blocks.trailing_zeros() as usize & (BLOCKS - 1);
            blocks &= blocks - 1;
            let alpha = L::load(&alphas[b]);
            let kept = L::load(&live[b]);
            let t = kept.max(L::zero());
            let weight = alpha * t;
            let next = t - weight;
            let end = L::splat(TRANSMITTANCE_MIN);
            let weight = weight.unless_le(next, end);
            next.or_if_le(next, end, kept.min(-kept)).store(&mut live[b]);
            for c in 0..3 {
                weight.fma(L::splat(r[at::RED + c]), L::load(&colour[c][b])).store(&mut colour[c][b]);
            }
            if EXTRAS {
                weight.fma(L::splat(r[at::Z]), L::load(&depth[b])).store(&mut depth[b]);
                weight.fma(L::splat(r[at::OWN]), L::load(&own[b])).store(&mut own[b]);
            }
            if next.all_le(end) {
                cold_path();
                alive &= !(1 << b);
            }
        }
    }

    for b in 0..BLOCKS {
        let t = L::load(&live[b]).abs();
        t.store(&mut live[b]);
        for c in 0..3 {
            t.fma(L::splat(background[c]), L::load(&colour[c][b])).store(&mut colour[c][b]);
        }
    }
    for c in 0..3 {
        tile.scatter(&colour[c], band.colour[c]);
    }
    tile.scatter(&live, band.transmittance);
    if EXTRAS {
        tile.scatter(&depth, band.depth);
        tile.scatter(&own, band.own);
    }
    visited
}

/// The rows of a frame and of the loss's gradient that belong to a band; empty planes are zero.
pub(crate) struct BackwardBand<'a> {
    colour: [&'a [f32]; 3],
    transmittance: &'a [f32],
    depth: &'a [f32],
    d_colour: [&'a [f32]; 3],
    d_transmittance: &'a [f32],
    d_depth: &'a [f32],
}

impl<'a> BackwardBand<'a> {
    pub(crate) fn new(frame: &'a Frame, upstream: &'a Upstream, band: usize) -> Self {
        let area = frame.width * frame.height;
        let from = band * TILE * frame.width;
        let to = (from + TILE * frame.width).min(area);
        let rows = |plane: &'a [f32], k: usize| plane.get(k * area + from..k * area + to).unwrap_or(&[]);
        Self {
            colour: [0, 1, 2].map(|c| rows(&frame.colour, c)),
            transmittance: rows(&frame.transmittance, 0),
            depth: rows(&frame.depth, 0),
            d_colour: [0, 1, 2].map(|c| rows(&upstream.colour, c)),
            d_transmittance: rows(&upstream.transmittance, 0),
            d_depth: rows(&upstream.depth, 0),
        }
    }
}

kernel!(
    /// The gradient of each pair of a tile, into `out` (one entry a pair; pairs that no pixel saw get zeros, those of context
    /// splats are left as they are).
    pub(crate) fn rasterize_backward(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) = rasterize_backward_lanes
);

#[inline(always)]
fn rasterize_backward_lanes<L: Lanes>(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) {
    if band.d_depth.is_empty() {
        rasterize_backward_tile::<L, false>(tile, band, out);
    } else {
        rasterize_backward_tile::<L, true>(tile, band, out);
    }
}

#[inline(always)]
fn rasterize_backward_tile<L: Lanes, const DEPTH: bool>(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) {
    let (mut live, mut alive) = tile.start();
    let (ends, owned) = ends_of_own(tile.pairs);
    let mut ended = 0;
    alive &= owned;
    if alive == 0 {
        return out
            .iter_mut()
            .zip(tile.pairs)
            .filter(|(_, pair)| pair.own)
            .for_each(|(out, _)| *out = Moments::default());
    }
    let mut d_colour = [Plane::filled(0.0); 3];
    let mut d_depth = Plane::filled(0.0);
    for c in 0..3 {
        tile.gather(band.d_colour[c], 1.0, &mut d_colour[c]);
    }
    // What lies behind the splats seen so far, weighted by the upstream gradient; at first all of it.
    let mut behind = Plane::filled(0.0);
    let mut product = |value: &[f32], gradient: &[f32]| {
        if !gradient.is_empty() {
            tile.runs(|block, lane, count, offset| {
                for k in 0..count {
                    behind[block][lane + k] += value[offset + k] * gradient[offset + k];
                }
            });
        }
    };
    for c in 0..3 {
        product(band.colour[c], band.d_colour[c]);
    }
    product(band.transmittance, band.d_transmittance);
    if DEPTH {
        product(band.depth, band.d_depth);
        tile.gather(band.d_depth, 1.0, &mut d_depth);
    }

    let [mut alphas, mut vs, mut weights] = [Plane::filled(0.0); 3];
    let (lane_x, lane_y) = lane_offsets::<L>();
    for (n, (pair, out)) in tile.pairs.iter().zip(out).enumerate() {
        if pair.own {
            *out = Moments::default();
        }
        tile.fetch(n + AHEAD);
        if ends[ended].0 < n as u32 {
            alive &= !ends[ended].1;
            ended += 1;
        }
        let blocks = u32::from(pair.blocks) & alive;
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let spread = Spread::<L>::new(r, tile);
        // dα/d(mean) / α, for the absolute sums: the exponent's derivative in natural units.
        let ln2 = std::f32::consts::LN_2;
        let (a, b, c) = (r[at::A], r[at::B], r[at::C]);
        let (a2, b1, c2) =
            (L::splat(2.0 * ln2 * a * a), L::splat(2.0 * ln2 * a * b), L::splat(2.0 * ln2 * (b * b + c * c)));
        spread.alphas(blocks, lane_x, lane_y, &mut alphas);
        let (mut unblended, mut unsummed) = (blocks, blocks);
        while unblended != 0 {
            let b = unblended.trailing_zeros() as usize & (BLOCKS - 1);
            unblended &= unblended - 1;
            let alpha = L::load(&alphas[b]);
            let t = L::load(&live[b]);
            let weight = alpha * t;
            let next = t - weight;
            let end = L::splat(TRANSMITTANCE_MIN);
            let weight = weight.unless_le(next, end);
            next.unless_le(next, end).store(&mut live[b]);
            if next.all_le(end) {
                cold_path();
                alive &= !(1 << b);
            }
            let mut along = L::load(&d_colour[0][b]).fma(
                L::splat(r[at::RED]),
                L::load(&d_colour[1][b]).fma(L::splat(r[at::GREEN]), L::load(&d_colour[2][b]) * L::splat(r[at::BLUE])),
            );
            if DEPTH {
                along = L::load(&d_depth[b]).fma(L::splat(r[at::Z]), along);
            }
            let rest = L::load(&behind[b]) - weight * along;
            rest.store(&mut behind[b]);
            if !pair.own {
                continue;
            }
            // α dL/dα = α (T·along - rest / (1 - α)); zero where clamped, finished or skipped.
            let d_alpha = t * along - rest * (L::splat(1.0) - alpha).recip();
            let v = (alpha * d_alpha).unless_le(next, end).unless_le(L::splat(ALPHA_MAX), alpha);
            v.store(&mut vs[b]);
            weight.store(&mut weights[b]);
        }
        if !pair.own {
            continue;
        }
        let mut sums = [L::zero(); 16];
        // A loop of its own, so that the sums stay in registers.
        while unsummed != 0 {
            let b = unsummed.trailing_zeros() as usize & (BLOCKS - 1);
            unsummed &= unsummed - 1;
            let (v, weight) = (L::load(&vs[b]), L::load(&weights[b]));
            let (dx, dy) = spread.offset(b, lane_x, lane_y);
            let (vx, vy) = (v * dx, v * dy);
            sums[moment::V] = sums[moment::V] + v;
            sums[moment::VX] = sums[moment::VX] + vx;
            sums[moment::VY] = sums[moment::VY] + vy;
            sums[moment::VXX] = vx.fma(dx, sums[moment::VXX]);
            sums[moment::VXY] = vx.fma(dy, sums[moment::VXY]);
            sums[moment::VYY] = vy.fma(dy, sums[moment::VYY]);
            for c in 0..3 {
                sums[moment::RED + c] = weight.fma(L::load(&d_colour[c][b]), sums[moment::RED + c]);
            }
            if DEPTH {
                sums[moment::Z] = weight.fma(L::load(&d_depth[b]), sums[moment::Z]);
            }
            sums[moment::WEIGHT] = sums[moment::WEIGHT] + weight;
            sums[moment::ABS_X] = sums[moment::ABS_X] + a2.fma(vx, b1 * vy).abs();
            sums[moment::ABS_Y] = sums[moment::ABS_Y] + c2.fma(vy, b1 * vx).abs();
        }
        L::sums(&sums).store(&mut out.0);
    }
}
