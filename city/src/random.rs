//! Counter-based random numbers: pure functions of a key and a counter, independent of order and threads.

use glam::Vec2;
pub use scene::random::bits;

/// A stream of random numbers. Each generator forks its own stream, by purpose and place.
#[derive(Debug, Clone, PartialEq)]
pub struct Random {
    key: u64,
    count: u64,
}

impl Random {
    /// The stream of a key.
    pub fn new(key: u64) -> Self {
        Self { key, count: 0 }
    }

    /// An independent stream for a purpose.
    pub fn fork(&self, purpose: u64) -> Self {
        Self::new(bits(self.key, purpose ^ 0xC17C_17C1_7C17_C17C))
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.count += 1;
        bits(self.key, self.count)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f32 {
        self.count += 1;
        scene::random::uniform(self.key, self.count)
    }

    /// Uniform in [from, to).
    pub fn range(&mut self, from: f32, to: f32) -> f32 {
        from + (to - from) * self.unit()
    }

    /// Uniform in `0 .. n`; 0 if `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        (self.bits() % (n.max(1) as u64)) as usize
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    /// A uniformly chosen element.
    ///
    /// # Panics
    /// The slice is empty.
    pub fn one_of<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        &items[self.below(items.len())]
    }

    /// Uniform in a rectangle.
    pub fn between(&mut self, min: Vec2, max: Vec2) -> Vec2 {
        min + (max - min) * Vec2::new(self.unit(), self.unit())
    }

    /// Normally distributed with unit variance (Box and Muller).
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.unit()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_independent_and_uniform() {
        let (mut a, mut b) = (Random::new(1), Random::new(1).fork(2));
        assert_ne!(a.bits(), b.bits());
        let mean: f32 = (0..10_000).map(|_| a.unit()).sum::<f32>() / 1e4;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        let variance: f32 = (0..10_000).map(|_| b.normal().powi(2)).sum::<f32>() / 1e4;
        assert!((variance - 1.0).abs() < 0.06, "{variance}");
        assert!((0..100).all(|_| b.below(3) < 3));
    }
}
