//! Seams: the faces between blocks of different owners in a cut, and the distance of a place to them.

use glam::{DVec2, DVec3};
use scene::BlockId;

use crate::ground::Ground;
use crate::lod::Cut;

/// A straight segment of the border between the areas of two owners, on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Face {
    /// The owner on the side of lower coordinates.
    pub a: BlockId,
    /// The owner on the other side.
    pub b: BlockId,
    /// The ground axis that the face is perpendicular to: 0 or 1.
    pub axis: usize,
    /// Coordinate on that axis, ground metres.
    pub at_metres: f64,
    /// Extent along the other axis, ground metres. Infinite at the scene's rim, as ownership is.
    pub extent_metres: [f64; 2],
}

impl Face {
    /// The distance of a place on the ground to the face, metres.
    pub fn distance(&self, ground: DVec2) -> f64 {
        let (across, along) = (ground[self.axis], ground[1 - self.axis]);
        let beyond = (self.extent_metres[0] - along).max(along - self.extent_metres[1]).max(0.0);
        (across - self.at_metres).hypot(beyond)
    }

    /// True when the place is on the side of `a`.
    pub fn is_before(&self, ground: DVec2) -> bool {
        ground[self.axis] < self.at_metres
    }
}

/// All faces of a cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Seams {
    ground: Ground,
    /// Sorted by axis and coordinate.
    faces: Vec<Face>,
}

impl Seams {
    /// The faces of a cut; empty if one block owns everything.
    pub fn of(cut: &Cut, ground: &Ground) -> Self {
        let squares = squares(cut);
        let mut faces = Vec::new();
        for &(square, owner) in &squares {
            let cells = 1u32 << square.level;
            let core = ground.core(square);
            for (axis, forward) in [(0, false), (0, true), (1, false), (1, true)] {
                let mut beside = square;
                let place = if axis == 0 { &mut beside.x } else { &mut beside.y };
                let Some(next) = place.checked_add_signed(if forward { 1 } else { -1 }).filter(|&c| c < cells) else {
                    continue;
                };
                *place = next;
                // The adjacent square of equal or larger size. A divided neighbour reports the face itself; of two
                // equal squares only the lower one does.
                let neighbour = (0..=square.level).rev().find_map(|level| {
                    let found = squares.binary_search_by_key(&beside.ancestor(level), |(square, _)| *square);
                    found.ok().map(|i| squares[i])
                });
                let Some((other, other_owner)) = neighbour.filter(|(_, other)| *other != owner) else { continue };
                if other.level == square.level && !forward {
                    continue;
                }
                let along = 1 - axis;
                let cell = [square.x, square.y][along];
                let open = |at_rim: bool, metres: f64, rim: f64| if at_rim { rim } else { metres };
                faces.push(Face {
                    a: if forward { owner } else { other_owner },
                    b: if forward { other_owner } else { owner },
                    axis,
                    at_metres: if forward { core.max[axis] } else { core.min[axis] },
                    extent_metres: [
                        open(cell == 0, core.min[along], f64::NEG_INFINITY),
                        open(cell == cells - 1, core.max[along], f64::INFINITY),
                    ],
                });
            }
        }
        let key = |face: &Face| (face.axis, face.at_metres, face.extent_metres[0]);
        faces.sort_by(|a, b| key(a).partial_cmp(&key(b)).expect("a sane ground has no NaN"));
        Self { ground: *ground, faces }
    }

    /// The faces, sorted by axis, coordinate and extent.
    pub fn faces(&self) -> &[Face] {
        &self.faces
    }

    /// The sorted pairs of blocks that share a face, the lower block first.
    pub fn pairs(&self) -> Vec<[BlockId; 2]> {
        let mut pairs: Vec<[BlockId; 2]> =
            self.faces.iter().map(|face| [face.a.min(face.b), face.a.max(face.b)]).collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    }

    /// The nearest face within `within_metres` of a place (world metres), and its distance in metres.
    pub fn nearest(&self, world: DVec3, within_metres: f64) -> Option<(&Face, f64)> {
        let at = self.ground.from_world(world).truncate();
        let mut found: Option<(&Face, f64)> = None;
        for axis in [0, 1] {
            let from = self.faces.partition_point(|f| (f.axis, f.at_metres) < (axis, at[axis] - within_metres));
            let near =
                self.faces[from..].iter().take_while(|f| f.axis == axis && f.at_metres <= at[axis] + within_metres);
            for face in near {
                let distance = face.distance(at);
                if distance <= within_metres && found.is_none_or(|(_, best)| distance < best) {
                    found = Some((face, distance));
                }
            }
        }
        found
    }
}

/// Divides the plane into squares with one owner each, sorted by id. A square with a deeper region inside is divided.
fn squares(cut: &Cut) -> Vec<(BlockId, BlockId)> {
    let regions: std::collections::BTreeMap<BlockId, BlockId> = cut.regions().collect();
    let divided: std::collections::BTreeSet<BlockId> =
        regions.keys().flat_map(|region| (0..region.level).map(|level| region.ancestor(level))).collect();
    let mut squares = Vec::new();
    let mut open = vec![(BlockId::ROOT, None)];
    while let Some((square, above)) = open.pop() {
        let owner = regions.get(&square).copied().or(above);
        if divided.contains(&square) {
            open.extend(square.children().map(|child| (child, owner)));
        } else if let Some(owner) = owner {
            squares.push((square, owner));
        }
    }
    squares.sort_unstable();
    squares
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::ground;

    fn block(level: u8, x: u32, y: u32) -> BlockId {
        BlockId { level, x, y }
    }

    #[test]
    fn four_blocks_have_four_faces_that_extend_to_infinity() {
        let cut: Cut = [BlockId::ROOT].into_iter().chain(BlockId::ROOT.children()).collect();
        let seams = Seams::of(&cut, &ground());
        assert_eq!(seams.faces().len(), 4);
        assert!(seams.faces().iter().all(|f| f.at_metres == 32.0 && f.a < f.b));
        assert_eq!(seams.faces()[0].extent_metres, [f64::NEG_INFINITY, 32.0]);
        assert_eq!(seams.pairs().len(), 4);
        let (face, distance) = seams.nearest(DVec3::new(33.5, -1e4, 7.0), 2.0).unwrap();
        assert_eq!((face.a, face.b, distance), (block(1, 0, 0), block(1, 1, 0), 1.5));
        assert!(seams.nearest(DVec3::new(33.5, -1e4, 7.0), 1.0).is_none());
        assert!(seams.nearest(DVec3::NAN, 1.0).is_none());
    }

    #[test]
    fn one_block_has_no_face_and_a_single_child_has_four() {
        assert!(Seams::of(&[BlockId::ROOT].into_iter().collect(), &ground()).faces().is_empty());
        assert!(Seams::of(&Cut::default(), &ground()).faces().is_empty());
        let inner = block(2, 1, 1);
        let seams = Seams::of(&[BlockId::ROOT, inner].into_iter().collect(), &ground());
        // The child covers 16..32 on both axes. The root's own squares have no faces between them.
        assert_eq!(seams.faces().len(), 4);
        assert_eq!(seams.pairs(), [[BlockId::ROOT, inner]]);
        assert!(seams.faces().iter().all(|f| f.extent_metres == [16.0, 32.0]));
        let corner = seams.nearest(DVec3::new(35.0, 36.0, 0.0), 6.0).unwrap();
        assert!((corner.1 - 5.0).abs() < 1e-12);
    }

    proptest! {
        /// The owner changes across every face and nowhere else.
        #[test]
        fn faces_are_where_the_owner_changes(keep in prop::collection::vec(any::<bool>(), 3..40), nearest in any::<bool>()) {
            let ground = ground();
            let mut blocks = vec![BlockId::ROOT];
            let mut i = 0;
            while let Some(&parent) = blocks.get(i) {
                if parent.level < 3 {
                    blocks.extend(parent.children().into_iter().enumerate().filter(|(k, _)| keep[(4 * i + k) % keep.len()]).map(|(_, b)| b));
                }
                i += 1;
            }
            let cut: Cut = if nearest {
                Cut::nearest(&ground, blocks.into_iter().filter(|b| b.level == 3))
            } else {
                blocks.into_iter().collect()
            };
            let seams = Seams::of(&cut, &ground);
            for face in seams.faces() {
                let along = face.extent_metres[0].max(-100.0) + 0.4;
                let place = |across: f64| {
                    let mut at = DVec3::ZERO;
                    (at[face.axis], at[1 - face.axis]) = (across, along);
                    at
                };
                prop_assert_eq!(cut.owner_of(&ground, place(face.at_metres - 0.1)), Some(face.a));
                prop_assert_eq!(cut.owner_of(&ground, place(face.at_metres + 0.1)), Some(face.b));
            }
            for k in 0..400 {
                let at = DVec3::new(f64::from(k % 20) * 4.0 - 7.0, f64::from(k / 20) * 4.0 - 7.0, 0.0);
                for step in [DVec3::X * 4.0, DVec3::Y * 4.0] {
                    let crosses = cut.owner_of(&ground, at) != cut.owner_of(&ground, at + step);
                    let face = seams.nearest(at + 0.5 * step, 2.0);
                    // A step of 4 m at odd coordinates crosses at most one border of 8 m squares.
                    prop_assert!(!crosses || face.is_some());
                }
            }
        }
    }
}
