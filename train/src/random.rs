//! Counter-based random numbers: a value is a pure function of its key, so no order of execution can change it.

/// A well mixed 64-bit hash of a key and a counter (SplitMix64's finaliser, Steele et al. 2014, twice).
pub fn bits(key: u64, counter: u64) -> u64 {
    let mix = |mut z: u64| {
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    mix(mix(key.wrapping_add(0x9e37_79b9_7f4a_7c15)).wrapping_add(counter.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// Uniform in [0, 1).
pub fn uniform(key: u64, counter: u64) -> f32 {
    (bits(key, counter) >> 40) as f32 / (1u64 << 24) as f32
}

/// A permutation of `0 .. n` (Fisher and Yates).
pub fn shuffle(key: u64, n: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n as u32).collect();
    for i in (1..n).rev() {
        order.swap(i, (bits(key, i as u64) % (i as u64 + 1)) as usize);
    }
    order
}

#[cfg(test)]
mod tests {
    #[test]
    fn shuffles_are_permutations_and_uniforms_are_uniform() {
        let mut order = super::shuffle(7, 100);
        assert_ne!(order, super::shuffle(8, 100));
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, &v)| i == v as usize));
        let mean: f32 = (0..10_000).map(|i| super::uniform(3, i)).sum::<f32>() / 1e4;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
    }
}
