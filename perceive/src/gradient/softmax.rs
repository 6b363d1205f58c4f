//! ONNX's `Softmax`.

use rayon::prelude::*;

use super::operator::Operator;
use super::pointwise::exp;

/// e to each element over the sum of these along one side.
pub(super) struct Softmax {
    /// Length of the side.
    pub(super) length: usize,
    /// Elements from one of the side to the next.
    pub(super) stride: usize,
}

impl Softmax {
    fn block(&self) -> usize {
        self.length * self.stride
    }

    /// Each line along the side within a block: its elements.
    fn lines(&self) -> impl Iterator<Item = impl Iterator<Item = usize> + Clone> {
        (0..self.stride).map(|start| (start..self.block()).step_by(self.stride))
    }
}

impl Operator for Softmax {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        let blocks = output.par_chunks_mut(self.block()).zip(inputs[0].par_chunks(self.block()));
        blocks.for_each(|(output, input)| {
            for line in self.lines() {
                let greatest = line.clone().map(|i| input[i]).fold(f32::NEG_INFINITY, f32::max);
                line.clone().for_each(|i| output[i] = exp(input[i] - greatest));
                let sum: f32 = line.clone().map(|i| output[i]).sum();
                line.for_each(|i| output[i] /= sum);
            }
        });
    }

    fn backward(&self, _: usize, _: &[&[f32]], output: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let of = output.par_chunks(self.block()).zip(weights.par_chunks(self.block()));
        gradient.par_chunks_mut(self.block()).zip(of).for_each(|(gradient, (output, weights))| {
            for line in self.lines() {
                let mean: f32 = line.clone().map(|i| output[i] * weights[i]).sum();
                line.for_each(|i| gradient[i] += output[i] * (weights[i] - mean));
            }
        });
    }
}
