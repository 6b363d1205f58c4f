//! Networks with derivatives: what a small change of every pixel changes in the output.
//!
//! [`Network`] reads an ONNX graph of fixed shapes with frozen weights, for one picture at a time, and walks over its
//! operators forwards and backwards. It knows those of convolutional detectors; any other is refused by its name. `rten`,
//! which runs the detectors elsewhere, has no derivatives.
//!
//! Dense convolutions and their gradients are products of matrices over panels of 32 pixels. Every number is one sum in
//! a fixed order, so results do not depend on the number of threads. Loops are compiled for AVX-512, AVX2 and the
//! baseline; their results differ in the last bits.

mod arrange;
mod axis;
mod budget;
mod constant;
mod conv;
mod depthwise;
mod nodes;
mod onnx;
mod operator;
mod plan;
mod pointwise;
mod pool;
mod product;
mod selection;
mod softmax;
#[cfg(test)]
mod tests;
mod tile;
mod vectorised;

use plan::{Builder, Input, Plan};

/// A network with one input and one output.
pub struct Network(Plan);

/// The numbers of a forward pass, and memory that the next passes use again.
#[derive(Debug, Default)]
pub struct Activations {
    tensors: Vec<Vec<f32>>,
    gradients: Vec<Option<Vec<f32>>>,
    spare: Vec<Vec<f32>>,
}

impl Network {
    /// Reads the bytes of an ONNX file.
    ///
    /// # Errors
    /// No ONNX graph, one with operators or shapes that are not known here, or one that needs more than 1 GiB.
    pub fn load(bytes: &[u8]) -> Result<Self, String> {
        Builder::plan(bytes, nodes::read).map(Self)
    }

    /// The sides of the input.
    pub fn input_shape(&self) -> &[usize] {
        &self.0.input_shape
    }

    /// The sides of the output.
    pub fn output_shape(&self) -> &[usize] {
        &self.0.output_shape
    }

    /// Multiply-adds of a forward pass. A backward pass has as many.
    pub fn work(&self) -> usize {
        self.0.work
    }

    /// Runs the network on an input and returns its output.
    ///
    /// # Panics
    /// If the input has not the elements of [`input_shape`](Self::input_shape).
    pub fn forward<'a>(&self, input: &[f32], activations: &'a mut Activations) -> &'a [f32] {
        let Plan { steps, lengths, constants, output, .. } = &self.0;
        assert_eq!(input.len(), lengths[0], "elements of the input");
        let tensors = &mut activations.tensors;
        tensors.resize_with(lengths.len(), Vec::new);
        tensors[0].clear();
        tensors[0].extend_from_slice(input);
        // On a thread of the pool already, its parallel loops start at once.
        rayon::scope(|_| {
            for step in steps {
                let mut output = std::mem::take(&mut tensors[step.output]);
                output.resize(lengths[step.output], 0.0);
                step.operator.forward(&inputs(&step.inputs, tensors, constants), &mut output);
                tensors[step.output] = output;
            }
        });
        &tensors[*output]
    }

    /// The gradient with respect to the input of Σ `weights`·output, for the input of the last
    /// [`forward`](Self::forward) with these activations.
    ///
    /// # Panics
    /// If there was none, or if `weights` has not the elements of the output.
    pub fn backward(&self, activations: &mut Activations, weights: &[f32]) -> Vec<f32> {
        let Plan { steps, lengths, constants, output, .. } = &self.0;
        let Activations { tensors, gradients, spare } = activations;
        assert!(tensors.len() == lengths.len() && weights.len() == lengths[*output], "a forward pass of this network");
        gradients.clear();
        gradients.resize(lengths.len(), None);
        gradients[*output] = Some(weights.to_vec());
        rayon::scope(|_| {
            for step in steps.iter().rev() {
                let Some(weights) = gradients[step.output].take() else { continue };
                let inputs = inputs(&step.inputs, tensors, constants);
                for (which, input) in step.inputs.iter().enumerate() {
                    let Input::Tensor(tensor) = *input else { continue };
                    let gradient = gradients[tensor].get_or_insert_with(|| {
                        let mut zeros = spare.pop().unwrap_or_default();
                        zeros.clear();
                        zeros.resize(lengths[tensor], 0.0);
                        zeros
                    });
                    step.operator.backward(which, &inputs, &tensors[step.output], &weights, gradient);
                }
                spare.push(weights);
            }
        });
        gradients[0].take().unwrap_or_else(|| vec![0.0; lengths[0]])
    }
}

/// What a step reads.
fn inputs<'a>(of: &[Input], tensors: &'a [Vec<f32>], constants: &'a [Vec<f32>]) -> Vec<&'a [f32]> {
    let input = |input: &Input| match *input {
        Input::Tensor(tensor) => &tensors[tensor][..],
        Input::Constant(constant) => &constants[constant][..],
    };
    of.iter().map(input).collect()
}
