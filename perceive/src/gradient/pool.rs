//! ONNX's `MaxPool` and `AveragePool` in two dimensions.

use rayon::prelude::*;

use super::axis::Axis;
use super::operator::Operator;

/// The greatest of each window. Pads are never the greatest.
pub(super) struct MaxPool(pub(super) [Axis; 2]);

/// The mean of each window.
pub(super) struct AveragePool {
    pub(super) axes: [Axis; 2],
    /// Whether the zeros around the input count.
    pub(super) counts_pads: bool,
}

fn input(axes: &[Axis; 2]) -> usize {
    axes[0].input * axes[1].input
}

fn output(axes: &[Axis; 2]) -> usize {
    axes[0].output * axes[1].output
}

fn greatest(values: impl Iterator<Item = f32>) -> f32 {
    values.fold(f32::NEG_INFINITY, |greatest, value| if value > greatest { value } else { greatest })
}

impl MaxPool {
    /// For every line of a plane the greatest along it, of each window's columns.
    fn along_lines(&self, plane: &[f32], out: &mut Vec<f32>) {
        let [_, x] = self.0;
        out.clear();
        for line in plane.chunks_exact(x.input) {
            out.extend((0..x.output).map(|column| greatest(line[x.window(column)].iter().copied())));
        }
    }
}

impl Operator for MaxPool {
    fn forward(&self, inputs: &[&[f32]], out: &mut [f32]) {
        let [y, x] = self.0;
        let planes = out.par_chunks_mut(output(&self.0)).zip(inputs[0].par_chunks(input(&self.0)));
        planes.for_each_init(Vec::new, |lines, (out, plane)| {
            self.along_lines(plane, lines);
            for (row, out) in out.chunks_exact_mut(x.output).enumerate() {
                for (column, out) in out.iter_mut().enumerate() {
                    *out = greatest(y.window(row).map(|line| lines[line * x.output + column]));
                }
            }
        });
    }

    /// The first of several that are the greatest gets all.
    fn backward(&self, _: usize, inputs: &[&[f32]], out: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let [y, x] = self.0;
        let of = inputs[0].par_chunks(input(&self.0)).zip(out.par_chunks(output(&self.0)));
        let of = of.zip(weights.par_chunks(output(&self.0)));
        let planes = gradient.par_chunks_mut(input(&self.0)).zip(of);
        planes.for_each_init(Vec::new, |lines, (gradient, ((plane, out), weights))| {
            self.along_lines(plane, lines);
            for (place, (&out, &weight)) in out.iter().zip(weights).enumerate() {
                let [row, column] = [place / x.output, place % x.output];
                let line = y.window(row).find(|line| lines[line * x.output + column] == out);
                let pixel = line.and_then(|line| {
                    let of_line = line * x.input;
                    x.window(column).map(|column| of_line + column).find(|&pixel| plane[pixel] == out)
                });
                if let Some(pixel) = pixel {
                    gradient[pixel] += weight;
                }
            }
        });
    }
}

impl AveragePool {
    /// One over the number of pixels of a window.
    fn share(&self, row: usize, column: usize) -> f32 {
        let count = |axis: &Axis, position: usize| {
            if self.counts_pads { axis.kernel } else { axis.window(position).len() }
        };
        1.0 / (count(&self.axes[0], row) * count(&self.axes[1], column)).max(1) as f32
    }
}

impl Operator for AveragePool {
    fn forward(&self, inputs: &[&[f32]], out: &mut [f32]) {
        let [y, x] = self.axes;
        let planes = out.par_chunks_mut(output(&self.axes)).zip(inputs[0].par_chunks(input(&self.axes)));
        planes.for_each(|(out, plane)| {
            for (place, out) in out.iter_mut().enumerate() {
                let [row, column] = [place / x.output, place % x.output];
                let lines = y.window(row).map(|line| &plane[line * x.input..][x.window(column)]);
                *out = self.share(row, column) * lines.flatten().sum::<f32>();
            }
        });
    }

    fn backward(&self, _: usize, _: &[&[f32]], _: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let [y, x] = self.axes;
        let planes = gradient.par_chunks_mut(input(&self.axes)).zip(weights.par_chunks(output(&self.axes)));
        planes.for_each(|(gradient, weights)| {
            for (place, weight) in weights.iter().enumerate() {
                let [row, column] = [place / x.output, place % x.output];
                for line in y.window(row) {
                    let pixels = &mut gradient[line * x.input..][x.window(column)];
                    pixels.iter_mut().for_each(|pixel| *pixel += weight * self.share(row, column));
                }
            }
        });
    }
}
