//! Assigns pixels to the band at a face, to the interior, or to neither.

use blocks::ground::HALO_SCALE;
use blocks::{Cut, Seams};
use model::Tree;
use render::Frame;
use scene::{BlockId, Camera, Splats};

use crate::surface::{foreground_test, surface_point};

/// Where the surface point of a pixel lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Region {
    /// Outside the root square, no surface, or masked.
    Neither,
    Interior,
    /// Near a face of the pair with this index; true on the side of the pair's first block.
    Band(u32, bool),
}

/// The faces of a tree's finest cut.
pub(super) struct RegionMap<'a> {
    pub(super) tree: &'a Tree,
    pub(super) leaves: &'a Cut,
    pub(super) seams: &'a Seams,
    pub(super) pairs: &'a [[BlockId; 2]],
    /// Half width of the band.
    pub(super) seam_metres: f64,
}

impl RegionMap<'_> {
    /// The region of each pixel of a frame with depth.
    pub(super) fn regions(&self, frame: &Frame, camera: &Camera) -> Vec<Region> {
        let ground = &self.tree.plan.ground;
        let root = ground.core(BlockId::ROOT);
        let region = |pixel: usize| {
            let Some((point, _)) = surface_point(frame, camera, pixel) else { return Region::Neither };
            let at = ground.from_world(point).truncate();
            if !root.contains(at) {
                return Region::Neither;
            }
            let Some((face, _)) = self.seams.nearest(point, self.seam_metres) else { return Region::Interior };
            let pair = [face.a.min(face.b), face.a.max(face.b)];
            let index = self.pairs.binary_search(&pair).expect("every face belongs to a pair");
            Region::Band(index as u32, face.is_before(at) == (face.a == pair[0]))
        };
        (0..frame.width * frame.height).map(region).collect()
    }

    /// The finest model with `keeper`'s splats in place of the other block's, as far beyond the pair's faces as a halo
    /// reaches. `None` if `keeper` has none there: it was trained against the other's final splats.
    pub(super) fn as_kept_by(&self, finest: &Splats, pair: usize, keeper: BlockId) -> Option<Splats> {
        let ground = &self.tree.plan.ground;
        let [a, b] = self.pairs[pair];
        let other = if keeper == a { b } else { a };
        let task = self.tree.plan.task(keeper)?;
        if other.level >= keeper.level && task.context.contains(&other) {
            return None;
        }
        let reach = 0.5 * (HALO_SCALE - 1.0) * ground.core_edge_metres(a.level.max(b.level));
        let faces = || self.seams.faces().iter().filter(|f| [f.a.min(f.b), f.a.max(f.b)] == [a, b]);
        let is_foreground = foreground_test(finest, ground);
        let is_replaced = |splats: &Splats, i: usize| {
            let mean = splats.mean(i).as_dvec3();
            let at = ground.from_world(mean).truncate();
            self.leaves.owner_of(ground, mean) == Some(other)
                && faces().any(|face| face.distance(at) <= reach)
                && is_foreground(mean)
        };
        let kept = self.tree.results.get(&keeper)?;
        let kept = kept.filter(|i| is_replaced(kept, i));
        let mut splats = finest.filter(|i| !is_replaced(finest, i));
        splats.append(&kept);
        (!kept.is_empty()).then_some(splats)
    }
}
