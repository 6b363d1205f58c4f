//! The trait of a sixteen-lane vector.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// Number of lanes of every vector type.
pub const LANES: usize = 16;

/// Arithmetic on sixteen `f32`. Masks are sixteen bits, lane 0 lowest.
pub trait Lanes:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// Broadcasts a value to all lanes.
    fn splat(x: f32) -> Self;
    /// Loads sixteen values.
    fn load(from: &[f32; 16]) -> Self;
    /// Stores sixteen values.
    fn store(self, to: &mut [f32; 16]);
    /// `self · b + c`, fused where the instruction set has it.
    fn fma(self, b: Self, c: Self) -> Self;
    /// Lane-wise minimum.
    fn min(self, b: Self) -> Self;
    /// Lane-wise maximum.
    fn max(self, b: Self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// `self < b`, false for NaN.
    fn lt(self, b: Self) -> u16;
    /// `self <= b`, false for NaN.
    fn le(self, b: Self) -> u16;
    /// Lanes of `a` where the mask is set, of `b` elsewhere.
    fn select(mask: u16, a: Self, b: Self) -> Self;
    /// `self` where `a <= b`, zero elsewhere (and where one of them is NaN).
    #[inline(always)]
    fn where_le(self, a: Self, b: Self) -> Self {
        Self::select(a.le(b), self, Self::zero())
    }
    /// Zero where `a <= b`, `self` elsewhere (and where one of them is NaN).
    #[inline(always)]
    fn unless_le(self, a: Self, b: Self) -> Self {
        Self::select(a.le(b), Self::zero(), self)
    }
    /// `other` where `a <= b`, `self` elsewhere (and where one of them is NaN).
    #[inline(always)]
    fn or_if_le(self, a: Self, b: Self, other: Self) -> Self {
        Self::select(a.le(b), other, self)
    }
    /// `self <= b` in every lane.
    #[inline(always)]
    fn all_le(self, b: Self) -> bool {
        self.le(b) == u16::MAX
    }
    /// 2^self, relative error below 3e-7 for exponents in -126 ..= 126; clamped outside.
    #[inline(always)]
    fn exp2(self) -> Self {
        self.max(Self::splat(-126.0)).min(Self::splat(126.0)).exp2_in_range()
    }
    /// `exp2` for exponents up to 126. Below -126 the result is at most 2^-126, and may be NaN where `self` is not
    /// finite.
    #[inline(always)]
    fn exp2_at_most(self) -> Self {
        self.max(Self::splat(-126.0)).exp2_in_range()
    }
    /// `exp2` for exponents in -126 ..= 126.
    fn exp2_in_range(self) -> Self;
    /// 1 / self, relative error below 2e-7, for normal numbers.
    fn recip(self) -> Self;
    /// Sums of the sixteen vectors: lane `i` of the result is the sum over the lanes of `v[i]`, added in a fixed order.
    fn sums(v: &[Self; 16]) -> Self;

    /// All lanes zero.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }

    /// Loads from a slice; lanes beyond its end are `fill`.
    #[inline(always)]
    fn load_from(slice: &[f32], at: usize, fill: f32) -> Self {
        match slice.get(at..at + LANES) {
            Some(lanes) => Self::load(lanes.try_into().expect("sixteen lanes")),
            None => {
                let mut lanes = [fill; LANES];
                let tail = slice.get(at..).unwrap_or(&[]);
                lanes[..tail.len()].copy_from_slice(tail);
                Self::load(&lanes)
            }
        }
    }

    /// Stores to a slice; lanes beyond its end are dropped.
    #[inline(always)]
    fn store_to(self, slice: &mut [f32], at: usize) {
        match slice.get_mut(at..at + LANES) {
            Some(lanes) => self.store(lanes.try_into().expect("sixteen lanes")),
            None => {
                let mut lanes = [0.0; LANES];
                self.store(&mut lanes);
                let tail = slice.get_mut(at..).unwrap_or(&mut []);
                tail.copy_from_slice(&lanes[..tail.len()]);
            }
        }
    }

    /// The lanes as an array.
    #[inline(always)]
    fn to_array(self) -> [f32; 16] {
        let mut lanes = [0.0; LANES];
        self.store(&mut lanes);
        lanes
    }

    /// Applies a scalar function to each lane; for functions too rare to vectorise.
    #[inline(always)]
    fn map(self, f: impl Fn(f32) -> f32) -> Self {
        Self::load(&self.to_array().map(f))
    }
}

/// Minimax polynomial of 2^f on [-½, ½], highest power first: 1.8e-7 relative.
pub(super) const EXP2: [f32; 6] = [1.339_887_4e-3, 9.618_437e-3, 5.550_326_5e-2, 2.402_265_1e-1, 6.931_472e-1, 1.0];

/// Implements the operators of a vector type by its methods `add_lanes` etc.
macro_rules! operators {
    ($name:ident) => {
        impl Add for $name {
            type Output = Self;
            #[inline(always)]
            fn add(self, b: Self) -> Self {
                self.add_lanes(b)
            }
        }
        impl Sub for $name {
            type Output = Self;
            #[inline(always)]
            fn sub(self, b: Self) -> Self {
                self.sub_lanes(b)
            }
        }
        impl Mul for $name {
            type Output = Self;
            #[inline(always)]
            fn mul(self, b: Self) -> Self {
                self.mul_lanes(b)
            }
        }
        impl Div for $name {
            type Output = Self;
            #[inline(always)]
            fn div(self, b: Self) -> Self {
                self.div_lanes(b)
            }
        }
        impl Neg for $name {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                Self::splat(-0.0).sub_lanes(self)
            }
        }
    };
}
pub(super) use operators;
