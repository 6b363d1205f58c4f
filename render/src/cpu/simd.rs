//! Sixteen `f32` lanes on any machine: one AVX-512 register, two AVX2 registers, or an array.
//!
//! Kernels are generic over [`Lanes`]; [`kernel!`](crate::kernel) compiles them for every instruction set, and
//! [`Isa::detect`] selects one at run time. Sixteen lanes are one 4×4 pixel block of the rasterizer, or sixteen splats
//! of the projection.
//!
//! Safety: the methods of the vector types call intrinsics that need their instruction set. The types are hidden: only
//! [`kernel!`](crate::kernel) names them, guarded by an [`Isa`], which exists only after detection.

mod isa;
mod lanes;
mod portable;
#[cfg(target_arch = "x86_64")]
#[allow(clippy::undocumented_unsafe_blocks)] // one reason for all of them: the "Safety" paragraph above
mod x86;

pub use isa::Isa;
#[doc(hidden)]
pub use isa::Level;
pub use lanes::{LANES, Lanes};
#[doc(hidden)]
pub use portable::Portable;
#[cfg(target_arch = "x86_64")]
#[doc(hidden)]
pub use x86::{Avx2, Avx512};

/// Compiles a generic kernel for every instruction set and dispatches on the first argument, an [`Isa`]:
/// `kernel!(pub(crate) fn forward(tile: &mut Tile) = forward_lanes);` with `fn forward_lanes<L: Lanes>(tile: &mut
/// Tile)`, which must be `#[inline(always)]`. The crate `train` uses it too.
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

/// An array of an expression evaluated at each index, unrolled: `unroll!(c in [0, 1, 2] => a[c] * b[c])`.
///
/// Kernels use it instead of closures: a closure is compiled as a function without the kernel's target features, and
/// intrinsics cannot be inlined into it.
#[macro_export]
#[doc(hidden)]
macro_rules! unroll {
    ($k:ident in [$($index:literal),*] => $value:expr) => {
        [$({
            let $k: usize = $index;
            $value
        }),*]
    };
}

/// Prefetches a value into the cache.
#[inline(always)]
pub(crate) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: every x86-64 has the instruction, and it neither faults nor has effects.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

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
    fn every_instruction_set_gives_the_same_results() {
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
