//! A splat in linear units, and several merged into one.
//!
//! Source: the moments of a mixture of Gaussians. Weights are area times opacity, so that a merged splat covers as much as its parts did;
//! its opacity may exceed 1, which viewers of level-of-detail trees draw as a flatter falloff.

use std::f32::consts::E;
use std::f64::consts::PI;

use glam::{DMat3, DVec3, Mat3, Quat, Vec3};

use crate::splats::{LEAST_OPACITY, LEAST_SCALE, SH_C0, Splat, Splats, log_scale, logit};

/// Opacity at most of a merged splat.
const MAX_OPACITY: f32 = 1000.0;
/// Weight and area at least, square metres: nothing is divided by zero.
const LEAST_WEIGHT: f64 = 1e-30;
/// Standard deviation at most, metres: areas stay finite.
const MOST_SCALE: f32 = 1e18;
/// Standard deviation at least, as a share of the longest, where two splats are compared.
const FLATTEST: f32 = 1e-3;

/// A splat in linear units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaussian {
    /// Centre, metres from the file's origin.
    pub mean: Vec3,
    /// Standard deviations along the own axes, metres.
    pub scale: Vec3,
    /// Rotation, of length 1.
    pub quat: Quat,
    /// 0 to 1; of a merged splat up to 1000.
    pub opacity: f32,
    /// SH coefficients, channel fastest; those above the degree are zero.
    pub sh: [[f32; 3]; 16],
}

impl Gaussian {
    /// Row `i` of splats, with its place relative to `origin` (metres).
    pub fn of(splats: &Splats, i: usize, origin: DVec3) -> Self {
        let splat = splats.get(i);
        let [w, x, y, z] = splat.quat;
        let quat = Quat::from_xyzw(x, y, z, w);
        Self {
            mean: (splat.mean.as_dvec3() - origin).as_vec3(),
            scale: splat.log_scale.map(|log| log.exp().clamp(LEAST_SCALE, MOST_SCALE)),
            quat: if quat.length_squared() > 0.0 { quat.normalize() } else { Quat::IDENTITY },
            opacity: 1.0 / (1.0 + (-splat.opacity_logit).exp()),
            sh: splat.sh,
        }
    }

    /// True when every number is finite.
    pub fn is_finite(&self) -> bool {
        let sh = self.sh.as_flattened().iter().all(|value| value.is_finite());
        sh && self.mean.is_finite() && self.scale.is_finite() && self.quat.is_finite() && self.opacity.is_finite()
    }

    /// Base colour, sRGB.
    pub fn colour(&self) -> Vec3 {
        Vec3::from_array(self.sh[0]) * SH_C0 + 0.5
    }

    /// Area of the ellipsoid of one standard deviation (Thomsen's formula), square metres.
    fn area(&self) -> f64 {
        const P: f64 = 1.6075;
        let DVec3 { x, y, z } = self.scale.as_dvec3();
        let mean = ((x * y).powf(P) + (x * z).powf(P) + (y * z).powf(P)) / 3.0;
        4.0 * PI * mean.powf(1.0 / P)
    }

    /// Area times opacity: what the splat covers.
    pub fn weight(&self) -> f64 {
        self.area() * f64::from(self.opacity)
    }

    /// How much farther an opacity above 1 reaches, 1 otherwise. Viewers store it in place of that opacity.
    pub fn reach(&self) -> f32 {
        if self.opacity > 1.0 { (1.0 + E * self.opacity.ln()).sqrt() } else { 1.0 }
    }

    /// The size that viewers choose the level of detail by, metres.
    pub fn size(&self) -> f32 {
        2.0 * self.scale.max_element() * self.reach()
    }

    fn covariance(&self, scale: Vec3) -> DMat3 {
        let axes = Mat3::from_quat(self.quat).as_dmat3() * DMat3::from_diagonal(scale.as_dvec3());
        axes * axes.transpose()
    }

    /// One splat for two, with their mean, covariance and coverage.
    pub fn merged(a: &Self, b: &Self) -> Self {
        let parts = [a, b];
        let weights = parts.map(|part| part.weight().max(LEAST_WEIGHT));
        let total: f64 = weights.iter().sum();
        let shares = weights.map(|weight| weight / total);
        let mean = a.mean.as_dvec3() * shares[0] + b.mean.as_dvec3() * shares[1];
        let mut covariance = DMat3::ZERO;
        let mut sh = [[0.0; 3]; 16];
        for (part, share) in parts.into_iter().zip(shares) {
            let off = part.mean.as_dvec3() - mean;
            let spread = DMat3::from_cols(off * off.x, off * off.y, off * off.z);
            covariance += (part.covariance(part.scale) + spread) * share;
            let values = sh.as_flattened_mut().iter_mut().zip(part.sh.as_flattened());
            values.for_each(|(sum, &value)| *sum += value * share as f32);
        }
        let (variances, axes) = eigen(covariance);
        let scale = variances.max(DVec3::ZERO).map(f64::sqrt).as_vec3();
        let scale = scale.clamp(Vec3::splat(LEAST_SCALE), Vec3::splat(MOST_SCALE));
        let mut merged =
            Self { mean: mean.as_vec3(), scale, quat: Quat::from_mat3(&axes.as_mat3()).normalize(), opacity: 1.0, sh };
        merged.opacity = ((total / merged.area().max(LEAST_WEIGHT)) as f32).clamp(LEAST_OPACITY, MAX_OPACITY);
        merged
    }
}

/// What is needed to tell how alike two splats are.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shape {
    mean: DVec3,
    covariance: DMat3,
    log_determinant: f64,
    colour: Vec3,
}

impl Shape {
    pub(super) fn of(gaussian: &Gaussian) -> Self {
        let floor = Vec3::splat((FLATTEST * gaussian.scale.max_element()).max(1e-9));
        let scale = gaussian.scale.max(floor);
        Self {
            mean: gaussian.mean.as_dvec3(),
            covariance: gaussian.covariance(scale),
            log_determinant: 2.0 * scale.to_array().map(|s| f64::from(s).ln()).iter().sum::<f64>(),
            colour: gaussian.colour(),
        }
    }

    /// Bhattacharyya's distance of two splats, and the square of that of their colours: 0 for equal ones.
    pub(super) fn distance(&self, other: &Self) -> f64 {
        let middle = (self.covariance + other.covariance) * 0.5;
        let determinant = middle.determinant();
        let off = other.mean - self.mean;
        let apart = 0.125 * off.dot(middle.inverse() * off);
        let unlike = 0.5 * (determinant.ln() - 0.5 * (self.log_determinant + other.log_determinant));
        let colours = f64::from((self.colour - other.colour).length_squared());
        let distance = apart + unlike + colours;
        if distance.is_finite() { distance } else { f64::MAX }
    }
}

/// Eigenvalues and eigenvectors of a symmetric matrix, the vectors right-handed. Source: Jacobi's rotations.
fn eigen(mut matrix: DMat3) -> (DVec3, DMat3) {
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..16 {
        let off = [(0, 1), (0, 2), (1, 2)].map(|(p, q)| (matrix.col(q)[p].abs(), p, q));
        let (largest, p, q) = off.into_iter().fold((0.0, 0, 1), |most, next| if next.0 > most.0 { next } else { most });
        if largest <= 1e-14 * (matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z) {
            break;
        }
        let angle = 0.5 * (2.0 * matrix.col(q)[p]).atan2(matrix.col(q)[q] - matrix.col(p)[p]);
        let (sin, cos) = angle.sin_cos();
        let mut turn = DMat3::IDENTITY;
        (turn.col_mut(p)[p], turn.col_mut(q)[q]) = (cos, cos);
        (turn.col_mut(q)[p], turn.col_mut(p)[q]) = (sin, -sin);
        matrix = turn.transpose() * matrix * turn;
        vectors *= turn;
    }
    (DVec3::new(matrix.x_axis.x, matrix.y_axis.y, matrix.z_axis.z), vectors)
}

/// Appends a splat, with its place relative to the file's origin. An opacity above 1 becomes nearly 1.
pub(super) fn push(splats: &mut Splats, gaussian: &Gaussian) {
    let Gaussian { mean, scale, quat, opacity, sh } = *gaussian;
    splats.push(&Splat {
        mean,
        log_scale: scale.map(log_scale),
        quat: [quat.w, quat.x, quat.y, quat.z],
        opacity_logit: logit(opacity),
        sh,
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round(x: f32, scale: f32) -> Gaussian {
        let sh = [[0.3; 3]; 16];
        Gaussian { mean: Vec3::X * x, scale: Vec3::splat(scale), quat: Quat::IDENTITY, opacity: 0.5, sh }
    }

    #[test]
    fn merging_keeps_moments_and_coverage() {
        let turned = Gaussian {
            scale: Vec3::new(3.0, 1.0, 0.2),
            quat: Quat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0),
            ..round(0.0, 1.0)
        };
        let same = Gaussian::merged(&turned, &turned);
        let difference = same.covariance(same.scale) - turned.covariance(turned.scale);
        assert!(difference.abs_diff_eq(DMat3::ZERO, 1e-4), "{difference}");
        assert!((same.weight() / (2.0 * turned.weight()) - 1.0).abs() < 1e-4 && same.sh == turned.sh);

        let pair = Gaussian::merged(&round(-2.0, 0.5), &round(2.0, 0.5));
        assert!((pair.scale.max_element() - 4.25f32.sqrt()).abs() < 1e-5 && pair.mean.length() < 1e-6);
        assert!((pair.weight() - 2.0 * round(0.0, 0.5).weight()).abs() < 1e-4);
        let many = (0..40).fold(round(0.0, 0.5), |sum, _| Gaussian::merged(&sum, &round(0.0, 0.5)));
        assert!(many.opacity > 10.0 && many.size() > 3.0);
    }

    #[test]
    fn near_and_like_splats_are_less_distant() {
        let shape = |x: f32, scale: f32| Shape::of(&round(x, scale));
        let at = shape(0.0, 1.0);
        assert!(at.distance(&at).abs() < 1e-9);
        assert!(at.distance(&shape(1.0, 1.0)) < at.distance(&shape(2.0, 1.0)));
        assert!(at.distance(&shape(0.0, 1.5)) < at.distance(&shape(0.0, 3.0)));
        assert!(Shape::of(&round(f32::MAX, MOST_SCALE)).distance(&at) > 40.0);
    }
}
