//! Level-of-detail cuts: which blocks of the tree stand for which part of the plane.
//!
//! The same rule chooses what a block trains against (its context) and what a viewer shows: full detail nearby, one
//! level coarser with every doubling of the distance.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::{BlockId, Splats};

use crate::ground::Ground;

/// A set of blocks that stand for the whole plane: the deepest block around a place owns it.
///
/// Of a block only the splats that it owns here count ([`Cut::keep`]), so a place never shows twice, even where a
/// coarse block fills in for finer ones that do not exist.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Cut {
    /// Region -> the block that owns it, unless a deeper region says otherwise.
    regions: BTreeMap<BlockId, BlockId>,
    deepest: u8,
}

impl FromIterator<BlockId> for Cut {
    /// A cut of these blocks, each owning its own core but for the members within.
    fn from_iter<T: IntoIterator<Item = BlockId>>(blocks: T) -> Self {
        Self::from_regions(blocks.into_iter().map(|b| (b, b)))
    }
}

impl Cut {
    fn from_regions(regions: impl Iterator<Item = (BlockId, BlockId)>) -> Self {
        let regions: BTreeMap<_, _> = regions.collect();
        let deepest = regions.keys().map(|b| b.level).max().unwrap_or(0);
        Self { regions, deepest }
    }

    /// A cut of blocks none of which lies inside another, where the gaps between them go to the block with the
    /// nearest centre (ties to the lowest id). A gap is decided as the largest empty square of the tree.
    pub fn nearest(ground: &Ground, blocks: impl IntoIterator<Item = BlockId>) -> Self {
        let blocks: BTreeSet<BlockId> = blocks.into_iter().collect();
        let mut inner: BTreeSet<BlockId> = BTreeSet::new();
        for block in &blocks {
            inner.extend((0..block.level).map(|level| block.ancestor(level)));
        }
        let mut regions: BTreeMap<BlockId, BlockId> = blocks.iter().map(|&b| (b, b)).collect();
        for gap in inner.iter().flat_map(|b| b.children()).filter(|b| !inner.contains(b) && !blocks.contains(b)) {
            let centre = ground.core(gap).centre();
            let distance = |b: &BlockId| ground.core(*b).centre().distance_squared(centre);
            if let Some(&owner) = blocks.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.cmp(b))) {
                regions.insert(gap, owner);
            }
        }
        Self::from_regions(regions.into_iter())
    }

    /// The blocks of the cut, in order.
    pub fn blocks(&self) -> BTreeSet<BlockId> {
        self.regions.values().copied().collect()
    }

    /// Each region with its owner, in order of the region. A region inside another one is taken out of that.
    pub fn regions(&self) -> impl Iterator<Item = (BlockId, BlockId)> {
        self.regions.iter().map(|(&region, &owner)| (region, owner))
    }

    /// The block that owns a place; `None` for a place that is not finite, or in a hole of the cut. What is far belongs to the
    /// root, if that is in the cut, whichever blocks are: no other trains it.
    pub fn owner_of(&self, ground: &Ground, world: DVec3) -> Option<BlockId> {
        if !world.is_finite() {
            return None;
        }
        if let Some(&root) = self.regions.get(&BlockId::ROOT).filter(|_| ground.is_far(world)) {
            return Some(root);
        }
        let cell = ground.block_at(self.deepest, world);
        (0..=self.deepest).rev().find_map(|level| self.regions.get(&cell.ancestor(level)).copied())
    }

    /// The rows of this block's splats that it owns in this cut.
    pub fn keep(&self, splats: &Splats, ground: &Ground, block: BlockId) -> Splats {
        splats.filter(|i| self.owner_of(ground, splats.mean(i).as_dvec3()) == Some(block))
    }
}

/// The level wanted at a distance from something of level `level` whose core has this edge (both metres): one less
/// at once, and one less again with every doubling of the distance.
pub fn wanted_level(level: u8, distance_metres: f64, core_edge_metres: f64) -> u8 {
    let steps = (1.0 + distance_metres / core_edge_metres).log2().floor();
    // `as` saturates: an infinite distance wants level 0.
    level.saturating_sub(1).saturating_sub(steps as u8)
}

/// What a block trains against: the cut, by [`wanted_level`], of the levels above it that exist. With the block's
/// parent (which is left out here) it covers the plane. Where all blocks exist none lies inside another; where some
/// do not, their nearest ancestor is in the cut to fill in. The root is always there, for what is far. Empty for the root.
pub fn context_of(ground: &Ground, block: BlockId, existing: &BTreeSet<BlockId>) -> Vec<BlockId> {
    let (halo, edge) = (ground.nominal_halo(block), ground.core_edge_metres(block.level));
    let mut found = BTreeSet::new();
    let mut open = Vec::from_iter((block.level > 0 && existing.contains(&BlockId::ROOT)).then_some(BlockId::ROOT));
    while let Some(node) = open.pop() {
        let distance = ground.core(node).distance(&halo);
        let split = wanted_level(block.level, distance, edge) > node.level;
        let children = node.children().map(|child| (split && existing.contains(&child)).then_some(child));
        if children.iter().any(Option::is_none) {
            found.insert(node);
        }
        open.extend(children.into_iter().flatten());
    }
    if let Some(parent) = block.parent() {
        found.extend(existing.get(&BlockId::ROOT));
        found.remove(&parent);
    }
    found.into_iter().collect()
}

/// The sweep of its level in which a block is trained, like the fields of a chessboard: no two blocks of one sweep share a face,
/// so a level takes two sweeps and the blocks of each can be trained at once.
pub fn sweep_of(block: BlockId) -> u8 {
    ((block.x ^ block.y) & 1) as u8
}

/// The order of training, and of a plan's tasks: by level, sweep, row, column.
pub fn training_order(block: BlockId) -> (u8, u8, u32, u32) {
    (block.level, sweep_of(block), block.y, block.x)
}

/// The neighbours of `block` on its own level, beyond its faces, that are trained in an earlier sweep. They are final when the block starts:
/// drawn, frozen, as the merged model will have them, so that the block fits what it will stand beside.
pub fn finished_neighbours(block: BlockId, of_level: &BTreeSet<BlockId>) -> impl Iterator<Item = BlockId> {
    let beside = move |b: &BlockId| b.x.abs_diff(block.x) + b.y.abs_diff(block.y) == 1;
    of_level.iter().copied().filter(move |b| b.level == block.level && beside(b) && sweep_of(*b) < sweep_of(block))
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;
    use scene::Splat;

    use super::*;
    use crate::testing::ground;

    fn all(levels: u8) -> BTreeSet<BlockId> {
        let mut blocks = BTreeSet::from([BlockId::ROOT]);
        for _ in 0..levels {
            blocks.extend(blocks.clone().into_iter().flat_map(BlockId::children));
        }
        blocks
    }

    /// Trees with gaps: a block stays only with its parent.
    fn some(levels: u8, keep: &[bool]) -> BTreeSet<BlockId> {
        let mut blocks = BTreeSet::new();
        for (i, block) in all(levels).into_iter().enumerate() {
            if block.parent().is_none_or(|p| blocks.contains(&p) && keep[i % keep.len()]) {
                blocks.insert(block);
            }
        }
        blocks
    }

    fn places() -> impl Iterator<Item = DVec3> {
        (-2..18).flat_map(|y| (-2..18).map(move |x| DVec3::new(f64::from(x) * 4.0, f64::from(y) * 4.0 + 0.1, 0.0)))
    }

    #[test]
    fn a_full_tree_gives_an_exact_cut_that_coarsens_outward() {
        let (ground, existing) = (ground(), all(4));
        for &block in existing.iter().filter(|b| b.level > 0) {
            let context = context_of(&ground, block, &existing);
            let parent = block.parent().unwrap();
            let members: Vec<BlockId> = context.iter().copied().chain([parent]).collect();
            assert!(members.contains(&BlockId::ROOT), "{block}: what is far is missing");
            // Where others cover the plane the root is there for what is far alone.
            let of_ground = |b: &BlockId| b.level > 0 || block.level == 1;
            let members: Vec<BlockId> = members.into_iter().filter(of_ground).collect();
            // Areas add up to the root's, and none lies inside another: an exact cover.
            assert_eq!(members.iter().map(|b| 1u64 << (2 * (8 - b.level))).sum::<u64>(), 1 << 16, "{block}");
            for a in &members {
                assert!(a.level < block.level);
                assert!(members.iter().all(|b| a == b || b.ancestor(a.level) != *a), "{block}: {a} twice");
                let distance = ground.core(*a).distance(&ground.nominal_halo(block));
                assert_eq!(
                    a.level,
                    a.level.max(wanted_level(block.level, distance, ground.core_edge_metres(block.level)))
                );
            }
        }
        assert!(context_of(&ground, BlockId::ROOT, &existing).is_empty());
        let far = context_of(&ground, BlockId { level: 4, x: 0, y: 0 }, &existing);
        assert!(far.iter().any(|b| b.level == 3) && far.iter().any(|b| b.level == 1), "{far:?}");
    }

    #[test]
    fn detail_falls_with_the_doubling_of_distance() {
        let levels = [0.0, 0.9, 1.0, 2.9, 3.0, 7.0, 1e300, f64::INFINITY].map(|d| wanted_level(5, d, 1.0));
        assert_eq!(levels, [4, 4, 3, 3, 2, 1, 0, 0]);
    }

    proptest! {
        #[test]
        fn trees_with_gaps_still_own_every_place_once(keep in prop::collection::vec(any::<bool>(), 3..50)) {
            let (ground, existing) = (ground(), some(4, &keep));
            for &block in existing.iter().filter(|b| b.level > 0) {
                let parent = block.parent().unwrap();
                let context = context_of(&ground, block, &existing);
                prop_assert!(context.iter().all(|b| existing.contains(b) && b.level < block.level && *b != parent));
                let cut: Cut = context.iter().copied().chain([parent]).collect();
                for at in places() {
                    let owner = cut.owner_of(&ground, at).unwrap();
                    prop_assert!(ground.owns(owner, at));
                    // Under the block itself its parent shows, whatever else exists.
                    prop_assert!(!ground.owns(block, at) || owner == parent);
                }
            }
        }

        #[test]
        fn gaps_go_to_the_nearest(picks in prop::collection::btree_set((0u32..8, 0u32..8), 1..20)) {
            let ground = ground();
            let blocks: BTreeSet<BlockId> = picks.into_iter().map(|(x, y)| BlockId { level: 3, x, y }).collect();
            let cut = Cut::nearest(&ground, blocks.iter().copied());
            prop_assert_eq!(&cut.blocks(), &blocks);
            let area: u64 = cut.regions().map(|(region, _)| 1u64 << (2 * (3 - region.level))).sum();
            prop_assert_eq!(area, 64);
            for at in places() {
                let owner = cut.owner_of(&ground, at).unwrap();
                let own = ground.block_at(3, at);
                prop_assert!(!blocks.contains(&own) || owner == own);
            }
        }
    }

    #[test]
    fn keeping_by_cut_partitions_splats() {
        let (ground, blocks) = (ground(), some(3, &[true, false, true, true]));
        let cut: Cut = blocks.iter().copied().collect();
        let mut splats = Splats::new(0);
        for at in places() {
            splats.push(&Splat::round(at.as_vec3(), 0.0, Vec3::ONE, 0.5));
        }
        let kept: usize = blocks.iter().map(|&b| cut.keep(&splats, &ground, b).len()).sum();
        assert_eq!(kept, splats.len());
    }

    #[test]
    fn what_is_far_is_the_roots_alone() {
        let ground = Ground { near_metres: 96.0, ..ground() };
        let cut: Cut = all(2).into_iter().collect();
        let middle = DVec3::new(32.0, 32.0, 0.0);
        let rising = [DVec3::new(1.0, 0.0, 1e-3), DVec3::new(0.0, -1.0, 1e-3), DVec3::Z, DVec3::new(0.6, 0.0, 0.8)];
        for direction in rising.map(DVec3::normalize) {
            let (near, far) = (middle + direction * 95.9, middle + direction * 96.1);
            assert_eq!(cut.owner_of(&ground, near).map(|b| b.level), Some(2));
            assert_eq!(cut.owner_of(&ground, far), Some(BlockId::ROOT));
            // Without a root, as in flat plans, whoever is below.
            let flat = Cut::nearest(&ground, all(2).into_iter().filter(|b| b.level == 2));
            assert_eq!(flat.owner_of(&ground, far), Some(ground.block_at(2, far)));
        }
        // What shows through the ground is its block's.
        for direction in [DVec3::NEG_Z, DVec3::new(0.6, 0.0, -0.8)] {
            assert_eq!(cut.owner_of(&ground, middle + direction * 200.0).map(|b| b.level), Some(2));
        }
        assert_eq!(cut.owner_of(&ground, DVec3::INFINITY), None);
    }
}
