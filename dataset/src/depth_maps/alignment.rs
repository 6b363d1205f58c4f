//! Aligns a map of relative depths or inverse depths to the sparse points of its view, by a scale and a shift.
//!
//! The error of a point of depth `d` is relative: `(s v + t) d - 1` for inverse depths, `(s v + t) / d - 1` for depths. To first
//! order it is the error that the depth loss of training compares. Points may be wrong, and models are wrong at edges, so that the fit
//! starts from the line through two points with the least median error (Rousseeuw, 1984) and goes on with least squares under
//! Tukey's biweight.

use std::ops::RangeInclusive;

use super::DepthKind;

/// Least number of points.
pub(crate) const MIN_POINTS: usize = 20;
/// Most points; of more, an even choice is used.
const MAX_POINTS: usize = 4000;
/// Lines that the fit may start from.
const STARTS: usize = 200;
/// Rounds of weighted least squares.
const ROUNDS: usize = 20;
/// Tukey's constant, in standard deviations, and the standard deviation as a multiple of the median absolute error.
const TUKEY: f64 = 4.685;
const SIGMA_PER_MEDIAN: f64 = 1.4826;
/// Least median error: that of 32-bit values.
const LEAST_ERROR: f64 = 1e-6;
/// A map whose median error is larger is not used.
const MAX_MEDIAN_ERROR: f64 = 0.25;
/// Depths are used up to this factor below the nearest and beyond the farthest point that the map agrees with.
const EXTRAPOLATION: f64 = 2.0;

/// How values become depths.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Alignment {
    kind: DepthKind,
    pub(crate) scale: f64,
    pub(crate) shift: f64,
    /// Depths that are used.
    range: RangeInclusive<f64>,
}

/// A point: the map's value `v`, the depth or inverse depth `y` that it stands for, and the factor `q` that makes errors relative.
#[derive(Clone, Copy)]
struct Pair {
    v: f64,
    y: f64,
    q: f64,
    depth: f64,
}

impl Pair {
    fn error(&self, (scale, shift): (f64, f64)) -> f64 {
        (scale * self.v + shift) * self.q - 1.0
    }
}

impl Alignment {
    /// Fits a map of [`DepthKind::Relative`] or [`DepthKind::Inverse`] to points: the map's value and the depth of each.
    ///
    /// # Errors
    /// Why the map cannot be used.
    pub(crate) fn fit(kind: DepthKind, points: &[(f32, f64)]) -> Result<Self, String> {
        if points.len() < MIN_POINTS {
            return Err(format!(
                "only {} of its view's sparse points have a value, of {MIN_POINTS} needed",
                points.len()
            ));
        }
        let pair = |&(v, depth): &(f32, f64)| {
            let (y, q) = if kind == DepthKind::Inverse { (1.0 / depth, depth) } else { (depth, 1.0 / depth) };
            Pair { v: f64::from(v), y, q, depth }
        };
        let mut pairs: Vec<Pair> = points.iter().map(pair).collect();
        pairs.sort_by(|a, b| a.v.total_cmp(&b.v).then(a.y.total_cmp(&b.y)));
        if pairs.len() > MAX_POINTS {
            pairs = (0..MAX_POINTS).map(|i| pairs[i * pairs.len() / MAX_POINTS]).collect();
        }
        let flat = || String::from("its values are the same at all sparse points");
        let mut line = start(&pairs).ok_or_else(flat)?;
        let mut weights = vec![0.0; pairs.len()];
        for _ in 0..ROUNDS {
            let limit = TUKEY * SIGMA_PER_MEDIAN * median_error(&pairs, line).max(LEAST_ERROR);
            for (weight, pair) in weights.iter_mut().zip(&pairs) {
                let ratio = pair.error(line) / limit;
                *weight = if ratio.abs() < 1.0 { (1.0 - ratio * ratio).powi(2) } else { 0.0 };
            }
            line = least_squares(&pairs, &weights).ok_or_else(flat)?;
        }
        let (scale, shift) = line;
        if scale <= 0.0 {
            return Err("its scale would be negative: its values fall where those of the sparse points rise".into());
        }
        let error = median_error(&pairs, line);
        if !(error <= MAX_MEDIAN_ERROR && scale.is_finite() && shift.is_finite()) {
            return Err(format!("it is off by {:.0} % at half of the sparse points", 100.0 * error));
        }
        let agreeing = || pairs.iter().zip(&weights).filter(|(_, weight)| **weight > 0.0).map(|(pair, _)| pair.depth);
        let (nearest, farthest) = (agreeing().fold(f64::INFINITY, f64::min), agreeing().fold(0.0, f64::max));
        Ok(Self { kind, scale, shift, range: nearest / EXTRAPOLATION..=EXTRAPOLATION * farthest })
    }

    /// The depth of a value; `None` far from the depths of the points.
    pub(crate) fn depth(&self, value: f32) -> Option<f32> {
        let aligned = self.scale * f64::from(value) + self.shift;
        let depth = if self.kind == DepthKind::Inverse { 1.0 / aligned } else { aligned };
        self.range.contains(&depth).then_some(depth as f32)
    }
}

/// The line through two of the pairs, sorted by value, that has the least median error.
fn start(pairs: &[Pair]) -> Option<(f64, f64)> {
    let half = pairs.len() / 2;
    // A pair of the lower and one of the upper half: multiples of two irrational numbers spread evenly over both.
    let index = |number: usize, step: f64, count: usize| (((number as f64 * step).fract()) * count as f64) as usize;
    let lines = (0..STARTS).filter_map(|number| {
        let (a, b) = (pairs[index(number, 0.754_877_666, half)], pairs[half + index(number, 0.569_840_296, half)]);
        let scale = (b.y - a.y) / (b.v - a.v);
        let line = (scale, a.y - scale * a.v);
        (b.v > a.v && line.0.is_finite() && line.1.is_finite()).then(|| (median_error(pairs, line), line))
    });
    lines.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, line)| line)
}

/// The line with the least sum of squared errors under these weights; `None` if the values do not differ.
fn least_squares(pairs: &[Pair], weights: &[f64]) -> Option<(f64, f64)> {
    let weighted = || pairs.iter().zip(weights).map(|(pair, weight)| (pair, weight * pair.q * pair.q));
    let mean = |pick: fn(&Pair) -> f64| {
        let (sum, total) = weighted().fold((0.0, 0.0), |(sum, total), (pair, w)| (sum + w * pick(pair), total + w));
        sum / total
    };
    let (v, y) = (mean(|pair| pair.v), mean(|pair| pair.y));
    let (mut covariance, mut variance, mut size) = (0.0, 0.0, 0.0);
    for (pair, weight) in weighted() {
        covariance += weight * (pair.v - v) * (pair.y - y);
        variance += weight * (pair.v - v) * (pair.v - v);
        size += weight * pair.v * pair.v;
    }
    let scale = covariance / variance;
    (variance > 1e-13 * size && scale.is_finite()).then_some((scale, y - scale * v))
}

fn median_error(pairs: &[Pair], line: (f64, f64)) -> f64 {
    let mut errors: Vec<f64> = pairs.iter().map(|pair| pair.error(line).abs()).collect();
    let middle = errors.len() / 2;
    *errors.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Numbers in 0..1 that depend on `i` only.
    fn spread(i: usize, step: f64) -> f64 {
        (i as f64 * step).fract()
    }

    /// Points of a street: most near, some far.
    fn depths(count: usize) -> impl Iterator<Item = f64> {
        (0..count).map(|i| 3.0 * (40f64).powf(spread(i, 0.618_034)))
    }

    fn value(kind: DepthKind, depth: f64, a: f64, b: f64) -> f32 {
        (if kind == DepthKind::Inverse { a / depth + b } else { a * depth + b }) as f32
    }

    #[test]
    fn scale_and_shift_are_restored_beside_noise_and_outliers() {
        for (kind, a, b) in [
            (DepthKind::Inverse, 7.0, 0.3),
            (DepthKind::Inverse, 200.0, -0.1),
            (DepthKind::Relative, 0.02, 0.4),
            (DepthKind::Relative, 3.0, -2.0),
        ] {
            // Three in ten points are of another surface, and noise of 1 % is on the others.
            let point = |(i, depth): (usize, f64)| {
                let noise = 1.0 + 0.02 * (spread(i, 0.324_718) - 0.5);
                let found = if i % 10 < 3 { depth * (0.05 + 4.0 * spread(i, 0.137)) } else { depth * noise };
                (value(kind, depth, a, b), found)
            };
            let points: Vec<(f32, f64)> = depths(400).enumerate().map(point).collect();
            let aligned = Alignment::fit(kind, &points).unwrap();
            assert!((aligned.scale * a - 1.0).abs() < 0.01, "{kind:?}: {} of {}", aligned.scale, 1.0 / a);
            assert!((aligned.shift + b / a).abs() < 0.01 * (b / a).abs(), "{kind:?}: {} {}", aligned.shift, -b / a);
            for depth in depths(50) {
                let found = f64::from(aligned.depth(value(kind, depth, a, b)).unwrap());
                assert!((found / depth - 1.0).abs() < 0.01, "{kind:?}: {found} {depth}");
            }
        }
    }

    #[test]
    fn maps_that_cannot_be_aligned_are_refused_with_the_reason() {
        let points = |count: usize, value: &dyn Fn(usize, f64) -> f64| -> Vec<(f32, f64)> {
            depths(count).enumerate().map(|(i, depth)| (value(i, depth) as f32, depth)).collect()
        };
        let refused = |points: &[(f32, f64)]| Alignment::fit(DepthKind::Inverse, points).unwrap_err();
        assert!(refused(&points(MIN_POINTS - 1, &|_, d| 1.0 / d)).starts_with("only 19 "));
        assert!(Alignment::fit(DepthKind::Inverse, &points(MIN_POINTS, &|_, d| 1.0 / d)).is_ok());
        assert!(refused(&points(100, &|_, _| 0.7)).contains("the same"));
        let falls = refused(&points(100, &|_, d| d));
        assert!(falls.contains("fall") || falls.contains("off by"), "{falls}");
        assert!(refused(&points(100, &|_, d| 5.0 - 1.0 / d)).contains("fall"));
        assert!(refused(&points(400, &|i, _| spread(i, 0.324_718))).contains("off by"));
    }

    #[test]
    fn values_far_beyond_the_points_give_no_depth() {
        let points: Vec<(f32, f64)> = depths(100).map(|depth| ((1.0 / depth) as f32, depth)).collect();
        let aligned = Alignment::fit(DepthKind::Inverse, &points).unwrap();
        let [nearest, farthest] = [3.0, 120.0f32];
        assert!(aligned.depth(1.0 / nearest).is_some() && aligned.depth(0.6 / farthest).is_some());
        for value in [0.0, -0.1, 0.4 / farthest, 2.5 / nearest] {
            assert_eq!(aligned.depth(value), None, "{value}");
        }
    }

    proptest! {
        #[test]
        fn any_numbers_give_an_alignment_or_a_reason(
            points in prop::collection::vec((any::<f32>().prop_filter("finite", |v| v.is_finite()), 1e-6..1e9f64), 0..80),
        ) {
            for kind in [DepthKind::Relative, DepthKind::Inverse] {
                if let Ok(aligned) = Alignment::fit(kind, &points) {
                    prop_assert!(aligned.scale > 0.0 && aligned.shift.is_finite());
                    let depths = points.iter().filter_map(|point| aligned.depth(point.0));
                    prop_assert!(depths.into_iter().all(|depth| depth > 0.0 && depth.is_finite()));
                }
            }
        }
    }
}
