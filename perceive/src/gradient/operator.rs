//! What every operator of a network can do.

/// An operator with fixed shapes: a function of tensors and its derivative.
///
/// Tensors are slices, the last side fastest. Results do not depend on the number of threads: each number is one sum in
/// a fixed order.
pub(super) trait Operator: Send + Sync {
    /// Overwrites all of `output`.
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]);

    /// Adds to `gradient` the derivative of Σ `weights`·output with respect to input number `which`; `output` is what
    /// [`forward`](Self::forward) gave for these inputs.
    fn backward(&self, which: usize, inputs: &[&[f32]], output: &[f32], weights: &[f32], gradient: &mut [f32]);
}

/// Elements of a parallel job of an operator that does little for each.
pub(super) const GRAIN: usize = 1 << 14;
