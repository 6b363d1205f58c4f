//! Loops compiled for each instruction set and chosen at run time. The compiler vectorises them.

/// `vectorised!(fn name(arguments) = body)` with `#[inline(always)] fn body<const LEVEL: usize>(arguments)`: a function
/// that calls the body compiled for the best instruction set of the machine. `LEVEL` is [`BASE`], [`AVX2`] or
/// [`AVX512`].
macro_rules! vectorised {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) = $body:ident) => {
        $(#[$meta])*
        $vis fn $name($($argument: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
                fn avx512($($argument: $type),*) {
                    $body::<{ $crate::gradient::vectorised::AVX512 }>($($argument),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($argument: $type),*) {
                    $body::<{ $crate::gradient::vectorised::AVX2 }>($($argument),*)
                }
                match $crate::gradient::vectorised::level() {
                    // SAFETY: the level is that of the instruction sets which the machine has.
                    $crate::gradient::vectorised::AVX512 => return unsafe { avx512($($argument),*) },
                    // SAFETY: as above.
                    $crate::gradient::vectorised::AVX2 => return unsafe { avx2($($argument),*) },
                    _ => {}
                }
            }
            $body::<{ $crate::gradient::vectorised::BASE }>($($argument),*)
        }
    };
}
pub(super) use vectorised;

/// What every machine of the target has.
pub(super) const BASE: usize = 0;
/// Sixteen registers of eight floats, and fused multiply-add.
pub(super) const AVX2: usize = 1;
/// 32 registers of sixteen floats, and fused multiply-add.
pub(super) const AVX512: usize = 2;

/// The best level that the machine has.
#[cfg(target_arch = "x86_64")]
pub(super) fn level() -> usize {
    let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let has_avx512 = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vl");
    match (has_avx2, has_avx512) {
        (true, true) => AVX512,
        (true, false) => AVX2,
        _ => BASE,
    }
}

/// `sums + weight · values`, fused where the level has it.
#[inline(always)]
pub(super) fn add_scaled<const N: usize, const LEVEL: usize>(
    weight: f32,
    values: &[f32; N],
    sums: [f32; N],
) -> [f32; N] {
    let mut out = sums;
    for i in 0..N {
        out[i] = if LEVEL == BASE { sums[i] + weight * values[i] } else { weight.mul_add(values[i], sums[i]) };
    }
    out
}
