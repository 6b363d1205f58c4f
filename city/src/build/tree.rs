//! Meshes of trees and hedges: trunk and branches, a crown of ellipsoids, and single leaves along its outline.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use super::Builder;
use crate::materials::{self as m, Surface};
use crate::random::Random;
use crate::types::{Asset, Class};

/// A tree species; lengths in metres.
struct Species {
    name: &'static str,
    height: f32,
    /// Height at which the crown begins.
    trunk: f32,
    radius: f32,
    bark: Surface,
    leaves: [Surface; 2],
    shape: Shape,
}

enum Shape {
    Round,
    Column,
    Cone,
}

const fn species(
    name: &'static str,
    [height, trunk, radius]: [f32; 3],
    bark: Surface,
    leaves: [Surface; 2],
    shape: Shape,
) -> Species {
    Species { name, height, trunk, radius, bark, leaves, shape }
}

const SPECIES: [Species; 9] = [
    species("lime", [9.0, 2.6, 2.8], m::BARK, [m::LEAVES, m::LEAVES_LIGHT], Shape::Round),
    species("maple", [7.0, 2.4, 2.5], m::BARK, [m::LEAVES, m::LEAVES], Shape::Round),
    species("plane", [12.0, 3.4, 3.8], m::BARK_BIRCH, [m::LEAVES_LIGHT, m::LEAVES], Shape::Round),
    species("copper beech", [10.0, 2.2, 3.6], m::BARK, [m::LEAVES_RED, m::LEAVES_RED], Shape::Round),
    species("birch", [8.5, 2.6, 1.7], m::BARK_BIRCH, [m::LEAVES_LIGHT, m::LEAVES_LIGHT], Shape::Column),
    species("poplar", [13.0, 1.6, 1.4], m::BARK, [m::LEAVES, m::LEAVES_DARK], Shape::Column),
    species("fir", [11.0, 1.0, 2.3], m::BARK, [m::LEAVES_DARK, m::LEAVES_DARK], Shape::Cone),
    species("cypress", [6.0, 0.3, 1.0], m::BARK, [m::LEAVES_DARK, m::LEAVES], Shape::Column),
    species("young lime", [5.0, 2.3, 1.3], m::BARK, [m::LEAVES_LIGHT, m::LEAVES], Shape::Round),
];

/// Number of species.
pub(crate) const KINDS: usize = SPECIES.len();
/// Species that are narrow enough for a pavement and high enough to walk under.
pub(crate) const STREET_KINDS: [usize; 4] = [0, 1, 4, 8];

/// A tree with its foot at the origin.
pub(crate) fn tree(kind: usize, mut random: Random) -> Asset {
    let species = &SPECIES[kind % KINDS];
    let mut b = Builder::new(Class::Vegetation);
    let width = 0.028 * species.height;
    b.paint(species.bark);
    b.tube(Vec3::new(0.0, 0.0, -0.3), Vec3::new(0.0, 0.0, 0.15), [1.5 * width, width], 8);
    b.tube(Vec3::new(0.0, 0.0, 0.15), Vec3::new(0.0, 0.0, species.trunk), [width, 0.8 * width], 8);
    match species.shape {
        Shape::Cone => cone(&mut b, species, &mut random),
        Shape::Column => column(&mut b, species, &mut random),
        Shape::Round => round(&mut b, species, &mut random),
    }
    b.finish(format!("tree, {}", species.name))
}

/// A round crown of lumps on branches.
fn round(b: &mut Builder, species: &Species, random: &mut Random) {
    let top = Vec3::new(0.0, 0.0, species.trunk);
    let (rise, width) = (species.height - species.trunk, 0.02 * species.height);
    let lumps = 6;
    for k in 0..=lumps {
        let turn = TAU * k as f32 / lumps as f32 + random.range(-0.3, 0.3);
        let out = if k == lumps { 0.0 } else { 0.52 * species.radius };
        let up = if k == lumps { 0.68 } else { random.range(0.34, 0.6) } * rise;
        let centre = top + Vec3::new(turn.cos() * out, turn.sin() * out, up);
        b.paint(species.bark).tube(top - Vec3::Z * 0.2, centre, [width, 0.3 * width], 5);
        let radius = species.radius * random.range(0.5, 0.62);
        let radii = Vec3::new(radius, radius, (0.36 * rise).min(radius) * random.range(0.85, 1.0));
        lump(b, species, random, centre, radii);
    }
}

fn column(b: &mut Builder, species: &Species, random: &mut Random) {
    let rise = species.height - species.trunk;
    b.paint(species.bark).tube(Vec3::Z * species.trunk, Vec3::Z * (species.trunk + 0.8 * rise), [0.1, 0.03], 5);
    let lumps = 5;
    for k in 0..lumps {
        let share = (k as f32 + 0.5) / lumps as f32;
        let radius = species.radius * (1.0 - 0.75 * (share - 0.35).abs()) * random.range(0.85, 1.0);
        let sway = Vec3::new(random.range(-0.2, 0.2), random.range(-0.2, 0.2), species.trunk + share * rise);
        lump(b, species, random, sway, Vec3::new(radius, radius, 0.62 * rise / lumps as f32));
    }
}

fn cone(b: &mut Builder, species: &Species, random: &mut Random) {
    let rise = species.height - species.trunk;
    let tiers = 7;
    for k in 0..tiers {
        let share = k as f32 / tiers as f32;
        let (low, radius) =
            (species.trunk + share * rise, species.radius * (1.0 - 0.88 * share) * random.range(0.92, 1.05));
        b.paint(species.leaves[0]);
        b.tube(Vec3::Z * low, Vec3::Z * (low + 1.6 * rise / tiers as f32), [radius, 0.08], 11);
        for _ in 0..28 {
            let turn = random.range(0.0, TAU);
            let at = Vec3::new(turn.cos() * radius, turn.sin() * radius, low + random.range(-0.12, 0.1));
            leaf(b, random, at, 0.28);
        }
    }
}

/// A lump of foliage: a deformed ellipsoid with leaves on its surface.
fn lump(b: &mut Builder, species: &Species, random: &mut Random, centre: Vec3, radii: Vec3) {
    let waves = [random.range(0.0, TAU), random.range(0.0, TAU), random.range(0.0, TAU)];
    let swell = move |d: Vec3| {
        1.0 + 0.13 * (5.0 * d.x + waves[0]).sin() * (4.0 * d.y + waves[1]).cos()
            + 0.1 * (9.0 * d.z + 3.0 * d.x + waves[2]).sin()
    };
    b.paint(species.leaves[random.below(2)]);
    b.ball(centre, radii, 9, &swell);
    let count = (70.0 * radii.x * radii.x).clamp(60.0, 260.0) as usize;
    for _ in 0..count {
        let (z, turn) = (random.range(-1.0, 1.0), random.range(0.0, TAU));
        let flat = (1.0 - z * z).sqrt();
        let unit = Vec3::new(flat * turn.cos(), flat * turn.sin(), z);
        let at = centre + radii * unit * swell(unit) * random.range(0.95, 1.1);
        let size = random.range(0.12, 0.34);
        leaf(b, random, at, size);
    }
}

/// A leaf: one two-sided triangle.
fn leaf(b: &mut Builder, random: &mut Random, at: Vec3, size: f32) {
    let mut corner =
        || at + size * Vec3::new(random.range(-1.0, 1.0), random.range(-1.0, 1.0), random.range(-0.8, 0.8));
    let corners = [corner(), corner(), corner()];
    b.triangle(corners);
}

/// A hedge piece of 2 m along x.
pub(crate) fn hedge(mut random: Random) -> Asset {
    let mut b = Builder::new(Class::Vegetation);
    b.paint(m::HEDGE);
    b.tapered([Vec2::new(-1.0, -0.3), Vec2::new(1.0, 0.3)], -0.4, [Vec2::new(-1.0, -0.22), Vec2::new(1.0, 0.22)], 1.15);
    for _ in 0..120 {
        let at = Vec3::new(random.range(-1.0, 1.0), random.range(-0.28, 0.28), random.range(0.1, 1.2));
        let out = if random.chance(0.6) { Vec3::new(at.x, at.y.signum() * 0.26, at.z) } else { at.with_z(1.15) };
        leaf(&mut b, &mut random, out, 0.09);
    }
    b.finish("hedge")
}
