//! Numbers as RAD stores them: f16, bytes between two bounds, rotations as an axis and an angle in three bytes.

use std::f32::consts::PI;

use glam::{Quat, Vec3};

/// The nearest f16; beyond its range, its largest number.
pub(super) fn f16_of(value: f32) -> u16 {
    let bits = value.to_bits();
    let sign = (bits >> 16 & 0x8000) as u16;
    let magnitude = f32::from_bits(bits & 0x7fff_ffff);
    // Below 2^-14 steps are 2^-24; above, ten bits follow the exponent. Ties go to the even neighbour.
    let code = if magnitude < 6.103_515_6e-5 {
        (magnitude * 16_777_216.0).round_ties_even() as u32
    } else {
        let rebased = magnitude.min(65_504.0).to_bits() - (112 << 23);
        (rebased + 0x0fff + (rebased >> 13 & 1)) >> 13
    };
    sign | code.min(0x7bff) as u16
}

/// The number of an f16.
pub(super) fn f16_value(code: u16) -> f32 {
    let (exponent, fraction) = (u32::from(code >> 10 & 0x1f), u32::from(code & 0x3ff));
    let magnitude = match exponent {
        0 => fraction as f32 / 16_777_216.0,
        31 => f32::from_bits(0x7f80_0000 | fraction << 13),
        _ => f32::from_bits((exponent + 112) << 23 | fraction << 13),
    };
    if code & 0x8000 == 0 { magnitude } else { -magnitude }
}

/// A value between two bounds as a byte.
pub(super) fn r8_of(value: f32, min: f32, max: f32) -> u8 {
    ((value - min) / (max - min) * 255.0).clamp(0.0, 255.0).round() as u8
}

/// The value of a byte between two bounds.
pub(super) fn r8_value(code: u8, min: f32, max: f32) -> f32 {
    f32::from(code) / 255.0 * (max - min) + min
}

/// A value from -max to max as a byte.
pub(super) fn s8_of(value: f32, max: f32) -> u8 {
    (value / max * 127.0).clamp(-127.0, 127.0).round() as i8 as u8
}

/// The value of a byte from -max to max.
pub(super) fn s8_value(code: u8, max: f32) -> f32 {
    f32::from(code as i8) / 127.0 * max
}

/// A scale between two bounds of its logarithm as a byte from 1; 0 is a scale of zero, which no splat has.
pub(super) fn scale_of(scale: f32, min: f32, max: f32) -> u8 {
    1 + ((scale.max(1e-30).ln() - min) / (max - min) * 254.0).clamp(0.0, 254.0).round() as u8
}

/// The scale of a byte.
pub(super) fn scale_value(code: u8, min: f32, max: f32) -> f32 {
    if code == 0 { 0.0 } else { (min + f32::from(code - 1) * (max - min) / 254.0).exp() }
}

/// A rotation: its axis on an octahedron in two bytes, and its angle from 0 to π in one.
pub(super) fn rotation_of(quat: Quat) -> [u8; 3] {
    let quat = if quat.w < 0.0 { -quat } else { quat };
    let half = quat.w.clamp(0.0, 1.0).acos();
    let axis = quat.xyz() / half.sin();
    let axis = if half.sin() < 1e-6 || !axis.is_finite() { Vec3::X } else { axis };
    let flat = axis / axis.abs().element_sum();
    let [mut u, mut v] = [flat.x, flat.y];
    if axis.z < 0.0 {
        [u, v] = [(1.0 - flat.y.abs()).copysign(u), (1.0 - flat.x.abs()).copysign(v)];
    }
    [r8_of(u, -1.0, 1.0), r8_of(v, -1.0, 1.0), r8_of(2.0 * half, 0.0, PI)]
}

/// The rotation of three bytes.
pub(super) fn rotation_value([u, v, angle]: [u8; 3]) -> Quat {
    let [u, v] = [u, v].map(|code| r8_value(code, -1.0, 1.0));
    let z = 1.0 - u.abs() - v.abs();
    let under = (-z).max(0.0);
    let axis = Vec3::new(u - under.copysign(u), v - under.copysign(v), z).normalize_or(Vec3::X);
    Quat::from_axis_angle(axis, r8_value(angle, 0.0, PI)).normalize()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn every_f16_is_kept() {
        for code in (0..=u16::MAX).filter(|code| code >> 10 & 0x1f != 31) {
            assert_eq!(f16_of(f16_value(code)), code);
        }
        assert_eq!([1e9, -1e9, f32::INFINITY].map(f16_of).map(f16_value), [65_504.0, -65_504.0, 65_504.0]);
        // Half way between 1 and its successor the even one is taken, and between that and the next as well.
        assert_eq!([1.0 + 1.0 / 2048.0, 1.0 + 3.0 / 2048.0].map(f16_of), [0x3c00, 0x3c02]);
    }

    proptest! {
        #[test]
        fn f16_is_the_nearest(value in -70_000.0f32..70_000.0) {
            let code = f16_of(value);
            let error = (f16_value(code) - value.clamp(-65_504.0, 65_504.0)).abs();
            prop_assert!([code.wrapping_sub(1), code.wrapping_add(1)].into_iter()
                .filter(|code| code >> 10 & 0x1f != 31)
                .all(|other| (f16_value(other) - value).abs() >= error));
        }

        #[test]
        fn rotations_are_near(x in -1.0f32..1.0, y in -1.0f32..1.0, z in -1.0f32..1.0, w in -1.0f32..1.0) {
            prop_assume!(x * x + y * y + z * z + w * w > 0.01);
            let quat = Quat::from_xyzw(x, y, z, w).normalize();
            let back = rotation_value(rotation_of(quat));
            prop_assert!(quat.dot(back).abs() > 0.02f32.cos(), "{quat} {back}");
        }
    }
}
