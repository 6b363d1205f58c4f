//! Between which bounds bytes of a file stand for numbers: those within which all but one in a thousand lie.

use serde::Serialize;

use super::gaussian::Gaussian;

/// One number in this many may lie beyond a bound.
const BEYOND: u64 = 1000;
/// Largest SH coefficient at least: finer steps cannot be seen, and take more bytes.
const LEAST_SH: f32 = 0.5;
/// Steps of a histogram.
const STEPS: usize = 1 << 13;

/// The bounds of a file's bytes; names are those of the format.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Encoding {
    /// Base colours, sRGB.
    pub rgb_min: f32,
    /// See `rgb_min`.
    pub rgb_max: f32,
    /// Natural logarithm of standard deviations, metres.
    pub ln_scale_min: f32,
    /// See `ln_scale_min`.
    pub ln_scale_max: f32,
    /// Magnitude of SH coefficients of degree 1.
    pub sh1_max: f32,
    /// The same of degree 2.
    pub sh2_max: f32,
    /// The same of degree 3.
    pub sh3_max: f32,
    /// Opacities from 1 to 2 stand for those above 1.
    pub lod_opacity: bool,
}

/// Histograms of the numbers of splats.
pub struct Bounds {
    colour: Histogram,
    log_scale: Histogram,
    sh: [Histogram; 3],
}

impl Bounds {
    /// Of no splat.
    #[expect(clippy::new_without_default, reason = "a default would not say that it is empty")]
    pub fn new() -> Self {
        let sh = [(); 3].map(|()| Histogram::new(0.0, 4.0));
        Self { colour: Histogram::new(-3.0, 4.0), log_scale: Histogram::new(-20.0, 20.0), sh }
    }

    /// Adds a splat.
    pub fn add(&mut self, gaussian: &Gaussian) {
        gaussian.colour().to_array().into_iter().for_each(|value| self.colour.add(value));
        gaussian.scale.to_array().into_iter().for_each(|scale| self.log_scale.add(scale.ln()));
        for (degree, histogram) in (1..).zip(&mut self.sh) {
            let of_degree = &gaussian.sh[degree * degree..(degree + 1) * (degree + 1)];
            of_degree.as_flattened().iter().for_each(|value| histogram.add(value.abs()));
        }
    }

    /// The bounds. Those of colours hold 0 to 1 in any case.
    pub fn encoding(&self) -> Encoding {
        let (rgb_min, rgb_max) = self.colour.bounds();
        let (ln_scale_min, ln_scale_max) = self.log_scale.bounds();
        let [sh1_max, sh2_max, sh3_max] = [0, 1, 2].map(|degree: usize| self.sh[degree].bounds().1.max(LEAST_SH));
        let (rgb_min, rgb_max) = (rgb_min.min(0.0), rgb_max.max(1.0));
        Encoding { rgb_min, rgb_max, ln_scale_min, ln_scale_max, sh1_max, sh2_max, sh3_max, lod_opacity: true }
    }
}

struct Histogram {
    from: f32,
    to: f32,
    counts: Vec<u64>,
}

impl Histogram {
    fn new(from: f32, to: f32) -> Self {
        Self { from, to, counts: vec![0; STEPS] }
    }

    fn add(&mut self, value: f32) {
        let share = (value - self.from) / (self.to - self.from);
        // `as` saturates, and takes what is no number as 0.
        self.counts[((share * STEPS as f32) as usize).min(STEPS - 1)] += 1;
    }

    /// Bounds of the middle of the distribution, which lie apart.
    fn bounds(&self) -> (f32, f32) {
        let beyond = self.counts.iter().sum::<u64>() / BEYOND;
        let step = (self.to - self.from) / STEPS as f32;
        let below = steps_within(self.counts.iter(), beyond);
        let above = steps_within(self.counts.iter().rev(), beyond);
        (self.from + below as f32 * step, self.to - above as f32 * step)
    }
}

/// The steps from one end whose counts make no more than `beyond`.
fn steps_within<'a>(counts: impl Iterator<Item = &'a u64>, beyond: u64) -> usize {
    let sums = counts.scan(0, |sum, count| {
        *sum += count;
        Some(*sum)
    });
    sums.take_while(|&sum| sum <= beyond).count().min(STEPS - 1)
}
