//! Splats as structure of arrays: one `Vec<f32>` per scalar, so that SIMD, optimiser and codecs read memory
//! sequentially.

use glam::Vec3;

/// Indices of the columns in [`Splats`].
pub mod column {
    /// x, y, z of the mean, metres.
    pub const MEAN: usize = 0;
    /// Natural logarithm of the three standard deviations, metres.
    pub const LOG_SCALE: usize = 3;
    /// w, x, y, z of the rotation quaternion; normalised on use.
    pub const QUAT: usize = 6;
    /// Opacity logit.
    pub const OPACITY: usize = 10;
    /// Spherical harmonics: column `SH + 3 * coefficient + channel`.
    pub const SH: usize = 11;
}

/// `1 / (2 √π)`, the spherical harmonic of degree 0. The colour of a splat of SH degree 0 is `SH_C0 · f_dc + ½`.
pub const SH_C0: f32 = 0.282_094_79;

/// The number of coefficients per channel of an SH degree.
pub const fn sh_coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// One 3D Gaussian, as a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// Centre, metres.
    pub mean: Vec3,
    /// ln of the standard deviations along the splat's own axes, metres.
    pub log_scale: Vec3,
    /// Rotation wxyz.
    pub quat: [f32; 4],
    /// Opacity logit.
    pub opacity_logit: f32,
    /// SH coefficients, channel fastest; those above the degree are zero.
    pub sh: [[f32; 3]; 16],
}

impl Splat {
    /// An isotropic splat of one colour (sRGB, 0..1), with `opacity` in (0, 1).
    pub fn round(mean: Vec3, log_scale: f32, colour: Vec3, opacity: f32) -> Self {
        let mut sh = [[0.0; 3]; 16];
        sh[0] = ((colour - 0.5) / SH_C0).to_array();
        let opacity_logit = (opacity / (1.0 - opacity)).ln();
        Self { mean, log_scale: Vec3::splat(log_scale), quat: [1.0, 0.0, 0.0, 0.0], opacity_logit, sh }
    }
}

/// Splats as columns (structure of arrays); see [`column`] for the order. All columns have the same length.
#[derive(Debug, Clone, PartialEq)]
pub struct Splats {
    sh_degree: u8,
    columns: Vec<Vec<f32>>,
}

impl Splats {
    /// No splats, with this SH degree (0 to 3).
    pub fn new(sh_degree: u8) -> Self {
        assert!(sh_degree <= 3, "SH degree {sh_degree} is above 3");
        Self { sh_degree, columns: vec![Vec::new(); column::SH + 3 * sh_coefficients(sh_degree)] }
    }

    /// Splats from columns in the order of [`column`]. `None` unless there are 14, 23, 38 or 59 columns of equal
    /// length.
    pub fn from_columns(columns: Vec<Vec<f32>>) -> Option<Self> {
        let sh_degree = (0..=3).find(|&d| columns.len() == column::SH + 3 * sh_coefficients(d))?;
        let n = columns[0].len();
        columns.iter().all(|c| c.len() == n).then_some(Self { sh_degree, columns })
    }

    /// The number of splats.
    pub fn len(&self) -> usize {
        self.columns[0].len()
    }

    /// True without splats.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// SH degree, 0 to 3.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// All columns, in the order of [`column`].
    pub fn columns(&self) -> &[Vec<f32>] {
        &self.columns
    }

    /// All columns, mutable. The caller must keep their lengths equal.
    pub fn columns_mut(&mut self) -> &mut [Vec<f32>] {
        &mut self.columns
    }

    /// One column.
    pub fn col(&self, index: usize) -> &[f32] {
        &self.columns[index]
    }

    /// The centre of splat `i`.
    pub fn mean(&self, i: usize) -> Vec3 {
        Vec3::new(self.columns[0][i], self.columns[1][i], self.columns[2][i])
    }

    /// Row `i`.
    pub fn get(&self, i: usize) -> Splat {
        let c = |k: usize| self.columns[k][i];
        let mut sh = [[0.0; 3]; 16];
        for (k, coefficient) in sh.iter_mut().enumerate().take(sh_coefficients(self.sh_degree)) {
            *coefficient = [c(column::SH + 3 * k), c(column::SH + 3 * k + 1), c(column::SH + 3 * k + 2)];
        }
        Splat {
            mean: self.mean(i),
            log_scale: Vec3::new(c(3), c(4), c(5)),
            quat: [c(6), c(7), c(8), c(9)],
            opacity_logit: c(10),
            sh,
        }
    }

    /// Overwrites row `i`, without coefficients above the SH degree.
    pub fn set(&mut self, i: usize, splat: &Splat) {
        for (k, value) in row(splat).take(self.columns.len()).enumerate() {
            self.columns[k][i] = value;
        }
    }

    /// Appends a row, without coefficients above the SH degree.
    pub fn push(&mut self, splat: &Splat) {
        for (column, value) in self.columns.iter_mut().zip(row(splat)) {
            column.push(value);
        }
    }

    /// Appends all rows of `other`. Coefficients above this SH degree are dropped, missing ones are zero.
    pub fn append(&mut self, other: &Self) {
        for (k, column) in self.columns.iter_mut().enumerate() {
            match other.columns.get(k) {
                Some(values) => column.extend_from_slice(values),
                None => column.resize(column.len() + other.len(), 0.0),
            }
        }
    }

    /// Reserves capacity for exactly this many more rows.
    pub fn reserve(&mut self, rows: usize) {
        self.columns.iter_mut().for_each(|column| column.reserve_exact(rows));
    }

    /// The rows with these indices, in that order.
    pub fn select(&self, rows: &[u32]) -> Self {
        let pick = |column: &Vec<f32>| rows.iter().map(|&i| column[i as usize]).collect();
        Self { sh_degree: self.sh_degree, columns: self.columns.iter().map(pick).collect() }
    }

    /// The rows for which `keep` is true, in order.
    pub fn filter(&self, keep: impl Fn(usize) -> bool) -> Self {
        let rows: Vec<u32> = (0..self.len()).filter(|&i| keep(i)).map(|i| i as u32).collect();
        self.select(&rows)
    }

    /// The same splats with another SH degree: higher coefficients dropped, missing ones zero.
    pub fn with_sh_degree(&self, sh_degree: u8) -> Self {
        let mut other = Self::new(sh_degree);
        other.append(self);
        other
    }

    /// True when every number of row `i` is finite.
    pub fn is_finite(&self, i: usize) -> bool {
        self.columns.iter().all(|column| column[i].is_finite())
    }
}

fn row(splat: &Splat) -> impl Iterator<Item = f32> + '_ {
    (splat.mean.to_array().into_iter())
        .chain(splat.log_scale.to_array())
        .chain(splat.quat)
        .chain([splat.opacity_logit])
        .chain(splat.sh.as_flattened().iter().copied())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_columns_agree() {
        let mut splat = Splat::round(Vec3::new(1.0, 2.0, 3.0), -2.0, Vec3::new(0.2, 0.5, 0.9), 0.7);
        splat.sh[15] = [7.0, 8.0, 9.0];
        let mut splats = Splats::new(3);
        splats.push(&splat);
        assert_eq!(splats.get(0), splat);
        let flat = splats.with_sh_degree(0);
        assert_eq!(flat.columns().len(), 14);
        assert_eq!(flat.get(0).sh[0], splat.sh[0]);
        assert_eq!(flat.with_sh_degree(3).get(0).sh[15], [0.0; 3]);
        assert_eq!(Splats::from_columns(splats.columns().to_vec()), Some(splats));
    }
}
