//! Vehicle meshes: an extruded side view with a tapered cabin, panes, wheels, lamps and number plates.
//!
//! x is forward, y left, z up; the origin is on the ground below the centre.

use glam::{Affine3A, Vec2, Vec3};

use super::{Builder, person};
use crate::materials::{self as m, Surface};
use crate::random::Random;
use crate::types::{Asset, Class};

/// Kinds of vehicles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum VehicleKind {
    Hatchback,
    Saloon,
    Estate,
    OffRoad,
    Taxi,
    Van,
    Pickup,
    Bus,
    Truck,
    Motorcycle,
    Bicycle,
    /// A bicycle without its rider.
    BicycleParked,
    /// A motorcycle without its rider.
    MotorcycleParked,
}

use VehicleKind as K;

impl VehicleKind {
    /// Class of the vehicle.
    pub(crate) fn class(self) -> Class {
        match self {
            K::Bus => Class::Bus,
            K::Truck => Class::Truck,
            K::Motorcycle | K::MotorcycleParked => Class::Motorcycle,
            K::Bicycle | K::BicycleParked => Class::Bicycle,
            _ => Class::Car,
        }
    }

    /// Length and width, metres.
    pub(crate) fn size(self) -> Vec2 {
        let (length, width) = match self {
            K::Hatchback => (4.0, 1.76),
            K::Saloon | K::Taxi => (4.7, 1.82),
            K::Estate => (4.7, 1.82),
            K::OffRoad => (4.5, 1.88),
            K::Van => (5.4, 1.98),
            K::Pickup => (5.2, 1.88),
            K::Bus => (12.0, 2.5),
            K::Truck => (9.0, 2.48),
            K::Motorcycle | K::MotorcycleParked => (2.1, 0.7),
            K::Bicycle | K::BicycleParked => (1.75, 0.55),
        };
        Vec2::new(length, width)
    }
}

const COLOURS: [Surface; 7] =
    [m::CAR_WHITE, m::CAR_SILVER, m::CAR_BLACK, m::CAR_RED, m::CAR_BLUE, m::CAR_GREEN, m::CAR_YELLOW];

/// Number of colours.
pub(crate) const PAINTS: usize = COLOURS.len();

/// A vehicle in a colour.
pub(crate) fn vehicle(kind: VehicleKind, paint: usize, mut random: Random) -> Asset {
    let mut b = Builder::new(kind.class());
    let colour = if kind == K::Taxi { m::CAR_YELLOW } else { COLOURS[paint % PAINTS] };
    match kind {
        K::Bus => bus(&mut b, colour, &mut random),
        K::Truck => truck(&mut b, colour, &mut random),
        K::Motorcycle | K::MotorcycleParked => motorcycle(&mut b, colour, kind == K::Motorcycle),
        K::Bicycle | K::BicycleParked => bicycle(&mut b, colour, kind == K::Bicycle),
        _ => car(&mut b, kind, colour, &mut random),
    }
    b.finish(format!("{kind:?}, {paint}").to_lowercase())
}

/// Side view of a car's body and cabin: x as shares of the length from the rear, heights in metres.
struct SideView {
    /// Rear and front of the cabin at the belt line and at the roof.
    belt: [f32; 2],
    roof: [f32; 2],
    /// Heights of sill, bonnet, belt line and roof. The boot is as high as the belt line.
    heights: [f32; 4],
}

fn side_view(kind: VehicleKind) -> SideView {
    let (belt, roof, heights) = match kind {
        K::Hatchback => ([0.02, 0.74], [0.13, 0.55], [0.22, 0.82, 0.93, 1.46]),
        K::Estate => ([0.02, 0.72], [0.07, 0.55], [0.2, 0.8, 0.92, 1.47]),
        K::OffRoad => ([0.02, 0.73], [0.06, 0.58], [0.3, 0.98, 1.1, 1.72]),
        K::Van => ([0.01, 0.9], [0.015, 0.74], [0.28, 1.05, 1.2, 2.1]),
        K::Pickup => ([0.38, 0.74], [0.42, 0.6], [0.34, 1.0, 1.08, 1.76]),
        _ => ([0.13, 0.73], [0.27, 0.54], [0.2, 0.8, 0.92, 1.43]),
    };
    SideView { belt, roof, heights }
}

fn car(b: &mut Builder, kind: VehicleKind, colour: Surface, random: &mut Random) {
    let (size, view) = (kind.size(), side_view(kind));
    let x = |share: f32| (share - 0.5) * size.x;
    let [sill, bonnet, belt, roof] = view.heights;
    let half = 0.5 * size.y;
    // the body is widest at half its height
    let body = [
        Vec2::new(x(0.02), sill),
        Vec2::new(x(0.98), sill),
        Vec2::new(x(1.0), 0.5 * (sill + bonnet)),
        Vec2::new(x(0.97), bonnet - 0.08),
        Vec2::new(x(view.belt[1]), belt),
        Vec2::new(x(view.belt[0]), belt),
        Vec2::new(x(0.0), belt - 0.06),
        Vec2::new(x(0.0), 0.5 * (sill + bonnet)),
    ];
    let belly = 0.5 * (sill + bonnet);
    let width = |p: Vec2| half - 0.22 * (p.y - belly).abs().min(0.3);
    b.paint(colour).extrude(&body, &width);
    b.caps(&body, Vec2::new(0.0, belly), &width);
    cabin(b, kind, colour, &view, size, width(Vec2::new(0.0, belt)));
    for across in [0.2, 0.81] {
        let radius = if matches!(kind, K::OffRoad | K::Van | K::Pickup) { 0.36 } else { 0.32 };
        wheels(b, x(across), half, radius);
    }
    lamps(b, [x(0.0), x(1.0)], half, belly + 0.1, random);
    if kind == K::Pickup {
        let (back, front) = (x(0.01), x(0.36));
        b.paint(m::TRIM).quad([
            Vec3::new(back, -half + 0.15, belt + 0.004),
            Vec3::new(front, -half + 0.15, belt + 0.004),
            Vec3::new(front, half - 0.15, belt + 0.004),
            Vec3::new(back, half - 0.15, belt + 0.004),
        ]);
    }
    if kind == K::Taxi {
        b.paint(m::CAR_YELLOW).cuboid(Vec3::new(-0.098, -0.31, roof), Vec3::new(0.098, 0.31, roof + 0.19));
        b.paint(m::traffic_sign(5));
        let p = |y: f32, z: f32| Vec3::new(0.1, y, roof + z);
        b.plate([p(-0.3, 0.03), p(0.3, 0.03), p(0.3, 0.18), p(-0.3, 0.18)]);
        let p = |y: f32, z: f32| Vec3::new(-0.1, y, roof + z);
        b.plate([p(0.3, 0.03), p(-0.3, 0.03), p(-0.3, 0.18), p(0.3, 0.18)]);
    }
}

/// The cabin: a frustum in the body's colour with panes slightly in front of its faces.
fn cabin(b: &mut Builder, kind: VehicleKind, colour: Surface, view: &SideView, size: Vec2, half: f32) {
    let x = |share: f32| (share - 0.5) * size.x;
    let [.., belt, roof] = view.heights;
    let narrow = half - if kind == K::Van { 0.1 } else { 0.2 };
    let low = [Vec2::new(x(view.belt[0]), -half + 0.02), Vec2::new(x(view.belt[1]), half - 0.02)];
    let high = [Vec2::new(x(view.roof[0]), -narrow), Vec2::new(x(view.roof[1]), narrow)];
    b.paint(colour).tapered(low, belt, high, roof);
    // a point of a side face of the frustum: u along it, v up
    let at = |a: Vec2, c: Vec2, ah: Vec2, ch: Vec2, u: f32, v: f32, out: Vec3| {
        a.lerp(c, u).lerp(ah.lerp(ch, u), v).extend(belt + v * (roof - belt)) + 0.008 * out
    };
    let corner = |r: [Vec2; 2], k: usize| [r[0], Vec2::new(r[1].x, r[0].y), r[1], Vec2::new(r[0].x, r[1].y)][k % 4];
    b.paint(m::GLASS_DARK);
    for k in 0..4 {
        let out = [Vec3::NEG_Y, Vec3::X, Vec3::Y, Vec3::NEG_X][k] + 0.5 * Vec3::Z;
        let panes: &[[f32; 2]] = match (k, kind) {
            (1 | 3, _) => &[[0.06, 0.94]],
            (0, K::Van) => &[[0.68, 0.93]],
            (_, K::Van) => &[[0.07, 0.32]],
            (0, K::Pickup) | (2, K::Pickup) => &[[0.12, 0.88]],
            (0, _) => &[[0.09, 0.46], [0.5, 0.9]],
            _ => &[[0.1, 0.5], [0.54, 0.91]],
        };
        if kind == K::Van && k == 3 {
            continue;
        }
        for &[from, to] in panes {
            let bottom = if kind == K::Van { 0.35 } else { 0.1 };
            let p = |u: f32, v: f32| {
                at(corner(low, k), corner(low, k + 1), corner(high, k), corner(high, k + 1), u, v, out)
            };
            b.quad([p(from, bottom), p(to, bottom), p(to, 0.9), p(from, 0.9)]);
        }
    }
}

/// A pair of wheels.
fn wheels(b: &mut Builder, x: f32, half: f32, radius: f32) {
    for side in [-1.0, 1.0] {
        let at = |y: f32| Vec3::new(x, side * y, radius);
        b.paint(m::TYRE).tube(at(half - 0.22), at(half + 0.005), [radius; 2], 14);
        b.paint(m::RIM).tube(at(half - 0.02), at(half + 0.015), [0.62 * radius; 2], 9);
        // the wheel arch
        b.paint(m::TRIM);
        let rim = |k: usize| {
            let turn = std::f32::consts::PI * (k as f32 / 8.0);
            at(half + 0.003) + (radius + 0.05) * Vec3::new(-side * turn.cos(), 0.0, turn.sin())
        };
        for k in 0..8 {
            b.triangle([at(half + 0.003), rim(k), rim(k + 1)]);
        }
    }
}

/// Lamps and number plates at both ends.
fn lamps(b: &mut Builder, [back, front]: [f32; 2], half: f32, z: f32, random: &mut Random) {
    for side in [-1.0, 1.0] {
        let (a, c) = (side * (half - 0.42), side * (half - 0.1));
        let (low, high) = (a.min(c), a.max(c));
        b.paint(m::LAMP_WHITE).cuboid(Vec3::new(front - 0.12, low, z - 0.06), Vec3::new(front + 0.01, high, z + 0.07));
        b.paint(m::LAMP_RED).cuboid(Vec3::new(back - 0.012, low, z - 0.02), Vec3::new(back + 0.1, high, z + 0.12));
    }
    b.paint(m::number_plate(random));
    let p = |x: f32, y: f32, up: f32| Vec3::new(x, y, z - 0.22 + up);
    b.plate([
        p(front + 0.012, -0.26, 0.0),
        p(front + 0.012, 0.26, 0.0),
        p(front + 0.012, 0.26, 0.11),
        p(front + 0.012, -0.26, 0.11),
    ]);
    b.plate([
        p(back - 0.014, 0.26, 0.0),
        p(back - 0.014, -0.26, 0.0),
        p(back - 0.014, -0.26, 0.11),
        p(back - 0.014, 0.26, 0.11),
    ]);
}

/// A pane on a long vehicle's side, `side` -1 right or 1 left.
fn side_pane(b: &mut Builder, side: f32, [x0, x1]: [f32; 2], y: f32, [z0, z1]: [f32; 2]) {
    let p = |x: f32, z: f32| Vec3::new(x, side * y, z);
    let (a, c) = if side < 0.0 { (x0, x1) } else { (x1, x0) };
    b.quad([p(a, z0), p(c, z0), p(c, z1), p(a, z1)]);
}

fn bus(b: &mut Builder, colour: Surface, random: &mut Random) {
    let (half, y) = (6.0, 1.25);
    b.paint(colour).tapered(
        [Vec2::new(-half, -y), Vec2::new(half, y)],
        0.3,
        [Vec2::new(-half, -y), Vec2::new(half, y)],
        1.2,
    );
    let roof = [Vec2::new(-half + 0.05, -y + 0.1), Vec2::new(half - 0.01, y - 0.1)];
    b.paint(m::CAR_WHITE).tapered([Vec2::new(-half, -y), Vec2::new(half, y)], 1.2, roof, 2.95);
    b.paint(m::STEEL).block(Vec3::new(-3.0, -0.8, 2.95), Vec3::new(1.0, 0.8, 3.15));
    b.paint(m::GLASS_DARK);
    for side in [-1.0, 1.0] {
        for k in 0..7 {
            let x = -5.6 + 1.5 * k as f32;
            side_pane(b, side, [x, x + 1.35], y - 0.01, [1.25, 2.3]);
        }
    }
    for x in [-1.5, 3.9] {
        b.paint(m::TRIM);
        side_pane(b, -1.0, [x, x + 1.2], y + 0.012, [0.4, 2.35]);
        b.paint(m::GLASS_DARK);
        side_pane(b, -1.0, [x + 0.1, x + 1.1], y + 0.016, [0.6, 2.25]);
    }
    let p = |y: f32, z: f32| Vec3::new(half + 0.01, y, z);
    b.quad([p(-1.12, 1.15), p(1.12, 1.15), p(1.1, 2.4), p(-1.1, 2.4)]);
    b.paint(m::poster(random.below(2)));
    let p = |y: f32, z: f32| Vec3::new(half + 0.012, y, z);
    b.plate([p(-0.9, 2.45), p(0.9, 2.45), p(0.9, 2.8), p(-0.9, 2.8)]);
    b.paint(m::poster(2 + random.below(4)));
    let p = |x: f32, z: f32| Vec3::new(x, y + 0.012, z);
    b.plate([p(2.0, 0.5), p(-2.5, 0.5), p(-2.5, 1.15), p(2.0, 1.15)]);
    wheels(b, -3.2, y, 0.48);
    wheels(b, 3.0, y, 0.48);
    lamps(b, [-half, half], y, 0.75, random);
}

fn truck(b: &mut Builder, colour: Surface, random: &mut Random) {
    let y = 1.24;
    let cab = [Vec2::new(2.5, -y + 0.04), Vec2::new(4.5, y - 0.04)];
    b.paint(colour).tapered(cab, 0.45, [cab[0], cab[1] - Vec2::new(0.05, 0.0)], 1.5);
    b.tapered([cab[0], cab[1] - Vec2::new(0.05, 0.0)], 1.5, [cab[0], cab[1] - Vec2::new(0.4, 0.1)], 2.9);
    b.paint(m::TRIM).cuboid(Vec3::new(-4.4, -0.5, 0.6), Vec3::new(2.6, 0.5, 0.95));
    b.paint(m::CANVAS).cuboid(Vec3::new(-4.5, -y, 0.95), Vec3::new(2.2, y, 3.5));
    b.paint(m::GLASS_DARK);
    for side in [-1.0, 1.0] {
        side_pane(b, side, [2.9, 4.0], y - 0.02, [1.6, 2.4]);
    }
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.quad([p(4.43, -1.1, 1.65), p(4.43, 1.1, 1.65), p(4.22, 1.1, 2.6), p(4.22, -1.1, 2.6)]);
    for side in [-1.0, 1.0] {
        b.paint(m::poster(2 + random.below(4)));
        let p = |x: f32, z: f32| Vec3::new(x * side, side * (y + 0.01), z);
        let shift = -1.15 * side;
        let q = |x: f32, z: f32| p(x, z) + Vec3::X * shift.abs() * -1.0;
        b.plate([q(1.6, 1.7), q(-1.6, 1.7), q(-1.6, 2.7), q(1.6, 2.7)]);
    }
    wheels(b, -3.0, y, 0.5);
    wheels(b, -1.8, y, 0.5);
    wheels(b, 3.4, y, 0.5);
    lamps(b, [-4.5, 4.5], y, 0.8, random);
}

/// A wheel of a two-wheeler, in the x-z plane.
fn single_wheel(b: &mut Builder, x: f32, radius: f32, half: f32, spokes: bool) {
    let at = |y: f32| Vec3::new(x, y, radius);
    if !spokes {
        b.paint(m::TYRE).tube(at(-half), at(half), [radius; 2], 14);
        b.paint(m::RIM).tube(at(-half - 0.01), at(half + 0.01), [0.55 * radius; 2], 9);
        return;
    }
    let rim = |k: usize, r: f32| {
        let turn = std::f32::consts::TAU * k as f32 / 14.0;
        Vec3::new(x + r * turn.cos(), 0.0, radius + r * turn.sin())
    };
    for k in 0..14 {
        b.paint(m::TYRE).tube(rim(k, radius - half), rim(k + 1, radius - half), [half; 2], 4);
        b.paint(m::RIM).tube(at(0.0), rim(k, radius - half), [0.004; 2], 3);
    }
}

fn motorcycle(b: &mut Builder, colour: Surface, ridden: bool) {
    for x in [-0.7, 0.7] {
        single_wheel(b, x, 0.31, 0.07, false);
    }
    let still = |_: Vec3| 1.0;
    b.paint(m::TRIM).cuboid(Vec3::new(-0.35, -0.14, 0.3), Vec3::new(0.35, 0.14, 0.62));
    b.paint(colour).ball(Vec3::new(0.15, 0.0, 0.82), Vec3::new(0.36, 0.15, 0.16), 6, &still);
    b.ball(Vec3::new(-0.75, 0.0, 0.78), Vec3::new(0.3, 0.12, 0.09), 5, &still);
    b.paint(m::LEATHER).cuboid(Vec3::new(-0.6, -0.13, 0.76), Vec3::new(-0.05, 0.13, 0.86));
    b.paint(m::STEEL).tube(Vec3::new(0.72, 0.0, 0.31), Vec3::new(0.5, 0.0, 1.02), [0.05, 0.04], 6);
    b.tube(Vec3::new(0.45, -0.35, 1.05), Vec3::new(0.45, 0.35, 1.05), [0.018; 2], 5);
    b.tube(Vec3::new(-0.9, -0.17, 0.4), Vec3::new(0.1, -0.17, 0.34), [0.06, 0.04], 7);
    b.paint(m::LAMP_WHITE).ball(Vec3::new(0.68, 0.0, 0.9), Vec3::splat(0.1), 5, &still);
    if ridden {
        b.within(Affine3A::from_translation(Vec3::new(-0.3, 0.0, 0.92)), |b| person::rider(b, 7, false));
    }
}

fn bicycle(b: &mut Builder, colour: Surface, ridden: bool) {
    for x in [-0.53, 0.53] {
        single_wheel(b, x, 0.34, 0.018, true);
    }
    let p = |x: f32, z: f32| Vec3::new(x, 0.0, z);
    let (back, crank, seat, head, fork) = (p(-0.53, 0.34), p(-0.05, 0.28), p(-0.2, 0.85), p(0.38, 0.85), p(0.53, 0.34));
    b.paint(colour);
    for [from, to] in [[back, crank], [back, seat], [crank, seat], [crank, head], [seat, head], [head, fork]] {
        b.tube(from, to, [0.018; 2], 5);
    }
    b.paint(m::TRIM).cuboid(Vec3::new(-0.34, -0.07, 0.9), Vec3::new(-0.08, 0.07, 0.95));
    b.tube(head, p(0.36, 1.02), [0.014; 2], 5);
    b.tube(Vec3::new(0.36, -0.27, 1.02), Vec3::new(0.36, 0.27, 1.02), [0.013; 2], 5);
    b.tube(Vec3::new(-0.05, -0.12, 0.28), Vec3::new(-0.05, 0.12, 0.28), [0.02; 2], 5);
    if ridden {
        b.within(Affine3A::from_translation(Vec3::new(-0.2, 0.0, 1.0)), |b| person::rider(b, 4, true));
    }
}
