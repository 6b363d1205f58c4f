//! Stage `contribute`: what each splat means to a view, for pruning.
//!
//! A pixel's colour is affine in the α of each of its splats, so what the pixel would be without one splat is known
//! exactly from one front-to-back walk: `δ = -α·dI/dα`, with `dI/dα = T·c - (what lies behind) / (1 - α)`. All sums here are
//! over pixels, of squares, which a gradient of the loss (a sum of signed terms) cannot give.

use std::hint::cold_path;

use rayon::prelude::*;

use super::bin::TILE;
use super::project::at;
use super::rasterize::{AHEAD, BLOCKS, Moments, Plane, Spread, TileInput, lane_offsets};
use super::simd::Lanes;
use super::{CHUNK, Renderer, simd};
use crate::{Contributions, TRANSMITTANCE_MIN, each, kernel};

/// Places of the sums in a pair's entry.
mod sum {
    pub(super) const WEIGHT: usize = 0;
    pub(super) const SQUARED: usize = 1;
    pub(super) const ENERGY: usize = 2;
}

impl Renderer {
    /// What each trainable splat of the last [`forward`](Self::forward) means to that view. `weights` is what each pixel
    /// counts, one plane, empty where all count 1.
    ///
    /// # Panics
    /// Without a forward pass before, or with a plane of another size: both are errors of the caller.
    pub fn contributions(&mut self, weights: &[f32]) -> &Contributions {
        let (_, _, count) = self.drawn.expect("contributions follows forward");
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
                contribute(self.isa, tile, &band, out);
            },
        );
        self.gather_contributions(count);
        &self.contributions
    }

    /// Adds up the pairs of each splat, in the order of its tiles.
    fn gather_contributions(&mut self, count: usize) {
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
                    for &place in &bins.place[bins.emitted[rank] as usize..bins.emitted[rank + 1] as usize] {
                        total.iter_mut().zip(&moments[place as usize].0).for_each(|(total, part)| *total += part);
                    }
                }
                weight[n] = total[sum::WEIGHT];
                squared[n] = total[sum::SQUARED];
                energy[n] = total[sum::ENERGY];
            }
        });
    }
}

/// Sixteen rows of what the sums are made of.
struct Band<'a> {
    colour: [&'a [f32]; 3],
    /// Empty where all pixels count 1.
    weights: &'a [f32],
}

kernel!(fn contribute(tile: &TileInput, band: &Band, out: &mut [Moments]) = contribute_lanes);

#[inline(always)]
fn contribute_lanes<L: Lanes>(tile: &TileInput, band: &Band, out: &mut [Moments]) {
    let (mut live, mut alive) = tile.start();
    // The colour behind the splats seen so far; at first all of it.
    let mut behind = [Plane::filled(0.0); 3];
    let mut weights = Plane::filled(1.0);
    for c in 0..3 {
        tile.gather(band.colour[c], 1.0, &mut behind[c]);
    }
    tile.gather(band.weights, 1.0, &mut weights);

    let mut alphas = Plane::filled(0.0);
    let (lane_x, lane_y) = lane_offsets::<L>();
    for (n, (pair, out)) in tile.pairs.iter().zip(out).enumerate() {
        tile.fetch(n + AHEAD);
        *out = Moments::default();
        let mut blocks = u32::from(pair.blocks) & alive;
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let spread = Spread::<L>::new(r, tile);
        let own = r[at::OWN] > 0.0;
        let opacity = L::splat(r[at::LOG2_OPACITY]).exp2();
        spread.alphas(blocks, lane_x, lane_y, &mut alphas);
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
            let rest = each!(c in [0, 1, 2] => {
                let rest = L::load(&behind[c][b]) - weight * L::splat(r[at::RED + c]);
                rest.store(&mut behind[c][b]);
                rest
            });
            if !own {
                continue;
            }
            // The pixel's change with α, and without the splat.
            let open = (L::splat(1.0) - alpha).recip();
            let d = each!(c in [0, 1, 2] => {
                (t * L::splat(r[at::RED + c]) - rest[c] * open).unless_le(next, end).unless_le(alpha, L::zero())
            });
            let count = L::load(&weights[b]);
            let d2 = count * d[0].fma(d[0], d[1].fma(d[1], d[2] * d[2]));
            sums[sum::WEIGHT] = count.fma(weight, sums[sum::WEIGHT]);
            sums[sum::SQUARED] = (opacity * opacity).fma(d2, sums[sum::SQUARED]);
            sums[sum::ENERGY] = (alpha * alpha).fma(d2, sums[sum::ENERGY]);
        }
        if own {
            L::sums(&sums).store(&mut out.0);
        }
    }
}
