//! Sixteen `f32` lanes, whatever the machine: one AVX-512 register, two AVX2 registers, or a plain array.
//!
//! Kernels are written once over [`Lanes`] and compiled three times by [`kernel!`](crate::kernel); [`Isa::detect`] picks
//! one at run time. Sixteen lanes are one 4×4 pixel block of the rasterizer, or sixteen splats of the projection.
//!
//! Safety: the methods of the vector types call intrinsics that need their instruction set. The types are hidden: only
//! [`kernel!`](crate::kernel) names them, behind an [`Isa`], which exists only after detection.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// The instruction set that kernels run on; part of a backend's name, as results differ in the last bits between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Isa(Level);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[doc(hidden)]
pub enum Level {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Portable,
}

impl Isa {
    /// The best instruction set of this machine.
    pub fn detect() -> Self {
        *Self::available().first().expect("the portable kernels are always there")
    }

    /// Every instruction set that this machine can run, best first: tests compare them all.
    pub fn available() -> Vec<Self> {
        let mut all = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            let fma = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            if fma && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") {
                all.push(Self(Level::Avx512));
            }
            if fma {
                all.push(Self(Level::Avx2));
            }
        }
        all.push(Self(Level::Portable));
        all
    }

    #[doc(hidden)]
    pub fn level(self) -> Level {
        self.0
    }

    /// "avx512", "avx2" or "portable".
    pub fn name(self) -> &'static str {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => "avx2",
            Level::Portable => "portable",
        }
    }
}

/// Compiles a generic kernel (here and in `train`) for every instruction set and dispatches on the first argument, an [`Isa`]:
/// `kernel!(pub(crate) fn forward(tile: &mut Tile) = forward_lanes);` with `fn forward_lanes<L: Lanes>(tile: &mut Tile)`,
/// which must be `#[inline(always)]`.
#[macro_export]
#[doc(hidden)]
macro_rules! kernel {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? = $generic:ident) => {
        $(#[$meta])*
        $vis fn $name(isa: $crate::cpu::simd::Isa, $($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
            fn avx512($($arg: $ty),*) $(-> $ret)? {
                $generic::<$crate::cpu::simd::Avx512>($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
            fn avx2($($arg: $ty),*) $(-> $ret)? {
                $generic::<$crate::cpu::simd::Avx2>($($arg),*)
            }
            match isa.level() {
                // SAFETY: an Isa of this level exists only where the instruction set was detected.
                #[cfg(target_arch = "x86_64")]
                $crate::cpu::simd::Level::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::cpu::simd::Level::Avx2 => unsafe { avx2($($arg),*) },
                $crate::cpu::simd::Level::Portable => $generic::<$crate::cpu::simd::Portable>($($arg),*),
            }
        }
    };
}

/// An array of an expression for each index: `each!(c in [0, 1, 2] => a[c] * b[c])`.
///
/// Kernels use it instead of closures: a closure is a function of its own, compiled without the kernel's instruction set,
/// and intrinsics cannot be inlined into it.
#[macro_export]
#[doc(hidden)]
macro_rules! each {
    ($k:ident in [$($index:literal),*] => $value:expr) => {
        [$({
            let $k: usize = $index;
            $value
        }),*]
    };
}

/// Begins to bring what is needed soon from memory; nothing depends on it.
#[inline(always)]
pub(crate) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: every x86-64 has the instruction, and it neither faults nor changes anything.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// Lanes in every vector.
pub const LANES: usize = 16;

/// Arithmetic on sixteen `f32`. Masks are sixteen bits, lane 0 lowest.
pub trait Lanes:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// All lanes the same.
    fn splat(x: f32) -> Self;
    /// From memory.
    fn load(from: &[f32; 16]) -> Self;
    /// To memory.
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
    /// The same for exponents up to 126. Below -126 it comes out as at most 2^-126, and may be NaN where `self` is not finite.
    #[inline(always)]
    fn exp2_at_most(self) -> Self {
        self.max(Self::splat(-126.0)).exp2_in_range()
    }
    /// The same for exponents in -126 ..= 126.
    fn exp2_in_range(self) -> Self;
    /// 1 / self, relative error below 2e-7, for normal numbers.
    fn recip(self) -> Self;
    /// Sums of the sixteen vectors: lane `i` of the result is the sum over the lanes of `v[i]`, added in a fixed order.
    fn sums(v: &[Self; 16]) -> Self;

    /// Zero lanes.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }

    /// From a slice: lanes beyond its end are `fill`.
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

    /// To a slice: lanes beyond its end are dropped.
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

    /// A scalar function of each lane, for what is too rare to be worth vector code.
    #[inline(always)]
    fn map(self, f: impl Fn(f32) -> f32) -> Self {
        Self::load(&self.to_array().map(f))
    }
}

/// Minimax polynomial of 2^f on [-½, ½], highest power first: 1.8e-7 relative.
const EXP2: [f32; 6] = [1.339_887_4e-3, 9.618_437e-3, 5.550_326_5e-2, 2.402_265_1e-1, 6.931_472e-1, 1.0];

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

/// Sixteen lanes as an array; the compiler vectorises what the target's baseline allows.
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

#[cfg(target_arch = "x86_64")]
#[doc(hidden)]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
#[allow(clippy::undocumented_unsafe_blocks)] // one reason for all of them: the module's "Safety" paragraph
mod x86;

#[cfg(test)]
mod tests {
    use super::*;

    kernel!(fn all_ops(x: &[f32; 16], y: &[f32; 16], out: &mut Vec<[f32; 16]>) = all_ops_lanes);

    #[inline(always)]
    fn all_ops_lanes<L: Lanes>(x: &[f32; 16], y: &[f32; 16], out: &mut Vec<[f32; 16]>) {
        let (a, b) = (L::load(x), L::load(y));
        let sums: [L; 16] = std::array::from_fn(|i| a * L::splat(i as f32) + b);
        let mask = a.lt(b);
        for v in [
            a + b,
            a - b,
            a * b,
            a / b,
            -a,
            a.fma(b, a),
            a.min(b),
            a.max(b),
            a.abs(),
            b.abs().sqrt(),
            a.exp2(),
            b.abs().recip(),
            L::select(mask, a, b),
            L::select(b.le(a), a, b),
            L::sums(&sums),
            a.where_le(b, a),
            a.unless_le(b, a),
            a.where_le(L::splat(f32::NAN), b),
            a.unless_le(L::splat(f32::NAN), b),
            L::splat(if a.all_le(b) { 1.0 } else { 0.0 }),
            L::splat(if a.min(b).all_le(b) { 1.0 } else { 0.0 }),
        ] {
            out.push(v.to_array());
        }
    }

    #[test]
    fn every_instruction_set_computes_the_same() {
        let x: [f32; 16] = std::array::from_fn(|i| (i as f32 - 7.3) * 1.7);
        let y: [f32; 16] = std::array::from_fn(|i| 5.0 - (i as f32) * 0.83);
        let close = |a: f32, b: f32| (a - b).abs() <= 1e-6 * (1.0 + a.abs().max(b.abs()));
        let mut results = Vec::new();
        for isa in Isa::available() {
            let mut out = Vec::new();
            all_ops(isa, &x, &y, &mut out);
            results.push(out);
        }
        for other in &results[1..] {
            for (op, (a, b)) in results[0].iter().zip(other).enumerate() {
                // Sums cancel: their error is relative to the terms, up to 180 each.
                let scale = if op == 14 { 1e3 } else { 1.0 };
                assert!(a.iter().zip(b).all(|(a, b)| close(*a / scale, *b / scale)), "op {op}: {a:?} {b:?}");
            }
        }
        let out = &results[0];
        for i in 0..16 {
            assert!(close(out[10][i] / x[i].exp2(), 1.0));
            assert!(close(out[11][i], 1.0 / y[i].abs()));
            assert_eq!(out[12][i], if x[i] < y[i] { x[i] } else { y[i] });
            assert_eq!([out[15][i], out[16][i]], if y[i] <= x[i] { [x[i], 0.0] } else { [0.0, x[i]] });
            assert_eq!([out[17][i], out[18][i]], [0.0, x[i]]);
            assert_eq!([out[19][i], out[20][i]], [0.0, 1.0]);
            let sum: f32 = (0..16).map(|l| x[l] * i as f32 + y[l]).sum();
            assert!((out[14][i] - sum).abs() < 1e-3);
        }
    }
}
