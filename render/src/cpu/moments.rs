//! What the backward stages before `project_backward` came to, for comparing.

use super::*;
use crate::{MOMENTS, Moments};

impl Renderer {
    /// The moments of the last [`backward`](Self::backward).
    pub fn moments(&self) -> Moments {
        let own = self.drawn.map_or(0, |(.., own)| own as u32);
        let first = |moments: &rasterize::Moments| std::array::from_fn::<f32, MOMENTS, _>(|k| moments.0[k]);
        let bins = &self.bins;
        let of_tile = |tile: usize| {
            let range = bins.start[tile] as usize..bins.start[tile + 1] as usize;
            let pairs = bins.pairs[range.clone()].iter().zip(&self.moments[range]);
            pairs.map(move |(pair, moments)| (tile as u32, self.order[pair.rank as usize], first(moments)))
        };
        let all = (0..bins.start.len().saturating_sub(1)).flat_map(of_tile);
        let mut seen: Vec<u32> = self.order.iter().copied().filter(|&i| i < own).collect();
        seen.sort_unstable();
        Moments {
            pairs: all.filter(|(_, splat, _)| *splat < own).collect(),
            splats: seen.into_iter().map(|i| (i, first(&self.sums[self.rank[i as usize] as usize]))).collect(),
        }
    }
}
