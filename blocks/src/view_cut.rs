//! The cut for a viewer: the sharpest cut of the tree for one camera within a budget of splats.

use std::collections::{BTreeMap, BinaryHeap};

use glam::{DVec2, DVec3};
use scene::{BlockId, Camera, Splats};

use crate::ground::{Ground, quantile};
use crate::lod::Cut;
use crate::plan::Plan;

/// The metadata of a block that the viewer needs before it loads the block.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    /// Number of its splats in each child's core, without background.
    in_children: [usize; 4],
    /// 2nd and 98th percentile of the heights of these splats, ground metres.
    heights: [f64; 2],
}

/// The block tree with the metadata for view-dependent level of detail.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewTree {
    ground: Ground,
    /// Resolution of each level, metres per pixel.
    rho_metres: Vec<f64>,
    nodes: BTreeMap<BlockId, Node>,
    /// Number of background splats of the root. They are part of every cut.
    background: usize,
}

impl ViewTree {
    /// The tree of a plan and its results. Empty without a result of the root: flat plans have no tree.
    pub fn new<'a>(plan: &Plan, results: impl IntoIterator<Item = (BlockId, &'a Splats)>) -> Self {
        let (ground, rho_metres) = (plan.ground, plan.rho_metres.clone());
        let node = |block: BlockId, splats: &Splats| {
            let children = block.children();
            let (mut in_children, mut heights) = ([0; 4], Vec::new());
            for i in 0..splats.len() {
                let place = splats.mean(i).as_dvec3();
                let child =
                    children.iter().position(|&child| ground.owns(child, place) && !ground.is_background(place));
                if let Some(child) = child {
                    in_children[child] += 1;
                    heights.push(ground.from_world(place).z);
                }
            }
            Node { in_children, heights: [0.02, 0.98].map(|share| quantile(&mut heights, share)) }
        };
        let (mut nodes, mut background) = (BTreeMap::new(), None);
        for (block, splats) in results {
            nodes.insert(block, node(block, splats));
            if block == BlockId::ROOT {
                background =
                    Some((0..splats.len()).filter(|&i| ground.is_background(splats.mean(i).as_dvec3())).count());
            }
        }
        let Some(background) = background else {
            return Self { ground, rho_metres, nodes: BTreeMap::new(), background: 0 };
        };
        Self { ground, rho_metres, nodes, background }
    }

    /// The screen-space error of a block: the size in camera pixels of one pixel of the block's resolution at the
    /// block's nearest point. 0 if the block is outside the frustum.
    pub fn screen_error(&self, block: BlockId, camera: &Camera) -> f64 {
        let (Some(node), Some(rho)) = (self.nodes.get(&block), self.rho_metres.get(usize::from(block.level))) else {
            return 0.0;
        };
        let core = self.ground.core(block);
        let (low, high) = (core.min.extend(node.heights[0]), core.max.extend(node.heights[1]));
        let eye = self.ground.from_world(camera.centre());
        if !self.may_be_visible(camera, low, high) {
            return 0.0;
        }
        let distance = eye.distance(eye.clamp(low, high.max(low)));
        rho * camera.pinhole.fx / distance.max(f64::from(f32::MIN_POSITIVE))
    }

    /// Refines greedily from the root: always the block with the largest screen-space error, until all errors are at
    /// most one pixel or no refinement fits into `budget` splats. The result has at least the root's splats. `None` for
    /// an empty tree.
    pub fn cut(&self, camera: &Camera, budget: usize) -> Option<Cut> {
        let mut splats = self.background + self.nodes.get(&BlockId::ROOT)?.in_children.iter().sum::<usize>();
        let mut members = vec![BlockId::ROOT];
        let mut open = BinaryHeap::from([Refinable(self.screen_error(BlockId::ROOT, camera), BlockId::ROOT)]);
        while let Some(Refinable(error, block)) = open.pop() {
            if error <= 1.0 {
                break;
            }
            let node = self.nodes[&block];
            let children =
                || block.children().into_iter().enumerate().filter_map(|(k, b)| Some((k, b, self.nodes.get(&b)?)));
            let added: usize = children().map(|(_, _, child)| child.in_children.iter().sum::<usize>()).sum();
            let removed: usize = children().map(|(k, ..)| node.in_children[k]).sum();
            if splats - removed + added > budget {
                continue;
            }
            splats = splats - removed + added;
            for (_, child, _) in children() {
                members.push(child);
                open.push(Refinable(self.screen_error(child, camera), child));
            }
        }
        Some(members.into_iter().collect())
    }

    /// Conservative frustum test of a box (ground metres): false only if the box is outside the image.
    fn may_be_visible(&self, camera: &Camera, low: DVec3, high: DVec3) -> bool {
        let k = &camera.pinhole;
        let corners: [DVec3; 8] = std::array::from_fn(|i| {
            let pick = |axis: usize| if i >> axis & 1 == 0 { low[axis] } else { high[axis] };
            camera.camera_from_world.apply(self.ground.to_world(DVec3::new(pick(0), pick(1), pick(2))))
        });
        let (near, far) = (DVec2::new(k.cx / k.fx, k.cy / k.fy), DVec2::new(f64::from(k.width), f64::from(k.height)));
        let far = far / DVec2::new(k.fx, k.fy) - near;
        let planes: [&dyn Fn(&DVec3) -> bool; 5] =
            [&|p| p.z > 0.0, &|p| p.x > -near.x * p.z, &|p| p.y > -near.y * p.z, &|p| p.x < far.x * p.z, &|p| {
                p.y < far.y * p.z
            }];
        planes.iter().all(|inside| corners.iter().any(inside))
    }
}

/// A block that can be refined, by screen-space error. Ties go to the lowest id.
#[derive(Debug, PartialEq)]
struct Refinable(f64, BlockId);

impl Eq for Refinable {}

impl Ord for Refinable {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

impl PartialOrd for Refinable {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::{ArtefactId, Splat};

    use super::*;
    use crate::plan::{Mode, PlanSettings};
    use crate::testing::{aerial, look_at, noise};

    /// A plan of two levels, and a result of 200 splats in the halo of each block.
    fn tree() -> (Plan, BTreeMap<BlockId, Splats>) {
        let settings = PlanSettings { mode: Mode::Tree, levels: Some(2), ..PlanSettings::default() };
        let plan = crate::plan(&aerial(8, 300.0, 8000), ArtefactId::of(b""), &settings, "cpu").unwrap();
        let mut results = BTreeMap::new();
        for task in &plan.tasks {
            let halo = plan.ground.nominal_halo(task.block);
            let mut splats = Splats::new(0);
            for i in 0..200 {
                let share = DVec2::new(noise(2 * i), noise(2 * i + 1));
                let at = plan.ground.to_world((halo.min + share * (halo.max - halo.min)).extend(0.0));
                splats.push(&Splat::round(at.as_vec3(), 0.0, Vec3::ONE, 0.5));
            }
            // A background dome, in the root and as a leftover in other blocks.
            for i in 0..50 {
                let at = DVec3::new(noise(1000 + i) - 0.5, noise(2000 + i) - 0.5, 0.3).normalize();
                let at = plan.ground.to_world(plan.ground.core(BlockId::ROOT).centre().extend(0.0)) + at * 1500.0;
                splats.push(&Splat::round(at.as_vec3(), 0.0, Vec3::ONE, 0.5));
            }
            results.insert(task.block, splats);
        }
        (plan, results)
    }

    fn splats_of(cut: &Cut, plan: &Plan, results: &BTreeMap<BlockId, Splats>) -> usize {
        results.iter().map(|(&block, splats)| cut.keep(splats, &plan.ground, block).len()).sum()
    }

    #[test]
    fn the_budget_is_kept_and_spent_in_view() {
        let (plan, results) = tree();
        let tree = ViewTree::new(&plan, results.iter().map(|(&b, s)| (b, s)));
        let centre = plan.ground.to_world(plan.ground.core(BlockId { level: 2, x: 0, y: 0 }).centre().extend(0.0));
        let camera = look_at(centre + DVec3::Z * 20.0, centre, DVec3::Y);
        let mut last = 0;
        for budget in [0, 200, 700, 1500, 5000] {
            let cut = tree.cut(&camera, budget).unwrap();
            let now = splats_of(&cut, &plan, &results);
            assert!(now <= budget.max(splats_of(&tree.cut(&camera, 0).unwrap(), &plan, &results)), "{now} of {budget}");
            assert!(now >= last);
            last = now;
        }
        let cut = tree.cut(&camera, 5000).unwrap();
        let level_at = |at: DVec3| cut.owner_of(&plan.ground, at).unwrap().level;
        assert_eq!(level_at(centre), 2, "near and in view");
        let opposite = plan.ground.to_world(plan.ground.core(BlockId { level: 2, x: 3, y: 3 }).centre().extend(0.0));
        assert!(level_at(opposite) < 2, "out of view");
        // The background belongs to the root in every cut.
        let background = |block: BlockId| {
            let kept = cut.keep(&results[&block], &plan.ground, block);
            (0..kept.len()).filter(|&i| plan.ground.is_background(kept.mean(i).as_dvec3())).count()
        };
        assert!(cut.blocks().into_iter().all(|block| background(block) == if block == BlockId::ROOT { 50 } else { 0 }));
    }

    #[test]
    fn a_distant_camera_gets_the_root() {
        let (plan, results) = tree();
        let tree = ViewTree::new(&plan, results.iter().map(|(&b, s)| (b, s)));
        let centre = plan.ground.to_world(plan.ground.core(BlockId::ROOT).centre().extend(0.0));
        let camera = look_at(centre + DVec3::Z * 1e5, centre, DVec3::Y);
        assert_eq!(tree.cut(&camera, usize::MAX).unwrap().blocks(), [BlockId::ROOT].into());
        assert_eq!(
            tree.screen_error(BlockId::ROOT, &look_at(centre + DVec3::Z * 1e3, centre + DVec3::Z * 2e3, DVec3::Y)),
            0.0
        );
        assert!(ViewTree::new(&plan, []).cut(&camera, 10).is_none());
    }
}
