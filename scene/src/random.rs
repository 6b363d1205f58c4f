//! The counter-based hash behind all random numbers of plat: a value is a pure function of key and counter, so the
//! order of execution does not matter.

/// A 64-bit hash of a key and a counter (SplitMix64's finaliser, Steele et al. 2014, twice).
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

#[cfg(test)]
mod tests {
    #[test]
    fn hash_values_are_stable() {
        // Existing plans, blocks and cities depend on these values.
        assert_eq!([super::bits(0, 0), super::bits(7, 1)], [0x4821_8226_ff3c_d4bf, 0xb8b4_c297_7eab_ce45]);
    }
}
