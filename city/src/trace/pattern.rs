//! Material patterns as procedural textures, filtered over the footprint of a pixel. Without the filter distant
//! patterns would alias, and views of the same surface would disagree.

use font8x8::legacy::BASIC_LEGACY;
use glam::{Vec2, Vec3};

use crate::{Material, Pattern};

/// Largest number of noise octaves.
const OCTAVES: u32 = 10;
/// Mean ink coverage of a letter's cell, over capital letters.
const INK: f32 = 0.36;

/// The colour of a material at a surface coordinate. `seed` differs by material, `size` is the footprint of the pixel
/// in u and v, `amount` from 0 (base colour only) to 1 is the strength of the pattern.
pub(crate) fn colour(material: &Material, seed: u32, texts: &[String], uv: Vec2, size: Vec2, amount: f32) -> Vec3 {
    let base = material.base_colour;
    let painted = match material.pattern {
        Pattern::Plain => return base,
        Pattern::Noise { finest_metres, coarsest_metres, amount } => {
            base * (1.0 + amount * fractal_noise(uv, finest_metres, coarsest_metres, seed, size)).max(0.0)
        }
        Pattern::Bricks { size_metres, joint_metres, joint_shade, bond, amount } => {
            bricks(base, uv, size_metres, joint_metres, joint_shade, bond, amount, seed, size)
        }
        Pattern::Panels { width_metres, joint_metres, amount } => {
            let one =
                detail_weight(width_metres, size.x) * (unit(hash(seed, (uv.x / width_metres).floor() as i32, 0)) - 0.5);
            let joints = stripe_coverage(uv.x, width_metres, joint_metres, size.x);
            let weather = 0.15 * fractal_noise(uv * Vec2::new(1.0, 0.2), 0.1, 3.0, seed ^ 1, size);
            base * (1.0 + amount * (one + weather)).max(0.0) * (1.0 - 0.55 * joints)
        }
        Pattern::Text { row, ink } => {
            let text = texts.get(row as usize).map_or("", String::as_str);
            base.lerp(ink, text_coverage(text, uv, size))
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
    // every other course is shifted
    let shift = if bond { 0.5 * brick.x * (course.rem_euclid(2.0)) } else { 0.0 };
    let along = uv.x + shift;
    let one = unit(hash(seed, (along / brick.x).floor() as i32, course as i32)) - 0.5;
    let visible = detail_weight(brick.x, size.x) * detail_weight(brick.y, size.y);
    let (level, upright) =
        (stripe_coverage(uv.y, brick.y, joint, size.y), stripe_coverage(along, brick.x, joint, size.x));
    let joints = level + upright - level * upright;
    let stains = 0.35 * fractal_noise(uv, 0.5 * brick.y, 4.0, seed ^ 1, size);
    let tone = (1.0 + amount * (1.4 * visible * one + stains)).max(0.0);
    (base * tone).lerp(base * shade, joints)
}

/// Ink coverage of a text that fills the unit square, in a dot-matrix font.
fn text_coverage(text: &str, uv: Vec2, size: Vec2) -> f32 {
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

/// Fractal noise, about -1..1, with wavelengths from `coarsest` metres down to `finest` or the pixel footprint.
fn fractal_noise(uv: Vec2, finest: f32, coarsest: f32, seed: u32, size: Vec2) -> f32 {
    // the geometric mean of the footprint's sides: less would alias, more would blur
    let footprint = (size.x * size.y).sqrt();
    let (mut feature, mut weight) = (coarsest.max(1e-3), 1.0);
    let (mut sum, mut power) = (0.0, 0.0);
    for octave in 0..OCTAVES {
        if feature < finest.max(1e-3) * 0.7 {
            break;
        }
        let visible = detail_weight(feature, footprint);
        if visible > 0.0 {
            sum += weight * visible * noise(uv / feature, seed.wrapping_add(octave));
        }
        power += weight * weight;
        (feature, weight) = (0.5 * feature, 0.97 * weight);
    }
    // the standard deviation of lattice noise is about 0.37 of its range
    if power > 0.0 { sum / (0.8 * power).sqrt() } else { 0.0 }
}

/// Value noise in -1..1 on the integer lattice.
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

/// Share of a pixel that is covered by stripes of this width, one at the start of each period.
fn stripe_coverage(x: f32, period: f32, width: f32, size: f32) -> f32 {
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

/// Weight of a detail: 1 where the pixel is much smaller than the feature, 0 where it is as large.
fn detail_weight(feature: f32, footprint: f32) -> f32 {
    (1.5 - 1.5 * footprint / feature).clamp(0.0, 1.0)
}

/// Hash of a lattice point (PCG output function, Jarzynski and Olano 2020).
pub(crate) fn hash(seed: u32, x: i32, y: i32) -> u32 {
    let mixed =
        seed.wrapping_mul(0x9e37_79b1) ^ (x as u32).wrapping_mul(0x85eb_ca77) ^ (y as u32).wrapping_mul(0xc2b2_ae3d);
    let state = mixed.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    (word >> 22) ^ word
}

/// Maps random bits to [0, 1).
pub(crate) fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 / (1 << 24) as f32
}

/// A uniform number in [0, 1) for a pixel and channel.
pub(crate) fn grain(seed: u32, i: usize, channel: i32) -> f32 {
    unit(hash(seed, i as i32, channel))
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
    fn distant_bricks_have_the_mean_colour_of_near_ones() {
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
    fn a_pattern_of_amount_zero_is_the_base_colour() {
        let material = brick();
        let of = |x: f32| colour(&material, 3, &[], Vec2::new(x, 0.01), Vec2::splat(0.001), 0.0);
        assert!((0..100).all(|i| of(i as f32 * 0.01) == Vec3::splat(0.5)));
    }

    #[test]
    fn text_is_upright_and_starts_at_the_left() {
        // an L: ink down the left, a foot at the bottom, nothing at the top right
        let ink = |u: f32, v: f32| text_coverage("L", Vec2::new(u, v), Vec2::splat(1e-3));
        assert!(ink(0.3, 0.6) > 0.5 && ink(0.7, 0.2) > 0.5 && ink(0.8, 0.8) < 0.5);
    }
}
