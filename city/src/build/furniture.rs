//! Meshes of street furniture: lamps, signs, signals, benches, bins, bollards, shelters, fences, platforms.
//!
//! The origin is on the ground. x runs along the curb with the block on the left, the road is at -y.

use glam::{Vec2, Vec3};

use super::Builder;
use crate::materials::{self as m, Surface};
use crate::random::Random;
use crate::types::{Asset, Class};

/// Kinds of street furniture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Piece {
    Lamp,
    OldLamp,
    Signal,
    /// A traffic sign: the index of [`m::traffic_sign`].
    Sign(u8),
    /// A plate with a street name, by number.
    StreetName(u8),
    /// A give-way triangle.
    Yield,
    Bin,
    Bench,
    Bollard,
    Hydrant,
    Shelter,
    Column,
    Fence,
    Wall,
    /// A pedestrian platform on pillars.
    Platform,
}

impl Piece {
    pub(crate) fn class(self) -> Class {
        match self {
            Self::Lamp | Self::OldLamp => Class::Pole,
            Self::Signal => Class::TrafficLight,
            Self::Sign(_) | Self::StreetName(_) | Self::Yield => Class::TrafficSign,
            Self::Fence => Class::Fence,
            Self::Wall => Class::Wall,
            Self::Platform => Class::Bridge,
            _ => Class::StreetFurniture,
        }
    }

    /// Builds the asset.
    pub(crate) fn build(self, mut random: Random) -> Asset {
        let mut b = Builder::new(self.class());
        match self {
            Self::Lamp => lamp(&mut b),
            Self::OldLamp => old_lamp(&mut b),
            Self::Signal => signal(&mut b),
            Self::Sign(k) => sign(&mut b, k.into()),
            Self::StreetName(k) => street_name(&mut b, m::street_names().nth(k.into()).unwrap_or(m::SIGN_BLUE)),
            Self::Yield => give_way(&mut b),
            Self::Bin => bin(&mut b),
            Self::Bench => bench(&mut b),
            Self::Bollard => bollard(&mut b),
            Self::Hydrant => hydrant(&mut b),
            Self::Shelter => shelter(&mut b, &mut random),
            Self::Column => column(&mut b, &mut random),
            Self::Fence => fence(&mut b),
            Self::Wall => b.paint(m::STONE).block(Vec3::new(-1.0, -0.15, -0.5), Vec3::new(1.0, 0.15, 1.1)),
            Self::Platform => platform(&mut b),
        }
        b.finish(format!("{self:?}").to_lowercase())
    }
}

fn post(b: &mut Builder, at: Vec2, height: f32, radius: f32) {
    b.class(Class::Pole).paint(m::STEEL).tube(at.extend(-0.2), at.extend(height), [radius, 0.8 * radius], 8);
}

/// A street lamp with an arm over the road.
fn lamp(b: &mut Builder) {
    post(b, Vec2::ZERO, 7.2, 0.09);
    b.tube(Vec3::new(0.0, 0.0, 7.1), Vec3::new(0.0, -1.7, 7.5), [0.05, 0.04], 6);
    b.paint(m::TRIM).cuboid(Vec3::new(-0.14, -2.3, 7.42), Vec3::new(0.14, -1.6, 7.56));
    b.paint(m::LAMP_WHITE).cuboid(Vec3::new(-0.1, -2.25, 7.39), Vec3::new(0.1, -1.7, 7.43));
    b.paint(m::STEEL).block(Vec3::new(-0.13, -0.13, 0.0), Vec3::new(0.13, 0.13, 0.9));
}

fn old_lamp(b: &mut Builder) {
    b.paint(m::IRON).tube(Vec3::Z * -0.2, Vec3::Z * 0.5, [0.12, 0.1], 8);
    b.tube(Vec3::Z * 0.5, Vec3::Z * 3.2, [0.055, 0.04], 8);
    b.paint(m::LAMP_WHITE).tube(Vec3::Z * 3.2, Vec3::Z * 3.65, [0.1, 0.18], 6);
    b.paint(m::IRON).tube(Vec3::Z * 3.65, Vec3::Z * 3.9, [0.22, 0.02], 6);
}

fn signal(b: &mut Builder) {
    post(b, Vec2::ZERO, 3.2, 0.06);
    // faces +x, towards oncoming traffic in the lane beside the block
    b.class(Class::TrafficLight).paint(m::TRIM).cuboid(Vec3::new(0.07, -0.17, 2.25), Vec3::new(0.3, 0.17, 3.3));
    for (surface, z) in [(m::LAMP_RED, 3.1), (m::LAMP_AMBER, 2.78), (m::LAMP_GREEN, 2.46)] {
        b.paint(surface).tube(Vec3::new(0.3, 0.0, z), Vec3::new(0.33, 0.0, z), [0.11; 2], 10);
        b.paint(m::TRIM).cuboid(Vec3::new(0.3, -0.14, z + 0.12), Vec3::new(0.45, 0.14, z + 0.14));
    }
}

/// A board that faces +x.
fn board(b: &mut Builder, surface: Surface, [y0, y1]: [f32; 2], [z0, z1]: [f32; 2], x: f32) {
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.class(Class::TrafficSign).paint(surface);
    b.plate([p(x, y0, z0), p(x, y1, z0), p(x, y1, z1), p(x, y0, z1)]);
    b.paint(m::STEEL).plate([p(x - 0.01, y1, z0), p(x - 0.01, y0, z0), p(x - 0.01, y0, z1), p(x - 0.01, y1, z1)]);
}

fn sign(b: &mut Builder, k: usize) {
    post(b, Vec2::ZERO, 2.9, 0.035);
    b.class(Class::TrafficSign);
    match k {
        // stop: an octagon; limits: a red ring
        0 => b.paint(m::SIGN_RED).tube(Vec3::new(0.04, 0.0, 2.5), Vec3::new(0.055, 0.0, 2.5), [0.4; 2], 8),
        1 | 2 => {
            b.paint(m::SIGN_RED).tube(Vec3::new(0.04, 0.0, 2.5), Vec3::new(0.05, 0.0, 2.5), [0.36; 2], 20);
            b.paint(m::SIGN_WHITE).tube(Vec3::new(0.05, 0.0, 2.5), Vec3::new(0.056, 0.0, 2.5), [0.29; 2], 20);
        }
        _ => b.paint(m::SIGN_BLUE).cuboid(Vec3::new(0.035, -0.32, 2.18), Vec3::new(0.05, 0.32, 2.82)),
    }
    let half = if k == 0 { 0.3 } else { 0.2 };
    let tall = if k == 3 { 0.26 } else { 0.15 };
    board(b, m::traffic_sign(k), [-half, half], [2.5 - tall, 2.5 + tall], 0.06);
}

fn give_way(b: &mut Builder) {
    post(b, Vec2::ZERO, 2.8, 0.035);
    b.class(Class::TrafficSign);
    for (surface, size, x) in [(m::SIGN_RED, 0.46, 0.045), (m::SIGN_WHITE, 0.3, 0.05)] {
        let p = |y: f32, z: f32| Vec3::new(x, y * size, 2.4 + 0.866 * z * size);
        b.paint(surface).triangle([p(0.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0)]);
    }
    let p = |y: f32, z: f32| Vec3::new(0.04, y * 0.46, 2.4 + 0.4 * z);
    b.paint(m::STEEL).triangle([p(0.0, -1.0), p(-1.0, 1.0), p(1.0, 1.0)]);
}

fn street_name(b: &mut Builder, surface: Surface) {
    post(b, Vec2::ZERO, 2.8, 0.035);
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.class(Class::TrafficSign).paint(m::STEEL).cuboid(p(-0.01, -0.038, 2.39), p(1.11, -0.012, 2.66));
    b.paint(surface);
    b.plate([p(0.0, -0.04, 2.4), p(1.1, -0.04, 2.4), p(1.1, -0.04, 2.65), p(0.0, -0.04, 2.65)]);
    b.plate([p(1.1, -0.01, 2.4), p(0.0, -0.01, 2.4), p(0.0, -0.01, 2.65), p(1.1, -0.01, 2.65)]);
}

fn bin(b: &mut Builder) {
    b.paint(m::PLASTIC_GREEN).tube(Vec3::Z * 0.0, Vec3::Z * 0.85, [0.2, 0.25], 10);
    b.paint(m::TRIM).tube(Vec3::Z * 0.85, Vec3::Z * 0.93, [0.27, 0.2], 10);
}

fn bench(b: &mut Builder) {
    b.paint(m::IRON);
    for x in [-0.7, 0.65] {
        b.block(Vec3::new(x, -0.2, 0.0), Vec3::new(x + 0.05, 0.25, 0.42));
        b.block(Vec3::new(x, 0.2, 0.42), Vec3::new(x + 0.05, 0.25, 0.85));
    }
    b.paint(m::TIMBER);
    for k in 0..4 {
        let y = -0.2 + 0.11 * k as f32;
        b.cuboid(Vec3::new(-0.9, y, 0.42), Vec3::new(0.9, y + 0.09, 0.46));
    }
    for k in 0..3 {
        let z = 0.52 + 0.12 * k as f32;
        b.cuboid(Vec3::new(-0.9, 0.16, z), Vec3::new(0.9, 0.2, z + 0.09));
    }
}

fn bollard(b: &mut Builder) {
    b.paint(m::IRON).tube(Vec3::Z * -0.1, Vec3::Z * 0.9, [0.07, 0.06], 8);
    b.paint(m::SIGN_WHITE).tube(Vec3::Z * 0.72, Vec3::Z * 0.8, [0.066, 0.066], 8);
}

fn hydrant(b: &mut Builder) {
    b.paint(m::PLASTIC_RED).tube(Vec3::Z * -0.1, Vec3::Z * 0.62, [0.12, 0.11], 9);
    b.ball(Vec3::Z * 0.62, Vec3::new(0.12, 0.12, 0.12), 5, &|_| 1.0);
    b.tube(Vec3::new(-0.2, 0.0, 0.45), Vec3::new(0.2, 0.0, 0.45), [0.05; 2], 7);
}

/// A bus stop: open to the road.
fn shelter(b: &mut Builder, random: &mut Random) {
    b.paint(m::STEEL);
    for x in [-1.9, 1.85] {
        b.block(Vec3::new(x, 0.42, 0.0), Vec3::new(x + 0.05, 0.48, 2.35));
    }
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.plank([p(-2.0, -0.55, 2.4), p(2.0, -0.55, 2.4), p(2.0, 0.55, 2.5), p(-2.0, 0.55, 2.5)], 0.06);
    b.paint(m::GLASS).quad([p(-1.85, 0.45, 0.25), p(1.85, 0.45, 0.25), p(1.85, 0.45, 2.2), p(-1.85, 0.45, 2.2)]);
    b.paint(m::TIMBER).cuboid(p(-1.2, 0.1, 0.42), p(1.2, 0.4, 0.47));
    b.paint(m::TRIM).cuboid(p(1.9, -0.2, 0.4), p(1.98, 0.45, 2.1));
    b.paint(m::poster(2 + random.below(4)));
    b.plate([p(1.985, -0.15, 0.5), p(1.985, 0.4, 0.5), p(1.985, 0.4, 2.0), p(1.985, -0.15, 2.0)]);
    b.plate([p(1.895, 0.4, 0.5), p(1.895, -0.15, 0.5), p(1.895, -0.15, 2.0), p(1.895, 0.4, 2.0)]);
}

/// An advertising column with eight sides.
fn column(b: &mut Builder, random: &mut Random) {
    const FLAT: f32 = 0.37;
    let half = FLAT * (std::f32::consts::PI / 8.0).tan();
    for k in 0..8 {
        let turn = std::f32::consts::TAU * k as f32 / 8.0;
        let (out, along) = (Vec3::new(turn.cos(), turn.sin(), 0.0), Vec3::new(-turn.sin(), turn.cos(), 0.0));
        let side = |s: f32, z0: f32, z1: f32, above: f32| {
            let p = |s: f32, z: f32| (FLAT + above) * out + s * along + Vec3::Z * z;
            [p(-s, z0), p(s, z0), p(s, z1), p(-s, z1)]
        };
        b.paint(m::CONCRETE).quad(side(half, 0.0, 2.6, 0.0));
        b.paint(m::poster(2 + random.below(4))).plate(side(0.9 * half, 1.5, 1.75, 0.003));
    }
    b.paint(m::ZINC).tube(Vec3::Z * 2.6, Vec3::Z * 2.95, [0.46, 0.1], 16);
}

/// Two metres of fence along x.
fn fence(b: &mut Builder) {
    b.paint(m::TIMBER).block(Vec3::new(-0.05, -0.05, -0.6), Vec3::new(0.05, 0.05, 1.1));
    for z in [0.3, 0.8] {
        b.cuboid(Vec3::new(-1.0, -0.02, z), Vec3::new(1.0, 0.02, z + 0.08));
    }
    for k in 0..14 {
        let x = -1.0 + 2.0 * k as f32 / 14.0;
        b.block(Vec3::new(x, -0.045, -0.3), Vec3::new(x + 0.09, -0.02, 1.0));
    }
}

/// A raised platform of 20 m × 12 m with railings, pillars and stairs.
fn platform(b: &mut Builder) {
    let (low, high, z) = (Vec2::new(-10.0, 0.0), Vec2::new(10.0, 12.0), 4.2);
    b.class(Class::Bridge).paint(m::CONCRETE).cuboid(low.extend(z - 0.5), high.extend(z));
    b.class(Class::Sidewalk).paint(m::SLABS);
    let p = |x: f32, y: f32| Vec3::new(x, y, z + 0.004);
    b.quad([p(low.x, low.y), p(high.x, low.y), p(high.x, high.y), p(low.x, high.y)]);
    b.class(Class::Bridge).paint(m::CONCRETE_SMOOTH);
    for x in [-8.5, 0.0, 8.5] {
        for y in [1.5, 10.5] {
            b.tube(Vec3::new(x, y, -2.0), Vec3::new(x, y, z - 0.5), [0.3; 2], 12);
        }
    }
    // the stairs arrive at the right end of the back edge
    let corners = [low, Vec2::new(high.x, low.y), high, Vec2::new(8.0, high.y), Vec2::new(low.x, high.y)];
    for (from, to) in [(0, 1), (1, 2), (3, 4), (4, 0)] {
        railing(b, corners[from].extend(z), corners[to].extend(z));
    }
    b.class(Class::Bridge).paint(m::CONCRETE);
    let steps = 24;
    for k in 0..steps {
        let (rise, run) = (z / steps as f32, 0.3);
        let (top, y) = (z - rise * k as f32, high.y + run * k as f32);
        b.cuboid(Vec3::new(8.05, y, top - 2.5 * rise), Vec3::new(9.95, y + run, top - rise * 0.5));
    }
}

/// A railing with posts and three tubes between two points.
pub(crate) fn railing(b: &mut Builder, from: Vec3, to: Vec3) {
    b.class(Class::GuardRail).paint(m::STEEL);
    let count = ((to - from).length() / 2.0).ceil().max(1.0) as usize;
    for k in 0..=count {
        let p = from.lerp(to, k as f32 / count as f32);
        b.tube(p - Vec3::Z * 0.02, p + Vec3::Z * 1.1, [0.03; 2], 6);
    }
    for z in [0.4, 0.75, 1.1] {
        b.tube(from + Vec3::Z * z, to + Vec3::Z * z, [0.025; 2], 6);
    }
}
