//! ONNX's `Conv` in two dimensions with frozen weights.

use super::axis::Axis;
use super::depthwise::Depthwise;
use super::operator::Operator;
use super::product::Product;

/// A convolution of one picture.
pub(super) struct Conv {
    kind: Kind,
    /// Numbers of the input and of the output that belong to one group.
    group: [usize; 2],
}

enum Kind {
    /// Each plane by itself.
    Depthwise(Depthwise),
    /// For each group the convolution, its bias, and the convolution that gives the input's gradient.
    Dense(Vec<(Product, Vec<f32>, Product)>),
}

impl Conv {
    /// A convolution from `channels[0]` to `channels[1]` planes in `groups`, both multiples of it. The weights are output
    /// × input of the group × kernel's rows × columns.
    pub(super) fn new(axes: [Axis; 2], channels: [usize; 2], groups: usize, weights: &[f32], bias: &[f32]) -> Self {
        let [input, output] = [axes.map(|axis| axis.input), axes.map(|axis| axis.output)];
        let [reads, writes] = channels.map(|channels| channels / groups);
        let group = [reads * input[0] * input[1], writes * output[0] * output[1]];
        if groups > 1 && [reads, writes] == [1, 1] {
            let kind = Kind::Depthwise(Depthwise::new(axes, weights.to_vec(), bias.to_vec()));
            return Self { kind, group };
        }
        let [kernel_y, kernel_x] = axes.map(|axis| axis.kernel);
        let of_group = |number: usize| {
            let weight = |to: usize, from: usize, y: usize, x: usize| {
                weights[(((number * writes + to) * reads + from) * kernel_y + y) * kernel_x + x]
            };
            let forward = Product::new([writes, reads], [input, output], axes.map(|axis| axis.forward()), weight);
            let back = |to: usize, from: usize, y: usize, x: usize| weight(from, to, y, x);
            let backward = Product::new([reads, writes], [output, input], axes.map(|axis| axis.backward()), back);
            (forward, bias[number * writes..(number + 1) * writes].to_vec(), backward)
        };
        Self { kind: Kind::Dense((0..groups).map(of_group).collect()), group }
    }
}

impl Operator for Conv {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        match &self.kind {
            Kind::Depthwise(planes) => planes.forward(inputs[0], output),
            Kind::Dense(groups) => {
                let parts = inputs[0].chunks(self.group[0]).zip(output.chunks_mut(self.group[1]));
                parts
                    .zip(groups)
                    .for_each(|((input, output), (product, bias, _))| product.run(input, Some(bias), output));
            }
        }
    }

    fn backward(&self, _: usize, _: &[&[f32]], _: &[f32], weights: &[f32], gradient: &mut [f32]) {
        match &self.kind {
            Kind::Depthwise(planes) => planes.backward(weights, gradient),
            Kind::Dense(groups) => {
                let parts = weights.chunks(self.group[1]).zip(gradient.chunks_mut(self.group[0]));
                parts
                    .zip(groups)
                    .for_each(|((weights, gradient), (_, _, product))| product.run(weights, None, gradient));
            }
        }
    }
}
