//! The road network: a lattice of lines bent by a smooth map, on which each layout has its own kinds of roads.
//!
//! ```text
//!  quarter = a cell between main lines        block = quarter, or a part of it between alleys
//!  ┌────────┬──┬──┬──┬────────┐               main lines are streets, fine lines between them are alleys
//!  │        ├──┼──┼──┤        │               an edge between two blocks is a road; an edge inside a block is none
//!  │        ├──┼──┼──┤        │
//!  └────────┴──┴──┴──┴────────┘
//! ```
//! Every block is a rectangle of cells with roads on all sides, so there are no dead ends. Everything beside a road
//! (curbs, front lines, lanes, pedestrian paths) is a **ring** around blocks: the centre lines at an offset, with
//! rounded corners. Rings at different offsets do not cross. Architecture invariant: this module builds no meshes.

use glam::DVec2;

use crate::settings::Layout;

/// Cross-section of a road, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Profile {
    pub(crate) kind: RoadKind,
    /// Half the width of the carriageway.
    pub(crate) half: f64,
    /// Width of each pavement.
    pub(crate) pavement: f64,
    /// From the centre line to the middle of the outermost driving lane.
    pub(crate) lane: f64,
    /// Height of the curb.
    pub(crate) curb: f64,
    /// Whether vehicles park along the curb.
    pub(crate) parking: bool,
}

/// Kinds of roads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RoadKind {
    Street,
    Boulevard,
    Corridor,
    Winding,
    Lane,
    Alley,
}

impl RoadKind {
    pub(crate) fn profile(self) -> Profile {
        let (half, pavement, lane, curb, parking) = match self {
            Self::Street => (5.3, 2.9, 1.6, 0.12, true),
            Self::Boulevard => (12.0, 4.0, 8.2, 0.14, true),
            Self::Corridor => (5.2, 2.2, 1.6, 0.12, true),
            Self::Winding => (3.4, 1.8, 1.7, 0.10, false),
            Self::Lane => (2.9, 0.9, 1.5, 0.06, false),
            Self::Alley => (1.2, 0.8, 0.0, 0.04, false),
        };
        Profile { kind: self, half, pavement, lane, curb, parking }
    }
}

impl Profile {
    /// Setback: from the centre line to the building fronts.
    pub(crate) fn front(&self) -> f64 {
        self.half + self.pavement
    }
}

/// A road between two neighbouring crossings, without the crossings.
#[derive(Debug, Clone)]
pub(crate) struct Edge {
    pub(crate) profile: Profile,
    /// Points of the centre line with unit directions (towards increasing lattice lines).
    pub(crate) path: Vec<(DVec2, DVec2)>,
}

/// A step of a walk around blocks. Arms of a crossing are numbered 0 east, 1 north, 2 west, 3 south.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Step {
    /// Along an edge, with the block on the left.
    Along { edge: usize, forward: bool },
    /// Through a crossing, from one arm to another; `turn` at a corner of the walk.
    Through { node: usize, from: usize, to: usize, turn: bool },
}

/// One or several cells between main lines with one layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Quarter {
    /// Lattice lines: west, east, south, north.
    pub(crate) lines: [usize; 4],
    pub(crate) layout: Layout,
    /// Row of main cells, from the south.
    pub(crate) row: usize,
}

/// An area between roads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Block {
    /// Lattice lines: west, east, south, north.
    pub(crate) lines: [usize; 4],
    pub(crate) quarter: usize,
}

/// The road network.
#[derive(Debug, Clone)]
pub(crate) struct Roads {
    /// Number of cells of the fine lattice.
    pub(crate) cells: [usize; 2],
    /// Fine cells per main cell.
    pub(crate) fine: usize,
    /// Horizontal edges row by row (`cells[0] × (cells[1] + 1)`), then vertical ones (`(cells[0] + 1) × cells[1]`).
    pub(crate) edges: Vec<Option<Edge>>,
    /// Positions of the lattice nodes, row by row.
    pub(crate) nodes: Vec<DVec2>,
    pub(crate) quarters: Vec<Quarter>,
    pub(crate) blocks: Vec<Block>,
    /// The horizontal line that the deck follows.
    pub(crate) deck: Option<usize>,
    /// The city is compact: roads at its edge are lanes (see [`crate::CitySettings::is_compact`]).
    pub(crate) is_compact: bool,
}

/// Inner points of a rounded corner between two roads. Odd, so that one is the middle.
pub(crate) const CORNER_POINTS: usize = 5;
/// Distance between samples of a road, metres.
pub(crate) const SAMPLE_METRES: f64 = 4.0;

/// A point of a ring.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RingPoint {
    pub(crate) at: DVec2,
    /// The road beside the point, at a crossing the road before it.
    pub(crate) profile: Profile,
    /// The step of the walk.
    pub(crate) step: usize,
}

impl Roads {
    pub(crate) fn node(&self, i: usize, j: usize) -> usize {
        i + j * (self.cells[0] + 1)
    }

    /// The edge east of a node.
    pub(crate) fn horizontal(&self, i: usize, j: usize) -> usize {
        i + j * self.cells[0]
    }

    /// The edge north of a node.
    pub(crate) fn vertical(&self, i: usize, j: usize) -> usize {
        self.cells[0] * (self.cells[1] + 1) + i + j * (self.cells[0] + 1)
    }

    /// The edge at an arm of a node, and whether its direction points away from the node.
    pub(crate) fn arm(&self, node: usize, arm: usize) -> Option<(usize, bool)> {
        let (i, j) = (node % (self.cells[0] + 1), node / (self.cells[0] + 1));
        let (index, away) = match arm {
            0 if i < self.cells[0] => (self.horizontal(i, j), true),
            1 if j < self.cells[1] => (self.vertical(i, j), true),
            2 if i > 0 => (self.horizontal(i - 1, j), false),
            3 if j > 0 => (self.vertical(i, j - 1), false),
            _ => return None,
        };
        self.edges[index].is_some().then_some((index, away))
    }

    /// The end of an arm at its node: position, direction away from the node, profile.
    pub(crate) fn arm_end(&self, node: usize, arm: usize) -> Option<(DVec2, DVec2, Profile)> {
        let (index, away) = self.arm(node, arm)?;
        let edge = self.edges[index].as_ref()?;
        let (at, direction) = *if away { edge.path.first() } else { edge.path.last() }?;
        Some((at, if away { direction } else { -direction }, edge.profile))
    }

    /// The blocks on both sides of an edge.
    fn adjacent_blocks(&self, index: usize) -> [Option<usize>; 2] {
        let horizontals = self.cells[0] * (self.cells[1] + 1);
        let cell = |i: usize, j: usize| (i < self.cells[0] && j < self.cells[1]).then(|| self.block_at(i, j));
        if index < horizontals {
            let (i, j) = (index % self.cells[0], index / self.cells[0]);
            [cell(i, j), j.checked_sub(1).and_then(|j| cell(i, j))]
        } else {
            let index = index - horizontals;
            let (i, j) = (index % (self.cells[0] + 1), index / (self.cells[0] + 1));
            [cell(i, j), i.checked_sub(1).and_then(|i| cell(i, j))]
        }
    }

    fn block_at(&self, i: usize, j: usize) -> usize {
        let holds = |lines: &[usize; 4]| lines[0] <= i && i < lines[1] && lines[2] <= j && j < lines[3];
        // blocks are sorted by rows of quarters, so only one row is searched
        let row = j / self.fine;
        let from = self.blocks.partition_point(|b| self.quarters[b.quarter].row < row);
        (from..self.blocks.len()).find(|&b| holds(&self.blocks[b].lines)).unwrap_or(0)
    }

    /// The kind of road of an edge; `None` inside a block.
    pub(crate) fn kind_of(&self, index: usize) -> Option<RoadKind> {
        let horizontals = self.cells[0] * (self.cells[1] + 1);
        let line =
            if index < horizontals { index / self.cells[0] } else { (index - horizontals) % (self.cells[0] + 1) };
        let sides = self.adjacent_blocks(index);
        if sides[0] == sides[1] {
            return None;
        }
        if !line.is_multiple_of(self.fine) {
            return Some(RoadKind::Alley);
        }
        if index < horizontals && self.deck == Some(line) {
            return Some(RoadKind::Boulevard);
        }
        let [Some(a), Some(b)] = sides.map(|s| s.map(|b| self.quarters[self.blocks[b].quarter].layout)) else {
            return Some(if self.is_compact { RoadKind::Lane } else { RoadKind::Street });
        };
        Some(match (a, b) {
            (Layout::Alley, Layout::Alley) => RoadKind::Lane,
            (Layout::Winding, Layout::Winding) => RoadKind::Winding,
            (Layout::CurvedCorridor, _) | (_, Layout::CurvedCorridor) => RoadKind::Corridor,
            _ => RoadKind::Street,
        })
    }

    /// The counter-clockwise walk around a rectangle of lattice lines, with the rectangle on the left and four turns.
    pub(crate) fn walk_around(&self, [west, east, south, north]: [usize; 4]) -> Vec<Step> {
        let mut steps = Vec::new();
        let mut side = |count: usize, arm: usize, edge: &dyn Fn(usize) -> usize, node: &dyn Fn(usize) -> usize| {
            for k in 0..count {
                steps.push(Step::Along { edge: edge(k), forward: arm < 2 });
                let turn = k + 1 == count;
                let to = if turn { (arm + 1) % 4 } else { arm };
                steps.push(Step::Through { node: node(k), from: (arm + 2) % 4, to, turn });
            }
        };
        let (wide, tall) = (east - west, north - south);
        side(wide, 0, &|k| self.horizontal(west + k, south), &|k| self.node(west + k + 1, south));
        side(tall, 1, &|k| self.vertical(east, south + k), &|k| self.node(east, south + k + 1));
        side(wide, 2, &|k| self.horizontal(east - k - 1, north), &|k| self.node(east - k - 1, north));
        side(tall, 3, &|k| self.vertical(west, north - k - 1), &|k| self.node(west, north - k - 1));
        steps
    }

    /// The clockwise walk around the whole city, with the countryside on the left.
    pub(crate) fn walk_outside(&self) -> Vec<Step> {
        let mut steps = self.walk_around([0, self.cells[0], 0, self.cells[1]]);
        // the walk starts with an edge
        steps.reverse();
        steps.rotate_left(1);
        for step in &mut steps {
            *step = match *step {
                Step::Along { edge, forward } => Step::Along { edge, forward: !forward },
                Step::Through { node, from, to, turn } => Step::Through { node, from: to, to: from, turn },
            };
        }
        steps
    }

    /// The closed line at an offset to the left of the centre lines of a walk, and the indices of the middles of its
    /// turns.
    pub(crate) fn ring(&self, walk: &[Step], distance: &dyn Fn(&Profile) -> f64) -> (Vec<RingPoint>, Vec<usize>) {
        let (mut ring, mut turns) = (Vec::new(), Vec::new());
        let mut profile = RoadKind::Street.profile();
        for (step, what) in walk.iter().enumerate() {
            match *what {
                Step::Along { edge, forward } => {
                    let Some(edge) = &self.edges[edge] else { continue };
                    profile = edge.profile;
                    let side = if forward { distance(&profile) } else { -distance(&profile) };
                    let at = |&(p, d): &(DVec2, DVec2)| RingPoint { at: p + side * d.perp(), profile, step };
                    if forward {
                        ring.extend(edge.path.iter().map(at));
                    } else {
                        ring.extend(edge.path.iter().rev().map(at));
                    }
                }
                Step::Through { node, from, to, turn } => {
                    if turn {
                        turns.push(ring.len() + CORNER_POINTS / 2);
                    }
                    ring.extend(self.corner(node, from, to, distance).map(|at| RingPoint { at, profile, step }));
                }
            }
        }
        (ring, turns)
    }

    /// The inner points of the curve through a crossing from arm `from` to arm `to`, at an offset to the left.
    pub(crate) fn corner(
        &self,
        node: usize,
        from: usize,
        to: usize,
        distance: &dyn Fn(&Profile) -> f64,
    ) -> impl Iterator<Item = DVec2> + use<> {
        let end = |arm: usize, side: f64| {
            self.arm_end(node, arm).map(|(at, out, profile)| (at + side * distance(&profile) * out.perp(), out))
        };
        // left of the incoming direction is right of the outgoing direction
        let ends = end(from, -1.0).zip(end(to, 1.0));
        let (a, control, b) = ends.map_or((DVec2::ZERO, DVec2::ZERO, DVec2::ZERO), |((a, out_a), (b, out_b))| {
            let middle = 0.5 * (a + b);
            let cross = out_a.perp_dot(out_b);
            let along = (b - a).perp_dot(out_b) / cross;
            let meet = a + along * out_a;
            let near = cross.abs() > 0.15 && (meet - middle).length() < (b - a).length();
            (a, if near { meet } else { middle }, b)
        });
        (1..=CORNER_POINTS).map(move |k| {
            let t = k as f64 / (CORNER_POINTS + 1) as f64;
            a.lerp(control, t).lerp(control.lerp(b, t), t)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::lay_roads;
    use crate::random::Random;
    use crate::settings::CitySettings;

    #[test]
    fn blocks_tile_the_lattice_and_no_road_is_a_dead_end() {
        for &layout in Layout::ALL {
            let settings = CitySettings { layout, area_km2: 0.6, ..CitySettings::default() };
            let roads = lay_roads(&settings, &Random::new(5));
            let area = |l: &[usize; 4]| (l[1] - l[0]) * (l[3] - l[2]);
            assert_eq!(roads.blocks.iter().map(|b| area(&b.lines)).sum::<usize>(), roads.cells[0] * roads.cells[1]);
            for node in 0..roads.nodes.len() {
                let arms = (0..4).filter(|&arm| roads.arm(node, arm).is_some()).count();
                assert_ne!(arms, 1, "{layout}: a dead end");
            }
            for edge in roads.edges.iter().flatten() {
                let sane = edge.path.iter().all(|(p, d)| p.is_finite() && (d.length() - 1.0).abs() < 1e-6);
                assert!(sane && edge.path.len() > 1, "{layout}");
            }
        }
    }

    #[test]
    fn opposite_sides_of_a_block_have_equal_point_counts_and_rings_nest() {
        let settings = CitySettings { layout: Layout::Mixed, area_km2: 0.6, ..CitySettings::default() };
        let roads = lay_roads(&settings, &Random::new(6));
        let area = |ring: &[RingPoint]| {
            let pairs = (0..ring.len()).map(|k| (ring[k].at, ring[(k + 1) % ring.len()].at));
            0.5 * pairs.map(|(a, b)| a.perp_dot(b)).sum::<f64>()
        };
        for block in &roads.blocks {
            let walk = roads.walk_around(block.lines);
            let (curb, turns) = roads.ring(&walk, &|p| p.half);
            let (front, _) = roads.ring(&walk, &Profile::front);
            let side = |k: usize| (turns[k] + curb.len() - turns[(k + 3) % 4]) % curb.len();
            assert_eq!((side(0), side(1)), (side(2), side(3)));
            assert!(area(&curb) > area(&front) && area(&front) > 0.0, "{block:?}");
        }
        let (outside, turns) = roads.ring(&roads.walk_outside(), &Profile::front);
        assert!(area(&outside) < 0.0 && turns.len() == 4);
    }

    #[test]
    fn alleys_are_three_to_five_metres_wide() {
        let profile = RoadKind::Alley.profile();
        assert!((3.0..5.0).contains(&(2.0 * profile.front())));
    }
}
