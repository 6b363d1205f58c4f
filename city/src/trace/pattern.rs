//! What surfaces are painted with: the patterns of materials, filtered over the footprint of a pixel, so that distance
//! blurs them as a lens would and no view shows what another cannot confirm.

use font8x8::legacy::BASIC_LEGACY;
use glam::{Vec2, Vec3};

use crate::{Material, Pattern};

/// Octaves of noise that are ever added up.
const OCTAVES: u32 = 10;
/// Share of a letter's cell that its ink covers, on average over capitals.
const INK: f32 = 0.36;

/// The colour of a material at a place of its surface. `seed` tells surfaces of different materials apart; `size` is how
/// far the pixel reaches in u and in v; `amount`, 0 to 1, fades the pattern (0: one colour).
pub(crate) fn colour(material: &Material, seed: u32, texts: &[String], uv: Vec2, size: Vec2, amount: f32) -> Vec3 {
    let base = material.base_colour;
    let painted = match material.pattern {
        Pattern::Plain => return base,
        Pattern::Noise { finest_metres, coarsest_metres, amount } => {
            base * (1.0 + amount * octaves(uv, finest_metres, coarsest_metres, seed, size)).max(0.0)
        }
        Pattern::Bricks { size_metres, joint_metres, joint_shade, bond, amount } => {
            bricks(base, uv, size_metres, joint_metres, joint_shade, bond, amount, seed, size)
        }
        Pattern::Panels { width_metres, joint_metres, amount } => {
            let one = fade(width_metres, size.x) * (unit(hash(seed, (uv.x / width_metres).floor() as i32, 0)) - 0.5);
            let joints = stripes(uv.x, width_metres, joint_metres, size.x);
            let weather = 0.15 * octaves(uv * Vec2::new(1.0, 0.2), 0.1, 3.0, seed ^ 1, size);
            base * (1.0 + amount * (one + weather)).max(0.0) * (1.0 - 0.55 * joints)
        }
        Pattern::Text { row, ink } => {
            let text = texts.get(row as usize).map_or("", String::as_str);
            base.lerp(ink, written(text, uv, size))
        }
    };
    base.lerp(painted, amount)
}

fn bricks(
    base: Vec3,
    uv: Vec2,
    brick: Vec2,
    joint: f32,
    shade: f32,
    bond: bool,
    amount: f32,
    seed: u32,
    size: Vec2,
) -> Vec3 {
    let course = (uv.y / brick.y).floor();
    // beyond the width of a course its offset is a mean too
    let shift = if bond { 0.5 * brick.x * (course.rem_euclid(2.0)) } else { 0.0 };
    let along = uv.x + shift;
    let one = unit(hash(seed, (along / brick.x).floor() as i32, course as i32)) - 0.5;
    let seen = fade(brick.x, size.x) * fade(brick.y, size.y);
    let (level, upright) = (stripes(uv.y, brick.y, joint, size.y), stripes(along, brick.x, joint, size.x));
    let joints = level + upright - level * upright;
    let stains = 0.35 * octaves(uv, 0.5 * brick.y, 4.0, seed ^ 1, size);
    let tone = (1.0 + amount * (1.4 * seen * one + stains)).max(0.0);
    (base * tone).lerp(base * shade, joints)
}

/// The share of ink where a text fills the unit square, dot by dot.
fn written(text: &str, uv: Vec2, size: Vec2) -> f32 {
    let letters = text.chars().count();
    if letters == 0 || uv.min_element() < 0.0 || uv.max_element() > 1.0 {
        return 0.0;
    }
    let dots = Vec2::new(8.0 * letters as f32, 8.0);
    let (at, reach) = (Vec2::new(uv.x, 1.0 - uv.y) * dots, size * dots);
    if reach.max_element() > 12.0 {
        return INK;
    }
    let taps = (2.0 * reach.max_element()).ceil().clamp(1.0, 6.0) as i32;
    let dot = |x: i32, y: i32| {
        let place = at + reach * ((Vec2::new(x as f32, y as f32) + 0.5) / taps as f32 - 0.5);
        if place.min_element() < 0.0 || place.y >= 8.0 {
            return 0.0;
        }
        let (column, line) = (place.x as usize, place.y as usize);
        let letter = text.chars().nth(column / 8).map_or(0, |c| c as usize);
        let bits = BASIC_LEGACY.get(letter).map_or(0, |glyph| glyph[line]);
        f32::from(bits >> (column % 8) & 1)
    };
    let sum: f32 = (0..taps).flat_map(|y| (0..taps).map(move |x| (x, y))).map(|(x, y)| dot(x, y)).sum();
    sum / (taps * taps) as f32
}

/// Noise in about -1..1 whose features reach from `coarsest` down to `finest` metres or the pixel, finer ones weaker.
fn octaves(uv: Vec2, finest: f32, coarsest: f32, seed: u32, size: Vec2) -> f32 {
    // between the two extents of a pixel seen at an angle: finer would shimmer, coarser would be a smear
    let footprint = (size.x * size.y).sqrt();
    let (mut feature, mut weight) = (coarsest.max(1e-3), 1.0);
    let (mut sum, mut power) = (0.0, 0.0);
    for octave in 0..OCTAVES {
        if feature < finest.max(1e-3) * 0.7 {
            break;
        }
        let seen = fade(feature, footprint);
        if seen > 0.0 {
            sum += weight * seen * noise(uv / feature, seed.wrapping_add(octave));
        }
        power += weight * weight;
        (feature, weight) = (0.5 * feature, 0.97 * weight);
    }
    // a lattice's values spread over 0.37 of their range
    if power > 0.0 { sum / (0.8 * power).sqrt() } else { 0.0 }
}

/// Smooth noise in -1..1 between values on the integer lattice.
fn noise(at: Vec2, seed: u32) -> f32 {
    let cell = at.floor();
    let t = at - cell;
    let t = t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (x, y) = (cell.x as i32, cell.y as i32);
    let corner = |i: i32, j: i32| unit(hash(seed, x.wrapping_add(i), y.wrapping_add(j)));
    let low = corner(0, 0) + t.x * (corner(1, 0) - corner(0, 0));
    let high = corner(0, 1) + t.x * (corner(1, 1) - corner(0, 1));
    2.0 * (low + t.y * (high - low)) - 1.0
}

/// The share of a pixel that lies on stripes of this width, one at the start of each period.
fn stripes(x: f32, period: f32, width: f32, size: f32) -> f32 {
    let covered = |x: f32| {
        let n = (x / period).floor();
        n * width + (x - n * period).min(width)
    };
    let mean = width / period;
    if !(period > 0.0 && width > 0.0 && width < period) {
        return 0.0;
    }
    if size > 8.0 * period {
        return mean;
    }
    let span = size.max(0.05 * width);
    ((covered(x + 0.5 * span) - covered(x - 0.5 * span)) / span).clamp(0.0, 1.0)
}

/// 1 where a pixel is much smaller than a feature, 0 where it is as large.
fn fade(feature: f32, footprint: f32) -> f32 {
    (1.5 - 1.5 * footprint / feature).clamp(0.0, 1.0)
}

/// Well mixed bits of a place on a lattice (the permuted generator's finaliser, Jarzynski and Olano 2020).
pub(crate) fn hash(seed: u32, x: i32, y: i32) -> u32 {
    let mixed =
        seed.wrapping_mul(0x9e37_79b1) ^ (x as u32).wrapping_mul(0x85eb_ca77) ^ (y as u32).wrapping_mul(0xc2b2_ae3d);
    let state = mixed.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}

/// A number in [0, 1).
pub(crate) fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 / (1 << 24) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn brick() -> Material {
        Material {
            name: "brick".into(),
            base_colour: Vec3::splat(0.5),
            roughness: 1.0,
            metallic: 0.0,
            transparency: 0.0,
            lidar_reflectivity: 0.3,
            pattern: Pattern::Bricks {
                size_metres: Vec2::new(0.4, 0.1),
                joint_metres: 0.02,
                joint_shade: 0.2,
                bond: true,
                amount: 0.0,
            },
        }
    }

    #[test]
    fn far_bricks_have_the_mean_colour_of_near_ones() {
        let material = brick();
        let mut mean = 0.0;
        for i in 0..64 {
            for j in 0..64 {
                let uv = Vec2::new(i as f32 * 0.8 / 64.0, j as f32 * 0.2 / 64.0);
                mean += colour(&material, 3, &[], uv, Vec2::splat(1e-4), 1.0).x / 4096.0;
            }
        }
        let far = colour(&material, 3, &[], Vec2::new(3.3, 7.7), Vec2::splat(40.0), 1.0).x;
        assert!((far - mean).abs() < 0.02, "{far} {mean}");
    }

    #[test]
    fn a_faded_pattern_is_one_colour() {
        let material = brick();
        let of = |x: f32| colour(&material, 3, &[], Vec2::new(x, 0.01), Vec2::splat(0.001), 0.0);
        assert!((0..100).all(|i| of(i as f32 * 0.01) == Vec3::splat(0.5)));
    }

    #[test]
    fn letters_are_written_upright_and_from_the_left() {
        // an L: ink down the left, a foot at the bottom, nothing at the top right
        let ink = |u: f32, v: f32| written("L", Vec2::new(u, v), Vec2::splat(1e-3));
        assert!(ink(0.3, 0.6) > 0.5 && ink(0.7, 0.2) > 0.5 && ink(0.8, 0.8) < 0.5);
    }
}
