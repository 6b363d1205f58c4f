//! Operators that put elements in other places: all that ONNX writes as `Slice`, `Transpose`, `Gather`, `Split`, `Pad`,
//! `Expand` and nearest `Resize`, and `Concat`.

use rayon::prelude::*;

use super::operator::{GRAIN, Operator};

/// In place of an element's number: none, which reads as zero.
pub(super) const NONE: u32 = u32::MAX;

/// Each element of the output is an element of the input or zero.
pub(super) struct Pick {
    /// The element of the input that each of the output is, or [`NONE`].
    from: Vec<u32>,
    /// For each element of the input an element of the output that reads it, or [`NONE`]: as many such lists as the most
    /// read element has readers, in the order of the output.
    readers: Vec<Vec<u32>>,
}

impl Pick {
    /// A pick from an input of `length` elements. It takes `from` as often again as the most read element is read.
    pub(super) fn new(from: Vec<u32>, length: usize) -> Self {
        let mut readers: Vec<Vec<u32>> = Vec::new();
        let mut read = vec![0usize; length];
        for (to, &element) in from.iter().enumerate().filter(|(_, element)| **element != NONE) {
            let times = &mut read[element as usize];
            if *times == readers.len() {
                readers.push(vec![NONE; length]);
            }
            readers[*times][element as usize] = to as u32;
            *times += 1;
        }
        Self { from, readers }
    }

    /// How often the most read of `length` elements is read.
    pub(super) fn most_read(from: &[u32], length: usize) -> usize {
        let mut read = vec![0usize; length];
        from.iter().filter(|element| **element != NONE).for_each(|&element| read[element as usize] += 1);
        read.into_iter().max().unwrap_or(0)
    }
}

/// The elements that a pick reads, with `none` for zeros.
pub(super) fn picked<T: Copy>(from: &[u32], values: &[T], none: T) -> Vec<T> {
    from.iter().map(|&element| values.get(element as usize).copied().unwrap_or(none)).collect()
}

impl Operator for Pick {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        output.par_chunks_mut(GRAIN).zip(self.from.par_chunks(GRAIN)).for_each(|(output, from)| {
            for (output, &element) in output.iter_mut().zip(from) {
                *output = inputs[0].get(element as usize).copied().unwrap_or(0.0);
            }
        });
    }

    fn backward(&self, _: usize, _: &[&[f32]], _: &[f32], weights: &[f32], gradient: &mut [f32]) {
        for readers in &self.readers {
            gradient.par_chunks_mut(GRAIN).zip(readers.par_chunks(GRAIN)).for_each(|(gradient, readers)| {
                for (gradient, &reader) in gradient.iter_mut().zip(readers) {
                    *gradient += weights.get(reader as usize).copied().unwrap_or(0.0);
                }
            });
        }
    }
}

/// Tensors one after the other along a side.
pub(super) struct Concat {
    /// For each input its length along the side and all later ones.
    pub(super) lengths: Vec<usize>,
}

impl Concat {
    fn total(&self) -> usize {
        self.lengths.iter().sum()
    }
}

impl Operator for Concat {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        for (block, output) in output.chunks_mut(self.total()).enumerate() {
            let mut rest = output;
            for (input, &length) in inputs.iter().zip(&self.lengths) {
                let (part, after) = rest.split_at_mut(length);
                let input = &input[block * length..(block + 1) * length];
                part.par_chunks_mut(GRAIN).zip(input.par_chunks(GRAIN)).for_each(|(to, from)| to.copy_from_slice(from));
                rest = after;
            }
        }
    }

    fn backward(&self, which: usize, _: &[&[f32]], _: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let before: usize = self.lengths[..which].iter().sum();
        for (weights, gradient) in weights.chunks(self.total()).zip(gradient.chunks_mut(self.lengths[which])) {
            let weights = &weights[before..before + gradient.len()];
            gradient.par_chunks_mut(GRAIN).zip(weights.par_chunks(GRAIN)).for_each(|(gradient, weights)| {
                gradient.iter_mut().zip(weights).for_each(|(gradient, weight)| *gradient += weight);
            });
        }
    }
}
