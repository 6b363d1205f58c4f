//! Convolutions of each plane by itself.
//!
//! A plane is padded and laid out by phases: pixel (y, x) lies in phase (y mod stride, x mod stride), whose planes all
//! have the same sides. So every tap of every output reads at a fixed distance from the output's own place, and one loop
//! over a whole phase serves a tap. Places between the rows hold numbers that are never read.

use rayon::prelude::*;

use super::axis::Axis;
use super::vectorised::{add_scaled, vectorised};

/// Floats of a step of the loop.
const STEP: usize = 32;

/// A convolution with one kernel for each channel.
pub(super) struct Depthwise {
    axes: [Axis; 2],
    /// For each channel its kernel, by rows.
    weights: Vec<f32>,
    bias: Vec<f32>,
    /// Sides of a phase.
    phase: [usize; 2],
    /// Of each tap the phase, and the distance within the phase.
    taps: Vec<[usize; 2]>,
}

/// Room for one plane.
#[derive(Default)]
struct Room {
    /// All phases of the input one after the other, and then a step more.
    phases: Vec<f32>,
    /// The output, in rows as long as those of a phase.
    rows: Vec<f32>,
}

impl Depthwise {
    pub(super) fn new(axes: [Axis; 2], weights: Vec<f32>, bias: Vec<f32>) -> Self {
        let [y, x] = axes;
        // All that the taps of the output read, and all of the input.
        let side = |axis: Axis| {
            let read = (axis.output - 1) * axis.stride + (axis.kernel - 1) * axis.dilation + 1;
            read.max(axis.pad + axis.input).div_ceil(axis.stride)
        };
        let phase = [side(y), side(x)];
        let tap = |k: [usize; 2]| {
            let [at_y, at_x] = [k[0] * y.dilation, k[1] * x.dilation];
            let number = (at_y % y.stride) * x.stride + at_x % x.stride;
            [number, (at_y / y.stride) * phase[1] + at_x / x.stride]
        };
        let taps = (0..y.kernel).flat_map(|a| (0..x.kernel).map(move |b| tap([a, b]))).collect();
        Self { axes, weights, bias, phase, taps }
    }

    /// Floats of a thread's room, at most; `None` if the number is too large.
    pub(super) fn room(axes: &[Axis; 2]) -> Option<usize> {
        let side = |axis: &Axis| axis.input + 2 * axis.kernel * axis.dilation + 2 * axis.stride;
        side(&axes[0]).checked_mul(side(&axes[1]))?.checked_mul(3)
    }

    fn sides(&self) -> ([usize; 2], [usize; 2]) {
        (self.axes.map(|axis| axis.input), self.axes.map(|axis| axis.output))
    }

    /// Places of a phase.
    fn places(&self) -> usize {
        self.phase[0] * self.phase[1]
    }

    /// Places from the first output to the last, whole steps.
    fn span(&self) -> usize {
        let (_, [height, width]) = self.sides();
        ((height - 1) * self.phase[1] + width).next_multiple_of(STEP)
    }

    /// Overwrites the output.
    pub(super) fn forward(&self, input: &[f32], output: &mut [f32]) {
        let ([height, width], [rows, columns]) = self.sides();
        let planes = output.par_chunks_mut(rows * columns).zip(input.par_chunks(height * width));
        let kernels = self.weights.par_chunks(self.taps.len()).zip(&self.bias);
        planes.zip(kernels).for_each_init(Room::default, |room, ((output, input), (kernel, &bias))| {
            room.phases.clear();
            room.phases.resize(self.axes[0].stride * self.axes[1].stride * self.places() + STEP, 0.0);
            self.each_pixel_run(|place, step, pixels| {
                let places = room.phases[place..].iter_mut();
                places.zip(input[pixels].iter().step_by(step)).for_each(|(place, pixel)| *place = *pixel);
            });
            let taps: Vec<_> =
                self.taps.iter().zip(kernel).map(|(tap, &weight)| (tap[0] * self.places() + tap[1], weight)).collect();
            room.rows.clear();
            room.rows.resize(self.span(), bias);
            add_taps(&taps, &room.phases, &mut room.rows);
            for (output, row) in output.chunks_exact_mut(columns).zip(room.rows.chunks(self.phase[1])) {
                output.copy_from_slice(&row[..columns]);
            }
        });
    }

    /// Adds to the input's gradient.
    pub(super) fn backward(&self, weights: &[f32], gradient: &mut [f32]) {
        let ([height, width], [rows, columns]) = self.sides();
        let farthest = self.taps.iter().map(|tap| tap[1]).max().unwrap_or(0);
        let planes = gradient.par_chunks_mut(height * width).zip(weights.par_chunks(rows * columns));
        planes.zip(self.weights.par_chunks(self.taps.len())).for_each_init(
            Room::default,
            |room, ((gradient, weights), kernel)| {
                // A place of a phase gets the output's gradient from every tap's distance before it.
                let length = self.places().next_multiple_of(STEP);
                room.rows.clear();
                room.rows.resize(farthest + length.max(self.span()), 0.0);
                for (row, weights) in room.rows[farthest..].chunks_mut(self.phase[1]).zip(weights.chunks_exact(columns))
                {
                    row[..columns].copy_from_slice(weights);
                }
                room.phases.resize(self.axes[0].stride * self.axes[1].stride * self.places() + STEP, 0.0);
                for (number, phase) in (0..self.axes[0].stride * self.axes[1].stride).map(|n| (n, n * self.places())) {
                    let of_phase = self.taps.iter().zip(kernel).filter(|(tap, _)| tap[0] == number);
                    let taps: Vec<_> = of_phase.map(|(tap, &weight)| (farthest - tap[1], weight)).collect();
                    // What a step writes beyond its phase is overwritten by the next phase, which starts from zero.
                    let end = (phase + length).min(room.phases.len());
                    room.phases[phase..end].fill(0.0);
                    add_taps(&taps, &room.rows, &mut room.phases[phase..end]);
                }
                self.each_pixel_run(|place, step, pixels| {
                    let places = room.phases[place..].iter();
                    gradient[pixels].iter_mut().step_by(step).zip(places).for_each(|(pixel, place)| *pixel += place);
                });
            },
        );
    }

    /// Every phase's part of every line of the input: the place of its first pixel, the pixels from one place to the
    /// next, and the pixels from the first to the line's end.
    fn each_pixel_run(&self, mut run: impl FnMut(usize, usize, std::ops::Range<usize>)) {
        let [y, x] = self.axes;
        for line in 0..y.input {
            let padded = line + y.pad;
            for start in 0..x.stride.min(x.input) {
                let column = start + x.pad;
                let number = (padded % y.stride) * x.stride + column % x.stride;
                let place = number * self.places() + (padded / y.stride) * self.phase[1] + column / x.stride;
                run(place, x.stride, line * x.input + start..(line + 1) * x.input);
            }
        }
    }
}

vectorised!(
    /// Adds `weight · source[i + distance]` of all taps (distance, weight) to every `sums[i]`, in the taps' order. What
    /// `sums` has beyond a multiple of 32 is left out; `source` must reach as far as the taps read.
    fn add_taps(taps: &[(usize, f32)], source: &[f32], sums: &mut [f32]) = add_taps_level
);

#[inline(always)]
fn add_taps_level<const LEVEL: usize>(taps: &[(usize, f32)], source: &[f32], sums: &mut [f32]) {
    for (i, out) in sums.as_chunks_mut::<STEP>().0.iter_mut().enumerate() {
        let mut sum = *out;
        for &(distance, weight) in taps {
            let Some(values) = source.get(distance + STEP * i..).and_then(|source| source.first_chunk()) else {
                continue;
            };
            sum = add_scaled::<_, LEVEL>(weight, values, sum);
        }
        *out = sum;
    }
}
