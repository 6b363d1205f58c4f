//! The footer of a Parquet file: its columns, and where their chunks lie.
//!
//! Source: `src/main/thrift/parquet.thrift` in github.com/apache/parquet-format.

use std::io::Read;

use super::thrift::{BINARY, I32, I64, LIST, Reader, STRUCT};
use crate::error::CodecError;

/// The largest footer, bytes.
pub(super) const MAX_FOOTER_BYTES: u64 = 16 << 20;
/// Most groups of rows, each with a chunk for each column.
const MAX_CHUNKS: usize = 1 << 18;
/// Most elements of the schema.
const MAX_ELEMENTS: u64 = 1 << 12;
/// Longest name of a column, bytes.
const MAX_NAME_BYTES: u64 = 1 << 10;
/// Most rows of a file.
const MAX_ROWS: u64 = 1 << 32;

/// How a column holds its values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Physical {
    Int32,
    Int64,
    Float,
    Double,
    ByteArray,
    /// Another one, which is not read.
    Other,
}

impl Physical {
    fn of(number: i64) -> Self {
        match number {
            1 => Self::Int32,
            2 => Self::Int64,
            4 => Self::Float,
            5 => Self::Double,
            6 => Self::ByteArray,
            _ => Self::Other,
        }
    }
}

/// A column. Waymo's are flat or lists of numbers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Column {
    /// Its name, which may contain dots.
    pub(super) name: String,
    pub(super) physical: Physical,
    /// The definition level of a value that is there.
    pub(super) max_definition: u8,
    /// 0 for a flat column, 1 for a list.
    pub(super) max_repetition: u8,
}

/// Where a column's values of a group of rows lie.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Chunk {
    /// The first page.
    pub(super) start: u64,
    /// The end of the last page.
    pub(super) end: u64,
    /// Number of its compression.
    pub(super) codec: i64,
    /// Number of values, counting those that are not there.
    pub(super) slots: u64,
}

/// A group of rows.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Group {
    pub(super) rows: u64,
    /// One for each column.
    pub(super) chunks: Vec<Chunk>,
}

/// The footer.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Footer {
    pub(super) columns: Vec<Column>,
    pub(super) groups: Vec<Group>,
}

impl Footer {
    /// Reads the footer of a file whose pages end before `data_end`.
    ///
    /// # Errors
    /// Not a footer, chunks outside of the file, or numbers out of range.
    pub(super) fn read(source: impl Read, data_end: u64) -> Result<Self, CodecError> {
        let mut reader = Reader::new(source, MAX_FOOTER_BYTES);
        let (mut elements, mut groups, mut rows) = (Vec::new(), Vec::new(), None);
        reader.structure(|reader, number, kind| {
            match (number, kind) {
                (2, LIST) => {
                    for _ in 0..structures(reader, MAX_ELEMENTS)? {
                        elements.push(Element::read(reader)?);
                    }
                }
                (3, I64) => rows = Some(reader.integer()?),
                (4, LIST) => {
                    let count = structures(reader, MAX_CHUNKS as u64)?;
                    let mut chunks = 0;
                    for _ in 0..count {
                        let group = group(reader, data_end)?;
                        chunks += group.chunks.len() + 1;
                        if chunks > MAX_CHUNKS {
                            return Err(CodecError::new("has too many groups of rows"));
                        }
                        groups.push(group);
                    }
                }
                _ => return Ok(false),
            }
            Ok(true)
        })?;
        let columns = columns(&elements)?;
        if groups.iter().any(|group| group.chunks.len() != columns.len()) {
            return Err(CodecError::new("has a group of rows that lacks columns"));
        }
        let sum: u64 = groups.iter().map(|group| group.rows).fold(0, u64::saturating_add);
        if rows != i64::try_from(sum).ok() || sum > MAX_ROWS {
            return Err(CodecError::new("has a footer whose numbers of rows disagree or are out of range"));
        }
        Ok(Self { columns, groups })
    }
}

/// The length of a list of structures.
fn structures<R: Read>(reader: &mut Reader<R>, most: u64) -> Result<u64, CodecError> {
    match reader.list()? {
        (0, _) => Ok(0),
        (length, STRUCT) if length <= most => Ok(length),
        _ => Err(CodecError::new("has a footer with a list that is too long or of another kind")),
    }
}

/// An element of the schema, a tree in depth-first order.
#[derive(Default)]
struct Element {
    name: String,
    /// `None` for a group.
    physical: Option<Physical>,
    /// 0 required, 1 optional, 2 repeated.
    repetition: i64,
    children: i64,
}

impl Element {
    fn read<R: Read>(reader: &mut Reader<R>) -> Result<Self, CodecError> {
        let mut element = Self::default();
        reader.structure(|reader, number, kind| {
            match (number, kind) {
                (1, I32) => element.physical = Some(Physical::of(reader.integer()?)),
                (3, I32) => element.repetition = reader.integer()?,
                (4, BINARY) => element.name = reader.text(MAX_NAME_BYTES)?,
                (5, I32) => element.children = reader.integer()?,
                _ => return Ok(false),
            }
            Ok(true)
        })?;
        Ok(element)
    }
}

/// The leaves of the schema.
fn columns(elements: &[Element]) -> Result<Vec<Column>, CodecError> {
    let wrong = || CodecError::new("has a schema that is not a tree of columns");
    let (root, rest) = elements.split_first().ok_or_else(wrong)?;
    let mut columns = Vec::new();
    // Groups that are open: their children to come, levels, and the name of the column that they belong to.
    let mut open: Vec<(i64, u8, u8, String)> = vec![(root.children, 0, 0, String::new())];
    for element in rest {
        while open.last().is_some_and(|(left, ..)| *left <= 0) {
            open.pop();
        }
        let is_top = open.len() == 1;
        let (left, definition, repetition, name) = open.last_mut().ok_or_else(wrong)?;
        *left -= 1;
        let name = if is_top { element.name.clone() } else { name.clone() };
        let (max_definition, max_repetition) = match element.repetition {
            0 => (*definition, *repetition),
            1 => (*definition + 1, *repetition),
            2 => (*definition + 1, *repetition + 1),
            _ => return Err(wrong()),
        };
        match element.physical {
            Some(physical) => columns.push(Column { name, physical, max_definition, max_repetition }),
            None if open.len() <= 8 => open.push((element.children, max_definition, max_repetition, name)),
            None => return Err(wrong()),
        }
    }
    if open.iter().any(|(left, ..)| *left > 0) { Err(wrong()) } else { Ok(columns) }
}

fn group<R: Read>(reader: &mut Reader<R>, data_end: u64) -> Result<Group, CodecError> {
    let mut group = Group { rows: 0, chunks: Vec::new() };
    reader.structure(|reader, number, kind| {
        match (number, kind) {
            (1, LIST) => {
                for _ in 0..structures(reader, MAX_ELEMENTS)? {
                    group.chunks.push(chunk(reader, data_end)?);
                }
            }
            (3, I64) => {
                let wrong = |_| CodecError::new("has a group of rows whose number of rows is out of range");
                group.rows = u64::try_from(reader.integer()?).map_err(wrong)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    Ok(group)
}

fn chunk<R: Read>(reader: &mut Reader<R>, data_end: u64) -> Result<Chunk, CodecError> {
    let (mut codec, mut slots, mut length, mut data, mut dictionary) = (0, -1, -1, -1, None);
    reader.structure(|reader, number, kind| {
        if (number, kind) != (3, STRUCT) {
            return Ok(false);
        }
        reader.structure(|reader, number, kind| {
            let field = match (number, kind) {
                (4, I32) => &mut codec,
                (5, I64) => &mut slots,
                (7, I64) => &mut length,
                (9, I64) => &mut data,
                (11, I64) => dictionary.get_or_insert(0),
                _ => return Ok(false),
            };
            *field = reader.integer()?;
            Ok(true)
        })?;
        Ok(true)
    })?;
    // Some writers give 0 where there is no dictionary.
    let start = dictionary.filter(|&at| at > 0 && at < data).unwrap_or(data);
    let range = u64::try_from(start).ok().zip(u64::try_from(length).ok());
    let inside = range.and_then(|(start, length)| Some((start, start.checked_add(length)?)));
    match (inside, u64::try_from(slots)) {
        (Some((start, end)), Ok(slots)) if end <= data_end => Ok(Chunk { start, end, codec, slots }),
        _ => Err(CodecError::new("has a footer with a column that lies outside of the file")),
    }
}
