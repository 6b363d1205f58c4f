//! What the backward stages before `project_backward` came to, read back for comparing.

use super::*;
use crate::Moments;

impl GpuRenderer {
    /// The moments of the last [`backward`](Self::backward), once it is done.
    ///
    /// # Errors
    /// What went wrong until then, or unless it was of one view.
    pub fn read_moments(&self) -> Result<Moments, GpuError> {
        let (views, side) = self.only_view("moments")?;
        const WORDS: usize = MOMENTS as usize;
        let (gpu, status) = (&*self.gpu, self.status()?);
        let (seen, pairs) = (status.seen as usize, status.pairs as usize);
        let of_pairs: Vec<[f32; WORDS]> = gpu.read(&self.of_pairs.moments, 0, pairs)?;
        let sums: Vec<[f32; WORDS]> = gpu.read(&self.sums, 0, seen)?;
        let visible: Vec<u32> = gpu.read(&self.of_splats.visible, 0, seen)?;
        let sorted: Vec<u32> = gpu.read(&self.of_pairs.sides.values[side], 0, pairs)?;
        let splats: Vec<u32> = gpu.read(&self.of_pairs.splat, 0, pairs)?;
        let ranges: Vec<[u32; 2]> = gpu.read(&self.tile_ranges, 0, views.tiles as usize)?;
        let of_tile = |(tile, [from, to]): (usize, [u32; 2])| {
            let pairs = sorted[from as usize..to as usize].iter().map(|&pair| pair as usize);
            pairs.map(|pair| (tile as u32, splats[pair], of_pairs[pair])).collect::<Vec<_>>()
        };
        let all = ranges.into_iter().enumerate().flat_map(of_tile);
        Ok(Moments {
            pairs: all.filter(|(_, splat, _)| *splat < views.own).collect(),
            splats: visible.into_iter().zip(sums).collect(),
        })
    }
}
