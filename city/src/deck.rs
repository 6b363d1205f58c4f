//! The deck: a road on pillars over the boulevard, with ramps down to it at both ends and guardrails on both sides.

use glam::{Affine3A, DVec2, DVec3, Vec3};

use crate::build::ground::{GroundBuilder, Piece, Polyline, uv};
use crate::materials as m;
use crate::roads::{Roads, Step};
use crate::terrain::Terrain;
use crate::types::Class;

/// Half the carriageway on the deck; two lanes each way.
const HALF: f64 = 6.2;
/// Width of a barrier.
const BARRIER: f64 = 0.3;
/// Height of the deck's surface over the boulevard.
const HIGH: f64 = 6.2;
/// Thickness of the deck.
const THICK: f64 = 0.9;
/// From the middle to the inner and to the outer lane.
pub(crate) const LANES: [f64; 2] = [1.6, 4.6];
/// Distance of a ramp's foot from the end of the boulevard.
const FOOT: f64 = 15.0;
/// Ramps have side walls down to the ground up to this height.
const CLOSED: f64 = 2.6;

/// Course and height of the deck.
pub(crate) struct Deck<'a> {
    line: Polyline,
    terrain: &'a Terrain,
    /// Intervals of arc length over crossings.
    crossings: Vec<[f64; 2]>,
    ramp: f64,
}

impl<'a> Deck<'a> {
    pub(crate) fn new(roads: &Roads, terrain: &'a Terrain) -> Option<Self> {
        let j = roads.deck?;
        let mut walk = Vec::new();
        for i in 0..roads.cells[0] {
            walk.push(Step::Along { edge: roads.horizontal(i, j), forward: true });
            if i + 1 < roads.cells[0] {
                walk.push(Step::Through { node: roads.node(i + 1, j), from: 2, to: 0, turn: false });
            }
        }
        let ring = roads.ring(&walk, &|_| 0.0).0;
        let line = Polyline::through(&ring.iter().map(|p| p.at).collect::<Vec<_>>());
        let mut crossings: Vec<[f64; 2]> = Vec::new();
        let mut s = 0.0;
        for (k, point) in ring.iter().enumerate() {
            s += if k > 0 { point.at.distance(ring[k - 1].at) } else { 0.0 };
            if matches!(walk[point.step], Step::Through { .. }) {
                match crossings.last_mut() {
                    Some(last) if s - last[1] < 12.0 => last[1] = s,
                    _ => crossings.push([s, s]),
                }
            }
        }
        let ramp = (0.46 * (line.length - 2.0 * FOOT)).min(115.0);
        (ramp > 40.0).then_some(Self { line, terrain, crossings, ramp })
    }

    /// Height above the boulevard.
    fn lift(&self, s: f64) -> f64 {
        let from_foot = (s - FOOT).min(self.line.length - FOOT - s);
        let t = (from_foot / self.ramp).clamp(0.0, 1.0);
        HIGH.min(0.075 * self.ramp) * t * t * (3.0 - 2.0 * t)
    }

    /// A point on the deck's surface, `side` to the left of the line.
    pub(crate) fn at(&self, s: f64, side: f64) -> DVec3 {
        let (p, along) = self.line.at(s);
        let q = p + side * along.perp();
        let (here, middle) = (self.terrain.height(q), self.terrain.height(p));
        // horizontal across at full height, following the road at the feet of the ramps
        let level = (self.lift(s) / 2.0).min(1.0);
        q.extend(here + (middle - here) * level + self.lift(s))
    }

    /// Arc lengths of the first and last point of the deck.
    fn ends(&self) -> [f64; 2] {
        let start = (0..).map(|k| FOOT + 0.25 * f64::from(k)).find(|&s| self.lift(s) > 0.03).unwrap_or(FOOT);
        [start, self.line.length - start]
    }

    /// A lane from ramp to ramp, before the turning loops: eastwards on the right side, westwards on the left.
    pub(crate) fn lane(&self, offset: f64, east: bool) -> Vec<DVec3> {
        let [from, to] = [FOOT - 2.0, self.line.length - FOOT + 2.0];
        let count = ((to - from) / 4.0) as usize;
        let side = if east { -offset } else { offset };
        let lane = (0..=count).map(|k| self.at(from + (to - from) * k as f64 / count as f64, side));
        if east { lane.collect() } else { lane.rev().collect() }
    }

    /// The closed route of vehicles: the outer lanes, joined by turns at the feet of the ramps.
    pub(crate) fn route(&self) -> Vec<DVec3> {
        let [from, to] = [FOOT - 5.0, self.line.length - FOOT + 5.0];
        let radius = LANES[1];
        let count = ((to - from) / 4.0) as usize;
        let lane = |k: usize, side: f64| self.at(from + (to - from) * k as f64 / count as f64, side);
        let turn = |s: f64, way: f64, k: usize| {
            let angle = std::f64::consts::PI * k as f64 / 8.0;
            self.at(s + way * radius * angle.sin(), -way * radius * angle.cos())
        };
        let mut route: Vec<DVec3> = (0..=count).map(|k| lane(k, -radius)).collect();
        route.extend((1..8).map(|k| turn(to, 1.0, k)));
        route.extend((0..=count).rev().map(|k| lane(k, radius)));
        route.extend((1..8).map(|k| turn(from, -1.0, k)));
        route
    }

    /// The deck in pieces of about 60 m.
    pub(crate) fn pieces(&self) -> Vec<Piece> {
        let [from, to] = self.ends();
        let count = ((to - from) / 3.0).ceil() as usize;
        let stations: Vec<f64> = (0..=count).map(|k| from + (to - from) * k as f64 / count as f64).collect();
        (0..count).step_by(20).map(|k| self.piece(&stations[k..=(k + 20).min(count)], k / 20)).collect()
    }

    fn piece(&self, stations: &[f64], number: usize) -> Piece {
        let mut layer = GroundBuilder::new(self.terrain, self.line.at(stations[0]).0, Class::Bridge);
        self.surface(&mut layer, stations);
        for pair in stations.windows(2) {
            self.sides(&mut layer, [pair[0], pair[1]]);
        }
        for side in [-1.0, 1.0] {
            self.guardrail(&mut layer, stations, side);
        }
        let [low, high] = [stations[0], stations[stations.len() - 1]];
        self.piers(&mut layer, low, high);
        let end = |s: f64| self.lift(s) < CLOSED;
        // abutments where the side walls of a ramp end
        for pair in stations.windows(2) {
            if end(pair[0]) != end(pair[1]) {
                self.abutment(&mut layer, pair[usize::from(end(pair[0]))], end(pair[0]));
            }
        }
        layer.finish(format!("deck {number}"))
    }

    fn local(&self, layer: &GroundBuilder, s: f64, side: f64, above: f64) -> Vec3 {
        (self.at(s, side) + DVec3::Z * above - layer.origin).as_vec3()
    }

    fn surface(&self, layer: &mut GroundBuilder, stations: &[f64]) {
        let mut strip = |surface, class, sides: &[f64], above: f64, every: usize, dash: bool| {
            layer.builder.paint(surface).class(class);
            for (k, pair) in stations.windows(2).enumerate() {
                if dash && k % every != 0 {
                    continue;
                }
                for across in sides.windows(2) {
                    let corners =
                        [(pair[0], across[0]), (pair[1], across[0]), (pair[1], across[1]), (pair[0], across[1])];
                    let corners = corners.map(|(s, side)| {
                        let at = (self.at(s, side) + DVec3::Z * above - layer.origin).as_vec3();
                        layer.builder.corner(at, uv(self.line.at(s).0 + side * self.line.at(s).1.perp()))
                    });
                    layer.builder.face([corners[0], corners[1], corners[2]]);
                    layer.builder.face([corners[0], corners[2], corners[3]]);
                }
            }
        };
        strip(m::ASPHALT, Class::Road, &[-HALF, -0.5 * HALF, 0.0, 0.5 * HALF, HALF], 0.0, 1, false);
        for side in [-HALF + 0.15, -0.1, 0.1, HALF - 0.15] {
            strip(m::PAINT_WHITE, Class::RoadMarking, &[side - 0.06, side + 0.06], 0.006, 1, false);
        }
        for side in [-3.1, 3.1] {
            strip(m::PAINT_WHITE, Class::RoadMarking, &[side - 0.06, side + 0.06], 0.006, 3, true);
        }
    }

    /// The outer faces and the underside between two stations.
    fn sides(&self, layer: &mut GroundBuilder, [a, b]: [f64; 2]) {
        let edge = HALF + BARRIER;
        let closed = self.lift(a) < CLOSED;
        let bottom = |s: f64, side: f64| {
            let top = self.at(s, side);
            let z = if closed { self.terrain.height(top.truncate()) - 0.3 } else { top.z - THICK };
            (top.with_z(z) - layer.origin).as_vec3()
        };
        let quads = [
            [bottom(a, -edge), bottom(b, -edge), self.local(layer, b, -edge, 0.0), self.local(layer, a, -edge, 0.0)],
            [bottom(b, edge), bottom(a, edge), self.local(layer, a, edge, 0.0), self.local(layer, b, edge, 0.0)],
        ];
        let under = [bottom(a, edge), bottom(b, edge), bottom(b, -edge), bottom(a, -edge)];
        layer.builder.class(if closed { Class::Wall } else { Class::Bridge }).paint(m::CONCRETE);
        quads.into_iter().for_each(|q| layer.builder.quad(q));
        if !closed {
            layer.builder.paint(m::CONCRETE_SMOOTH).quad(under);
        }
    }

    /// A concrete base, posts and a steel beam.
    fn guardrail(&self, layer: &mut GroundBuilder, stations: &[f64], side: f64) {
        layer.builder.class(Class::GuardRail);
        let (inner, outer) = (side * HALF, side * (HALF + BARRIER));
        for pair in stations.windows(2) {
            let [a, b] = [pair[0], pair[1]];
            self.bar(layer, [a, b], [inner, outer], [0.0, 0.45], m::CONCRETE);
            self.bar(layer, [a, b], [inner - 0.02 * side, inner + 0.06 * side], [0.62, 0.92], m::STEEL);
            let at = self.local(layer, a, side * (HALF + 0.12), 0.4);
            layer.builder.paint(m::STEEL).block(at - Vec3::new(0.06, 0.06, 0.0), at + Vec3::new(0.06, 0.06, 0.6));
        }
    }

    /// A bar of four faces between two stations.
    fn bar(
        &self,
        layer: &mut GroundBuilder,
        [a, b]: [f64; 2],
        sides: [f64; 2],
        heights: [f64; 2],
        surface: m::Surface,
    ) {
        let right = sides[0].min(sides[1]);
        let left = sides[0].max(sides[1]);
        let p = |s: f64, side: f64, above: f64| self.local(layer, s, side, above);
        let [low, high] = heights;
        let quads = [
            [p(a, right, low), p(b, right, low), p(b, right, high), p(a, right, high)],
            [p(b, left, low), p(a, left, low), p(a, left, high), p(b, left, high)],
            [p(a, right, high), p(b, right, high), p(b, left, high), p(a, left, high)],
            [p(a, left, low), p(b, left, low), p(b, right, low), p(a, right, low)],
        ];
        layer.builder.paint(surface);
        quads.into_iter().for_each(|q| layer.builder.quad(q));
    }

    /// Pillars with crossheads, clear of crossings.
    fn piers(&self, layer: &mut GroundBuilder, low: f64, high: f64) {
        const EVERY: f64 = 22.0;
        let first = (low / EVERY).ceil() as usize;
        for s in (first..).map(|k| k as f64 * EVERY).take_while(|&s| s < high) {
            let near = self.crossings.iter().any(|c| s > c[0] - 6.0 && s < c[1] + 6.0);
            if near || self.lift(s) < CLOSED + 0.8 {
                continue;
            }
            let top = self.at(s, 0.0) - DVec3::Z * THICK - layer.origin;
            let ground = self.terrain.height(self.line.at(s).0) - layer.origin.z;
            let heading = self.line.at(s).1.to_angle() as f32;
            let tall = (top.z - ground) as f32;
            let frame = Affine3A::from_translation(top.as_vec3()) * Affine3A::from_rotation_z(heading);
            layer.builder.class(Class::Bridge).within(frame, |b| {
                b.paint(m::CONCRETE).tube(Vec3::Z * (-tall - 1.0), Vec3::Z * -0.7, [0.65; 2], 16);
                b.cuboid(Vec3::new(-0.7, -5.6, -0.75), Vec3::new(0.7, 5.6, 0.0));
            });
        }
    }

    /// The wall across the road where a ramp becomes a bridge; it faces east or west.
    fn abutment(&self, layer: &mut GroundBuilder, s: f64, east: bool) {
        let edge = HALF + BARRIER;
        let p = |side: f64, top: bool| {
            let at = self.at(s, side);
            let z = if top { at.z - 0.05 } else { self.terrain.height(at.truncate()) - 0.3 };
            (at.with_z(z) - layer.origin).as_vec3()
        };
        let side = if east { edge } else { -edge };
        let quad = [p(-side, false), p(side, false), p(side, true), p(-side, true)];
        layer.builder.class(Class::Wall).paint(m::CONCRETE).quad(quad);
    }

    /// Positions of lamps on the outer edges every 30 m, with the direction of the adjacent lane.
    pub(crate) fn lamps(&self) -> Vec<(DVec3, DVec2)> {
        let count = (self.line.length / 30.0) as usize;
        let lamp = |k: usize| {
            let side = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
            let s = 30.0 * (k as f64 + 0.5);
            (self.lift(s) > 1.0).then(|| {
                let at = self.at(s, side * (HALF + 0.5 * BARRIER)) + DVec3::Z * 0.45;
                // a lamp's arm points to -y, over the road
                (at, self.line.at(s).1 * side)
            })
        };
        (0..count).filter_map(lamp).collect()
    }
}
