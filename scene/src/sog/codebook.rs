//! 256 values that stand for many.

/// Bins of the histogram that a codebook is made from.
const BINS: usize = 1 << 14;
/// Cells that the density of the values is measured in.
const CELLS: usize = 256;
/// Passes of Lloyd's method. More change the error by less than a percent.
const PASSES: usize = 12;

/// 256 values, ascending, about as the means that k-means finds.
pub(super) struct Codebook {
    values: Vec<f32>,
}

impl Codebook {
    /// The codebook of finite values.
    pub(super) fn of(values: impl Iterator<Item = f32> + Clone) -> Self {
        let (least, largest) =
            values.clone().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        if least >= largest || !(largest - least).is_finite() {
            return Self { values: vec![if least.is_finite() { least } else { 0.0 }; 256] };
        }
        // Per bin: how many values, and their sum.
        let mut bins = vec![(0.0f64, 0.0f64); BINS];
        let step = (f64::from(largest) - f64::from(least)) / BINS as f64;
        for value in values {
            let bin = &mut bins[(((f64::from(value) - f64::from(least)) / step) as usize).min(BINS - 1)];
            *bin = (bin.0 + 1.0, bin.1 + f64::from(value));
        }
        // The best density of means is the cube root of that of the values (Panter and Dite 1951).
        let densities: Vec<f64> =
            bins.chunks_exact(BINS / CELLS).map(|cell| cell.iter().map(|bin| bin.0).sum::<f64>().cbrt()).collect();
        let whole: f64 = densities.iter().sum();
        let mut means = Vec::with_capacity(256);
        let mut before = 0.0;
        for (cell, density) in densities.into_iter().enumerate() {
            while means.len() < 256 && before + density >= (means.len() as f64 + 0.5) / 256.0 * whole {
                let share = ((means.len() as f64 + 0.5) / 256.0 * whole - before) / density;
                means.push(f64::from(least) + (cell as f64 + share) * step * (BINS / CELLS) as f64);
            }
            before += density;
        }
        means.resize(256, f64::from(largest));
        bins.retain(|bin| bin.0 > 0.0);
        let bins: Vec<(f64, f64)> = bins.into_iter().map(|(count, sum)| (count, sum / count)).collect();
        for _ in 0..PASSES {
            let mut sums = vec![(0.0f64, 0.0f64); 256];
            let mut of = 0;
            for &(count, mean) in &bins {
                while of < 255 && (means[of + 1] - mean).abs() <= (mean - means[of]).abs() {
                    of += 1;
                }
                sums[of] = (sums[of].0 + count, sums[of].1 + count * mean);
            }
            for (mean, (count, sum)) in means.iter_mut().zip(sums) {
                if count > 0.0 {
                    *mean = sum / count;
                }
            }
            means.sort_by(f64::total_cmp);
        }
        Self { values: means.into_iter().map(|mean| mean as f32).collect() }
    }

    /// The index of the nearest value.
    pub(super) fn code(&self, value: f32) -> u8 {
        let above = self.values.partition_point(|&v| v < value).min(255);
        let below = above.saturating_sub(1);
        let nearer = (value - self.values[below]).abs() <= (self.values[above] - value).abs();
        (if nearer { below } else { above }) as u8
    }

    /// The 256 values.
    pub(super) fn values(&self) -> Vec<f32> {
        self.values.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_the_nearest_values() {
        let values: Vec<f32> = (0..5000).map(|i| ((i * i % 9973) as f32 / 700.0).sin() * (i as f32 / 900.0)).collect();
        let book = Codebook::of(values.iter().copied());
        assert!(book.values.is_sorted() && book.values.len() == 256);
        let mut squares = 0.0;
        for &value in &values {
            let found = (value - book.values[usize::from(book.code(value))]).abs();
            let least = book.values.iter().map(|v| (value - v).abs()).fold(f32::INFINITY, f32::min);
            assert_eq!(found, least);
            squares += f64::from(found).powi(2);
        }
        let range = values.iter().copied().fold(0.0f32, |far, v| far.max(v.abs())) * 2.0;
        let rms = (squares / values.len() as f64).sqrt();
        assert!(rms < f64::from(range) / 256.0 / 12f64.sqrt(), "{rms} is worse than even steps");
    }

    #[test]
    fn few_values_are_kept() {
        for values in [&[][..], &[3.5], &[-1.0, 0.0, 2.0, 2.0], &[f32::MIN, f32::MAX]] {
            let book = Codebook::of(values.iter().copied());
            assert_eq!(book.values.len(), 256);
            if values.len() < 2 || values[0] > f32::MIN {
                values.iter().for_each(|&v| assert_eq!(book.values[usize::from(book.code(v))], v));
            }
        }
    }
}
