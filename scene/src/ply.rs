//! PLY: splats as INRIA's 3D Gaussian Splatting writes them, and point clouds.
//!
//! The INRIA convention: one `vertex` element with `x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`;
//! `f_rest` is channel-major (all of red, then green, then blue), opacity is a logit, scales are logarithms and
//! `rot` is wxyz. Reading takes any order of properties, any scalar types and all three encodings of PLY (Turk 1994).
//! Splats pass bit for bit, NaNs too: whether a number is sensible is the caller's question.

use glam::DVec3;

use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

/// Rows that are transposed at a time: few enough to stay in the cache.
const ROWS: usize = 128;

/// Splats of SH degree 0 to 3 (0, 9, 24 or 45 `f_rest` properties); other properties and elements are left out.
///
/// # Errors
/// A malformed header, a missing property, another number of `f_rest`, or a body that is too short.
pub fn read(bytes: &[u8]) -> Result<Splats, CodecError> {
    let header = Header::parse(bytes)?;
    let rest = header.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let sh_degree = (0..=3)
        .find(|&d| 3 * (sh_coefficients(d) - 1) == rest)
        .ok_or_else(|| CodecError::new(format!("{rest} f_rest properties, SH degrees 0 to 3 have 0, 9, 24 or 45")))?;
    let wanted = column_names(sh_degree).iter().map(|name| header.find(name)).collect::<Result<Vec<_>, _>>()?;
    Splats::from_columns(header.columns(&wanted)?).ok_or_else(|| CodecError::new("columns of unequal length"))
}

/// Splats as a `binary_little_endian` PLY with zero normals; each comment becomes one header line.
pub fn write(splats: &Splats, comments: &[&str]) -> Vec<u8> {
    let names = column_names(splats.sh_degree());
    let mut order: Vec<(String, Option<usize>)> = Vec::with_capacity(names.len() + 3);
    let mut put = |name: &str| order.push((name.into(), names.iter().position(|n| n == name)));
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].into_iter().for_each(&mut put);
    (0..names.len() - column::SH - 3).for_each(|k| put(&format!("f_rest_{k}")));
    ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].into_iter().for_each(&mut put);

    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {}\n", splats.len());
    order.iter().for_each(|(name, _)| header += &format!("property float {name}\n"));
    header += "end_header\n";

    let stride = 4 * order.len();
    let mut bytes = Vec::with_capacity(header.len() + stride * splats.len());
    bytes.extend_from_slice(header.as_bytes());
    bytes.resize(header.len() + stride * splats.len(), 0);
    for (block, rows) in bytes[header.len()..].chunks_mut(stride * ROWS).enumerate() {
        for (place, (_, source)) in order.iter().enumerate() {
            let Some(source) = *source else { continue };
            for (row, value) in rows.chunks_exact_mut(stride).zip(&splats.col(source)[block * ROWS..]) {
                row[4 * place..4 * place + 4].copy_from_slice(&value.to_le_bytes());
            }
        }
    }
    bytes
}

/// The texts of the header's `comment` lines; none where the bytes are no PLY. plat marks anti-aliased models with
/// `antialiased`.
pub fn comments(bytes: &[u8]) -> Vec<String> {
    Header::parse(bytes).map(|header| header.comments).unwrap_or_default()
}

/// The points of a cloud with their colours (sRGB): `x y z` of any scalar type, `red green blue` as `uchar`; points
/// without such colours are grey (128).
///
/// # Errors
/// As [`read`], or a coordinate that is not finite.
pub fn read_points(bytes: &[u8]) -> Result<(Vec<DVec3>, Vec<[u8; 3]>), CodecError> {
    let header = Header::parse(bytes)?;
    let [x, y, z] = [header.find("x")?, header.find("y")?, header.find("z")?];
    let positions = header.columns::<f64>(&[x, y, z])?;
    let points: Vec<DVec3> =
        (0..header.count).map(|i| DVec3::new(positions[0][i], positions[1][i], positions[2][i])).collect();
    if let Some(i) = points.iter().position(|p| !p.is_finite()) {
        return Err(CodecError::new(format!("vertex {i} has a coordinate that is not finite")));
    }
    let rgb: Vec<usize> = ["red", "green", "blue"].iter().filter_map(|name| header.find(name).ok()).collect();
    if rgb.len() < 3 || rgb.iter().any(|&p| header.properties[p].kind != Kind::U8) {
        return Ok((points, vec![[128; 3]; header.count]));
    }
    let rgb = header.columns::<f32>(&rgb)?;
    let colours = (0..header.count).map(|i| [rgb[0][i] as u8, rgb[1][i] as u8, rgb[2][i] as u8]).collect();
    Ok((points, colours))
}

/// The property of each of our columns, in their order.
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

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn parse(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// A number that columns can be made of.
trait Number: Copy + std::str::FromStr {
    fn from_f32(value: f32) -> Self;
    fn from_f64(value: f64) -> Self;
}

impl Number for f32 {
    fn from_f32(value: f32) -> Self {
        value
    }
    fn from_f64(value: f64) -> Self {
        value as f32
    }
}

impl Number for f64 {
    fn from_f32(value: f32) -> Self {
        value.into()
    }
    fn from_f64(value: f64) -> Self {
        value
    }
}

struct Property {
    name: String,
    kind: Kind,
    /// Bytes from the start of a binary row.
    offset: usize,
}

/// The `vertex` element, which has to be the first, and the bytes from it on.
struct Header<'a> {
    encoding: Encoding,
    comments: Vec<String>,
    count: usize,
    properties: Vec<Property>,
    /// Bytes of a binary row.
    stride: usize,
    body: &'a [u8],
}

impl<'a> Header<'a> {
    fn parse(bytes: &'a [u8]) -> Result<Self, CodecError> {
        let mut rest = bytes;
        let mut next_line = move || {
            let end = rest.iter().position(|&b| b == b'\n')?;
            let line = rest[..end].strip_suffix(b"\r").unwrap_or(&rest[..end]);
            rest = &rest[end + 1..];
            Some((line, rest))
        };
        if next_line().is_none_or(|(line, _)| line.trim_ascii_end() != b"ply") {
            return Err(CodecError::new("not a PLY: the first line is not 'ply'"));
        }
        let (mut encoding, mut count, mut elements) = (None, None, 0);
        let (mut comments, mut properties, mut stride): (_, Vec<Property>, _) = (Vec::new(), Vec::new(), 0);
        loop {
            let (line, body) = next_line().ok_or_else(|| CodecError::new("the PLY header has no end_header"))?;
            let line = String::from_utf8_lossy(line);
            let bad = || CodecError::new(format!("PLY header line {:?}", line.chars().take(80).collect::<String>()));
            let mut words = line.split_ascii_whitespace();
            match (words.next(), words.next(), words.next()) {
                (Some("format"), Some("ascii"), _) => encoding = Some(Encoding::Ascii),
                (Some("format"), Some("binary_little_endian"), _) => encoding = Some(Encoding::Little),
                (Some("format"), Some("binary_big_endian"), _) => encoding = Some(Encoding::Big),
                (Some("comment"), _, _) => {
                    let text = line.trim_start().strip_prefix("comment").unwrap_or_default();
                    comments.push(text.strip_prefix(' ').unwrap_or(text).to_owned());
                }
                (None | Some("obj_info"), _, _) => {}
                (Some("element"), Some("vertex"), Some(number)) if elements == 0 => {
                    count = Some(number.parse::<usize>().map_err(|_| bad())?);
                    elements = 1;
                }
                (Some("element"), Some(_), Some(_)) if elements > 0 => elements += 1,
                (Some("element"), Some(name), Some(_)) => {
                    return Err(CodecError::new(format!(
                        "the first element is {:?}, expected 'vertex'",
                        name.chars().take(80).collect::<String>()
                    )));
                }
                (Some("property"), Some(_), Some(_)) if elements > 1 => {}
                (Some("property"), Some(kind), Some(name)) if elements == 1 => {
                    let kind = Kind::parse(kind).ok_or_else(bad)?;
                    properties.push(Property { name: name.to_owned(), kind, offset: stride });
                    stride += kind.size();
                }
                (Some("end_header"), None, None) => {
                    let encoding = encoding.ok_or_else(|| CodecError::new("the PLY header has no format"))?;
                    let count = count.ok_or_else(|| CodecError::new("the PLY header has no vertex element"))?;
                    let header = Self { encoding, comments, count, properties, stride, body };
                    return header.check_length().map(|()| header);
                }
                _ => return Err(bad()),
            }
        }
    }

    /// The rows fit the body: nothing is allocated for a count that lies.
    fn check_length(&self) -> Result<(), CodecError> {
        let needed = match self.encoding {
            // A number takes a digit and a separator, which the last one may lack.
            Encoding::Ascii => self.count.checked_mul(2 * self.properties.len()).map(|n| n.saturating_sub(1)),
            Encoding::Little | Encoding::Big => self.count.checked_mul(self.stride),
        };
        if (self.stride == 0 && self.count > 0) || needed.is_none_or(|needed| needed > self.body.len()) {
            let (count, has) = (self.count, self.body.len());
            return Err(CodecError::new(format!("cut short: {has} bytes cannot hold {count} vertices")));
        }
        Ok(())
    }

    fn find(&self, name: &str) -> Result<usize, CodecError> {
        (self.properties.iter().position(|p| p.name == name))
            .ok_or_else(|| CodecError::new(format!("the vertex element has no property '{name}'")))
    }

    /// These properties as columns.
    fn columns<T: Number>(&self, wanted: &[usize]) -> Result<Vec<Vec<T>>, CodecError> {
        let mut columns: Vec<Vec<T>> = wanted.iter().map(|_| Vec::with_capacity(self.count)).collect();
        match self.encoding {
            Encoding::Ascii => self.ascii(wanted, &mut columns)?,
            Encoding::Little | Encoding::Big if self.count > 0 => {
                for rows in self.body[..self.count * self.stride].chunks(ROWS * self.stride) {
                    for (&property, column) in wanted.iter().zip(&mut columns) {
                        self.binary(&self.properties[property], rows, column);
                    }
                }
            }
            Encoding::Little | Encoding::Big => {}
        }
        Ok(columns)
    }

    fn binary<T: Number>(&self, property: &Property, rows: &[u8], column: &mut Vec<T>) {
        let values = rows.chunks_exact(self.stride).map(|row| &row[property.offset..]);
        macro_rules! extend {
            ($type:ty, $into:expr) => {
                column.extend(values.map(|value| {
                    let bytes = *value.first_chunk().expect("a row is as long as its properties");
                    let big = self.encoding == Encoding::Big;
                    $into(if big { <$type>::from_be_bytes(bytes) } else { <$type>::from_le_bytes(bytes) })
                }))
            };
        }
        match property.kind {
            Kind::I8 => extend!(i8, |v| T::from_f32(f32::from(v))),
            Kind::U8 => extend!(u8, |v| T::from_f32(f32::from(v))),
            Kind::I16 => extend!(i16, |v| T::from_f32(f32::from(v))),
            Kind::U16 => extend!(u16, |v| T::from_f32(f32::from(v))),
            Kind::I32 => extend!(i32, |v| T::from_f64(f64::from(v))),
            Kind::U32 => extend!(u32, |v| T::from_f64(f64::from(v))),
            Kind::F32 => extend!(f32, T::from_f32),
            Kind::F64 => extend!(f64, T::from_f64),
        }
    }

    fn ascii<T: Number>(&self, wanted: &[usize], columns: &mut [Vec<T>]) -> Result<(), CodecError> {
        let mut words = self.body.split(|b| b.is_ascii_whitespace()).filter(|word| !word.is_empty());
        let mut row: Vec<&[u8]> = Vec::with_capacity(self.properties.len());
        for i in 0..self.count {
            row.clear();
            row.extend(words.by_ref().take(self.properties.len()));
            if row.len() < self.properties.len() {
                return Err(CodecError::new(format!("cut short in vertex {i} of {}", self.count)));
            }
            for (&property, column) in wanted.iter().zip(&mut *columns) {
                let number = std::str::from_utf8(row[property]).ok().and_then(|word| word.parse().ok());
                column.push(number.ok_or_else(|| {
                    let name = &self.properties[property].name;
                    CodecError::new(format!("vertex {i}: property '{name}' is not a number"))
                })?);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
