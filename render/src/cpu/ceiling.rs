//! What one core can do at most: the ceiling that kernels are held against (the roofline of Williams et al. 2009).

use super::simd::{Isa, LANES, Lanes};
use crate::{each, kernel};

/// Floating-point operations of one lane of the forward rasterizer, for each 4×4 block of pixels that a splat visits: additions
/// and multiplications of its loops, a fused one counted as two: 10 of the exponent, 12 of its power of two, 8 of the blending.
/// Comparisons, selections, rounding and signs are left out.
pub const RASTERIZE_FLOPS: u64 = 30;
/// The same of the backward rasterizer, without depth: 22 of α, 18 of the blending, its reciprocal counted as four, and 26 of the
/// moments. What is computed a second time there, the places of the pixels, is counted once.
pub const RASTERIZE_BACKWARD_FLOPS: u64 = 66;

/// Does `rounds` of independent fused multiply-adds on this instruction set, in as many chains as its registers hold without
/// spilling; returns the number of floating-point operations done, and a value that depends on them all.
pub fn multiply_adds(isa: Isa, rounds: u64) -> (u64, f32) {
    // Sixteen lanes are one register of 32 with AVX-512, two of 16 with AVX2, four of 16 with SSE2. Latency times ports is 8
    // registers (Zen, Skylake) to 10 (Haswell).
    let (chains, value) = match isa.name() {
        "avx512" => (12, twelve(isa, rounds)),
        "avx2" => (5, five(isa, rounds)),
        _ => (2, two(isa, rounds)),
    };
    (2 * LANES as u64 * chains * rounds, value)
}

kernel!(fn twelve(rounds: u64) -> f32 = twelve_lanes);
kernel!(fn five(rounds: u64) -> f32 = five_lanes);
kernel!(fn two(rounds: u64) -> f32 = two_lanes);

macro_rules! chains {
    ($name:ident, [$($k:literal),*]) => {
        #[inline(always)]
        fn $name<L: Lanes>(rounds: u64) -> f32 {
            // Towards a fixed point, so that no value becomes denormal or infinite.
            let (factor, addend) = (L::splat(std::hint::black_box(0.75)), L::splat(std::hint::black_box(0.25)));
            let mut values = each!(k in [$($k),*] => L::splat(k as f32));
            for _ in 0..rounds {
                values = each!(k in [$($k),*] => values[k].fma(factor, addend));
            }
            values.iter().map(|value| value.to_array().iter().sum::<f32>()).sum()
        }
    };
}

chains!(twelve_lanes, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]);
chains!(five_lanes, [0, 1, 2, 3, 4]);
chains!(two_lanes, [0, 1]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chains_do_the_work_that_they_claim() {
        for isa in Isa::available() {
            let (flops, value) = multiply_adds(isa, 1000);
            let chains = flops / (2 * LANES as u64 * 1000);
            // Every lane of every chain has come to the fixed point of x = x·¾ + ¼.
            assert!((value - (chains * LANES as u64) as f32).abs() < 1e-2, "{}: {value}", isa.name());
        }
    }
}
