//! Searches for the number of splats that can be removed within an allowed error.

/// The search ends once a cut uses this share of the allowed error.
const SUFFICIENT_DEPTH: f64 = 0.9;

/// Searches for the largest number of splats to remove, least important first. It assumes that the error grows by a
/// factor times the removed importance and updates the factor with every trial. Where a trial does not halve the
/// interval, the next one bisects.
pub(super) struct Search {
    /// Prefix sums of the importance.
    removed: Vec<f64>,
    /// Allowed relative increase of the error.
    allowed: f64,
    /// Largest number of removed splats known to be within the allowed error.
    low: usize,
    /// Smallest number known to exceed it.
    high: usize,
    /// Relative increase of the error per unit of importance.
    factor: Option<f64>,
    /// The next step bisects.
    bisect: bool,
}

impl Search {
    pub(super) fn new(importance: impl Iterator<Item = f64>, allowed: f64, factor: Option<f64>) -> Self {
        let sums = importance.scan(0.0, |sum, value| {
            *sum += value;
            Some(*sum)
        });
        let removed: Vec<f64> = [0.0].into_iter().chain(sums).collect();
        Self { high: removed.len() - 1, removed, allowed, low: 0, factor, bisect: false }
    }

    /// The next number of splats to remove on trial; `None` when the search is finished.
    pub(super) fn next(&mut self) -> Option<usize> {
        if self.high - self.low <= 1 + self.removed.len() / 100 {
            return None;
        }
        let middle = (self.low + self.high) / 2;
        let Some(factor) = self.factor.filter(|_| !self.bisect) else { return Some(middle) };
        // Slightly below the limit, so that the trial is likely within it.
        let aim = 0.5 * (1.0 + SUFFICIENT_DEPTH) * self.allowed / factor;
        let count = self.removed.partition_point(|removed| *removed <= aim);
        let margin = (self.high - self.low) / 16;
        Some(count.clamp(self.low + 1 + margin, (self.high - 1 - margin).max(self.low + 1)))
    }

    /// Records the relative increase of the error for a trial. Returns true if it is within the limit.
    pub(super) fn record(&mut self, count: usize, growth: f64) -> bool {
        let width = self.high - self.low;
        let is_within = growth <= self.allowed;
        if is_within {
            self.low = count;
            if growth >= SUFFICIENT_DEPTH * self.allowed {
                self.high = count;
            }
        } else {
            self.high = count;
        }
        self.factor = (growth > 0.0 && self.removed[count] > 0.0).then(|| growth / self.removed[count]);
        self.bisect = !self.bisect && self.high - self.low > width / 2;
        is_within
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The result of a search and its number of trials, where `growth` is the increase of the error by the number of
    /// removed splats.
    fn run_search(count: usize, allowed: f64, factor: Option<f64>, growth: impl Fn(usize) -> f64) -> (usize, usize) {
        let mut search = Search::new((0..count).map(|i| 1e-6 * i as f64), allowed, factor);
        let (mut best, mut trials) = (0, 0);
        while let Some(tried) = search.next() {
            assert!(tried > 0 && tried < count, "{tried} of {count}");
            trials += 1;
            if search.record(tried, growth(tried)) {
                assert!(growth(tried) <= allowed);
                best = tried;
            }
        }
        (best, trials)
    }

    #[test]
    fn searches_are_short_if_importance_predicts_the_error_and_always_end() {
        let sum = |n: usize| 0.5e-6 * (n * n) as f64;
        let (best, trials) = run_search(10_000, 2.0, Some(1.0), |n| 3.0 * sum(n));
        assert!(trials <= 4 && (0.9..=1.0).contains(&(3.0 * sum(best) / 2.0)), "{best} {trials}");
        // A cliff; no effect; no splat removable; one splat; none; an error that falls with the number removed.
        let (best, trials) = run_search(10_000, 2.0, Some(1.0), |n| if n > 7_000 { 1e9 } else { 0.0 });
        assert!((6_890..=7_000).contains(&best) && trials <= 14, "{best} {trials}");
        assert!(run_search(10_000, 2.0, None, |_| 0.0).0 >= 9_890);
        assert_eq!(run_search(10_000, 2.0, None, |_| 1e9).0, 0);
        assert_eq!((run_search(1, 2.0, None, |_| 0.0), run_search(0, 2.0, None, |_| 0.0)), ((0, 0), (0, 0)));
        assert!(run_search(5_000, 2.0, Some(1e9), |n| 4.0 / (1 + n) as f64).1 <= 20);
        assert!(run_search(5_000, 0.0, Some(f64::NAN), |_| f64::NAN).1 <= 20);
    }
}
