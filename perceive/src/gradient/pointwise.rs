//! Functions of each element by itself.

use rayon::prelude::*;

use super::operator::{GRAIN, Operator};
use super::vectorised::vectorised;

/// A function of one number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Unary {
    Relu,
    /// With the slope below 0.
    LeakyRelu(f32),
    /// To a range.
    Clip(f32, f32),
    Exp,
    Sigmoid,
    /// x · sigmoid(x), which ONNX writes as two nodes.
    Silu,
    Tanh,
}

impl Operator for Unary {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        let parts = output.par_chunks_mut(GRAIN).zip(inputs[0].par_chunks(GRAIN));
        parts.for_each(|(output, input)| apply(*self, input, output));
    }

    fn backward(&self, _: usize, inputs: &[&[f32]], output: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let of = inputs[0].par_chunks(GRAIN).zip(output.par_chunks(GRAIN)).zip(weights.par_chunks(GRAIN));
        let parts = gradient.par_chunks_mut(GRAIN).zip(of);
        parts.for_each(|(gradient, ((x, y), weights))| differentiate(*self, x, y, weights, gradient));
    }
}

vectorised!(
    /// y = f(x).
    fn apply(f: Unary, x: &[f32], y: &mut [f32]) = apply_level
);

#[inline(always)]
fn apply_level<const LEVEL: usize>(f: Unary, x: &[f32], y: &mut [f32]) {
    macro_rules! each {
        (|$x:ident| $value:expr) => {
            for (y, &$x) in y.iter_mut().zip(x) {
                *y = $value;
            }
        };
    }
    match f {
        Unary::Relu => each!(|x| if x > 0.0 { x } else { 0.0 }),
        Unary::LeakyRelu(slope) => each!(|x| if x > 0.0 { x } else { slope * x }),
        Unary::Clip(low, high) => each!(|x| if x < low {
            low
        } else if x > high {
            high
        } else {
            x
        }),
        Unary::Exp => each!(|x| exp(x)),
        Unary::Sigmoid => each!(|x| sigmoid(x)),
        Unary::Silu => each!(|x| x * sigmoid(x)),
        Unary::Tanh => each!(|x| 2.0 * sigmoid(2.0 * x) - 1.0),
    }
}

vectorised!(
    /// gradient += weights · f'(x), with y = f(x).
    fn differentiate(f: Unary, x: &[f32], y: &[f32], weights: &[f32], gradient: &mut [f32]) = differentiate_level
);

#[inline(always)]
fn differentiate_level<const LEVEL: usize>(f: Unary, x: &[f32], y: &[f32], weights: &[f32], gradient: &mut [f32]) {
    macro_rules! each {
        (|$x:ident, $y:ident| $slope:expr) => {
            for (((gradient, weight), &$x), &$y) in gradient.iter_mut().zip(weights).zip(x).zip(y) {
                *gradient += weight * $slope;
            }
        };
    }
    match f {
        Unary::Relu => each!(|x, _y| if x > 0.0 { 1.0 } else { 0.0 }),
        Unary::LeakyRelu(slope) => each!(|x, _y| if x > 0.0 { 1.0 } else { slope }),
        Unary::Clip(low, high) => each!(|x, _y| if x < low || x > high { 0.0 } else { 1.0 }),
        Unary::Exp => each!(|_x, y| y),
        Unary::Sigmoid => each!(|_x, y| y * (1.0 - y)),
        Unary::Silu => each!(|x, y| {
            let s = sigmoid(x);
            s + y * (1.0 - s)
        }),
        Unary::Tanh => each!(|_x, y| 1.0 - y * y),
    }
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// e to the x within 2 units in the last place, between 2⁻¹²⁶ and 2¹²⁷; without a branch, for vectors.
///
/// x = n·ln 2 + r with |r| ≤ ln 2 / 2, and the Taylor series of e to the r up to r⁷. Adding 1.5·2²³ rounds n, which then
/// stands in the lowest bits.
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    // ln 2 as a part of few bits, whose products with n are exact, and the rest.
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN_2[0]) - n * LN_2[1];
    let series = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
    let mut sum = 0.0;
    for coefficient in series {
        sum = (sum + coefficient) * r;
    }
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0f32.to_bits()));
    (1.0 + sum) * power
}

/// A function of two tensors of the same shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Binary {
    Add,
    Sub,
    Mul,
    Div,
}

impl Operator for Binary {
    fn forward(&self, inputs: &[&[f32]], output: &mut [f32]) {
        let of = inputs[0].par_chunks(GRAIN).zip(inputs[1].par_chunks(GRAIN));
        output.par_chunks_mut(GRAIN).zip(of).for_each(|(output, (a, b))| {
            let value = |a: f32, b: f32| match self {
                Self::Add => a + b,
                Self::Sub => a - b,
                Self::Mul => a * b,
                Self::Div => a / b,
            };
            output.iter_mut().zip(a.iter().zip(b)).for_each(|(output, (&a, &b))| *output = value(a, b));
        });
    }

    fn backward(&self, which: usize, inputs: &[&[f32]], _: &[f32], weights: &[f32], gradient: &mut [f32]) {
        let of = inputs[0].par_chunks(GRAIN).zip(inputs[1].par_chunks(GRAIN)).zip(weights.par_chunks(GRAIN));
        gradient.par_chunks_mut(GRAIN).zip(of).for_each(|(gradient, ((a, b), weights))| {
            let slope = |a: f32, b: f32| match (self, which) {
                (Self::Add, _) | (Self::Sub, 0) => 1.0,
                (Self::Sub, _) => -1.0,
                (Self::Mul, 0) => b,
                (Self::Mul, _) => a,
                (Self::Div, 0) => 1.0 / b,
                (Self::Div, _) => -a / (b * b),
            };
            let of = a.iter().zip(b).zip(weights);
            gradient.iter_mut().zip(of).for_each(|(gradient, ((&a, &b), weight))| *gradient += weight * slope(a, b));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_exact_to_two_units() {
        let mut worst = 0.0f64;
        for i in -869_990..=879_990 {
            let x = i as f32 * 1e-4;
            let exact = f64::from(x).exp();
            worst = worst.max((f64::from(exp(x)) - exact).abs() / exact);
        }
        println!("relative error {worst:.1e}");
        assert!(worst < 2.0 * f64::from(f32::EPSILON));
        assert!(exp(f32::NAN).is_nan() && exp(f32::INFINITY) < f32::INFINITY && exp(f32::NEG_INFINITY) > 0.0);
    }
}
