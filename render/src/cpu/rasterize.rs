//! Stage `rasterize`: blends the pairs of a tile front to back, sixteen pixels (a 4×4 block) at a time, until every
//! pixel is finished.

use std::hint::cold_path;

use super::project::at;
use super::simd::Lanes;
use super::tile::{BLOCKS, PREFETCH_DISTANCE, Plane, SplatLanes, TileInput, lane_offsets};
use crate::{TRANSMITTANCE_MIN, kernel};

/// The pixels of a tile row: sixteen rows of every plane of a frame.
pub(crate) struct Band<'a> {
    pub(crate) colour: [&'a mut [f32]; 3],
    pub(crate) transmittance: &'a mut [f32],
    /// Empty without extras.
    pub(crate) depth: &'a mut [f32],
    /// Empty without extras.
    pub(crate) trainable_alpha: &'a mut [f32],
}

/// Work of a tile until all its pixels were finished.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Visited {
    /// Pairs visited.
    pub(crate) pairs: u32,
    /// (pair, block) combinations evaluated.
    pub(crate) blocks: u32,
}

kernel!(
    /// Draws a tile into its tile row.
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
    // Transmittance of each pixel; negated once the pixel is finished, to keep its final value.
    let (mut live, mut alive) = tile.start();
    let mut colour = [Plane::filled(0.0); 3];
    let mut depth = Plane::filled(0.0);
    let mut trainable_alpha = Plane::filled(0.0);
    let mut alphas = Plane::filled(0.0);
    let (lane_x, lane_y) = lane_offsets::<L>();

    let mut visited = Visited::default();
    for (n, pair) in tile.pairs.iter().enumerate() {
        if alive == 0 {
            break;
        }
        tile.prefetch_pair(n + PREFETCH_DISTANCE);
        visited.pairs += 1;
        let mut blocks = u32::from(pair.blocks) & alive;
        visited.blocks += blocks.count_ones();
        if blocks == 0 {
            continue;
        }
        let r = &tile.ranked[pair.rank as usize].0;
        let lanes = SplatLanes::<L>::new(r, tile);
        lanes.alphas(blocks, lane_x, lane_y, &mut alphas);
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
                weight.fma(L::splat(r[at::TRAINABLE]), L::load(&trainable_alpha[b])).store(&mut trainable_alpha[b]);
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
        tile.scatter(&trainable_alpha, band.trainable_alpha);
    }
    visited
}
