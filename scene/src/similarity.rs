//! Moves splats by a rotation, a uniform scale and a translation: what a matrix may do to a splat that stays one.
//!
//! Colours vary with the direction from which a splat is seen, so spherical harmonics turn with it. Those of one degree turn among
//! themselves: a coefficient becomes a sum of all of its degree.

use std::f64::consts::PI;

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4};

use crate::splats::{Splats, column};

/// Largest difference of the matrix, its scale taken off, from a rotation: some files have `f32` numbers.
const TOLERANCE: f64 = 1e-4;
/// Sines of half angles below it leave `f32` numbers as they are.
const LEAST_TURN: f64 = 1e-9;

/// A rotation, a uniform scale, then a translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    rotation: DQuat,
    scale: f64,
    translation: DVec3,
}

impl Similarity {
    /// Of a matrix; `None` if it mirrors, shears, scales unevenly or not at all, projects, or has numbers that are not finite.
    pub fn from_matrix(matrix: DMat4) -> Option<Self> {
        let turn = DMat3::from_mat4(matrix);
        let scale = turn.x_axis.length();
        let unit = turn * scale.recip();
        let is_rotation = (unit.transpose() * unit).abs_diff_eq(DMat3::IDENTITY, TOLERANCE) && unit.determinant() > 0.0;
        let is_affine = matrix.row(3).abs_diff_eq(DVec4::W, TOLERANCE) && matrix.is_finite();
        (is_rotation && is_affine).then(|| Self {
            rotation: DQuat::from_mat3(&unit).normalize(),
            scale,
            translation: matrix.w_axis.truncate(),
        })
    }

    /// Moves splats. Numbers that leave the range of `f32` become infinite.
    pub fn apply(&self, splats: &mut Splats) {
        let turns = self.rotation.xyz().length() > LEAST_TURN;
        for row in 0..splats.len() {
            let place = self.rotation * splats.mean(row).as_dvec3() * self.scale + self.translation;
            let quat = [0, 1, 2, 3].map(|k| f64::from(splats.col(column::QUAT + k)[row]));
            let columns = splats.columns_mut();
            (0..3).for_each(|axis| columns[column::MEAN + axis][row] = place[axis] as f32);
            if turns {
                let [w, x, y, z] = quat;
                let DQuat { x, y, z, w } = self.rotation * DQuat::from_xyzw(x, y, z, w);
                [w, x, y, z].into_iter().enumerate().for_each(|(k, v)| columns[column::QUAT + k][row] = v as f32);
            }
        }
        let log = self.scale.ln();
        for column in &mut splats.columns_mut()[column::LOG_SCALE..column::QUAT] {
            column.iter_mut().for_each(|value| *value = (f64::from(*value) + log) as f32);
        }
        if turns {
            (1..=splats.sh_degree()).for_each(|degree| turn_harmonics(splats, degree, self.rotation));
        }
    }
}

/// Turns the coefficients of one degree.
fn turn_harmonics(splats: &mut Splats, degree: u8, rotation: DQuat) {
    let (turn, range) = (harmonics_turn(degree, rotation), coefficients(degree));
    for channel in 0..3 {
        let at = |k: usize| column::SH + 3 * k + channel;
        let columns = splats.columns_mut();
        let old: Vec<Vec<f32>> = range.clone().map(|k| std::mem::take(&mut columns[at(k)])).collect();
        for (k, weights) in range.clone().zip(&turn) {
            let value = |row: usize| old.iter().zip(weights).map(|(old, weight)| weight * f64::from(old[row])).sum();
            columns[at(k)] = (0..old[0].len()).map(|row| -> f64 { value(row) }).map(|value| value as f32).collect();
        }
    }
}

/// Indices of the coefficients of one degree.
fn coefficients(degree: u8) -> std::ops::Range<usize> {
    let degree = usize::from(degree);
    degree * degree..(degree + 1) * (degree + 1)
}

/// The matrix that turns coefficients of one degree, by rows.
///
/// The basis is orthonormal, so an element is the integral of one function times another that was turned. Gauss-Legendre
/// quadrature of four heights, and seven directions around each, is exact for such products up to degree 3.
fn harmonics_turn(degree: u8, rotation: DQuat) -> Vec<Vec<f64>> {
    const HEIGHTS: [(f64, f64); 4] = [
        (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
        (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
        (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    ];
    const AROUND: usize = 7;
    let range = coefficients(degree);
    let mut turn = vec![vec![0.0; range.len()]; range.len()];
    for (z, weight) in HEIGHTS {
        for step in 0..AROUND {
            let (sin, cos) = (2.0 * PI * step as f64 / AROUND as f64).sin_cos();
            let across = (1.0 - z * z).sqrt();
            let seen = DVec3::new(across * cos, across * sin, z);
            let [to, from] = [seen, rotation.inverse() * seen].map(harmonics);
            let weight = weight * 2.0 * PI / AROUND as f64;
            for (row, to) in turn.iter_mut().zip(&to[range.clone()]) {
                row.iter_mut().zip(&from[range.clone()]).for_each(|(element, from)| *element += weight * to * from);
            }
        }
    }
    turn
}

/// The real spherical harmonics of splats up to degree 3, in a unit direction.
pub(crate) fn harmonics(DVec3 { x, y, z }: DVec3) -> [f64; 16] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    // √(number / π) times what stands before the polynomials.
    let root = |number: f64, of: f64| (number / PI).sqrt() * of;
    let (first, second, third) = (root(3.0, 0.5), root(15.0, 0.5), root(35.0 / 2.0, 0.25));
    let fourth = root(21.0 / 2.0, 0.25);
    [
        root(1.0, 0.5),
        -first * y,
        first * z,
        -first * x,
        second * x * y,
        -second * y * z,
        root(5.0, 0.25) * (2.0 * zz - xx - yy),
        -second * x * z,
        0.5 * second * (xx - yy),
        -third * y * (3.0 * xx - yy),
        root(105.0, 0.5) * x * y * z,
        -fourth * y * (4.0 * zz - xx - yy),
        root(7.0, 0.25) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -fourth * x * (4.0 * zz - xx - yy),
        root(105.0, 0.25) * z * (xx - yy),
        -third * x * (xx - 3.0 * yy),
    ]
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::Splat;

    fn splats() -> Splats {
        let mut splats = Splats::new(3);
        for i in 0..5 {
            let mut splat = Splat::round(Vec3::new(i as f32, 2.0, -3.0), -1.0, Vec3::splat(0.4), 0.7);
            splat.quat = [0.6, 0.2 * i as f32, -0.3, 0.5];
            let sh = splat.sh.as_flattened_mut().iter_mut().enumerate();
            sh.for_each(|(k, value)| *value = (0.7 * (k + 3 * i) as f32).sin());
            splats.push(&splat);
        }
        splats
    }

    fn colour(splats: &Splats, row: usize, direction: DVec3) -> DVec3 {
        let sh = splats.get(row).sh;
        let basis = harmonics(direction.normalize());
        sh.iter().zip(basis).map(|(sh, basis)| Vec3::from_array(*sh).as_dvec3() * basis).sum()
    }

    #[test]
    fn the_basis_has_the_renderers_constants() {
        let at = harmonics(DVec3::new(0.6, 0.0, 0.8));
        for (value, wanted) in [
            (at[0], 0.282_094_79),
            (at[3], -0.488_602_51 * 0.6),
            (at[7], -1.092_548_4 * 0.48),
            (at[8], 0.546_274_2 * 0.36),
            (at[12], 0.373_176_33 * 0.8 * 0.2),
            (at[13], -0.457_045_8 * 0.6 * 2.2),
            (at[14], 1.445_305_7 * 0.8 * 0.36),
            (at[15], -0.590_043_6 * 0.216),
        ] {
            assert!((value - wanted).abs() < 1e-6, "{value} {wanted}");
        }
        let corner = harmonics(DVec3::splat(1.0));
        assert!((corner[10] - 2.890_611_4).abs() < 1e-6);
    }

    #[test]
    fn a_turned_splat_shows_in_a_turned_direction_what_it_showed() {
        let rotation = DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
        let matrix = DMat4::from_scale_rotation_translation(DVec3::splat(2.0), rotation, DVec3::new(5.0, 6.0, 7.0));
        let (before, mut after) = (splats(), splats());
        Similarity::from_matrix(matrix).unwrap().apply(&mut after);
        for row in 0..before.len() {
            for direction in [DVec3::new(0.2, 0.9, -0.4), DVec3::NEG_X, DVec3::ONE, DVec3::new(-0.1, -0.7, 0.8)] {
                let difference = colour(&before, row, direction) - colour(&after, row, rotation * direction);
                assert!(difference.length() < 1e-5, "{difference}");
            }
            let (a, b) = (before.get(row), after.get(row));
            assert!(b.mean.as_dvec3().distance(matrix.transform_point3(a.mean.as_dvec3())) < 1e-5);
            assert!((b.log_scale - a.log_scale - 2.0f32.ln()).length() < 1e-6);
            let [p, q] = [a.quat, b.quat].map(|q| DQuat::from_array([q[1], q[2], q[3], q[0]].map(f64::from)));
            assert!((rotation * p).dot(q).abs() > (1.0 - 1e-6) * p.length_squared());
        }
    }

    #[test]
    fn half_a_turn_changes_signs_only_and_none_changes_nothing() {
        let mut turned = splats();
        Similarity::from_matrix(DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0))).unwrap().apply(&mut turned);
        let largest = |a: &Splats, b: &Splats, row: usize, k: usize| {
            let (a, b) = (a.get(row).sh[k][0], b.get(row).sh[k][0]);
            (a.abs() - b.abs()).abs()
        };
        assert!((0..5).all(|row| (0..16).all(|k| largest(&splats(), &turned, row, k) < 1e-6)));
        let mut same = splats();
        Similarity::from_matrix(DMat4::IDENTITY).unwrap().apply(&mut same);
        assert_eq!(same, splats());
    }

    #[test]
    fn other_matrices_are_refused() {
        let mut projective = DMat4::IDENTITY;
        projective.x_axis.w = 0.5;
        for matrix in [
            DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0)),
            DMat4::from_scale(DVec3::new(1.0, 1.0, 1.01)),
            DMat4::from_scale(DVec3::ZERO),
            DMat4::from_scale(DVec3::splat(f64::MAX)),
            DMat4::from_translation(DVec3::new(f64::NAN, 0.0, 0.0)),
            DMat4::from_cols(DVec4::X, DVec4::new(0.1, 1.0, 0.0, 0.0), DVec4::Z, DVec4::W),
            projective,
        ] {
            assert_eq!(Similarity::from_matrix(matrix), None, "{matrix}");
        }
    }
}
