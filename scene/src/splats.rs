//! Splats as structure of arrays: one `Vec<f32>` per scalar, so that SIMD, optimiser and codecs read memory
//! sequentially.

use std::borrow::Cow;

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

/// Opacities nearer to 0 or 1 than this have no logit that is kept.
pub(crate) const LEAST_OPACITY: f32 = 1e-6;
/// Standard deviations below it have no logarithm that is kept, metres.
pub(crate) const LEAST_SCALE: f32 = 1e-30;

/// The logit of an opacity, which is kept within (0, 1).
pub(crate) fn logit(opacity: f32) -> f32 {
    let opacity = opacity.clamp(LEAST_OPACITY, 1.0 - LEAST_OPACITY);
    (opacity / (1.0 - opacity)).ln()
}

/// The logarithm of a standard deviation, which is kept above 0.
pub(crate) fn log_scale(scale: f32) -> f32 {
    scale.max(LEAST_SCALE).ln()
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
///
/// Beside the float columns, which rendering and training use, splats may carry [attributes](Attribute): named integer
/// columns that every operation on rows carries along.
#[derive(Debug, Clone, PartialEq)]
pub struct Splats {
    sh_degree: u8,
    columns: Vec<Vec<f32>>,
    /// Sorted by name.
    attributes: Vec<Attribute>,
}

/// A named integer column of splats: a class label, an object id, the block of origin ([`BLOCK_ATTRIBUTE`]). The value 0
/// means unset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attribute {
    /// 1 to [`Attribute::MAX_NAME`] lower-case letters, digits and underscores; also the name of the PLY property.
    pub name: String,
    /// One value per splat.
    pub values: Vec<u32>,
}

impl Attribute {
    /// Longest name, bytes.
    pub const MAX_NAME: usize = 32;
    /// Largest number of attributes that files may declare.
    pub const MAX_COUNT: usize = 16;

    /// True for names that files may declare.
    pub fn is_name(name: &str) -> bool {
        let is_fine = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_';
        (1..=Self::MAX_NAME).contains(&name.len()) && name.bytes().all(is_fine)
    }
}

/// The attribute that names the block which trained a splat: [`BlockId::code`](crate::BlockId::code).
pub const BLOCK_ATTRIBUTE: &str = "block";

impl Splats {
    /// No splats, with this SH degree (0 to 3).
    pub fn new(sh_degree: u8) -> Self {
        assert!(sh_degree <= 3, "SH degree {sh_degree} is above 3");
        let columns = vec![Vec::new(); column::SH + 3 * sh_coefficients(sh_degree)];
        Self { sh_degree, columns, attributes: Vec::new() }
    }

    /// Splats from columns in the order of [`column`]. `None` unless there are 14, 23, 38 or 59 columns of equal
    /// length.
    pub fn from_columns(columns: Vec<Vec<f32>>) -> Option<Self> {
        let sh_degree = (0..=3).find(|&d| columns.len() == column::SH + 3 * sh_coefficients(d))?;
        let n = columns[0].len();
        columns.iter().all(|c| c.len() == n).then_some(Self { sh_degree, columns, attributes: Vec::new() })
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

    /// The attributes, sorted by name.
    pub fn attributes(&self) -> &[Attribute] {
        &self.attributes
    }

    /// The names of the attributes, sorted.
    pub fn attribute_names(&self) -> Vec<String> {
        self.attributes.iter().map(|attribute| attribute.name.clone()).collect()
    }

    /// The values of an attribute, one per splat; `None` where the splats do not carry it.
    pub fn attribute(&self, name: &str) -> Option<&[u32]> {
        self.attributes.iter().find(|attribute| attribute.name == name).map(|attribute| attribute.values.as_slice())
    }

    /// Adds an attribute, or replaces the one of this name. There must be one value per splat.
    pub fn set_attribute(&mut self, name: &str, values: Vec<u32>) {
        assert_eq!(values.len(), self.len(), "attribute {name} has another length than the splats");
        match self.attributes.binary_search_by(|attribute| attribute.name.as_str().cmp(name)) {
            Ok(at) => self.attributes[at].values = values,
            Err(at) => self.attributes.insert(at, Attribute { name: name.to_owned(), values }),
        }
    }

    /// The same splats with at least these attributes, unset where they were missing.
    #[must_use]
    pub fn with_attributes(mut self, names: &[String]) -> Self {
        for name in names {
            if self.attribute(name).is_none() {
                self.set_attribute(name, vec![0; self.len()]);
            }
        }
        self
    }

    /// The same float columns with the attributes of `other`, which must have as many splats.
    #[must_use]
    pub fn with_attributes_of(mut self, other: &Self) -> Self {
        assert_eq!(self.len(), other.len(), "attributes belong to the same rows");
        self.attributes.clone_from(&other.attributes);
        self
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

    /// Overwrites the floats of row `i`, without coefficients above the SH degree.
    pub fn set(&mut self, i: usize, splat: &Splat) {
        for (k, value) in row(splat).take(self.columns.len()).enumerate() {
            self.columns[k][i] = value;
        }
    }

    /// Appends a row, without coefficients above the SH degree. Its attributes are unset.
    pub fn push(&mut self, splat: &Splat) {
        for (column, value) in self.columns.iter_mut().zip(row(splat)) {
            column.push(value);
        }
        self.attributes.iter_mut().for_each(|attribute| attribute.values.push(0));
    }

    /// Appends a row with the attributes of row `like`, such as the second half of a splat that was split.
    pub fn push_like(&mut self, like: usize, splat: &Splat) {
        self.push(splat);
        for Attribute { values, .. } in &mut self.attributes {
            let value = values[like];
            *values.last_mut().expect("a row was pushed") = value;
        }
    }

    /// Appends all rows of `other`. Coefficients above this SH degree are dropped, missing ones are zero. The result has
    /// the attributes of both, unset where one side lacks them.
    pub fn append(&mut self, other: &Self) {
        let (before, after) = (self.len(), self.len() + other.len());
        for Attribute { name, values } in &other.attributes {
            let mut joined = self.attribute(name).map_or_else(|| vec![0; before], <[u32]>::to_vec);
            joined.extend_from_slice(values);
            match self.attributes.binary_search_by(|attribute| attribute.name.cmp(name)) {
                Ok(at) => self.attributes[at].values = joined,
                Err(at) => self.attributes.insert(at, Attribute { name: name.clone(), values: joined }),
            }
        }
        self.attributes.iter_mut().for_each(|attribute| attribute.values.resize(after, 0));
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
        let attributes = self.attributes.iter().map(|Attribute { name, values }| Attribute {
            name: name.clone(),
            values: rows.iter().map(|&i| values[i as usize]).collect(),
        });
        Self {
            sh_degree: self.sh_degree,
            columns: self.columns.iter().map(pick).collect(),
            attributes: attributes.collect(),
        }
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

impl<'a> From<&'a Splats> for Cow<'a, Splats> {
    fn from(splats: &'a Splats) -> Self {
        Self::Borrowed(splats)
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

    #[test]
    fn attributes_follow_their_rows() {
        let at = |x: f32| Splat::round(Vec3::new(x, 0.0, 0.0), -2.0, Vec3::ONE, 0.7);
        let mut splats = Splats::new(1);
        (0..4).for_each(|i| splats.push(&at(i as f32)));
        splats.set_attribute("label", vec![10, 11, 12, 13]);
        splats.push(&at(4.0));
        splats.push_like(2, &at(5.0));
        assert_eq!(splats.attribute("label"), Some(&[10, 11, 12, 13, 0, 12][..]));
        assert_eq!(splats.select(&[5, 0]).attribute("label"), Some(&[12, 10][..]));
        assert_eq!(splats.with_sh_degree(0).attribute("label"), splats.attribute("label"));

        let mut other = Splats::new(0);
        other.push(&at(6.0));
        other.set_attribute("block", vec![7]);
        other.append(&splats.filter(|i| i < 2));
        let names: Vec<&str> = other.attributes().iter().map(|attribute| attribute.name.as_str()).collect();
        assert_eq!(names, ["block", "label"]);
        assert_eq!(other.attribute("block"), Some(&[7, 0, 0][..]));
        assert_eq!(other.attribute("label"), Some(&[0, 10, 11][..]));
        assert_eq!(["label", "a_1", "", "Label", "a b"].map(Attribute::is_name), [true, true, false, false, false]);
    }
}
