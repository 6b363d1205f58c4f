//! What stands in the small city: a grid of streets, blocks of houses around courtyards, trees, lamps and parked cars.

use glam::{Vec2, Vec3};

/// Half the carriageway, metres: a driving lane and a parking lane.
pub(super) const HALF_ROAD: f32 = 5.0;
/// Width of each pavement, metres.
pub(super) const PAVEMENT: f32 = 2.5;
/// The lane in which the capture's vehicle drives, metres right of the centre line.
pub(super) const LANE: f32 = 1.6;
const FLOOR: f32 = 3.2;
const GROUND_FLOOR: f32 = 4.0;

/// A body that rays can hit; `min` and `max` bound it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Solid {
    pub(super) min: Vec3,
    pub(super) max: Vec3,
    pub(super) shape: Shape,
    pub(super) material: Material,
    pub(super) seed: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    /// Fills its bounds.
    Box,
    /// A roof: a triangular prism whose ridge runs along x (or else y) at `max.z`.
    Gable { along_x: bool },
    /// Touches all six sides of its bounds.
    Ellipsoid,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Material {
    Brick,
    Plaster,
    Tower,
    RoofTiles,
    FlatRoof,
    Balcony,
    Awning,
    CarBody,
    CarCabin,
    Foliage,
    Bark,
    Metal,
    Stone,
}

/// The street grid: `blocks × blocks` blocks centred on the origin, streets along every line between and around them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    pub(super) seed: u32,
    pub(super) extent: f32,
    pub(super) blocks: u32,
    /// Distance of neighbouring street lines.
    pub(super) pitch: f32,
    /// West of this is a bare plain.
    pub(super) plain: f32,
}

impl Layout {
    pub(super) fn new(seed: u64, extent_metres: f64, plain: f64) -> Self {
        let blocks = ((extent_metres / 66.0).round() as u32).max(2);
        let extent = extent_metres as f32;
        let plain = if plain > 0.0 { (plain as f32 - 0.5) * extent } else { f32::NEG_INFINITY };
        Self { seed: hash(seed as u32, (seed >> 32) as u32, 1), extent, blocks, pitch: extent / blocks as f32, plain }
    }

    /// The coordinate of street line `k`, `0..=blocks`.
    pub(super) fn line(&self, k: u32) -> f32 {
        k as f32 * self.pitch - 0.5 * self.extent
    }

    /// The signed distance to the nearest street line along one axis.
    pub(super) fn off_line(&self, coordinate: f32) -> f32 {
        let k = ((coordinate + 0.5 * self.extent) / self.pitch).round().clamp(0.0, self.blocks as f32);
        coordinate - self.line(k as u32)
    }

    /// The block that holds a ground point.
    pub(super) fn block(&self, p: Vec2) -> (u32, u32) {
        let index = |c: f32| (((c + 0.5 * self.extent) / self.pitch) as u32).min(self.blocks - 1);
        (index(p.x), index(p.y))
    }

    /// One block in five is a park; so is the middle one.
    pub(super) fn is_park(&self, (x, y): (u32, u32)) -> bool {
        (x == self.blocks / 2 && y == self.blocks / 2) || hash(self.seed, x + 1, y + 7).is_multiple_of(9)
    }
}

/// Everything that stands on the ground.
pub(super) fn build(layout: &Layout) -> Vec<Solid> {
    let mut city = Builder { solids: Vec::new(), random: Random::new(layout.seed, 0) };
    for y in 0..layout.blocks {
        for x in 0..layout.blocks {
            city.random = Random::new(layout.seed, 1 + x + y * layout.blocks);
            let inset = Vec2::splat(HALF_ROAD + PAVEMENT);
            let min = Vec2::new(layout.line(x), layout.line(y)) + inset;
            let max = Vec2::new(layout.line(x + 1), layout.line(y + 1)) - inset;
            if layout.is_park((x, y)) { city.park(min, max) } else { city.houses(min, max) }
        }
    }
    city.random = Random::new(layout.seed, u32::MAX);
    for k in 0..=layout.blocks {
        for along_x in [false, true] {
            city.kerbside(layout, layout.line(k), along_x);
        }
    }
    city.solids.retain(|solid| solid.min.x >= layout.plain);
    city.solids
}

struct Builder {
    solids: Vec<Solid>,
    random: Random,
}

impl Builder {
    fn add(&mut self, min: Vec3, max: Vec3, shape: Shape, material: Material) {
        let seed = self.random.bits();
        self.solids.push(Solid { min, max, shape, material, seed });
    }

    /// Four rows of houses along the sides of a block, a courtyard with trees within.
    fn houses(&mut self, min: Vec2, max: Vec2) {
        let depth = (0.22 * (max - min).min_element()).clamp(6.0, 11.0);
        for (at, far) in [(min.y, false), (max.y - depth, true)] {
            self.row(min.x, max.x, |from, to| (Vec2::new(from, at), Vec2::new(to, at + depth)), Side::y(far));
        }
        let (from, to) = (min.y + depth, max.y - depth);
        for (at, far) in [(min.x, false), (max.x - depth, true)] {
            self.row(from, to, |from, to| (Vec2::new(at, from), Vec2::new(at + depth, to)), Side::x(far));
        }
        let (yard_min, yard_max) = (min + depth + 3.0, max - depth - 3.0);
        for _ in 0..5 {
            let place = self.random.between(yard_min, yard_max);
            self.tree(place, 1.0);
        }
    }

    fn row(&mut self, from: f32, to: f32, lot: impl Fn(f32, f32) -> (Vec2, Vec2), street: Side) {
        let mut at = from;
        while to - at > 1.0 {
            let mut width = self.random.range(8.0, 16.0);
            if to - at - width < 8.0 {
                width = to - at;
            }
            // a gap in the row now and then
            if self.random.unit() > 0.07 || width > 16.0 {
                let (min, max) = lot(at, at + width);
                self.house(min, max, street);
            }
            at += width;
        }
    }

    fn house(&mut self, min: Vec2, max: Vec2, street: Side) {
        let tall = self.random.unit() < 0.08;
        let floors = if tall { self.random.range(6.0, 9.0) } else { self.random.range(1.0, 5.0) }.floor();
        let eaves = GROUND_FLOOR + FLOOR * floors + 0.4;
        let wall = match self.random.unit() {
            _ if tall => Material::Tower,
            u if u < 0.45 => Material::Brick,
            _ => Material::Plaster,
        };
        self.add(min.extend(0.0), max.extend(eaves), Shape::Box, wall);
        if !tall && self.random.unit() < 0.65 {
            let rise = 0.38 * if street.along_x { max.y - min.y } else { max.x - min.x };
            let overhang = if street.along_x { Vec2::new(0.0, 0.4) } else { Vec2::new(0.4, 0.0) };
            let (low, high) = ((min - overhang).extend(eaves), (max + overhang).extend(eaves + rise));
            self.add(low, high, Shape::Gable { along_x: street.along_x }, Material::RoofTiles);
            let foot = self.random.between(min + 1.5, max - 2.5);
            let top = foot + self.random.range(0.7, 1.1);
            self.add(foot.extend(eaves), top.extend(eaves + rise + 0.6), Shape::Box, Material::Stone);
        } else {
            let low = eaves + 0.0;
            self.add((min + 0.3).extend(low), (max - 0.3).extend(low + 0.25), Shape::Box, Material::FlatRoof);
            for _ in 0..3 {
                let size = Vec2::new(self.random.range(1.0, 2.6), self.random.range(1.0, 2.6));
                let foot = self.random.between(min + 1.0, max - 1.0 - size);
                let top = low + self.random.range(0.9, 2.4);
                self.add(foot.extend(low), (foot + size).extend(top), Shape::Box, Material::Metal);
            }
        }
        self.front(min, max, street, floors as u32);
    }

    /// What juts out of the street front: balconies and awnings.
    fn front(&mut self, min: Vec2, max: Vec2, street: Side, floors: u32) {
        let jut = |from: f32, to: f32, out: f32| {
            let (a, b) = if street.along_x {
                let y = if street.far { (max.y, max.y + out) } else { (min.y - out, min.y) };
                (Vec2::new(min.x + from, y.0), Vec2::new(min.x + to, y.1))
            } else {
                let x = if street.far { (max.x, max.x + out) } else { (min.x - out, min.x) };
                (Vec2::new(x.0, min.y + from), Vec2::new(x.1, min.y + to))
            };
            (a, b)
        };
        let width = if street.along_x { max.x - min.x } else { max.y - min.y };
        if self.random.unit() < 0.5 {
            let (from, to) = (0.1 * width, self.random.range(0.45, 0.9) * width);
            let (a, b) = jut(from, to, 1.3);
            self.add(a.extend(2.9), b.extend(3.25), Shape::Box, Material::Awning);
        }
        if self.random.unit() < 0.45 {
            let from = self.random.range(0.1, 0.5) * width;
            for floor in 0..floors {
                let (a, b) = jut(from, from + 3.2, 1.1);
                let z = GROUND_FLOOR + FLOOR * floor as f32;
                self.add(a.extend(z), b.extend(z + 1.0), Shape::Box, Material::Balcony);
            }
        }
    }

    /// Trees on grass, and a clock tower.
    fn park(&mut self, min: Vec2, max: Vec2) {
        let centre = 0.5 * (min + max);
        let around = |half: f32, z0: f32, z1: f32| ((centre - half).extend(z0), (centre + half).extend(z1));
        let (a, b) = around(4.5, 0.0, 0.6);
        self.add(a, b, Shape::Box, Material::Stone);
        let (a, b) = around(2.6, 0.6, 22.0);
        self.add(a, b, Shape::Box, Material::Brick);
        let (a, b) = around(3.0, 22.0, 22.6);
        self.add(a, b, Shape::Box, Material::Stone);
        let (a, b) = around(2.8, 22.6, 28.0);
        self.add(a, b, Shape::Gable { along_x: true }, Material::RoofTiles);
        let count = ((max - min).element_product() / 90.0) as u32;
        for _ in 0..count {
            let place = self.random.between(min + 2.0, max - 2.0);
            let off_paths = (place - centre).abs().min_element() > 4.0;
            if off_paths {
                self.tree(place, 1.4);
            }
        }
    }

    fn tree(&mut self, foot: Vec2, size: f32) {
        let trunk = size * self.random.range(2.2, 3.0);
        self.add((foot - 0.16).extend(0.0), (foot + 0.16).extend(trunk + 0.6), Shape::Box, Material::Bark);
        for _ in 0..4 {
            let r = Vec3::new(1.0, 1.0, 0.9) * size * self.random.range(0.9, 1.5);
            let spread = Vec2::splat(0.8 * size);
            let at = (foot + self.random.between(-spread, spread)).extend(trunk + size * self.random.range(0.6, 2.0));
            self.add(at - r, at + r, Shape::Ellipsoid, Material::Foliage);
        }
    }

    /// Parked cars, trees and lamps along both sides of one street line.
    fn kerbside(&mut self, layout: &Layout, line: f32, along_x: bool) {
        let place = |along: f32, across: f32| {
            if along_x { Vec2::new(along, line + across) } else { Vec2::new(line + across, along) }
        };
        let free = |along: f32| layout.off_line(along).abs() > HALF_ROAD + 5.0;
        let half = 0.5 * layout.extent;
        for side in [-1.0, 1.0] {
            let mut at = -half;
            while at < half {
                at += self.random.range(5.4, 14.0);
                if at < half && free(at) {
                    let (centre, half_width) = (place(at, side * (HALF_ROAD - 1.15)), 0.9);
                    let half_length = self.random.range(1.9, 2.3);
                    let half_size =
                        if along_x { Vec2::new(half_length, half_width) } else { Vec2::new(half_width, half_length) };
                    self.car(centre, half_size);
                }
            }
            let mut at = -half + self.random.range(2.0, 8.0);
            while at < half {
                let foot = place(at, side * (HALF_ROAD + 0.7));
                if free(at) && self.random.unit() < 0.6 {
                    self.tree(foot, 0.8);
                } else if free(at) {
                    self.add((foot - 0.09).extend(0.0), (foot + 0.09).extend(6.0), Shape::Box, Material::Metal);
                    let arm = place(at, side * (HALF_ROAD - 0.6));
                    let (a, b) = (foot.min(arm) - 0.12, foot.max(arm) + 0.12);
                    self.add(a.extend(5.9), b.extend(6.1), Shape::Box, Material::Metal);
                }
                at += self.random.range(10.0, 16.0);
            }
        }
    }

    fn car(&mut self, centre: Vec2, half: Vec2) {
        let seed = self.solids.len();
        self.add((centre - half).extend(0.28), (centre + half).extend(0.95), Shape::Box, Material::CarBody);
        let cabin = half * if half.x > half.y { Vec2::new(0.58, 0.86) } else { Vec2::new(0.86, 0.58) };
        self.add((centre - cabin).extend(0.95), (centre + cabin).extend(1.5), Shape::Box, Material::CarCabin);
        for corner in [Vec2::new(-1.0, -1.0), Vec2::new(-1.0, 1.0), Vec2::new(1.0, -1.0), Vec2::new(1.0, 1.0)] {
            let wheel = centre + half * 0.66 * corner + 0.3 * half * corner * Vec2::new(0.2, 0.2);
            let r = Vec2::splat(0.3);
            self.add((wheel - r).extend(0.0), (wheel + r).extend(0.6), Shape::Ellipsoid, Material::Bark);
        }
        // the cabin's pillars take the colour of the body
        self.solids[seed + 1].seed = self.solids[seed].seed;
    }
}

/// The side of a lot that faces the street: the wall runs along x or y, on the near (low) or far side.
#[derive(Clone, Copy)]
struct Side {
    along_x: bool,
    far: bool,
}

impl Side {
    fn y(far: bool) -> Self {
        Self { along_x: true, far }
    }
    fn x(far: bool) -> Self {
        Self { along_x: false, far }
    }
}

/// Mixes three words into one (finaliser of MurmurHash3 over a multiply-xor chain).
pub(super) fn hash(a: u32, b: u32, c: u32) -> u32 {
    let mut h = a.wrapping_mul(0x9E37_79B1) ^ b.wrapping_mul(0x85EB_CA77) ^ c.wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 16;
    h = h.wrapping_mul(0x7FEB_352D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x846C_A68B);
    h ^ (h >> 16)
}

/// A hash as a number in [0, 1).
pub(super) fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / (1 << 24) as f32)
}

/// A counter and a key: the n-th number is a hash of both.
pub(super) struct Random {
    key: u32,
    stream: u32,
    count: u32,
}

impl Random {
    pub(super) fn new(key: u32, stream: u32) -> Self {
        Self { key, stream, count: 0 }
    }

    pub(super) fn bits(&mut self) -> u32 {
        self.count += 1;
        hash(self.key, self.stream, self.count)
    }

    pub(super) fn unit(&mut self) -> f32 {
        unit(self.bits())
    }

    pub(super) fn range(&mut self, from: f32, to: f32) -> f32 {
        from + (to - from) * self.unit()
    }

    fn between(&mut self, min: Vec2, max: Vec2) -> Vec2 {
        min + (max - min) * Vec2::new(self.unit(), self.unit())
    }

    /// Normally distributed with unit variance (Box-Muller).
    pub(super) fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.unit()).cos()
    }
}
