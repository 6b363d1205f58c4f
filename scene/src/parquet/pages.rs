//! Pages of a column: their headers, their levels, and their values as a decompressed stream.

use std::io::{self, BufReader, ErrorKind, Read, Take, copy, sink};

use super::Source;
use super::footer::{Chunk, Column};
use super::levels::levels;
use super::snappy::Snappy;
use super::thrift::{FALSE, I32, Reader, STRUCT, TRUE};
use crate::error::CodecError;

/// The largest header of a page, which may quote its smallest and largest value.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// Most values of a page with levels, each of which takes a byte then.
const MAX_SLOTS: u64 = 1 << 24;
/// Most bytes of a page's levels, of its indices, and of a dictionary that is held as a whole.
pub(super) const MAX_HELD_BYTES: u64 = 32 << 20;
/// Windows of Zstandard of up to 8 MB: those of all levels but the highest.
const ZSTD_WINDOW_LOG: u32 = 23;

/// A decompressed stream.
pub(super) type Bytes = Box<dyn Read>;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Data,
    Dictionary,
    Other,
}

/// A page.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Page {
    pub(super) kind: Kind,
    /// Where its bytes begin and end in the file.
    pub(super) start: u64,
    pub(super) end: u64,
    /// Their number, decompressed.
    unpacked: u64,
    /// Number of values, counting those that are not there.
    pub(super) slots: u64,
    pub(super) encoding: i64,
    /// In the second version of data pages, levels are not compressed: the lengths of both, and whether the values are.
    apart: Option<([u64; 2], bool)>,
}

/// The page whose header is at a place of the file, which ends at `end`.
///
/// # Errors
/// Not a header, or one that claims more than is there.
pub(super) fn page(source: &impl Source, at: u64, end: u64) -> Result<Page, CodecError> {
    let mut reader = Reader::new(reader(source, at)?, MAX_HEADER_BYTES.min(end.saturating_sub(at)));
    let (mut kind, mut unpacked, mut length, mut slots, mut encoding, mut lengths, mut packed) =
        (-1, -1, -1, -1, 0, None, true);
    reader.structure(|reader, number, field| {
        match (number, field) {
            (1, I32) => kind = reader.integer()?,
            (2, I32) => unpacked = reader.integer()?,
            (3, I32) => length = reader.integer()?,
            // The header of a data page, of a dictionary, or of a data page of the second version.
            (5 | 7 | 8, STRUCT) => reader.structure(|reader, inner, field| {
                match (number, inner, field) {
                    (_, 1, I32) => slots = reader.integer()?,
                    (5 | 7, 2, I32) | (8, 4, I32) => encoding = reader.integer()?,
                    (8, 5, I32) => lengths.get_or_insert([0; 2])[1] = reader.integer()?,
                    (8, 6, I32) => lengths.get_or_insert([0; 2])[0] = reader.integer()?,
                    (8, 7, TRUE | FALSE) => packed = field == TRUE,
                    _ => return Ok(false),
                }
                Ok(true)
            })?,
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    let start = at + reader.position();
    let wrong = || CodecError::new("has a page whose header claims more bytes than its column has, or is damaged");
    let positive = |value: i64| u64::try_from(value).map_err(|_| wrong());
    let (length, unpacked) = (positive(length)?, positive(unpacked)?);
    let end = start.checked_add(length).filter(|stop| *stop <= end).ok_or_else(wrong)?;
    let kind = match kind {
        0 | 3 => Kind::Data,
        2 => Kind::Dictionary,
        _ => Kind::Other,
    };
    let slots = if kind == Kind::Other { 0 } else { positive(slots)? };
    let apart = match lengths {
        Some([repetition, definition]) => Some(([positive(repetition)?, positive(definition)?], packed)),
        None => None,
    };
    Ok(Page { kind, start, end, unpacked, slots, encoding, apart })
}

/// Levels of a page and the stream of its values.
pub(super) struct Opened {
    /// One a slot; empty for a flat column.
    pub(super) repetition: Vec<u8>,
    /// One a slot; empty if every value is there.
    pub(super) definition: Vec<u8>,
    pub(super) values: Bytes,
}

/// Opens a page of a column's chunk.
///
/// # Errors
/// Damaged levels, or a compression that is not read.
pub(super) fn open(source: &impl Source, column: &Column, chunk: &Chunk, page: &Page) -> Result<Opened, CodecError> {
    let most = [column.max_repetition, column.max_definition];
    if page.kind == Kind::Data && page.slots > MAX_SLOTS && most != [0, 0] {
        return Err(CodecError::new(format!("has a page of {} values; {MAX_SLOTS} are read at most", page.slots)));
    }
    let mut found = [Vec::new(), Vec::new()];
    let values = match &page.apart {
        Some((lengths, packed)) => {
            let mut at = page.start;
            for ((found, most), &length) in found.iter_mut().zip(most).zip(lengths) {
                let inside = at.checked_add(length).filter(|stop| *stop <= page.end);
                let stop = inside.ok_or_else(|| CodecError::new("has a page whose levels are longer than itself"))?;
                if most > 0 {
                    let bytes = held(&mut reader(source, at)?.take(length), length)?;
                    *found = levels(bytes, most, page.slots)?;
                }
                at = stop;
            }
            let left = page.unpacked.saturating_sub(lengths.iter().fold(0, |sum, &length| sum.saturating_add(length)));
            unpacked(reader(source, at)?.take(page.end - at), if *packed { chunk.codec } else { 0 }, left)?
        }
        None => {
            let body = reader(source, page.start)?.take(page.end - page.start);
            let mut values = unpacked(body, chunk.codec, page.unpacked)?;
            if page.kind == Kind::Data {
                for (found, most) in found.iter_mut().zip(most).filter(|(_, most)| *most > 0) {
                    let mut length = [0; 4];
                    exact(&mut values, &mut length)?;
                    let length = u32::from_le_bytes(length).into();
                    *found = levels(held(&mut values, length)?, most, page.slots)?;
                }
            }
            values
        }
    };
    let [repetition, definition] = found;
    Ok(Opened { repetition, definition, values })
}

/// The next `length` bytes of a stream. Memory grows with the bytes that are there, whatever a header claims.
///
/// # Errors
/// Fewer bytes, or more than are held.
pub(super) fn held(stream: &mut dyn Read, length: u64) -> Result<Vec<u8>, CodecError> {
    if length > MAX_HELD_BYTES {
        let problem = format!("has a page with a part of {length} bytes; {MAX_HELD_BYTES} are read at most");
        return Err(CodecError::new(problem));
    }
    let mut bytes = Vec::new();
    stream.take(length).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
    if bytes.len() as u64 == length { Ok(bytes) } else { Err(ended()) }
}

/// All bytes of a stream.
///
/// # Errors
/// More than are held.
pub(super) fn rest(stream: &mut dyn Read) -> Result<Vec<u8>, CodecError> {
    let mut bytes = Vec::new();
    stream.take(MAX_HELD_BYTES + 1).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
    if bytes.len() as u64 > MAX_HELD_BYTES {
        return Err(CodecError::new(format!("has a page of over {MAX_HELD_BYTES} bytes")));
    }
    Ok(bytes)
}

/// Fills a buffer from a stream.
///
/// # Errors
/// Fewer bytes.
pub(super) fn exact(stream: &mut dyn Read, bytes: &mut [u8]) -> Result<(), CodecError> {
    stream.read_exact(bytes).map_err(|e| damaged(&e))
}

/// Passes over bytes of a stream.
///
/// # Errors
/// Fewer bytes.
pub(super) fn pass(stream: &mut dyn Read, length: u64) -> Result<(), CodecError> {
    let passed = copy(&mut stream.take(length), &mut sink()).map_err(|e| damaged(&e))?;
    if passed == length { Ok(()) } else { Err(ended()) }
}

fn ended() -> CodecError {
    CodecError::new("has a page that claims more values than it has")
}

fn damaged(error: &io::Error) -> CodecError {
    match error.kind() {
        ErrorKind::UnexpectedEof => ended(),
        _ => CodecError::new(format!("has a page that cannot be read ({error})")),
    }
}

fn reader(source: &impl Source, at: u64) -> Result<BufReader<Box<dyn Read>>, CodecError> {
    let reader = source.reader(at).map_err(|e| CodecError::new(format!("cannot be read ({e})")))?;
    Ok(BufReader::new(reader))
}

/// Decompresses a stream, of which `length` bytes are taken at most.
fn unpacked(packed: Take<BufReader<Box<dyn Read>>>, codec: i64, length: u64) -> Result<Bytes, CodecError> {
    Ok(match codec {
        0 => Box::new(packed.take(length)),
        1 => Box::new(Snappy::new(packed).take(length)),
        2 => Box::new(flate2::read::MultiGzDecoder::new(packed).take(length)),
        4 => Box::new(brotli_decompressor::Decompressor::new(packed, 1 << 14).take(length)),
        6 => {
            let mut decoder = zstd::stream::read::Decoder::new(packed).map_err(|e| damaged(&e))?;
            decoder.window_log_max(ZSTD_WINDOW_LOG).map_err(|e| damaged(&e))?;
            Box::new(decoder.take(length))
        }
        other => {
            let problem = format!(
                "has a column of compression {other}, which is not read (Snappy, gzip, Brotli and Zstandard are)"
            );
            return Err(CodecError::new(problem));
        }
    })
}
