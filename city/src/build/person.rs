//! Meshes of people as articulated bodies: walking, in sixteen gait phases, and riding.
//!
//! x is forward, y left, z up; the lower foot stands at z = 0. Angles of hip, knee, shoulder and elbow are sines that
//! approximate measured gait (Winter, "Biomechanics and Motor Control of Human Movement", chapter 3): hips swing about
//! ±25°, a knee bends to 60° while its leg swings, arms go against the legs.

use std::f32::consts::TAU;

use glam::{Affine3A, Vec3};

use super::Builder;
use crate::materials::{self as m, Surface};
use crate::types::{Asset, Class};

/// Phases of a gait cycle.
pub(crate) const PHASES: usize = 16;
/// Number of body builds.
pub(crate) const BUILDS: usize = 8;
/// Stride (two steps) of a person 1.75 m tall, metres.
pub(crate) const STRIDE: f64 = 1.4;

/// Build and clothing of a person.
struct Appearance {
    height: f32,
    girth: f32,
    top: Surface,
    trousers: Surface,
    skin: Surface,
    skirt: bool,
    bag: bool,
    hat: bool,
}

const fn appearance(
    height: f32,
    girth: f32,
    top: Surface,
    trousers: Surface,
    skin: Surface,
    extras: [bool; 3],
) -> Appearance {
    let [skirt, bag, hat] = extras;
    Appearance { height, girth, top, trousers, skin, skirt, bag, hat }
}

const APPEARANCES: [Appearance; BUILDS] = [
    appearance(1.78, 1.0, m::CLOTH_BLUE, m::DENIM, m::SKIN_LIGHT, [false, true, false]),
    appearance(1.66, 0.9, m::CLOTH_RED, m::CLOTH_BLACK, m::SKIN_LIGHT, [true, false, false]),
    appearance(1.85, 1.1, m::CLOTH_GREY, m::CLOTH_BLACK, m::SKIN_DARK, [false, false, true]),
    appearance(1.70, 1.2, m::CLOTH_BEIGE, m::CLOTH_GREY, m::SKIN_LIGHT, [false, true, true]),
    appearance(1.62, 0.95, m::CLOTH_GREEN, m::DENIM, m::SKIN_DARK, [false, false, false]),
    appearance(1.20, 0.75, m::PLASTIC_RED, m::DENIM, m::SKIN_LIGHT, [false, true, false]),
    appearance(1.73, 1.0, m::CLOTH_WHITE, m::CLOTH_BEIGE, m::SKIN_DARK, [true, true, false]),
    appearance(1.80, 1.05, m::CLOTH_BLACK, m::CLOTH_GREY, m::SKIN_LIGHT, [false, false, true]),
];

/// Height of a build relative to the average; its stride scales alike.
pub(crate) fn scale(build: usize) -> f64 {
    f64::from(APPEARANCES[build % BUILDS].height) / 1.75
}

/// Joint angles, radians, positive forward.
#[derive(Clone, Copy)]
struct Pose {
    hips: [f32; 2],
    knees: [f32; 2],
    shoulders: [f32; 2],
    elbows: [f32; 2],
    lean: f32,
}

fn gait(phase: usize) -> Pose {
    let turn = |side: f32| TAU * (phase as f32 / PHASES as f32) + side * TAU / 2.0;
    let hip = |t: f32| 0.07 + 0.42 * t.sin();
    // the knee bends most while the thigh swings forward
    let knee = |t: f32| 0.12 + 0.9 * (t.cos().max(0.0)).powi(2);
    let shoulder = |t: f32| -0.4 * t.sin();
    let elbow = |t: f32| 0.35 - 0.2 * t.sin();
    let (left, right) = (turn(0.0), turn(1.0));
    Pose {
        hips: [hip(left), hip(right)],
        knees: [knee(left), knee(right)],
        shoulders: [shoulder(left), shoulder(right)],
        elbows: [elbow(left), elbow(right)],
        lean: 0.05,
    }
}

/// A pedestrian in a gait phase.
pub(crate) fn walker(build: usize, phase: usize) -> Asset {
    let appearance = &APPEARANCES[build % BUILDS];
    let mut b = Builder::new(Class::Person);
    body(&mut b, appearance, gait(phase));
    let lowest = b.lowest();
    b.shift(Vec3::Z * -lowest);
    b.finish(format!("person {build}, phase {phase}"))
}

/// A rider with the hips at the origin.
pub(crate) fn rider(b: &mut Builder, build: usize, pedals: bool) {
    let appearance = &APPEARANCES[build % BUILDS];
    let spread = if pedals { 0.35 } else { 0.0 };
    let pose = Pose {
        hips: [1.15 + spread, 1.15 - spread],
        knees: [1.35 + 0.6 * spread, 1.35 - 0.6 * spread],
        shoulders: [0.95; 2],
        elbows: [0.25; 2],
        lean: 0.35,
    };
    b.class(Class::Rider);
    let hip = appearance.height * 0.52;
    b.within(Affine3A::from_translation(-Vec3::Z * hip), |b| body(b, appearance, pose));
}

fn body(b: &mut Builder, appearance: &Appearance, pose: Pose) {
    let h = appearance.height;
    let hip = Vec3::Z * 0.52 * h;
    let (thigh, shin) = (0.25 * h, 0.25 * h);
    for (k, side) in [(0, 1.0), (1, -1.0)] {
        let socket = hip + Vec3::Y * side * 0.055 * h * appearance.girth;
        let limb = |angle: f32, length: f32| length * Vec3::new(angle.sin(), 0.0, -angle.cos());
        let knee = socket + limb(pose.hips[k], thigh);
        let foot = pose.hips[k] - pose.knees[k];
        let ankle = knee + limb(foot, shin);
        b.paint(appearance.trousers).tube(socket, knee, [0.05 * h * appearance.girth, 0.034 * h], 7);
        b.paint(if appearance.skirt { appearance.skin } else { appearance.trousers }).tube(
            knee,
            ankle,
            [0.034 * h, 0.024 * h],
            7,
        );
        // the loaded foot stays nearly horizontal
        let pitch = (0.6 * foot).min(0.2);
        b.within(Affine3A::from_translation(ankle) * Affine3A::from_rotation_y(-pitch), |b| {
            let (low, high) = (Vec3::new(-0.045, -0.024, -0.035), Vec3::new(0.105, 0.024, 0.012));
            b.paint(m::LEATHER).cuboid(low * h, high * h);
        });
    }
    b.within(Affine3A::from_translation(hip) * Affine3A::from_rotation_y(pose.lean), |b| torso(b, appearance, pose));
}

/// The upper body in the frame of the hips.
fn torso(b: &mut Builder, appearance: &Appearance, pose: Pose) {
    let (h, g) = (appearance.height, appearance.girth);
    let still = |_: Vec3| 1.0;
    if appearance.skirt {
        b.paint(appearance.trousers).tube(Vec3::Z * -0.2 * h, Vec3::Z * 0.03 * h, [0.125 * h, 0.085 * h], 9);
    } else {
        b.paint(appearance.trousers).ball(Vec3::ZERO, Vec3::new(0.068 * g, 0.1 * g, 0.06) * h, 5, &still);
    }
    b.paint(appearance.top).ball(Vec3::Z * 0.15 * h, Vec3::new(0.068 * g, 0.108 * g, 0.185) * h, 7, &still);
    b.paint(appearance.skin).tube(Vec3::Z * 0.3 * h, Vec3::Z * 0.36 * h, [0.032 * h, 0.03 * h], 6);
    b.ball(Vec3::new(0.01, 0.0, 0.405) * h, Vec3::new(0.054, 0.043, 0.064) * h, 6, &still);
    b.paint(if appearance.hat { appearance.trousers } else { m::HAIR });
    b.ball(Vec3::new(-0.004, 0.0, 0.424) * h, Vec3::new(0.058, 0.048, 0.056) * h, 6, &still);
    if appearance.bag {
        b.paint(m::LEATHER).cuboid(Vec3::new(-0.14, -0.08, 0.08) * h, Vec3::new(-0.06, 0.08, 0.29) * h);
    }
    for (k, side) in [(0, 1.0), (1, -1.0)] {
        let shoulder = Vec3::new(0.0, side * 0.118 * g, 0.275) * h;
        let limb = |angle: f32, length: f32| length * h * Vec3::new(angle.sin(), side * 0.06, -angle.cos());
        let elbow = shoulder + limb(pose.shoulders[k], 0.17);
        let hand = elbow + limb(pose.shoulders[k] + pose.elbows[k], 0.16);
        b.paint(appearance.top).tube(shoulder, elbow, [0.032 * h, 0.025 * h], 6);
        b.tube(elbow, hand, [0.025 * h, 0.019 * h], 6);
        b.paint(appearance.skin).ball(hand, Vec3::splat(0.024 * h), 4, &still);
    }
}
