//! Reads and writes splats as PLY in the layout of INRIA's 3D Gaussian Splatting, and reads point clouds.
//!
//! The INRIA convention: one `vertex` element with `x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`;
//! `f_rest` is channel-major (all of red, then green, then blue), opacity is a logit, scales are logarithms and `rot`
//! is wxyz. The reader accepts any order of properties, any scalar types and all three encodings of PLY (Turk 1994).
//! Values are bit exact, including NaN; the caller checks their range. PlayCanvas' `.compressed.ply` is read too; see
//! [`packed`].

mod header;
mod packed;

use glam::DVec3;

use self::header::{Header, Kind, Property};
pub(crate) use self::packed::logit_of_byte;
use crate::error::CodecError;
use crate::splats::{Attribute, Splats, column, sh_coefficients};

/// Rows transposed at a time, few enough to stay in cache.
const ROWS: usize = 128;

/// Decodes splats of SH degree 0 to 3 (0, 9, 24 or 45 `f_rest` properties). Properties of type `uint` become
/// [attributes](Attribute) where their name is valid. Other properties and elements are ignored.
/// PlayCanvas' packed splats are unpacked.
///
/// # Errors
/// A malformed header, a missing property, another number of `f_rest` properties, or a body that is too short.
pub fn read(bytes: &[u8]) -> Result<Splats, CodecError> {
    let header = Header::parse(bytes)?;
    if packed::is_packed(&header) {
        return packed::read(&header);
    }
    let vertices = header.vertices()?;
    let rest = vertices.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let sh_degree = (0..=3)
        .find(|&d| 3 * (sh_coefficients(d) - 1) == rest)
        .ok_or_else(|| CodecError::new(format!("{rest} f_rest properties, SH degrees 0 to 3 have 0, 9, 24 or 45")))?;
    let wanted = column_names(sh_degree).iter().map(|name| vertices.find(name)).collect::<Result<Vec<_>, _>>()?;
    let mut splats =
        Splats::from_columns(vertices.columns(&wanted)?).ok_or_else(|| CodecError::new("columns of unequal length"))?;
    let is_attribute = |p: &&Property| p.kind == Kind::U32 && Attribute::is_name(&p.name);
    let names: Vec<&str> = vertices.properties.iter().filter(is_attribute).map(|p| p.name.as_str()).collect();
    for name in names.into_iter().take(Attribute::MAX_COUNT) {
        if splats.attribute(name).is_none() && !column_names(sh_degree).iter().any(|column| column == name) {
            let values = vertices.columns::<u32>(&[vertices.find(name)?])?.pop().unwrap_or_default();
            splats.set_attribute(name, values);
        }
    }
    Ok(splats)
}

/// Encodes splats as a `binary_little_endian` PLY with zero normals and one header line per comment.
pub fn write(splats: &Splats, comments: &[&str]) -> Vec<u8> {
    let names = splats.attribute_names();
    let header = header(splats.len(), splats.sh_degree(), &names, comments);
    let stride = 4 * (properties(splats.sh_degree()).len() + names.len());
    let mut bytes = Vec::with_capacity(header.len() + stride * splats.len());
    bytes.extend_from_slice(&header);
    append_rows(&mut bytes, splats);
    bytes
}

/// The header of [`write`] for this number of splats with these attributes. The [`rows`] of that many splats follow it,
/// in any number of parts, each of which has all these attributes.
pub fn header(splats: usize, sh_degree: u8, attributes: &[String], comments: &[&str]) -> Vec<u8> {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {splats}\n");
    properties(sh_degree).iter().for_each(|(name, _)| header += &format!("property float {name}\n"));
    attributes.iter().for_each(|name| header += &format!("property uint {name}\n"));
    header += "end_header\n";
    header.into_bytes()
}

/// The rows that follow the header in [`write`].
pub fn rows(splats: &Splats) -> Vec<u8> {
    let mut bytes = Vec::new();
    append_rows(&mut bytes, splats);
    bytes
}

fn append_rows(bytes: &mut Vec<u8>, splats: &Splats) {
    let properties = properties(splats.sh_degree());
    let (start, stride) = (bytes.len(), 4 * (properties.len() + splats.attributes().len()));
    bytes.resize(start + stride * splats.len(), 0);
    for (block, rows) in bytes[start..].chunks_mut(stride * ROWS).enumerate() {
        for (slot, (_, source)) in properties.iter().enumerate() {
            let Some(source) = *source else { continue };
            for (row, value) in rows.chunks_exact_mut(stride).zip(&splats.col(source)[block * ROWS..]) {
                row[4 * slot..4 * slot + 4].copy_from_slice(&value.to_le_bytes());
            }
        }
        for (attribute, slot) in splats.attributes().iter().zip(properties.len()..) {
            for (row, value) in rows.chunks_exact_mut(stride).zip(&attribute.values[block * ROWS..]) {
                row[4 * slot..4 * slot + 4].copy_from_slice(&value.to_le_bytes());
            }
        }
    }
}

/// The properties of a row in INRIA's order with their columns; normals have none.
fn properties(sh_degree: u8) -> Vec<(String, Option<usize>)> {
    let names = column_names(sh_degree);
    let mut properties: Vec<(String, Option<usize>)> = Vec::with_capacity(names.len() + 3);
    let mut put = |name: &str| properties.push((name.into(), names.iter().position(|n| n == name)));
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].into_iter().for_each(&mut put);
    (0..names.len() - column::SH - 3).for_each(|k| put(&format!("f_rest_{k}")));
    ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].into_iter().for_each(&mut put);
    properties
}

/// The header's `comment` lines; empty if the bytes are not a PLY. plat marks anti-aliased models with `antialiased`.
pub fn comments(bytes: &[u8]) -> Vec<String> {
    Header::parse(bytes).map(|header| header.comments).unwrap_or_default()
}

/// Decodes a point cloud: positions `x y z` of any scalar type and sRGB colours `red green blue` as `uchar`. Without
/// such colours points are grey (128).
///
/// # Errors
/// As [`read`], or a coordinate that is not finite.
pub fn read_points(bytes: &[u8]) -> Result<(Vec<DVec3>, Vec<[u8; 3]>), CodecError> {
    let header = Header::parse(bytes)?;
    let vertices = header.vertices()?;
    let [x, y, z] = [vertices.find("x")?, vertices.find("y")?, vertices.find("z")?];
    let positions = vertices.columns::<f64>(&[x, y, z])?;
    let points: Vec<DVec3> =
        (0..vertices.count).map(|i| DVec3::new(positions[0][i], positions[1][i], positions[2][i])).collect();
    if let Some(i) = points.iter().position(|p| !p.is_finite()) {
        return Err(CodecError::new(format!("vertex {i} has a coordinate that is not finite")));
    }
    let rgb: Vec<usize> = ["red", "green", "blue"].iter().filter_map(|name| vertices.find(name).ok()).collect();
    if rgb.len() < 3 || rgb.iter().any(|&p| vertices.properties[p].kind != Kind::U8) {
        return Ok((points, vec![[128; 3]; vertices.count]));
    }
    let rgb = vertices.columns::<f32>(&rgb)?;
    let colours = (0..vertices.count).map(|i| [rgb[0][i] as u8, rgb[1][i] as u8, rgb[2][i] as u8]).collect();
    Ok((points, colours))
}

/// The property of each column, in the order of [`column`].
fn column_names(sh_degree: u8) -> Vec<String> {
    let mut names: Vec<String> =
        ["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity"]
            .map(String::from)
            .to_vec();
    let higher = sh_coefficients(sh_degree) - 1;
    names.extend((0..3).map(|channel| format!("f_dc_{channel}")));
    names.extend((0..higher).flat_map(|k| (0..3).map(move |channel| format!("f_rest_{}", channel * higher + k))));
    names
}

#[cfg(test)]
mod tests;
