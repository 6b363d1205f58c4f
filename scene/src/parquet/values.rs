//! The values of a page, plain or as numbers of a dictionary.

use std::io::BufReader;
use std::ops::Range;

use super::footer::{Column, Physical};
use super::levels::Hybrid;
use super::pages::{self, Bytes, Page};
use crate::error::CodecError;

/// Numbers of encodings.
pub(super) const PLAIN: i64 = 0;
pub(super) const PLAIN_DICTIONARY: i64 = 2;
pub(super) const RLE_DICTIONARY: i64 = 8;

/// A value as a page holds it.
pub(super) enum Value {
    /// Its bytes come first.
    Number([u8; 8]),
    Bytes(Vec<u8>),
}

pub(super) type Convert<'a, T> = &'a mut dyn FnMut(Physical, Value) -> Result<T, CodecError>;

pub(super) fn as_number(physical: Physical, value: Value) -> Result<f64, CodecError> {
    match (physical, value) {
        (Physical::Float, Value::Number([a, b, c, d, ..])) => Ok(f32::from_le_bytes([a, b, c, d]).into()),
        (Physical::Double, Value::Number(bytes)) => Ok(f64::from_le_bytes(bytes)),
        (physical, value) => Ok(as_integer(physical, value)? as f64),
    }
}

pub(super) fn as_integer(physical: Physical, value: Value) -> Result<i64, CodecError> {
    match (physical, value) {
        (Physical::Int32, Value::Number([a, b, c, d, ..])) => Ok(i32::from_le_bytes([a, b, c, d]).into()),
        (Physical::Int64, Value::Number(bytes)) => Ok(i64::from_le_bytes(bytes)),
        _ => Err(CodecError::new("has a column of another kind than its numbers need")),
    }
}

/// The size of a column's values, bytes; 0 for those of any length.
fn size(physical: Physical) -> usize {
    match physical {
        Physical::Int32 | Physical::Float => 4,
        Physical::Int64 | Physical::Double => 8,
        Physical::ByteArray | Physical::Other => 0,
    }
}

/// The distinct values of a chunk.
pub(super) struct Dictionary {
    bytes: Vec<u8>,
    /// Where values of any length lie.
    places: Vec<Range<usize>>,
}

impl Dictionary {
    pub(super) fn read(physical: Physical, bytes: Vec<u8>) -> Self {
        let (mut places, mut at) = (Vec::new(), 0);
        let is_text = physical == Physical::ByteArray;
        while let Some(&[a, b, c, d]) = bytes.get(at..at + 4).filter(|_| is_text) {
            let end = at + 4 + u32::from_le_bytes([a, b, c, d]) as usize;
            places.push(at + 4..end);
            at = end;
        }
        Self { bytes, places }
    }

    fn get(&self, number: usize, size: usize) -> Option<&[u8]> {
        let place = if size > 0 { number * size..(number + 1) * size } else { self.places.get(number)?.clone() };
        self.bytes.get(place)
    }
}

/// The values of a page, one after the other.
pub(super) struct Values<'a> {
    size: usize,
    stored: Stored<'a>,
}

enum Stored<'a> {
    Plain(Bytes),
    Coded(Hybrid, &'a Dictionary),
}

impl<'a> Values<'a> {
    /// Those of a page after the first `passed` ones.
    pub(super) fn new(
        column: &Column,
        page: &Page,
        mut stream: Bytes,
        dictionary: Option<&'a Dictionary>,
        passed: u64,
    ) -> Result<Self, CodecError> {
        let size = size(column.physical);
        let stored = match (page.encoding, dictionary) {
            _ if column.physical == Physical::Other => {
                return Err(at_column(&column.name, "holds values of a kind that is not read"));
            }
            (PLAIN, _) => {
                pages::pass(&mut stream, passed.saturating_mul(size as u64))?;
                Stored::Plain(Box::new(BufReader::with_capacity(1 << 16, stream)))
            }
            (PLAIN_DICTIONARY | RLE_DICTIONARY, Some(dictionary)) => {
                let mut indices = indices(stream)?;
                indices.skip(passed)?;
                Stored::Coded(indices, dictionary)
            }
            (PLAIN_DICTIONARY | RLE_DICTIONARY, None) => return Err(at_column(&column.name, "lacks its dictionary")),
            (other, _) => return Err(encoding(&column.name, other)),
        };
        Ok(Self { size, stored })
    }

    pub(super) fn next(&mut self) -> Result<Value, CodecError> {
        let mut bytes = [0; 8];
        match &mut self.stored {
            Stored::Plain(stream) if self.size > 0 => pages::exact(stream, &mut bytes[..self.size])?,
            Stored::Plain(stream) => {
                let mut length = [0; 4];
                pages::exact(stream, &mut length)?;
                return Ok(Value::Bytes(pages::held(stream, u32::from_le_bytes(length).into())?));
            }
            Stored::Coded(indices, dictionary) => {
                let value = dictionary.get(indices.next()? as usize, self.size);
                let value =
                    value.ok_or_else(|| CodecError::new("has a page that names a value that its dictionary lacks"))?;
                if self.size == 0 {
                    return Ok(Value::Bytes(value.to_vec()));
                }
                bytes[..self.size].copy_from_slice(value);
            }
        }
        Ok(Value::Number(bytes))
    }
}

/// The indices of a page: their width, then runs.
pub(super) fn indices(mut stream: Bytes) -> Result<Hybrid, CodecError> {
    let mut width = [0];
    pages::exact(&mut stream, &mut width)?;
    if width[0] > 32 {
        return Err(CodecError::new("has a page with indices of over 32 bits"));
    }
    Ok(Hybrid::new(pages::rest(&mut stream)?, width[0].into()))
}

pub(super) fn encoding(column: &str, number: i64) -> CodecError {
    at_column(column, &format!("has a page of encoding {number}, which is not read (plain ones and dictionaries are)"))
}

pub(super) fn at_column(column: &str, problem: &str) -> CodecError {
    CodecError::new(format!("column {column:.100} {problem}"))
}
