//! The compute ceiling of one core, for the roofline model (Williams et al. 2009), and the kernels' operation counts.

use super::simd::{Isa, LANES, Lanes};
use crate::{kernel, unroll};

/// Floating-point operations per lane of the forward rasterizer, for one (splat, 4×4 block) combination: the additions
/// and multiplications of its loops, an FMA counted as two; 10 for the exponent, 12 for `exp2`, 8 for blending.
/// Comparisons, selections, rounding and signs do not count.
pub const RASTERIZE_FLOPS: u64 = 30;
/// The same for the backward rasterizer without depth: 22 for α, 18 for blending with its reciprocal counted as four,
/// 26 for the moments. Pixel offsets are computed twice but counted once.
pub const RASTERIZE_BACKWARD_FLOPS: u64 = 66;

/// Runs `rounds` of independent FMA chains on this instruction set, as many chains as fit into registers without
/// spilling. Returns the number of floating-point operations, and a value that depends on all of them.
pub fn multiply_adds(isa: Isa, rounds: u64) -> (u64, f32) {
    // Sixteen lanes take one of 32 registers with AVX-512, two of 16 with AVX2, four of 16 with SSE2. Latency times
    // ports is 8 registers (Zen, Skylake) to 10 (Haswell).
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
            // Values converge to a fixed point, so none becomes denormal or infinite.
            let (factor, addend) = (L::splat(std::hint::black_box(0.75)), L::splat(std::hint::black_box(0.25)));
            let mut values = unroll!(k in [$($k),*] => L::splat(k as f32));
            for _ in 0..rounds {
                values = unroll!(k in [$($k),*] => values[k].fma(factor, addend));
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
    fn every_chain_runs_every_round() {
        for isa in Isa::available() {
            let (flops, value) = multiply_adds(isa, 1000);
            let chains = flops / (2 * LANES as u64 * 1000);
            // Every lane of every chain has converged to the fixed point 1 of x = x·¾ + ¼.
            assert!((value - (chains * LANES as u64) as f32).abs() < 1e-2, "{}: {value}", isa.name());
        }
    }
}
