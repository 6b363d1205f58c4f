//! Contribution of each splat to a view, as a pruning score.
//!
//! A pixel's colour is affine in the α of each of its splats. So one front-to-back pass gives the exact change of the
//! pixel if a splat is removed: `δ = -α·dI/dα`, with `dI/dα = T·c - (colour behind) / (1 - α)`. The scores are sums of
//! squares over pixels; a loss gradient cannot provide them, as it sums signed terms.

use std::hint::cold_path;

use rayon::prelude::*;

use super::bin::TILE;
use super::project::at;
use super::simd::Lanes;
use super::tile::{BLOCKS, Moments, PREFETCH_DISTANCE, Plane, SplatLanes, TileInput, lane_offsets};
use super::{CHUNK, Renderer, simd};
use crate::{Contributions, TRANSMITTANCE_MIN, kernel, unroll};

/// Indices of the sums in a pair's moments.
mod sum {
    pub(super) const WEIGHT: usize = 0;
    pub(super) const SQUARED: usize = 1;
    pub(super) const ENERGY: usize = 2;
}

impl Renderer {
    /// Contributions of the trainable splats to the view of the last [`forward`](Self::forward). `weights` is one plane
    /// of pixel weights; empty: all weights are 1.
    ///
    /// # Panics
    /// Without a forward pass before, or if the plane has another size than the frame.
    pub fn contributions(&mut self, weights: &[f32]) -> &Contributions {
        let (_, _, count) = self.last_forward.expect("contributions follows forward");
        let area = self.frame.width * self.frame.height;
        assert!(weights.is_empty() || weights.len() == area, "a plane of the frame's size");
        let rows = |row: usize, plane: usize| {
            let end = area.min((row + 1) * TILE * self.frame.width);
            plane * area + row * TILE * self.frame.width..plane * area + end
        };
        let frame = &self.frame;
        self.bins.for_each_tile(
            &self.ranked,
            &self.visited,
            &mut self.moments,
            frame.width,
            frame.height,
            |row, tile, out| {
                let band = Band {
                    colour: [0, 1, 2].map(|c| &frame.colour[rows(row, c)]),
                    weights: if weights.is_empty() { weights } else { &weights[rows(row, 0)] },
                };
                contributions(self.isa, tile, &band, out);
            },
        );
        self.reduce_contributions(count);
        &self.contributions
    }

    /// Sums the pairs of each splat, in the order of its tiles.
    fn reduce_contributions(&mut self, count: usize) {
        self.rank_splats();
        let out = &mut self.contributions;
        for column in [&mut out.weight, &mut out.squared, &mut out.energy] {
            column.resize(count, 0.0);
        }
        let (bins, seen, rank, moments) = (&self.bins, &self.seen, &self.rank, &self.moments);
        let columns = out.weight.par_chunks_mut(CHUNK).zip(out.squared.par_chunks_mut(CHUNK));
        let columns = columns.zip(out.energy.par_chunks_mut(CHUNK));
        columns.enumerate().for_each(|(chunk, ((weight, squared), energy))| {
            for n in 0..weight.len() {
                let i = chunk * CHUNK + n;
                let mut total = [0.0f32; 3];
                if seen[i / simd::LANES] >> (i % simd::LANES) & 1 == 1 {
                    let rank = rank[i] as usize;
                    for &position in &bins.position[bins.emitted[rank] as usize..bins.emitted[rank + 1] as usize] {
                        total.iter_mut().zip(&moments[position as usize].0).for_each(|(total, part)| *total += part);
                    }
                }
                weight[n] = total[sum::WEIGHT];
                squared[n] = total[sum::SQUARED];
                energy[n] = total[sum::ENERGY];
            }
        });
    }
}

/// The rows of a tile row.
struct Band<'a> {
    colour: [&'a [f32]; 3],
    /// Pixel weights; empty: all are 1.
    weights: &'a [f32],
}

kernel!(fn contributions(tile: &TileInput, band: &Band, out: &mut [Moments]) = contributions_lanes);

#[inline(always)]
fn contributions_lanes<L: Lanes>(tile: &TileInput, band: &Band, out: &mut [Moments]) {
    let (mut live, mut alive) = tile.start();
    // The colour behind the splats blended so far; initially the pixel's final colour.
    let mut behind = [Plane::filled(0.0); 3];
    let mut weights = Plane::filled(1.0);
    for c in 0..3 {
        tile.gather(band.colour[c], 1.0, &mut behind[c]);
    }
    tile.gather(band.weights, 1.0, &mut weights);

    let mut alphas = Plane::filled(0.0);
    let (lane_x, lane_y) = lane_offsets::<L>();
    for (n, (pair, out)) in tile.pairs.iter().zip(out).enumerate() {
        tile.prefetch_pair(n + PREFETCH_DISTANCE);
        *out = Moments::default();
        let mut blocks = u32::from(pair.blocks) & alive;
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let lanes = SplatLanes::<L>::new(r, tile);
        let trainable = r[at::TRAINABLE] > 0.0;
        let opacity = L::splat(r[at::LOG2_OPACITY]).exp2();
        lanes.alphas(blocks, lane_x, lane_y, &mut alphas);
        let mut sums = [L::zero(); 16];
        while blocks != 0 {
            let b = blocks.trailing_zeros() as usize & (BLOCKS - 1);
            blocks &= blocks - 1;
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
            let rest = unroll!(c in [0, 1, 2] => {
                let rest = L::load(&behind[c][b]) - weight * L::splat(r[at::RED + c]);
                rest.store(&mut behind[c][b]);
                rest
            });
            if !trainable {
                continue;
            }
            // dI/dα of the pixel.
            let inv_open = (L::splat(1.0) - alpha).recip();
            let d = unroll!(c in [0, 1, 2] => {
                (t * L::splat(r[at::RED + c]) - rest[c] * inv_open).unless_le(next, end).unless_le(alpha, L::zero())
            });
            let count = L::load(&weights[b]);
            let d2 = count * d[0].fma(d[0], d[1].fma(d[1], d[2] * d[2]));
            sums[sum::WEIGHT] = count.fma(weight, sums[sum::WEIGHT]);
            sums[sum::SQUARED] = (opacity * opacity).fma(d2, sums[sum::SQUARED]);
            sums[sum::ENERGY] = (alpha * alpha).fma(d2, sums[sum::ENERGY]);
        }
        if trainable {
            L::sums(&sums).store(&mut out.0);
        }
    }
}
