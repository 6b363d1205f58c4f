//! Writes NumPy array files (`.npy`) in C order, and reads those of floats.
//!
//! Source: NumPy, "A simple file format for NumPy arrays" (`numpy.lib.format`).

use crate::error::CodecError;

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// An element type of arrays.
pub trait Number: Copy {
    /// NumPy's type descriptor.
    const DESCR: &'static str;

    /// Appends the value, little endian.
    fn put(self, bytes: &mut Vec<u8>);
}

macro_rules! number {
    ($($type:ty = $descr:literal),+) => {
        $(impl Number for $type {
            const DESCR: &'static str = $descr;

            fn put(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }
        })+
    };
}

number!(u8 = "|u1", u32 = "<u4", f32 = "<f4", f64 = "<f8");

/// Encodes an array of this shape (slowest axis first) as npy 1.0, with data at a multiple of 64 bytes.
///
/// # Panics
/// If the shape does not have `data.len()` elements.
pub fn write<T: Number>(shape: &[usize], data: &[T]) -> Vec<u8> {
    assert_eq!(shape.iter().product::<usize>(), data.len(), "the shape {shape:?} does not match the data");
    let axes: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let axes = if shape.len() == 1 { axes.trim_end() } else { axes.trim_end_matches(", ") };
    let mut dict = format!("{{'descr': '{}', 'fortran_order': False, 'shape': ({axes}), }}", T::DESCR);
    let unpadded = MAGIC.len() + 4 + dict.len() + 1;
    dict.extend(std::iter::repeat_n(' ', unpadded.next_multiple_of(64) - unpadded));
    dict.push('\n');
    let mut bytes = Vec::with_capacity(MAGIC.len() + 4 + dict.len() + size_of_val(data));
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[1, 0]);
    bytes.extend_from_slice(&u16::try_from(dict.len()).expect("a shape has a few axes").to_le_bytes());
    bytes.extend_from_slice(dict.as_bytes());
    data.iter().for_each(|value| value.put(&mut bytes));
    bytes
}

/// [`write`] of floats.
///
/// # Panics
/// As [`write`].
pub fn write_f32(shape: &[usize], data: &[f32]) -> Vec<u8> {
    write(shape, data)
}

/// Decodes the shape and data of an array of `<f4` (bit exact) or `<f8` (rounded to f32) in C order. NaN and infinity
/// are kept, as depth maps use them for missing values.
///
/// # Errors
/// Not npy, another element type or order, or a body that does not match the shape.
pub fn read_f32(bytes: &[u8]) -> Result<(Vec<usize>, Vec<f32>), CodecError> {
    let cut_short = || CodecError::new("the npy header is cut short");
    let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| CodecError::new("not an npy file"))?;
    let (version, rest) = rest.split_first_chunk::<2>().ok_or_else(cut_short)?;
    let (length, rest) = match version {
        [1, 0] => rest.split_first_chunk().map(|(n, rest)| (u16::from_le_bytes(*n) as usize, rest)),
        [2 | 3, 0] => rest.split_first_chunk().map(|(n, rest)| (u32::from_le_bytes(*n) as usize, rest)),
        [major, minor] => {
            return Err(CodecError::new(format!("npy version {major}.{minor}, this program reads 1 to 3")));
        }
    }
    .ok_or_else(cut_short)?;
    let (dict, body) = rest.split_at_checked(length).ok_or_else(cut_short)?;
    let dict = std::str::from_utf8(dict).map_err(|_| CodecError::new("the npy header is not text"))?;

    if !value_of(dict, "fortran_order")?.starts_with("False") {
        return Err(CodecError::new("the npy array is in Fortran order, only C order is supported"));
    }
    let descr = value_of(dict, "descr")?;
    let size = match descr.get(1..4) {
        Some("<f4") => 4,
        Some("<f8") => 8,
        _ => return Err(CodecError::new("the npy array is neither '<f4' nor '<f8'")),
    };
    let shape =
        shape(value_of(dict, "shape")?).ok_or_else(|| CodecError::new("the npy header's shape is malformed"))?;
    let needed = shape.iter().try_fold(size, |product: usize, &n| product.checked_mul(n));
    if needed != Some(body.len()) {
        return Err(CodecError::new(format!("the npy shape {shape:?} does not match {} bytes of data", body.len())));
    }
    let data = if size == 4 {
        body.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    } else {
        body.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect()
    };
    Ok((shape, data))
}

/// The text that follows `'key':` in the header's dictionary.
fn value_of<'a>(dict: &'a str, key: &str) -> Result<&'a str, CodecError> {
    (dict.find(&format!("'{key}'")))
        .and_then(|at| dict[at + key.len() + 2..].trim_start().strip_prefix(':'))
        .map(str::trim_start)
        .ok_or_else(|| CodecError::new(format!("the npy header has no '{key}'")))
}

/// A tuple of at most 64 lengths, NumPy's limit.
fn shape(text: &str) -> Option<Vec<usize>> {
    let (tuple, _) = text.strip_prefix('(')?.split_once(')')?;
    let tuple = tuple.trim();
    let axes = tuple.strip_suffix(',').unwrap_or(tuple);
    if axes.is_empty() {
        return Some(Vec::new());
    }
    let shape: Vec<usize> = axes.split(',').take(65).map(|n| n.trim().parse().ok()).collect::<Option<_>>()?;
    (shape.len() <= 64).then_some(shape)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn round_trips_bit_for_bit(rows in 0usize..5, bits in prop::collection::vec(any::<u32>(), 12)) {
            let data: Vec<f32> = bits[..rows * 2].iter().map(|&b| f32::from_bits(b)).collect();
            for shape in [vec![rows, 2], vec![rows * 2], vec![1, rows, 2, 1]] {
                let bytes = write_f32(&shape, &data);
                let header = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
                prop_assert!(header.is_multiple_of(64) && bytes.len() == header + 4 * data.len());
                let (read_shape, read) = read_f32(&bytes).unwrap();
                prop_assert_eq!(read_shape, shape);
                prop_assert!(read.iter().map(|v| v.to_bits()).eq(data.iter().map(|v| v.to_bits())));
                for end in 0..bytes.len() {
                    prop_assert!(read_f32(&bytes[..end]).is_err(), "cut at {} of {}", end, bytes.len());
                }
            }
        }

        #[test]
        fn damaged_headers_do_not_panic(at in 0usize..128, byte in any::<u8>()) {
            let mut bytes = write_f32(&[3, 2], &[1.0; 6]);
            bytes[at] = byte;
            let _ = read_f32(&bytes);
        }
    }

    fn with_dict(dict: &str, body: &[u8]) -> Vec<u8> {
        let length = (dict.len() as u16).to_le_bytes();
        [MAGIC.as_slice(), &[1, 0], &length, dict.as_bytes(), body].concat()
    }

    #[test]
    fn doubles_scalars_and_numpy_headers_are_read() {
        let body: Vec<u8> = [1.5f64, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let bytes = with_dict("{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }\n", &body);
        assert_eq!(read_f32(&bytes), Ok((vec![2], vec![1.5, -2.0])));
        assert_eq!(read_f32(&write_f32(&[], &[7.0])), Ok((vec![], vec![7.0])));
        assert_eq!(read_f32(&write(&[2, 1], &[0.1, 2.5f64])), Ok((vec![2, 1], vec![0.1, 2.5])));
        assert!(write(&[3], &[1u8, 2, 3]).ends_with(b"\n\x01\x02\x03"));
        assert!(write(&[1], &[258u32]).starts_with(b"\x93NUMPY\x01\x00v\x00{'descr': '<u4', "));
        let header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }";
        assert!(write_f32(&[1], &[0.0]).starts_with(header));
    }

    #[test]
    fn invalid_headers_are_refused() {
        for dict in [
            "{'descr': '<f4', 'fortran_order': True, 'shape': (1,), }",
            "{'descr': '>f4', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<i4', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (18446744073709551615, 2), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (4294967296, 4294967296), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1, }",
            "{'descr': '<f4', 'shape': (1,), }",
            "",
        ] {
            assert!(read_f32(&with_dict(dict, &[0; 4])).is_err(), "{dict}");
        }
    }
}
