//! Stages `sort` and `bin`: the depth order of the splats, and for every tile the list of splats that overlap it.
//!
//! A tile is 16×16 pixels, that is sixteen blocks of 4×4 pixels. A pair of splat and tile has a bit for each block that
//! the ellipse at α = 1/255 overlaps; one SIMD test, a lane per block, computes all sixteen bits. So the rasterizer
//! skips the empty corners of the bounding box. Splats are sorted by depth once; pairs are emitted in that order and
//! sorted by tile with a stable counting sort.

use rayon::prelude::*;

use super::counting_sort::{ScatterWriter, offsets, parts};
use super::project::{Projected, at};
use super::simd::{Isa, Lanes};
use crate::kernel;

/// Side of a tile in pixels.
pub(crate) const TILE: usize = 16;

/// A splat in a tile.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Pair {
    /// Rank of the splat in depth order.
    pub(crate) rank: u32,
    /// Bit per 4×4 block that it overlaps.
    pub(crate) blocks: u16,
    /// Whether the splat is trainable.
    pub(crate) trainable: bool,
}

/// The pairs of every tile, front to back.
#[derive(Debug, Default)]
pub(crate) struct Bins {
    pub(crate) tiles_x: usize,
    pub(crate) tiles_y: usize,
    /// `pairs[start[t] .. start[t + 1]]` belong to tile `t` (row-major).
    pub(crate) start: Vec<u32>,
    pub(crate) pairs: Vec<Pair>,
    /// `emitted[r] .. emitted[r + 1]` are the emission numbers of the pairs of rank `r`.
    pub(crate) emitted: Vec<u32>,
    /// Index in `pairs` of the pair with this emission number.
    pub(crate) position: Vec<u32>,
}

/// Sorts the indices of the visible splats by depth, nearest first; ties keep index order. Positive floats sort as
/// their bits.
pub(crate) fn sort_by_depth(projected: &[Projected], seen: &[u16], order: &mut Vec<u32>, scratch: &mut SortScratch) {
    const BITS: u32 = 11;
    const BUCKETS: usize = 1 << BITS;
    let SortScratch { keys, swap } = scratch;
    keys.clear();
    for (word, &bits) in seen.iter().enumerate() {
        let mut bits = bits;
        while bits != 0 {
            let i = word * 16 + bits.trailing_zeros() as usize;
            bits &= bits - 1;
            keys.push((projected[i].0[at::Z].to_bits(), i as u32));
        }
    }
    swap.clear();
    swap.resize(keys.len(), (0, 0));
    let mut counts = [[0u32; BUCKETS]; 3];
    for (key, _) in keys.iter() {
        for (pass, counts) in counts.iter_mut().enumerate() {
            counts[(key >> (BITS * pass as u32)) as usize & (BUCKETS - 1)] += 1;
        }
    }
    for (pass, counts) in counts.iter_mut().enumerate() {
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &(key, i) in keys.iter() {
            let to = &mut counts[(key >> (BITS * pass as u32)) as usize & (BUCKETS - 1)];
            swap[*to as usize] = (key, i);
            *to += 1;
        }
        std::mem::swap(keys, swap);
    }
    order.clear();
    order.extend(keys.iter().map(|&(_, i)| i));
}

/// Buffers of [`sort_by_depth`].
#[derive(Debug, Default)]
pub(crate) struct SortScratch {
    keys: Vec<(u32, u32)>,
    swap: Vec<(u32, u32)>,
}

/// Fills `bins` with the tiles of `width × height` pixels; `ranked` are the records in depth order.
pub(crate) fn bin(isa: Isa, ranked: &[Projected], width: usize, height: usize, bins: &mut Bins) {
    const CHUNK: usize = 2048;
    bins.tiles_x = width.div_ceil(TILE);
    bins.tiles_y = height.div_ceil(TILE);
    let tiles = bins.tiles_x * bins.tiles_y;
    let limit = (bins.tiles_x, bins.tiles_y);
    let emissions: Vec<Emission> = (ranked.par_chunks(CHUNK).enumerate().with_max_len(1))
        .map(|(chunk, records)| {
            let mut out = Emission::default();
            emit(isa, records, (chunk * CHUNK) as u32, limit, &mut out);
            out
        })
        .collect();

    let total = emissions.iter().map(|emission| emission.pairs.len()).sum();
    let part = emissions.len().div_ceil(parts(total)).max(1);
    let counted = emissions.par_chunks(part).map(|part| {
        let mut counts = vec![0; tiles];
        part.iter().flat_map(|emission| &emission.pairs).for_each(|(tile, _)| counts[*tile as usize] += 1);
        counts
    });
    let mut next: Vec<Vec<u32>> = counted.collect();
    bins.start.clear();
    offsets(&mut next, tiles, |start| bins.start.push(start));

    bins.pairs.resize(total, Pair::default());
    bins.position.resize(total, 0);
    bins.emitted.resize(ranked.len() + 1, 0);
    bins.emitted[0] = 0;
    let (mut first, mut position, mut emitted) = (0, &mut bins.position[..], &mut bins.emitted[1..]);
    let mut scatters = Vec::with_capacity(next.len());
    for (part, next) in emissions.chunks(part).zip(next) {
        let pairs: usize = part.iter().map(|emission| emission.pairs.len()).sum();
        let records = part.iter().map(|emission| emission.counts.len()).sum();
        scatters.push(Scatter {
            part,
            next,
            first,
            position: position.split_off_mut(..pairs).expect("as many positions as pairs"),
            emitted: emitted.split_off_mut(..records).expect("as many counts as records"),
        });
        first += pairs as u32;
    }
    let pairs = ScatterWriter::new(&mut bins.pairs);
    scatters.into_par_iter().for_each(|scatter| scatter.run(&pairs));
}

/// The scatter pass of the counting sort over one part of the pairs.
struct Scatter<'a> {
    part: &'a [Emission],
    /// Output position of the next pair of each tile.
    next: Vec<u32>,
    /// Emission number of the first pair.
    first: u32,
    position: &'a mut [u32],
    emitted: &'a mut [u32],
}

impl Scatter<'_> {
    fn run(mut self, pairs: &ScatterWriter<Pair>) {
        let emitted = self.part.iter().flat_map(|emission| &emission.pairs);
        for (&(tile, pair), position) in emitted.zip(self.position) {
            let to = &mut self.next[tile as usize];
            // Safety: the counting pass reserved this range of positions for this tile and part.
            unsafe { pairs.write(*to as usize, pair) };
            *position = *to;
            *to += 1;
        }
        let counts = self.part.iter().flat_map(|emission| &emission.counts);
        for (count, emitted) in counts.zip(self.emitted) {
            self.first += count;
            *emitted = self.first;
        }
    }
}

/// The pairs of a chunk of splats, in depth order, and the number of pairs of each splat.
#[derive(Default)]
struct Emission {
    pairs: Vec<(u32, Pair)>,
    counts: Vec<u32>,
}

kernel!(fn emit(records: &[Projected], first_rank: u32, tiles: (usize, usize), out: &mut Emission) = emit_lanes);

#[inline(always)]
fn emit_lanes<L: Lanes>(records: &[Projected], first_rank: u32, tiles: (usize, usize), out: &mut Emission) {
    // Pixel centres at the left and top of the sixteen blocks of a tile.
    let (mut block_x, mut block_y) = ([0.5; 16], [0.5; 16]);
    for b in 0..16 {
        block_x[b] += (b % 4 * 4) as f32;
        block_y[b] += (b / 4 * 4) as f32;
    }
    let (block_x, block_y) = (L::load(&block_x), L::load(&block_y));
    let three = L::splat(3.0);
    for (n, Projected(r)) in records.iter().enumerate() {
        let before = out.pairs.len();
        let span = |centre: f32, half: f32, tiles: usize| {
            // The cast saturates, which clips huge and negative extents to the image.
            let first = ((centre - half - 0.5) / TILE as f32).max(0.0) as usize;
            let last = ((centre + half - 0.5) / TILE as f32).max(0.0) as usize;
            first..(last + 1).min(tiles)
        };
        let columns = span(r[at::X], r[at::HALF_WIDTH], tiles.0);
        let rows = span(r[at::Y], r[at::HALF_HEIGHT], tiles.1);
        let (a, b, c) = (L::splat(r[at::A]), L::splat(r[at::B]), L::splat(r[at::C]));
        // Position of the largest exponent on a vertical line (times x) and on a horizontal line (times y).
        let on_column = L::splat(-r[at::A] * r[at::B] / (r[at::B] * r[at::B] + r[at::C] * r[at::C]));
        let on_row = L::splat(-r[at::B] / r[at::A]);
        // The exponent must reach log2(α_min). The slack covers rounding; the rasterizer tests each pixel itself.
        let reach = L::splat(r[at::LOG2_OPACITY] - crate::ALPHA_MIN.log2() + 1e-3);
        for row in rows {
            let y0 = block_y + L::splat((row * TILE) as f32 - r[at::Y]);
            let y1 = y0 + three;
            let y_near = y0.max(L::zero().min(y1));
            for column in columns.clone() {
                let x0 = block_x + L::splat((column * TILE) as f32 - r[at::X]);
                let x1 = x0 + three;
                let x_near = x0.max(L::zero().min(x1));
                // The largest exponent over a block lies on the vertical or horizontal line nearest to the mean.
                let y = (on_column * x_near).max(y0).min(y1);
                let (u, v) = (a.fma(x_near, b * y), c * y);
                let on_vertical = u.fma(u, v * v);
                let x = (on_row * y_near).max(x0).min(x1);
                let (u, v) = (a.fma(x, b * y_near), c * y_near);
                let on_horizontal = u.fma(u, v * v);
                let blocks = on_vertical.min(on_horizontal).le(reach);
                if blocks != 0 {
                    let tile = (row * tiles.0 + column) as u32;
                    out.pairs
                        .push((tile, Pair { rank: first_rank + n as u32, blocks, trainable: r[at::TRAINABLE] > 0.0 }));
                }
            }
        }
        out.counts.push((out.pairs.len() - before) as u32);
    }
}
