//! The cells of a model: disjoint squares of the ground that cover it, each with the blocks that show it at each level of detail.
//!
//! Viewers replace the splats of a cell by coarser or finer ones. A cell is shown by one block at each level, so that nothing is
//! shown twice and nothing is missing, whatever levels its neighbours have.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::BlockId;

use crate::ground::Ground;
use crate::lod::Cut;

/// The cells of a cut, by region, with the block that shows each most finely.
#[derive(Debug, Clone, Default)]
pub struct Cells {
    owners: BTreeMap<BlockId, BlockId>,
    deepest: u8,
}

impl Cells {
    /// The cells of a cut: the squares of the quadtree that one block of it owns whole.
    pub fn of(cut: &Cut) -> Self {
        let regions: BTreeMap<BlockId, BlockId> = cut.regions().collect();
        let above = |block: &BlockId| (0..block.level).map(|level| block.ancestor(level)).collect::<Vec<_>>();
        let divided: BTreeSet<BlockId> = regions.keys().flat_map(above).collect();
        let mut owners = BTreeMap::new();
        let mut open = vec![(BlockId::ROOT, None)];
        while let Some((region, above)) = open.pop() {
            let owner = regions.get(&region).copied().or(above);
            if divided.contains(&region) {
                open.extend(region.children().map(|child| (child, owner)));
            } else if let Some(owner) = owner {
                owners.insert(region, owner);
            }
        }
        let deepest = owners.keys().map(|region| region.level).max().unwrap_or(0);
        Self { owners, deepest }
    }

    /// Each region with its owner, sorted by region.
    pub fn iter(&self) -> impl Iterator<Item = (BlockId, BlockId)> {
        self.owners.iter().map(|(&region, &owner)| (region, owner))
    }

    /// The block that shows the cell of a region most finely; `None` if the region is no cell.
    pub fn owner(&self, region: BlockId) -> Option<BlockId> {
        self.owners.get(&region).copied()
    }

    /// The region that contains a place (world metres); `None` in a hole of the cut, and where the place is not finite.
    pub fn region_at(&self, ground: &Ground, world: DVec3) -> Option<BlockId> {
        if !world.is_finite() {
            return None;
        }
        let finest = ground.block_at(self.deepest, world);
        (0..=self.deepest).rev().map(|level| finest.ancestor(level)).find(|region| self.owners.contains_key(region))
    }

    /// Whether a block shows the cell of a region: the owner, and in a tree its ancestors.
    pub fn is_shown_by(&self, region: BlockId, block: BlockId) -> bool {
        self.owner(region).is_some_and(|owner| owner.ancestor(block.level) == block)
    }

    /// Replaces a cell by its four quarters, of the same owner.
    pub fn divide(&mut self, region: BlockId) {
        if region.level < BlockId::MAX_LEVEL
            && let Some(owner) = self.owners.remove(&region)
        {
            self.owners.extend(region.children().map(|child| (child, owner)));
            self.deepest = self.deepest.max(region.level + 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::ground;

    fn block(level: u8, x: u32, y: u32) -> BlockId {
        BlockId { level, x, y }
    }

    /// Every place is in one cell, and the owners are those of the cut.
    #[test]
    fn cells_cover_the_ground_once() {
        let ground = ground();
        let tree = [BlockId::ROOT, block(1, 0, 0), block(1, 1, 1), block(2, 2, 2), block(2, 3, 3)];
        let cut: Cut = tree.into_iter().collect();
        let mut cells = Cells::of(&cut);
        let regions: Vec<BlockId> = cells.iter().map(|(region, _)| region).collect();
        assert_eq!(regions.len(), 3 + 4, "three quarters of the root, and those of 1/1/1");
        let check = |cells: &Cells| {
            for (x, y) in (-3..40).flat_map(|x| (-3..40).map(move |y| (x, y))) {
                let at = DVec3::new(f64::from(x) * 0.61, f64::from(y) * 0.47, 0.0);
                let region = cells.region_at(&ground, at).unwrap();
                assert_eq!(ground.block_at(region.level, at), region);
                let owner = cut.owner_of(&ground, at).unwrap();
                assert!(cells.is_shown_by(region, owner) && cells.is_shown_by(region, BlockId::ROOT), "{region}");
                let showing: Vec<&BlockId> = tree.iter().filter(|b| cells.is_shown_by(region, **b)).collect();
                assert_eq!(showing.len(), usize::from(owner.level) + 1, "{region}: {showing:?}");
            }
        };
        check(&cells);
        cells.divide(block(1, 0, 1));
        cells.divide(block(2, 1, 3));
        assert_eq!(cells.iter().count(), 7 + 3 + 3);
        check(&cells);
        assert_eq!(cells.region_at(&ground, DVec3::NAN), None);
        assert_eq!(Cells::of(&Cut::default()).iter().count(), 0);
    }
}
