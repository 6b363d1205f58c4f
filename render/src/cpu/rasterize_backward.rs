//! Stage `rasterize_backward`: the gradient moments of each pair of a tile.
//!
//! It walks the pairs front to back like the forward pass and keeps, per pixel, the colour behind the current splat as
//! "final colour minus colour blended so far". So it needs neither a list per pixel nor a back-to-front pass (as in
//! Taming-3DGS and Brush). The gradient of a pair is a few moments, sums over its pixels; the gradients of the conic
//! and of the mean are linear in them.

use std::hint::cold_path;

use super::bin::{Pair, TILE};
use super::project::at;
use super::simd::Lanes;
use super::tile::{BLOCKS, Moments, PREFETCH_DISTANCE, Plane, SplatLanes, TileInput, lane_offsets, moment};
use crate::{ALPHA_MAX, Frame, TRANSMITTANCE_MIN, Upstream, kernel};

/// The last trainable pair of each block: pairs behind it do not affect any gradient of that block. Returns (pair, mask
/// of blocks that end there), ascending and terminated by an unreachable pair, and the mask of all blocks with a
/// trainable pair.
pub(crate) fn last_trainable_pairs(pairs: &[Pair]) -> ([(u32, u32); BLOCKS + 1], u32) {
    let (mut ends, mut first, mut found) = ([(u32::MAX, 0); BLOCKS + 1], BLOCKS, 0);
    for (n, pair) in pairs.iter().enumerate().rev().filter(|(_, pair)| pair.trainable) {
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

/// The pixels of a tile row, of the frame and of the upstream gradient; empty planes are zero.
pub(crate) struct BackwardBand<'a> {
    colour: [&'a [f32]; 3],
    transmittance: &'a [f32],
    depth: &'a [f32],
    trainable_alpha: &'a [f32],
    d_colour: [&'a [f32]; 3],
    d_transmittance: &'a [f32],
    d_depth: &'a [f32],
    d_trainable_alpha: &'a [f32],
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
            trainable_alpha: rows(&frame.trainable_alpha, 0),
            d_colour: [0, 1, 2].map(|c| rows(&upstream.colour, c)),
            d_transmittance: rows(&upstream.transmittance, 0),
            d_depth: rows(&upstream.depth, 0),
            d_trainable_alpha: rows(&upstream.trainable_alpha, 0),
        }
    }
}

kernel!(
    /// Moments of each pair of a tile, into `out` (one element per pair). Pairs that no pixel blends get zeros; pairs
    /// of context splats are not written.
    pub(crate) fn rasterize_backward(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) = rasterize_backward_lanes
);

#[inline(always)]
fn rasterize_backward_lanes<L: Lanes>(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) {
    if band.d_depth.is_empty() && band.d_trainable_alpha.is_empty() {
        rasterize_backward_tile::<L, false>(tile, band, out);
    } else {
        rasterize_backward_tile::<L, true>(tile, band, out);
    }
}

#[inline(always)]
fn rasterize_backward_tile<L: Lanes, const EXTRAS: bool>(tile: &TileInput, band: &BackwardBand, out: &mut [Moments]) {
    let (mut live, mut alive) = tile.start();
    let (ends, with_gradient) = last_trainable_pairs(tile.pairs);
    let mut ended = 0;
    alive &= with_gradient;
    if alive == 0 {
        return out
            .iter_mut()
            .zip(tile.pairs)
            .filter(|(_, pair)| pair.trainable)
            .for_each(|(out, _)| *out = Moments::default());
    }
    let mut d_colour = [Plane::filled(0.0); 3];
    let [mut d_depth, mut d_trainable] = [Plane::filled(0.0); 2];
    for c in 0..3 {
        tile.gather(band.d_colour[c], 1.0, &mut d_colour[c]);
    }
    // Dot product of the upstream gradient with the colour behind the splats blended so far; initially with the final
    // colour.
    let mut behind = Plane::filled(0.0);
    let mut product = |value: &[f32], gradient: &[f32]| {
        if !gradient.is_empty() {
            tile.for_each_run(|block, lane, count, offset| {
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
    if EXTRAS {
        product(band.depth, band.d_depth);
        product(band.trainable_alpha, band.d_trainable_alpha);
        tile.gather(band.d_depth, 1.0, &mut d_depth);
        tile.gather(band.d_trainable_alpha, 1.0, &mut d_trainable);
    }

    let [mut alphas, mut vs, mut weights] = [Plane::filled(0.0); 3];
    let (lane_x, lane_y) = lane_offsets::<L>();
    for (n, (pair, out)) in tile.pairs.iter().zip(out).enumerate() {
        if pair.trainable {
            *out = Moments::default();
        }
        tile.prefetch_pair(n + PREFETCH_DISTANCE);
        if ends[ended].0 < n as u32 {
            alive &= !ends[ended].1;
            ended += 1;
        }
        let blocks = u32::from(pair.blocks) & alive;
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let lanes = SplatLanes::<L>::new(r, tile);
        // (dα/d(mean)) / α for the absolute sums: the derivative of the exponent, converted from base 2.
        let ln2 = std::f32::consts::LN_2;
        let (a, b, c) = (r[at::A], r[at::B], r[at::C]);
        let (a2, b1, c2) =
            (L::splat(2.0 * ln2 * a * a), L::splat(2.0 * ln2 * a * b), L::splat(2.0 * ln2 * (b * b + c * c)));
        lanes.alphas(blocks, lane_x, lane_y, &mut alphas);
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
            let mut d_weight = L::load(&d_colour[0][b]).fma(
                L::splat(r[at::RED]),
                L::load(&d_colour[1][b]).fma(L::splat(r[at::GREEN]), L::load(&d_colour[2][b]) * L::splat(r[at::BLUE])),
            );
            if EXTRAS {
                let d_trainable = L::load(&d_trainable[b]) * L::splat(r[at::TRAINABLE]);
                d_weight = L::load(&d_depth[b]).fma(L::splat(r[at::Z]), d_weight + d_trainable);
            }
            let rest = L::load(&behind[b]) - weight * d_weight;
            rest.store(&mut behind[b]);
            if !pair.trainable {
                continue;
            }
            // v = α dL/dα = α (T dL/dw - rest / (1 - α)); zero where clamped, finished or skipped.
            let d_alpha = t * d_weight - rest * (L::splat(1.0) - alpha).recip();
            let v = (alpha * d_alpha).unless_le(next, end).unless_le(L::splat(ALPHA_MAX), alpha);
            v.store(&mut vs[b]);
            weight.store(&mut weights[b]);
        }
        if !pair.trainable {
            continue;
        }
        let mut sums = [L::zero(); 16];
        // A separate loop keeps the sums in registers.
        while unsummed != 0 {
            let b = unsummed.trailing_zeros() as usize & (BLOCKS - 1);
            unsummed &= unsummed - 1;
            let (v, weight) = (L::load(&vs[b]), L::load(&weights[b]));
            let (dx, dy) = lanes.offset(b, lane_x, lane_y);
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
            if EXTRAS {
                sums[moment::Z] = weight.fma(L::load(&d_depth[b]), sums[moment::Z]);
            }
            sums[moment::WEIGHT] = sums[moment::WEIGHT] + weight;
            sums[moment::ABS_X] = sums[moment::ABS_X] + a2.fma(vx, b1 * vy).abs();
            sums[moment::ABS_Y] = sums[moment::ABS_Y] + c2.fma(vy, b1 * vx).abs();
        }
        L::sums(&sums).store(&mut out.0);
    }
}
