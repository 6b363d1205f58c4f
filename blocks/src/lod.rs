//! Level-of-detail cuts of the block tree, and the context and training order that follow from them.
//!
//! Training context and viewer use the same rule: full detail nearby, one level coarser with every doubling of the
//! distance.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::{BlockId, Splats};

use crate::ground::{Ground, Square};

/// A set of blocks that represents the whole plane. The deepest block that contains a place owns it.
///
/// A block contributes only the splats that it owns in the cut ([`Cut::keep`]). No place is rendered twice, also where
/// a coarse block fills in for finer blocks that do not exist.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Cut {
    /// Region -> its owner. A deeper region inside takes precedence.
    regions: BTreeMap<BlockId, BlockId>,
    deepest: u8,
}

impl FromIterator<BlockId> for Cut {
    /// The cut of these blocks. Each owns its core without the cores of deeper members.
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

    /// The cut of disjoint blocks in which gaps belong to the block with the nearest centre (ties: the lowest id). Each
    /// gap is the largest empty square of the tree and has one owner.
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

    /// The blocks of the cut, sorted.
    pub fn blocks(&self) -> BTreeSet<BlockId> {
        self.regions.values().copied().collect()
    }

    /// Each region with its owner, sorted by region. A region excludes the regions inside it.
    pub fn regions(&self) -> impl Iterator<Item = (BlockId, BlockId)> {
        self.regions.iter().map(|(&region, &owner)| (region, owner))
    }

    /// The block that owns a place (world metres). `None` if the place is not finite or in a hole of the cut.
    /// Background belongs to the root if the root is in the cut, because no other block trains it.
    pub fn owner_of(&self, ground: &Ground, world: DVec3) -> Option<BlockId> {
        if !world.is_finite() {
            return None;
        }
        if let Some(&root) = self.regions.get(&BlockId::ROOT).filter(|_| ground.is_background(world)) {
            return Some(root);
        }
        let cell = ground.block_at(self.deepest, world);
        (0..=self.deepest).rev().find_map(|level| self.regions.get(&cell.ancestor(level)).copied())
    }

    /// The rows of the block's splats that the block owns in this cut.
    pub fn keep(&self, splats: &Splats, ground: &Ground, block: BlockId) -> Splats {
        splats.filter(|i| self.owner_of(ground, splats.mean(i).as_dvec3()) == Some(block))
    }
}

/// The level of the context at a distance from the halo of a block of level `level` (distance and core edge in metres):
/// one level coarser than the block immediately outside, and another level coarser with every doubling of the distance.
pub fn target_level(level: u8, distance_metres: f64, core_edge_metres: f64) -> u8 {
    let steps = (1.0 + distance_metres / core_edge_metres).log2().floor();
    // `as` saturates: an infinite distance gives level 0.
    level.saturating_sub(1).saturating_sub(steps as u8)
}

/// The coarser context of a block: the cut of the existing coarser levels by [`target_level`], without the block's
/// parent.
///
/// Together with the parent the context covers the plane. In a complete tree its blocks are disjoint. Where blocks are
/// missing, their nearest ancestor fills in. The root is always a member, for the background. The context of the root
/// is empty.
pub fn context_of(ground: &Ground, block: BlockId, existing: &BTreeSet<BlockId>) -> Vec<BlockId> {
    if block.level == 0 {
        return Vec::new();
    }
    let (halo, edge) = (ground.nominal_halo(block), ground.core_edge_metres(block.level));
    let mut found = cut_around(ground, &halo, block.level, edge, existing);
    if let Some(parent) = block.parent() {
        found.extend(existing.get(&BlockId::ROOT));
        found.remove(&parent);
    }
    found.into_iter().collect()
}

/// The cut of the existing blocks by [`target_level`] around a square: blocks that touch it are of the level above `level`, if they
/// exist.
pub(crate) fn cut_around(
    ground: &Ground,
    square: &Square,
    level: u8,
    edge_metres: f64,
    existing: &BTreeSet<BlockId>,
) -> BTreeSet<BlockId> {
    let mut found = BTreeSet::new();
    let mut open = Vec::from_iter(existing.get(&BlockId::ROOT).copied());
    while let Some(node) = open.pop() {
        let distance = ground.core(node).distance(square);
        let split = target_level(level, distance, edge_metres) > node.level;
        let children = node.children().map(|child| (split && existing.contains(&child)).then_some(child));
        if children.iter().any(Option::is_none) {
            found.insert(node);
        }
        open.extend(children.into_iter().flatten());
    }
    found
}

/// The sweep, 0 or 1, in which a block is trained: a red-black (checkerboard) colouring of its level. Blocks of one
/// sweep share no face, so all of them can be trained concurrently.
pub fn sweep_of(block: BlockId) -> u8 {
    ((block.x ^ block.y) & 1) as u8
}

/// The sort key of training and of a plan's tasks: level, sweep, row, column.
pub fn training_order(block: BlockId) -> (u8, u8, u32, u32) {
    (block.level, sweep_of(block), block.y, block.x)
}

/// The face neighbours of `block` on its own level that are trained in an earlier sweep. They are final when the block
/// starts, and are rendered frozen as in the merged model, so that the block fits its neighbours at the seam.
pub fn finished_neighbours(block: BlockId, of_level: &BTreeSet<BlockId>) -> impl Iterator<Item = BlockId> {
    let is_face_neighbour = move |b: &BlockId| b.x.abs_diff(block.x) + b.y.abs_diff(block.y) == 1;
    of_level
        .iter()
        .copied()
        .filter(move |b| b.level == block.level && is_face_neighbour(b) && sweep_of(*b) < sweep_of(block))
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

    /// Trees with gaps: a block exists only if its parent does.
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
            assert!(members.contains(&BlockId::ROOT), "{block}: the background is missing");
            // In a complete cover the root only owns the background.
            let of_ground = |b: &BlockId| b.level > 0 || block.level == 1;
            let members: Vec<BlockId> = members.into_iter().filter(of_ground).collect();
            // The areas add up to the root's and the blocks are disjoint: an exact cover.
            assert_eq!(members.iter().map(|b| 1u64 << (2 * (8 - b.level))).sum::<u64>(), 1 << 16, "{block}");
            for a in &members {
                assert!(a.level < block.level);
                assert!(members.iter().all(|b| a == b || b.ancestor(a.level) != *a), "{block}: {a} twice");
                let distance = ground.core(*a).distance(&ground.nominal_halo(block));
                assert_eq!(
                    a.level,
                    a.level.max(target_level(block.level, distance, ground.core_edge_metres(block.level)))
                );
            }
        }
        assert!(context_of(&ground, BlockId::ROOT, &existing).is_empty());
        let far = context_of(&ground, BlockId { level: 4, x: 0, y: 0 }, &existing);
        assert!(far.iter().any(|b| b.level == 3) && far.iter().any(|b| b.level == 1), "{far:?}");
    }

    #[test]
    fn the_level_falls_with_every_doubling_of_the_distance() {
        let levels = [0.0, 0.9, 1.0, 2.9, 3.0, 7.0, 1e300, f64::INFINITY].map(|d| target_level(5, d, 1.0));
        assert_eq!(levels, [4, 4, 3, 3, 2, 1, 0, 0]);
    }

    proptest! {
        #[test]
        fn trees_with_gaps_own_every_place_once(keep in prop::collection::vec(any::<bool>(), 3..50)) {
            let (ground, existing) = (ground(), some(4, &keep));
            for &block in existing.iter().filter(|b| b.level > 0) {
                let parent = block.parent().unwrap();
                let context = context_of(&ground, block, &existing);
                prop_assert!(context.iter().all(|b| existing.contains(b) && b.level < block.level && *b != parent));
                let cut: Cut = context.iter().copied().chain([parent]).collect();
                for at in places() {
                    let owner = cut.owner_of(&ground, at).unwrap();
                    prop_assert!(ground.owns(owner, at));
                    // The block's own core belongs to its parent.
                    prop_assert!(!ground.owns(block, at) || owner == parent);
                }
            }
        }

        #[test]
        fn gaps_belong_to_the_nearest_block(picks in prop::collection::btree_set((0u32..8, 0u32..8), 1..20)) {
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
    fn keep_partitions_splats() {
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
    fn the_background_belongs_to_the_root() {
        let ground = Ground { near_metres: 96.0, ..ground() };
        let cut: Cut = all(2).into_iter().collect();
        let middle = DVec3::new(32.0, 32.0, 0.0);
        let rising = [DVec3::new(1.0, 0.0, 1e-3), DVec3::new(0.0, -1.0, 1e-3), DVec3::Z, DVec3::new(0.6, 0.0, 0.8)];
        for direction in rising.map(DVec3::normalize) {
            let (near, far) = (middle + direction * 95.9, middle + direction * 96.1);
            assert_eq!(cut.owner_of(&ground, near).map(|b| b.level), Some(2));
            assert_eq!(cut.owner_of(&ground, far), Some(BlockId::ROOT));
            // Without a root, as in flat plans, the block below owns the background.
            let flat = Cut::nearest(&ground, all(2).into_iter().filter(|b| b.level == 2));
            assert_eq!(flat.owner_of(&ground, far), Some(ground.block_at(2, far)));
        }
        // Places below the ground belong to their block.
        for direction in [DVec3::NEG_Z, DVec3::new(0.6, 0.0, -0.8)] {
            assert_eq!(cut.owner_of(&ground, middle + direction * 200.0).map(|b| b.level), Some(2));
        }
        assert_eq!(cut.owner_of(&ground, DVec3::INFINITY), None);
    }
}
