//! How strongly figures of views move together.

use serde::Serialize;

/// Pearson's coefficient and how likely chance alone gives one as far from 0. The field names are keys of
/// `eval/report.json`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Correlation {
    /// -1..1.
    pub r: f64,
    /// Two-sided, by Student's t with two degrees of freedom less than there are views. Exact to 1e-14.
    pub p: f64,
}

/// The correlation of pairs; `None` of fewer than three, or where all are equal on a side.
pub(crate) fn correlation(pairs: &[(f64, f64)]) -> Option<Correlation> {
    // Compared, for the mean of equal numbers can be another number.
    let varies = |side: fn(&(f64, f64)) -> f64| pairs.iter().any(|of| side(of) != side(&pairs[0]));
    if pairs.len() < 3 || !varies(|of| of.0) || !varies(|of| of.1) {
        return None;
    }
    let count = pairs.len() as f64;
    let mean = |side: fn(&(f64, f64)) -> f64| pairs.iter().map(side).sum::<f64>() / count;
    let (x, y) = (mean(|of| of.0), mean(|of| of.1));
    let moment = |of: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|(a, b)| of(a - x, b - y)).sum::<f64>();
    let (xx, yy, xy) = (moment(&|a, _| a * a), moment(&|_, b| b * b), moment(&|a, b| a * b));
    let r = (xy / (xx.sqrt() * yy.sqrt())).clamp(-1.0, 1.0);
    r.is_finite().then(|| Correlation { r, p: chance(r, pairs.len() - 2) })
}

/// The two-sided p value of a coefficient: 1 - A(t | ν) with t = r √(ν / (1 - r²)), in finite sums over the angle
/// θ = arctan(t / √ν), whose sine is |r| (Abramowitz and Stegun 1964, 26.7.3 and 26.7.4).
fn chance(r: f64, freedom: usize) -> f64 {
    let (sine, square) = (r.abs(), 1.0 - r * r);
    let odd = freedom % 2;
    // Even: 1 + 1/2 cos² + 1·3/(2·4) cos⁴ … Odd: cos + 2/3 cos³ + 2·4/(3·5) cos⁵ …; up to cos^(ν - 2).
    let (mut term, mut sum) = (if odd == 1 { square.sqrt() } else { 1.0 }, 0.0);
    for i in 0..(freedom - odd) / 2 {
        sum += term;
        let k = (2 * i + 1 + odd) as f64;
        term *= square * k / (k + 1.0);
    }
    let within = if odd == 1 { (sine.asin() + sine * sum) * std::f64::consts::FRAC_2_PI } else { sine * sum };
    (1.0 - within).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `scipy.stats.pearsonr` (1.17) of x = 1 … n and y = (x² · 7 mod 11) + s · x.
    #[test]
    fn coefficients_and_chances_are_those_of_scipy() {
        for (n, slope, r, p) in [
            (3, 0.0, 0.5, 6.666666666666666e-01),
            (4, 0.1, -0.6076436202502, 3.923563797498002e-01),
            (5, -0.5, -0.158776837207489, 7.986917091832402e-01),
            (8, 0.3, 0.235051420297619, 5.752425239950726e-01),
            (13, -0.2, -0.419640959972075, 1.534369395846931e-01),
            (30, 0.05, 0.124747852864773, 5.113017575483048e-01),
            (100, -0.02, -0.20618060339524, 3.958510971085035e-02),
            (201, 0.01, 0.173878410943334, 1.356384760931686e-02),
            (12, 2.0, 0.903122787460691, 5.700521490015043e-05),
        ] {
            let pairs: Vec<(f64, f64)> =
                (1..=n).map(|x| (f64::from(x), f64::from(x * x * 7 % 11) + slope * f64::from(x))).collect();
            let found = correlation(&pairs).unwrap();
            assert!((found.r - r).abs() < 1e-12 && (found.p - p).abs() < 1e-12, "{n} {slope}: {found:?}, {r} {p}");
        }
    }

    #[test]
    fn what_does_not_vary_has_no_correlation() {
        assert_eq!(correlation(&[]), None);
        assert_eq!(correlation(&[(1.0, 2.0), (2.0, 3.0)]), None);
        assert_eq!(correlation(&[(1.0, 2.0), (1.0, 3.0), (1.0, 4.0)]), None);
        for count in 3..40 {
            assert_eq!(correlation(&vec![(0.1, 0.7); count]), None, "{count}");
        }
        let line = correlation(&[(1.0, 4.0), (2.0, 3.0), (3.0, 2.0)]).unwrap();
        assert!((line.r + 1.0).abs() < 1e-12 && line.p < 1e-7, "{line:?}");
    }
}
