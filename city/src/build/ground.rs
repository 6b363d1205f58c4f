//! Ground meshes: carriageways, crossings, curbs, pavements, block interiors and the countryside.
//!
//! Adjacent pieces use the same points of the same rings as corners, so that there are no cracks.

use glam::{DVec2, DVec3, Vec2, Vec3};

use super::Builder;
use crate::materials::{self as m, Surface};
use crate::random::Random;
use crate::roads::{CORNER_POINTS, Edge, Profile, RingPoint, RoadKind, Roads, Step};
use crate::terrain::Terrain;
use crate::types::{Asset, Class};

/// Paint lies this much above the road, metres.
pub(crate) const PAINT_HEIGHT: f64 = 0.005;
/// Width of a curb stone.
const CURB_STONE: f64 = 0.15;
/// Width of the countryside around the city, metres.
const COUNTRYSIDE_METRES: f64 = 420.0;

/// A ground mesh and the world position of its frame's origin.
pub(crate) struct Piece {
    pub(crate) asset: Asset,
    pub(crate) origin: DVec3,
}

/// Builds ground in a frame at `origin`.
pub(crate) struct GroundBuilder<'a> {
    pub(crate) builder: Builder,
    pub(crate) terrain: &'a Terrain,
    pub(crate) origin: DVec3,
}

impl<'a> GroundBuilder<'a> {
    pub(crate) fn new(terrain: &'a Terrain, at: DVec2, class: Class) -> Self {
        Self { builder: Builder::new(class), terrain, origin: terrain.at(at) }
    }

    pub(crate) fn finish(self, name: String) -> Piece {
        Piece { asset: self.builder.finish(name), origin: self.origin }
    }

    /// A world point at a height above the ground, in the frame.
    pub(crate) fn local(&self, p: DVec2, above: f64) -> Vec3 {
        (self.terrain.at(p) + DVec3::Z * above - self.origin).as_vec3()
    }

    /// Adds a shared corner with world x and y as uv.
    fn corner(&mut self, p: DVec2, above: f64) -> u32 {
        let at = self.local(p, above);
        self.builder.corner(at, p.as_vec2())
    }

    /// Faces of a grid of corners (`rows[k][c]`); they face up if c increases to the left of increasing k.
    fn grid_faces(&mut self, rows: &[Vec<u32>], mut paint: impl FnMut(&mut Builder, usize, usize)) {
        for (k, pair) in rows.windows(2).enumerate() {
            for c in 0..pair[0].len().min(pair[1].len()).saturating_sub(1) {
                paint(&mut self.builder, k, c);
                let [a, b, c, d] = [pair[0][c], pair[1][c], pair[1][c + 1], pair[0][c + 1]];
                self.builder.face([a, b, c]);
                self.builder.face([a, c, d]);
            }
        }
    }
}

/// A crossing with its eastern and northern arms.
pub(crate) fn crossing(roads: &Roads, terrain: &Terrain, node: usize, random: &Random) -> Option<Piece> {
    let arms: Vec<(usize, Profile)> = (0..4).filter_map(|arm| Some((arm, roads.arm_end(node, arm)?.2))).collect();
    if arms.is_empty() {
        return None;
    }
    let mut layer = GroundBuilder::new(terrain, roads.nodes[node], Class::Road);
    junction(&mut layer, roads, node, &arms);
    for arm in [0, 1] {
        let Some((index, true)) = roads.arm(node, arm) else { continue };
        if let Some(edge) = &roads.edges[index] {
            let far = if arm == 0 { node + 1 } else { node + roads.cells[0] + 1 };
            let crossed = [node, far].map(|node| is_crossing(roads, node));
            road(&mut layer, edge, crossed, &mut random.fork(index as u64));
        }
    }
    Some(layer.finish(format!("road {node}")))
}

/// Whether more than two roads other than alleys meet at a node.
fn is_crossing(roads: &Roads, node: usize) -> bool {
    let street = |arm| roads.arm_end(node, arm).is_some_and(|m| m.2.kind != RoadKind::Alley);
    (0..4).filter(|&arm| street(arm)).count() > 2
}

/// Number of strips across a carriageway.
fn strips(profile: &Profile) -> usize {
    (2.0 * profile.half / 3.5).ceil() as usize
}

/// Offsets of the corners of a cross-section, from right to left.
fn cross_section(profile: &Profile) -> impl Iterator<Item = f64> + use<> {
    let (half, count) = (profile.half, strips(profile));
    (0..=count).map(move |c| half * (2.0 * c as f64 / count as f64 - 1.0))
}

fn junction(layer: &mut GroundBuilder, roads: &Roads, node: usize, arms: &[(usize, Profile)]) {
    let mut rim = Vec::new();
    for (k, &(arm, profile)) in arms.iter().enumerate() {
        let Some((at, out, _)) = roads.arm_end(node, arm) else { continue };
        rim.extend(cross_section(&profile).map(|side| at + side * out.perp()));
        let next = arms[(k + 1) % arms.len()].0;
        let corner: Vec<DVec2> = roads.corner(node, next, arm, &|p| p.half).collect();
        rim.extend(corner.into_iter().rev());
    }
    // the rim is star-shaped around the node
    let middle = roads.nodes[node];
    let paved = if arms.iter().all(|a| a.1.kind == RoadKind::Alley) { m::COBBLES } else { m::ASPHALT };
    layer.builder.class(Class::Road).paint(paved);
    let ring = |layer: &mut GroundBuilder, share: f64| -> Vec<u32> {
        rim.iter().map(|&p| layer.corner(middle.lerp(p, share), 0.0)).collect()
    };
    let reach = rim.iter().map(|p| p.distance(middle)).fold(0.0, f64::max);
    let rings = (reach / 3.5).ceil().max(1.0) as usize;
    let mut inner = ring(layer, 1.0 / rings as f64);
    let centre = layer.corner(middle, 0.0);
    for k in 0..rim.len() {
        layer.builder.face([centre, inner[k], inner[(k + 1) % rim.len()]]);
    }
    for r in 2..=rings {
        let outer = ring(layer, r as f64 / rings as f64);
        for k in 0..rim.len() {
            let next = (k + 1) % rim.len();
            layer.builder.face([inner[k], outer[k], outer[next]]);
            layer.builder.face([inner[k], outer[next], inner[next]]);
        }
        inner = outer;
    }
}

fn road(layer: &mut GroundBuilder, edge: &Edge, crossed: [bool; 2], random: &mut Random) {
    let profile = edge.profile;
    let paved = match profile.kind {
        RoadKind::Alley => m::COBBLES,
        RoadKind::Lane if random.chance(0.5) => m::COBBLES,
        _ if random.chance(0.22) => m::ASPHALT_FRESH,
        _ => m::ASPHALT,
    };
    layer.builder.class(Class::Road).paint(paved);
    let rows: Vec<Vec<u32>> = edge
        .path
        .iter()
        .map(|&(p, d)| cross_section(&profile).map(|side| layer.corner(p + side * d.perp(), 0.0)).collect())
        .collect();
    layer.grid_faces(&rows, |_, _, _| {});
    let line = Polyline::new(&edge.path);
    if paved == m::ASPHALT {
        for _ in 0..random.below(4) {
            let (s, side) =
                (random.range(0.1, 0.9) as f64 * line.length, random.range(-0.7, 0.5) as f64 * profile.half);
            let (long, wide) = (random.range(1.0, 4.0) as f64, random.range(0.6, 1.6) as f64);
            layer.builder.paint(m::ASPHALT_PATCH);
            layer.stripe(&line, [s, (s + long).min(line.length)], [side, side + wide], 0.4 * PAINT_HEIGHT);
        }
    }
    layer.builder.class(Class::RoadMarking).paint(m::PAINT_WHITE);
    markings(layer, &line, &profile, crossed);
}

fn markings(layer: &mut GroundBuilder, line: &Polyline, profile: &Profile, crossed: [bool; 2]) {
    let (half, length) = (profile.half, line.length);
    // lines keep clear of zebra crossings
    let clear = crossed.map(|c| if c { 7.0 } else { 0.0 });
    let (start, end) = (clear[0], length - clear[1]);
    let solid = |layer: &mut GroundBuilder, side: f64, from: f64, to: f64| {
        layer.stripe(line, [from, to], [side - 0.06, side + 0.06], PAINT_HEIGHT);
    };
    match profile.kind {
        RoadKind::Alley | RoadKind::Lane => return,
        RoadKind::Winding => {
            for side in [-0.12, 0.12] {
                solid(layer, side, 0.3 * start, length - 0.3 * clear[1]);
            }
            return;
        }
        RoadKind::Boulevard => {
            for side in [-6.7, 6.7] {
                solid(layer, side, start, end);
            }
        }
        RoadKind::Street | RoadKind::Corridor => {
            let mut at = start + 1.0;
            while at + 3.0 < end {
                solid(layer, 0.0, at, at + 3.0);
                at += 6.0;
            }
        }
    }
    for side in [-1.0, 1.0] {
        solid(layer, side * (half - 2.15), start, end);
    }
    // zebra crossings and stop lines at both ends, the stop lines in the incoming lane
    let bars = ((2.0 * half - 0.6) / 1.0) as usize;
    let ends = [[1.0, 5.2, -1.0], [length - 4.0, length - 5.6, 1.0]];
    for ([zebra, stop, way], _) in ends.into_iter().zip(crossed).filter(|end| end.1) {
        for k in 0..bars {
            let side = -0.5 * bars as f64 + 0.25 + k as f64;
            layer.stripe(line, [zebra, zebra + 3.0], [side, side + 0.5], PAINT_HEIGHT);
        }
        let lane: [f64; 2] = if way > 0.0 { [-(half - 2.3), -0.2] } else { [0.2, half - 2.3] };
        layer.stripe(line, [stop, stop + 0.4], lane, PAINT_HEIGHT);
    }
}

impl GroundBuilder<'_> {
    /// A stripe on a road between two arc lengths and two offsets (left positive).
    pub(crate) fn stripe(&mut self, line: &Polyline, [from, to]: [f64; 2], sides: [f64; 2], above: f64) {
        let count = ((to - from) / 2.0).ceil().max(1.0) as usize;
        let rows: Vec<Vec<u32>> = (0..=count)
            .map(|k| {
                let (p, d) = line.at(from + (to - from) * k as f64 / count as f64);
                sides.map(|side| self.corner(p + side * d.perp(), above)).to_vec()
            })
            .collect();
        self.grid_faces(&rows, |_, _, _| {});
    }
}

/// A polyline parametrised by arc length.
pub(crate) struct Polyline {
    points: Vec<(DVec2, DVec2)>,
    along: Vec<f64>,
    pub(crate) length: f64,
}

impl Polyline {
    pub(crate) fn new(points: &[(DVec2, DVec2)]) -> Self {
        let mut along = vec![0.0];
        for pair in points.windows(2) {
            along.push(along[along.len() - 1] + pair[0].0.distance(pair[1].0));
        }
        let length = along[along.len() - 1];
        Self { points: points.to_vec(), along, length }
    }

    /// A polyline with directions from its points.
    pub(crate) fn through(points: &[DVec2]) -> Self {
        let direction = |k: usize| {
            let (a, b) = (points[k.saturating_sub(1)], points[(k + 1).min(points.len() - 1)]);
            (b - a).normalize_or_zero()
        };
        Self::new(&(0..points.len()).map(|k| (points[k], direction(k))).collect::<Vec<_>>())
    }

    /// Point and unit direction at an arc length.
    pub(crate) fn at(&self, s: f64) -> (DVec2, DVec2) {
        if self.points.len() < 2 {
            return self.points.first().copied().unwrap_or((DVec2::ZERO, DVec2::X));
        }
        let k = self.along.partition_point(|&a| a <= s).clamp(1, self.points.len() - 1);
        let ((p, dp), (q, dq)) = (self.points[k - 1], self.points[k]);
        let t = ((s - self.along[k - 1]) / (self.along[k] - self.along[k - 1])).clamp(0.0, 1.0);
        (p.lerp(q, t), dp.lerp(dq, t).normalize_or_zero())
    }
}

/// Ground cover of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cover {
    /// Cover of the interior.
    pub(crate) ground: (Surface, Class),
    /// Cover next to the pavement.
    pub(crate) rim: (Surface, Class),
}

/// Pavement and interior of a block.
pub(crate) fn block_ground(roads: &Roads, terrain: &Terrain, walk: &[Step], cover: Cover, name: String) -> Piece {
    let rings = Rings::new(roads, walk);
    let count = rings.front.len();
    let middle = rings.front.iter().map(|p| p.at).sum::<DVec2>() / count as f64;
    let mut layer = GroundBuilder::new(terrain, middle, Class::Sidewalk);
    rings.pavement(&mut layer, 0, count);
    block_interior(&mut layer, &rings, cover);
    layer.finish(name)
}

/// The rings of a pavement: foot of the curb, back of the curb stone, front line.
struct Rings {
    foot: Vec<RingPoint>,
    stone: Vec<RingPoint>,
    front: Vec<RingPoint>,
    turns: Vec<usize>,
}

impl Rings {
    fn new(roads: &Roads, walk: &[Step]) -> Self {
        let (foot, turns) = roads.ring(walk, &|p| p.half);
        let stone = roads.ring(walk, &|p| p.half + CURB_STONE.min(0.3 * p.pavement)).0;
        let front = roads.ring(walk, &Profile::front).0;
        Self { foot, stone, front, turns }
    }

    /// Builds curb and slabs between two points of the ring.
    fn pavement(&self, layer: &mut GroundBuilder, from: usize, to: usize) {
        let count = self.foot.len();
        let row = |layer: &mut GroundBuilder, ring: &[RingPoint], high: bool| -> Vec<u32> {
            let corner = |k: usize| (ring[k % count].at, if high { ring[k % count].profile.curb } else { 0.0 });
            (from..=to).map(corner).map(|(p, above)| layer.corner(p, above)).collect()
        };
        let low = row(layer, &self.foot, false);
        let [top, stone, front] = [&self.foot, &self.stone, &self.front].map(|ring| row(layer, ring, true));
        layer.builder.class(Class::Sidewalk);
        for k in 0..to - from {
            layer.builder.paint(m::CURB);
            layer.builder.face([low[k], low[k + 1], top[k + 1]]);
            layer.builder.face([low[k], top[k + 1], top[k]]);
            layer.builder.face([top[k], top[k + 1], stone[k + 1]]);
            layer.builder.face([top[k], stone[k + 1], stone[k]]);
            let narrow = matches!(self.front[(from + k) % count].profile.kind, RoadKind::Lane | RoadKind::Alley);
            layer.builder.paint(if narrow { m::PAVERS } else { m::SLABS });
            layer.builder.face([stone[k], stone[k + 1], front[k + 1]]);
            layer.builder.face([stone[k], front[k + 1], front[k]]);
        }
    }
}

/// The ground behind the fronts, a Coons patch of the four sides.
fn block_interior(layer: &mut GroundBuilder, rings: &Rings, cover: Cover) {
    let Ok(turns) = <[usize; 4]>::try_from(rings.turns.clone()) else { return };
    let count = rings.front.len();
    let side = |from: usize, to: usize| -> Vec<DVec3> {
        let to = if to <= from { to + count } else { to };
        (from..=to).map(|k| &rings.front[k % count]).map(|p| p.at.extend(p.profile.curb)).collect()
    };
    let (south, east) = (side(turns[3], turns[0]), side(turns[0], turns[1]));
    let (mut north, mut west) = (side(turns[1], turns[2]), side(turns[2], turns[3]));
    north.reverse();
    west.reverse();
    let (nu, nv) = (south.len() - 1, east.len() - 1);
    debug_assert!(north.len() == nu + 1 && west.len() == nv + 1);
    let rows: Vec<Vec<u32>> = (0..=nu)
        .map(|i| {
            (0..=nv)
                .map(|j| {
                    let (u, v) = (i as f64 / nu as f64, j as f64 / nv as f64);
                    let p = south[i].lerp(north[i], v) + west[j].lerp(east[j], u)
                        - south[0].lerp(south[nu], u).lerp(north[0].lerp(north[nu], u), v);
                    layer.corner(p.truncate(), p.z)
                })
                .collect()
        })
        .collect();
    layer.grid_faces(&rows, |builder, i, j| {
        let rim = i < 2 || j < 2 || i + 2 >= nu || j + 2 >= nv;
        let (surface, class) = if rim { cover.rim } else { cover.ground };
        builder.paint(surface).class(class);
    });
}

/// The outer pavement of the city and the countryside, in pieces.
pub(crate) fn countryside(roads: &Roads, terrain: &Terrain, half: f64, west_gap: f64) -> Vec<Piece> {
    const PIECE: usize = 24;
    let walk = roads.walk_outside();
    let rings = Rings::new(roads, &walk);
    let count = rings.front.len();
    let far = countryside_rim(&rings, half);
    let shares = radial_shares(west_gap);
    (0..count)
        .step_by(PIECE)
        .map(|from| {
            let to = (from + PIECE).min(count);
            let mut layer = GroundBuilder::new(terrain, rings.front[from].at, Class::Sidewalk);
            rings.pavement(&mut layer, from, to);
            layer.builder.class(Class::Terrain);
            let place = |k: usize, share: f64| rings.front[k % count].at.lerp(far[k % count], share);
            let sheet: Vec<Vec<u32>> = (from..=to)
                .map(|k| {
                    let near = rings.front[k % count];
                    let at = |t: &f64| (place(k, *t), near.profile.curb * (1.0 - (20.0 * t).min(1.0)));
                    shares.iter().map(at).map(|(p, above)| layer.corner(p, above)).collect()
                })
                .collect();
            layer.grid_faces(&sheet, |builder, k, c| {
                let bare = west_gap > 0.0 && place(from + k, shares[c]).x < west_gap - half;
                builder.paint(if bare { m::PASTURE } else { m::MEADOW });
            });
            layer.finish(format!("country {}", from / PIECE))
        })
        .collect()
}

/// The outer rim of the countryside, a square, for each point of the outer ring.
fn countryside_rim(rings: &Rings, half: f64) -> Vec<DVec2> {
    let count = rings.front.len();
    let far = half + COUNTRYSIDE_METRES;
    // the turns of the walk correspond to the corners of the square
    let mut targets = vec![DVec2::ZERO; count];
    for k in 0..rings.turns.len() {
        let (from, mut to) = (rings.turns[k], rings.turns[(k + 1) % rings.turns.len()]);
        if to <= from {
            to += count;
        }
        let corner = |p: DVec2| far * DVec2::new(p.x.signum(), p.y.signum());
        let [a, b] = [from, to].map(|i| corner(rings.front[i % count].at - rings.centre()));
        for i in from..to {
            let p = rings.front[i % count].at;
            // straight outwards, with a fan at each corner, so that the lines do not cross a curved side
            let out = if a.x == b.x { DVec2::new(a.x, p.y) } else { DVec2::new(p.x, a.y) };
            let (near, steps) = if i - from <= to - i { (a, i - from) } else { (b, to - i) };
            targets[i % count] = out.lerp(near, (1.0 - steps as f64 / (CORNER_POINTS + 2) as f64).max(0.0));
        }
    }
    targets
}

impl Rings {
    fn centre(&self) -> DVec2 {
        self.turns.iter().map(|&t| self.front[t].at).sum::<DVec2>() / self.turns.len().max(1) as f64
    }
}

/// Relative distances from city to rim at which the countryside has corners: denser near the city and across a plain.
fn radial_shares(west_gap: f64) -> Vec<f64> {
    let count = 14 + ((west_gap / 40.0) as usize).min(60);
    let power = if west_gap > 0.0 { 1.3 } else { 2.0 };
    (0..=count).map(|k| (k as f64 / count as f64).powf(power)).collect()
}

/// The uv of a ground point.
pub(crate) fn uv(p: DVec2) -> Vec2 {
    p.as_vec2()
}
