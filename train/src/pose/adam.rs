//! Adam on the numbers of cameras and of sensors.

use glam::DVec3;

const BETA1: f32 = 0.9;
/// Adam's usual 0.999 remembers longer than a view is drawn.
const BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;
/// Learning rate of translations in units of the depth, relative to that of rotations. Either explains nearly the same
/// motion of an image, and the error of a measured translation is the smaller one seen from a distance. At 1 the
/// translations of a city with errors of 0.15 m and 0.6° got twice as wrong; at 0.2 they stayed as they were.
pub(crate) const TRANSLATION_RATE: f32 = 0.3;

/// Rates of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rates {
    /// Learning rate of rotations in radians; that of translations follows from the depth.
    pub(crate) rate: f32,
    /// Share of every displacement of a view in the step that is taken back.
    pub(crate) decay: f32,
}

/// What the moments lack after this many steps, as they start from zero.
pub(super) fn bias(steps: u32) -> [f32; 2] {
    let steps = steps.min(1 << 20) as i32;
    [1.0 - BETA1.powi(steps), 1.0 - BETA2.powi(steps)]
}

/// Takes a gradient into the two moments of a number, and returns how far to go down for a learning rate of 1.
pub(super) fn step(moments: [&mut f32; 2], gradient: f32, bias: [f32; 2]) -> f32 {
    let [first, second] = moments;
    *first = BETA1 * *first + (1.0 - BETA1) * gradient;
    *second = BETA2 * *second + (1.0 - BETA2) * gradient * gradient;
    (*first / bias[0]) / ((*second / bias[1]).sqrt() + EPSILON)
}

/// The numbers of a rigid motion: metres and radians.
pub(super) fn joined([translation, rotation]: [DVec3; 2]) -> [f32; 6] {
    let ([x, y, z], [a, b, c]) = (translation.to_array(), rotation.to_array());
    [x, y, z, a, b, c].map(|value| value as f32)
}

/// The translation and the rotation vector of these numbers.
pub(super) fn parts(numbers: &[f32; 6]) -> [DVec3; 2] {
    let [x, y, z, a, b, c] = numbers.map(f64::from);
    [DVec3::new(x, y, z), DVec3::new(a, b, c)]
}

/// The upper median.
pub(super) fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}
