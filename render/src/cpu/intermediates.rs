//! Intermediate results of the last view, for comparing backends stage by stage.

use super::project::{Projected, at};
use super::{Renderer, simd, tile};
use crate::{BackwardIntermediates, ForwardIntermediates, MOMENTS};

impl Renderer {
    /// Results of the stages before `rasterize` of the last [`forward`](Self::forward).
    pub fn forward_intermediates(&self) -> ForwardIntermediates {
        let trainable = self.last_forward.map_or(0, |(.., trainable)| trainable as u32);
        let first_context = trainable.next_multiple_of(simd::LANES as u32);
        let record = |Projected(r): &Projected| {
            use at::{A, B, BLUE, C, GREEN, HALF_HEIGHT, HALF_WIDTH, LOG2_OPACITY, RED, X, Y, Z};
            [X, Y, A, B, C, LOG2_OPACITY, RED, GREEN, BLUE, Z, HALF_WIDTH, HALF_HEIGHT].map(|k| r[k])
        };
        let index = |&i: &u32| if i < trainable { i } else { i - first_context + trainable };
        ForwardIntermediates {
            order: self.order.iter().map(index).collect(),
            records: self.ranked.iter().map(record).collect(),
            start: self.bins.start.clone(),
            pairs: self.bins.pairs.iter().map(|pair| pair.rank).collect(),
        }
    }

    /// Moments of the last [`backward`](Self::backward).
    pub fn backward_intermediates(&self) -> BackwardIntermediates {
        let trainable = self.last_forward.map_or(0, |(.., trainable)| trainable as u32);
        let values = |moments: &tile::Moments| std::array::from_fn::<f32, MOMENTS, _>(|k| moments.0[k]);
        let bins = &self.bins;
        let of_tile = |tile: usize| {
            let range = bins.start[tile] as usize..bins.start[tile + 1] as usize;
            let pairs = bins.pairs[range.clone()].iter().zip(&self.moments[range]);
            pairs.map(move |(pair, moments)| (tile as u32, self.order[pair.rank as usize], values(moments)))
        };
        let all = (0..bins.start.len().saturating_sub(1)).flat_map(of_tile);
        let mut visible: Vec<u32> = self.order.iter().copied().filter(|&i| i < trainable).collect();
        visible.sort_unstable();
        BackwardIntermediates {
            pairs: all.filter(|(_, splat, _)| *splat < trainable).collect(),
            splats: visible.into_iter().map(|i| (i, values(&self.sums[self.rank[i as usize] as usize]))).collect(),
        }
    }
}
