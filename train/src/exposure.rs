//! Applies per-view exposures to renders, computes their gradients and trains them with Adam.
//!
//! Exposures are trained once, in the block that covers the whole scene (the root of the tree), and stay fixed in all
//! others, so that neighbouring blocks agree on colours. Splats and exposures determine colours only up to a common
//! transform. That freedom is removed by keeping the mean of all exposures at the identity. A held-out view is rendered
//! without one and shows the mean exposure.

use std::collections::BTreeSet;

use rayon::prelude::*;
use scene::{Exposure, Exposures};

use crate::view::TrainView;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;
/// Pixels per parallel job. The jobs' sums are added in order, for determinism.
const CHUNK: usize = 1 << 14;
/// Independent partial sums, for instruction-level parallelism.
const LANES: usize = 16;

/// Applies an exposure to a render (three planes) and writes the result to `out`.
pub fn expose(exposure: &Exposure, colour: &[f32], out: &mut Vec<f32>) {
    out.resize(colour.len(), 0.0);
    let [red, green, blue] = planes(colour);
    for (out, [r, g, b, add]) in out.chunks_exact_mut(red.len().max(1)).zip(exposure.0) {
        let pixels = red.iter().zip(green).zip(blue);
        out.iter_mut().zip(pixels).for_each(|(out, ((red, green), blue))| *out = r * red + g * green + b * blue + add);
    }
}

/// Converts `gradient`, the loss gradient with respect to the exposed render, in place to that with respect to the render
/// `colour`. Returns the gradient with respect to the exposure. Pixels of weight zero have no gradient and contribute
/// nothing.
pub fn expose_backward(exposure: &Exposure, colour: &[f32], gradient: &mut [f32]) -> [[f32; 4]; 3] {
    let [red, green, blue] = planes(colour);
    let (by_red, rest) = gradient.split_at_mut(red.len());
    let (by_green, by_blue) = rest.split_at_mut(red.len());
    let gradients = by_red.par_chunks_mut(CHUNK).zip(by_green.par_chunks_mut(CHUNK)).zip(by_blue.par_chunks_mut(CHUNK));
    let colours = red.par_chunks(CHUNK).zip(green.par_chunks(CHUNK)).zip(blue.par_chunks(CHUNK));
    let sums: Vec<[[f64; 4]; 3]> = gradients
        .zip(colours)
        .map(|(((by_red, by_green), by_blue), ((red, green), blue))| {
            chunk_backward(exposure, [red, green, blue], [by_red, by_green, by_blue])
        })
        .collect();
    let mut total = [[0.0; 4]; 3];
    for sums in sums {
        total.iter_mut().flatten().zip(sums.iter().flatten()).for_each(|(total, sum)| *total += sum);
    }
    total.map(|row| row.map(|sum| sum as f32))
}

fn planes(colour: &[f32]) -> [&[f32]; 3] {
    let area = colour.len() / 3;
    [0, 1, 2].map(|c| &colour[c * area..(c + 1) * area])
}

fn chunk_backward(exposure: &Exposure, colour: [&[f32]; 3], gradient: [&mut [f32]; 3]) -> [[f64; 4]; 3] {
    let mut sums = [[[0.0f32; LANES]; 4]; 3];
    let [by_red, by_green, by_blue] = gradient;
    for at in (0..by_red.len()).step_by(LANES) {
        let lanes = (by_red.len() - at).min(LANES);
        let load = |plane: &[f32]| {
            let mut values = [0.0f32; LANES];
            values[..lanes].copy_from_slice(&plane[at..at + lanes]);
            values
        };
        let drawn = [load(colour[0]), load(colour[1]), load(colour[2]), [1.0; LANES]];
        let by = [load(by_red), load(by_green), load(by_blue)];
        for (row, by) in sums.iter_mut().zip(&by) {
            for (sum, drawn) in row.iter_mut().zip(&drawn) {
                (0..LANES).for_each(|i| sum[i] += by[i] * drawn[i]);
            }
        }
        for (c, out) in [&mut *by_red, &mut *by_green, &mut *by_blue].into_iter().enumerate() {
            let column = exposure.0.map(|row| row[c]);
            let mut back = [0.0f32; LANES];
            (0..LANES).for_each(|i| back[i] = column[0] * by[0][i] + column[1] * by[1][i] + column[2] * by[2][i]);
            out[at..at + lanes].copy_from_slice(&back[..lanes]);
        }
    }
    sums.map(|row| row.map(|lanes| lanes.iter().map(|&sum| f64::from(sum)).sum()))
}

/// Mean factor, over colour directions, by which the exposure scales the square of a change of the render.
pub(crate) fn square_gain(exposure: &Exposure) -> f32 {
    exposure.0.iter().flat_map(|row| &row[..3]).map(|value| value * value).sum::<f32>() / 3.0
}

/// Exposures in training, each with its own Adam state. A view's step count is the number of times that it was
/// rendered.
#[derive(Debug, Clone, PartialEq)]
pub struct ExposureTraining {
    /// Ascending.
    pub(crate) views: Vec<u32>,
    /// Adam steps of each view.
    pub(crate) steps: Vec<u32>,
    /// Exposure, first and second moment of each view, in rows of twelve.
    pub(crate) values: [Vec<[f32; 12]>; 3],
}

impl ExposureTraining {
    /// Identity exposures of all views.
    pub fn new(views: &[TrainView]) -> Self {
        let views: BTreeSet<u32> = views.iter().map(|view| view.view).collect();
        let rows = |row: [f32; 12]| vec![row; views.len()];
        let values = [rows(flat(&Exposure::IDENTITY.0)), rows([0.0; 12]), rows([0.0; 12])];
        Self { steps: vec![0; views.len()], values, views: views.into_iter().collect() }
    }

    /// The exposure of a view.
    pub fn of(&self, view: u32) -> Option<Exposure> {
        self.views.binary_search(&view).ok().map(|at| Exposure(rows(&self.values[0][at])))
    }

    /// The current exposures.
    pub fn exposures(&self) -> Exposures {
        self.views.iter().zip(&self.values[0]).map(|(&view, row)| (view, Exposure(rows(row)))).collect()
    }

    /// One Adam step with learning rate `rate` on the exposure of one view. Then shifts all exposures so that their
    /// mean stays the identity.
    pub fn step(&mut self, view: u32, gradient: &[[f32; 4]; 3], rate: f32) {
        let (Ok(at), true) =
            (self.views.binary_search(&view), gradient.iter().flatten().all(|value| value.is_finite()))
        else {
            return;
        };
        self.steps[at] = self.steps[at].saturating_add(1);
        let age = self.steps[at].min(1 << 20) as i32;
        let [values, first, second] = &mut self.values;
        let ages = [1.0 - BETA1.powi(age), 1.0 - BETA2.powi(age)];
        for (k, gradient) in flat(gradient).into_iter().enumerate() {
            let (m, v) = (&mut first[at][k], &mut second[at][k]);
            *m = BETA1 * *m + (1.0 - BETA1) * gradient;
            *v = BETA2 * *v + (1.0 - BETA2) * gradient * gradient;
            values[at][k] -= rate * (*m / ages[0]) / ((*v / ages[1]).sqrt() + EPSILON);
        }
        let identity = flat(&Exposure::IDENTITY.0);
        for k in 0..12 {
            let mean = values.iter().map(|row| f64::from(row[k])).sum::<f64>() / values.len() as f64;
            let excess = (mean - f64::from(identity[k])) as f32;
            values.iter_mut().for_each(|row| row[k] -= excess);
        }
    }
}

fn flat(rows: &[[f32; 4]; 3]) -> [f32; 12] {
    std::array::from_fn(|k| rows[k / 4][k % 4])
}

fn rows(flat: &[f32; 12]) -> [[f32; 4]; 3] {
    [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| flat[4 * r + c]))
}

#[cfg(test)]
mod tests {
    use render::cpu::Isa;
    use scene::{Camera, Pinhole, Pixels, Rect, Rigid};

    use super::*;
    use crate::loss::PhotometricLoss;
    use crate::random::uniform;

    fn exposure(key: u64) -> Exposure {
        let mut exposure = Exposure::IDENTITY;
        exposure.0.iter_mut().flatten().zip(0..).for_each(|(value, k)| *value += 0.2 * (uniform(key, k) - 0.5));
        exposure
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        // A size that is no multiple of the lanes, of more than one chunk.
        let (width, height) = (131usize, 127usize);
        let area = width * height;
        assert!(area > CHUNK);
        let colour: Vec<f32> = (0..3 * area).map(|i| uniform(1, i as u64)).collect();
        let mask = (0..area).map(|i| if i % width < 100 { 255 } else { 0 }).collect();
        let rgb = (0..3 * area).map(|i| (255.0 * uniform(2, i as u64)) as u8).collect();
        let photo = Pixels { width: width as u32, height: height as u32, rgb, mask: Some(mask), ..Pixels::default() };
        let weights: Vec<f32> = photo.mask.iter().flatten().map(|&mask| f32::from(mask) / 255.0).collect();
        // A quadratic loss, in f64, so that differences are exact: half the weighted squared error.
        let loss = |exposure: &[[f64; 4]; 3], colour: &[f64]| -> f64 {
            let shown = |r: usize, i: usize| {
                let [a, b, c, add] = exposure[r];
                a * colour[i] + b * colour[area + i] + c * colour[2 * area + i] + add
            };
            let error = |r: usize, i: usize| shown(r, i) - f64::from(photo.rgb[r * area + i]) / 255.0;
            let pixels = (0..3).flat_map(|r| (0..area).map(move |i| (r, i)));
            pixels.map(|(r, i)| 0.5 * f64::from(weights[i]) * error(r, i).powi(2)).sum()
        };
        let exposure = exposure(3);
        let mut exposed = Vec::new();
        expose(&exposure, &colour, &mut exposed);
        let error = |i: usize| weights[i % area] * (exposed[i] - f32::from(photo.rgb[i]) / 255.0);
        let mut gradient: Vec<f32> = (0..3 * area).map(error).collect();
        let by_exposure = expose_backward(&exposure, &colour, &mut gradient);

        let exact = exposure.0.map(|row| row.map(f64::from));
        let rendered: Vec<f64> = colour.iter().map(|&value| f64::from(value)).collect();
        for r in 0..3 {
            for c in 0..4 {
                let at = |step: f64| {
                    let mut moved = exact;
                    moved[r][c] += step;
                    loss(&moved, &rendered)
                };
                let slope = (at(1e-3) - at(-1e-3)) / 2e-3;
                let found = f64::from(by_exposure[r][c]);
                assert!((found - slope).abs() < 1e-4 * (1.0 + slope.abs()), "{r} {c}: {found} against {slope}");
            }
        }
        for i in [0, 57, area - 40, 2 * area + 1, 3 * area - 40, 99, 100, 130] {
            let at = |step: f64| {
                let mut moved = rendered.clone();
                moved[i] += step;
                loss(&exact, &moved)
            };
            let slope = (at(1e-3) - at(-1e-3)) / 2e-3;
            assert!((f64::from(gradient[i]) - slope).abs() < 1e-5, "{i}: {} against {slope}", gradient[i]);
            assert!(i % area % width < 100 || gradient[i] == 0.0, "{i} is under the mask");
        }

        // Masked pixels do not affect the gradient through the real loss either.
        let by = |photo: &Pixels, colour: &[f32]| {
            let (mut exposed, mut gradient) = (Vec::new(), Vec::new());
            expose(&exposure, colour, &mut exposed);
            PhotometricLoss::new(Isa::detect(), 0.2).evaluate(&exposed, photo, &weights, &mut gradient);
            expose_backward(&exposure, colour, &mut gradient)
        };
        let hidden = |i: usize| i % area % width >= 100;
        let other: Vec<f32> = (0..3 * area).map(|i| if hidden(i) { 0.3 } else { colour[i] }).collect();
        let mut other_photo = photo.clone();
        (0..3 * area).filter(|&i| hidden(i)).for_each(|i| other_photo.rgb[i] = 9);
        let expected = by(&photo, &colour);
        assert!(expected.iter().flatten().all(|value| value.abs() > 0.0));
        assert_eq!(expected, by(&other_photo, &other));
    }

    fn views(of: &[u32]) -> Vec<TrainView> {
        let pinhole = Pinhole { width: 9, height: 9, fx: 9.0, fy: 9.0, cx: 4.5, cy: 4.5 };
        let camera_from_world = Rigid { rotation: glam::DQuat::IDENTITY, translation: glam::DVec3::ZERO };
        let camera = Camera { pinhole, camera_from_world };
        let rect = Rect { x: 0, y: 0, width: 9, height: 9 };
        of.iter().map(|&view| TrainView { view, mip: 0, rect, camera, camera_from_context: None }).collect()
    }

    #[test]
    fn mean_exposure_stays_the_identity() {
        let mut training = ExposureTraining::new(&views(&[9, 2, 5, 5]));
        assert_eq!(training.views, [2, 5, 9]);
        for step in 0..300u64 {
            let view = [2, 5, 9, 4][step as usize % 4];
            // All gradients brighten, that of view 2 the most.
            let gradient = [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| uniform(step, 4 * r + c) - 1.2));
            training.step(view, &gradient, if view == 2 { 0.02 } else { 0.01 });
        }
        training.step(5, &[[f32::NAN; 4]; 3], 1.0);
        let exposures = training.exposures();
        assert_eq!((exposures.len(), exposures.of(4)), (3, None));
        for k in 0..12 {
            let mean = exposures.iter().map(|(_, exposure)| flat(&exposure.0)[k]).sum::<f32>() / 3.0;
            assert!((mean - flat(&Exposure::IDENTITY.0)[k]).abs() < 1e-5, "{k}: {mean}");
        }
        let gain = |view| exposures.of(view).unwrap().gain();
        assert!(gain(2) > 1.5 && gain(5) < 1.0 && gain(9) < 1.0, "{} {} {}", gain(2), gain(5), gain(9));
        assert_eq!(training.of(9), exposures.of(9).copied());
    }

    #[test]
    fn square_gain_is_the_square_of_the_gain() {
        assert_eq!(square_gain(&Exposure::IDENTITY), 1.0);
        assert_eq!(square_gain(&Exposure(Exposure::IDENTITY.0.map(|row| row.map(|v| 2.0 * v)))), 4.0);
    }
}
