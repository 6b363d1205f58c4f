//! The compact protocol of Thrift, in which Parquet writes its footer and the headers of its pages.
//!
//! A structure is a list of fields, each with a number and a kind, and ends with a zero byte. Integers are variable in length,
//! signed ones in zigzag order. Source: "Thrift compact protocol", `doc/specs/thrift-compact-protocol.md` in
//! github.com/apache/thrift.

use std::io::Read;

use crate::error::CodecError;

/// Kinds of values.
pub(super) const TRUE: u8 = 1;
pub(super) const FALSE: u8 = 2;
pub(super) const I32: u8 = 5;
pub(super) const I64: u8 = 6;
pub(super) const BINARY: u8 = 8;
pub(super) const LIST: u8 = 9;
pub(super) const STRUCT: u8 = 12;

/// Structures that are skipped may be nested this deep.
const MAX_DEPTH: u32 = 16;

/// Reads values from a stream of limited length.
pub(super) struct Reader<R> {
    source: R,
    left: u64,
    read: u64,
}

impl<R: Read> Reader<R> {
    /// A reader that takes this many bytes at most.
    pub(super) fn new(source: R, limit: u64) -> Self {
        Self { source, left: limit, read: 0 }
    }

    /// The number of bytes read.
    pub(super) fn position(&self) -> u64 {
        self.read
    }

    fn byte(&mut self) -> Result<u8, CodecError> {
        let mut byte = [0];
        self.exact(&mut byte)?;
        Ok(byte[0])
    }

    fn exact(&mut self, bytes: &mut [u8]) -> Result<(), CodecError> {
        let cut = || CodecError::new("has a header that is cut short or too long");
        self.left = self.left.checked_sub(bytes.len() as u64).ok_or_else(cut)?;
        self.read += bytes.len() as u64;
        self.source.read_exact(bytes).map_err(|_| cut())
    }

    fn varint(&mut self) -> Result<u64, CodecError> {
        let mut value = 0;
        for shift in (0..70).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 0x7f).checked_shl(shift).unwrap_or(0);
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(CodecError::new("has a header with a number of over 64 bits"))
    }

    /// An integer of any width.
    pub(super) fn integer(&mut self) -> Result<i64, CodecError> {
        let raw = self.varint()?;
        Ok((raw >> 1) as i64 ^ -((raw & 1) as i64))
    }

    /// Text of this many bytes at most.
    pub(super) fn text(&mut self, most: u64) -> Result<String, CodecError> {
        let length = self.varint()?;
        if length > most.min(self.left) {
            return Err(CodecError::new("has a header with a text that is cut short or too long"));
        }
        let mut bytes = vec![0; length as usize];
        self.exact(&mut bytes)?;
        String::from_utf8(bytes).map_err(|_| CodecError::new("has a header with a text that is not UTF-8"))
    }

    /// The length of a list and the kind of its values, each of which takes a byte at least.
    pub(super) fn list(&mut self) -> Result<(u64, u8), CodecError> {
        let head = self.byte()?;
        let length = if head >> 4 == 15 { self.varint()? } else { u64::from(head >> 4) };
        if length > self.left {
            return Err(CodecError::new("has a header with a list that is cut short"));
        }
        Ok((length, head & 15))
    }

    /// Calls `take` for each field, with its number and kind. It reads the value and returns true, or returns false for a field
    /// to skip.
    pub(super) fn structure(
        &mut self,
        mut take: impl FnMut(&mut Self, i64, u8) -> Result<bool, CodecError>,
    ) -> Result<(), CodecError> {
        let mut number = 0;
        while let Some(kind) = self.field(&mut number)? {
            if !take(self, number, kind)? {
                self.skip(kind, 0)?;
            }
        }
        Ok(())
    }

    /// The kind of the next field; `None` at the end of a structure.
    fn field(&mut self, number: &mut i64) -> Result<Option<u8>, CodecError> {
        let head = self.byte()?;
        if head == 0 {
            return Ok(None);
        }
        let step = i64::from(head >> 4);
        *number = if step > 0 { number.saturating_add(step) } else { self.integer()? };
        Ok(Some(head & 15))
    }

    fn skip(&mut self, kind: u8, depth: u32) -> Result<(), CodecError> {
        if depth > MAX_DEPTH {
            return Err(CodecError::new("has a header with structures nested too deep"));
        }
        match kind {
            TRUE | FALSE => {}
            3 => drop(self.byte()?),
            4..=6 => drop(self.varint()?),
            7 => self.exact(&mut [0; 8])?,
            BINARY => {
                let length = self.varint()?;
                self.skip_bytes(length)?;
            }
            LIST | 10 => {
                let (length, kind) = self.list()?;
                for _ in 0..length {
                    // A truth value is in the field's kind, but takes a byte in a list.
                    self.skip(if kind <= FALSE { 3 } else { kind }, depth + 1)?;
                }
            }
            STRUCT => {
                let mut number = 0;
                while let Some(kind) = self.field(&mut number)? {
                    self.skip(kind, depth + 1)?;
                }
            }
            _ => return Err(CodecError::new("has a header with a value of an unknown kind")),
        }
        Ok(())
    }

    fn skip_bytes(&mut self, mut length: u64) -> Result<(), CodecError> {
        let mut scratch = [0; 256];
        while length > 0 {
            let step = length.min(scratch.len() as u64) as usize;
            self.exact(&mut scratch[..step])?;
            length -= step as u64;
        }
        Ok(())
    }
}

/// Writes the fields of a structure, in ascending order.
#[derive(Default)]
pub(super) struct Fields {
    bytes: Vec<u8>,
    last: i64,
}

impl Fields {
    fn head(&mut self, number: i64, kind: u8) {
        // Numbers of Parquet's fields are at most 15 apart.
        self.bytes.push(((number - self.last) as u8) << 4 | kind);
        self.last = number;
    }

    /// A field with a 32-bit integer.
    pub(super) fn i32(mut self, number: i64, value: i32) -> Self {
        self.head(number, I32);
        push_integer(&mut self.bytes, value.into());
        self
    }

    /// A field with a 64-bit integer.
    pub(super) fn i64(mut self, number: i64, value: i64) -> Self {
        self.head(number, I64);
        push_integer(&mut self.bytes, value);
        self
    }

    /// A field with a text.
    pub(super) fn text(mut self, number: i64, text: &str) -> Self {
        self.head(number, BINARY);
        push_text(&mut self.bytes, text);
        self
    }

    /// A field with a structure.
    pub(super) fn structure(mut self, number: i64, value: Self) -> Self {
        self.head(number, STRUCT);
        self.bytes.extend(value.end());
        self
    }

    /// A field with a list of encoded values of a kind.
    pub(super) fn list(mut self, number: i64, kind: u8, values: &[Vec<u8>]) -> Self {
        self.head(number, LIST);
        self.bytes.push((values.len().min(15) as u8) << 4 | kind);
        if values.len() >= 15 {
            push_varint(&mut self.bytes, values.len() as u64);
        }
        values.iter().for_each(|value| self.bytes.extend(value));
        self
    }

    /// The structure's bytes.
    pub(super) fn end(mut self) -> Vec<u8> {
        self.bytes.push(0);
        self.bytes
    }
}

/// A value of a list: an integer.
pub(super) fn integer(value: i32) -> Vec<u8> {
    let mut bytes = Vec::new();
    push_integer(&mut bytes, value.into());
    bytes
}

/// A value of a list: a text.
pub(super) fn text(text: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    push_text(&mut bytes, text);
    bytes
}

fn push_text(bytes: &mut Vec<u8>, text: &str) {
    push_varint(bytes, text.len() as u64);
    bytes.extend(text.as_bytes());
}

fn push_integer(bytes: &mut Vec<u8>, value: i64) {
    push_varint(bytes, (value << 1 ^ value >> 63) as u64);
}

/// Appends an unsigned number of variable length.
pub(super) fn push_varint(bytes: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
}
