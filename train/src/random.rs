//! Counter-based random numbers: a value is a pure function of key and counter, independent of the order of execution.

pub use scene::random::{bits, uniform};

/// A random permutation of `0 .. n` (Fisher-Yates).
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
