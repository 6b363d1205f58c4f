//! The lanes as an array, for every target.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::lanes::{EXP2, LANES, Lanes, operators};

/// Sixteen lanes as an array; the compiler vectorises it for the target's baseline.
#[derive(Clone, Copy)]
#[doc(hidden)]
pub struct Portable([f32; 16]);

impl Portable {
    #[inline(always)]
    fn zip(self, b: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], b.0[i])))
    }
    #[inline(always)]
    fn test(self, b: Self, f: impl Fn(f32, f32) -> bool) -> u16 {
        (0..LANES).fold(0, |mask, i| mask | (u16::from(f(self.0[i], b.0[i])) << i))
    }
    #[inline(always)]
    fn add_lanes(self, b: Self) -> Self {
        self.zip(b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub_lanes(self, b: Self) -> Self {
        self.zip(b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul_lanes(self, b: Self) -> Self {
        self.zip(b, |a, b| a * b)
    }
    #[inline(always)]
    fn div_lanes(self, b: Self) -> Self {
        self.zip(b, |a, b| a / b)
    }
}

operators!(Portable);

impl Lanes for Portable {
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([x; 16])
    }
    #[inline(always)]
    fn load(from: &[f32; 16]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; 16]) {
        *to = self.0;
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        self * b + c
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        self.zip(b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        self.zip(b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn lt(self, b: Self) -> u16 {
        self.test(b, |a, b| a < b)
    }
    #[inline(always)]
    fn le(self, b: Self) -> u16 {
        self.test(b, |a, b| a <= b)
    }
    #[inline(always)]
    fn select(mask: u16, a: Self, b: Self) -> Self {
        Self(std::array::from_fn(|i| if mask >> i & 1 == 1 { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        // Adding 1.5·2^23 rounds to an integer that then sits in the low bits.
        const MAGIC: f32 = 12_582_912.0;
        let shifted = self + Self::splat(MAGIC);
        let f = self - (shifted - Self::splat(MAGIC));
        let mut p = Self::splat(EXP2[0]);
        for c in &EXP2[1..] {
            p = p.fma(f, Self::splat(*c));
        }
        Self(std::array::from_fn(|i| f32::from_bits(p.0[i].to_bits().wrapping_add(shifted.0[i].to_bits() << 23))))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        Self::splat(1.0) / self
    }
    #[inline(always)]
    fn sums(v: &[Self; 16]) -> Self {
        Self(std::array::from_fn(|i| {
            let x = &v[i].0;
            let quarter = |k: usize| (x[k] + x[k + 8]) + (x[k + 4] + x[k + 12]);
            (quarter(0) + quarter(2)) + (quarter(1) + quarter(3))
        }))
    }
}
