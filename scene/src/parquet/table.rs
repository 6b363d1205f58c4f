//! The values of a table: of whole columns, or of single rows.

use std::io::{BufReader, Read};
use std::ops::Range;

use super::footer::{Chunk, Column, Footer, MAX_FOOTER_BYTES, Physical};
use super::pages::{self, Bytes, Kind, Opened, Page};
use super::values::{
    Convert, Dictionary, PLAIN, PLAIN_DICTIONARY, RLE_DICTIONARY, Value, Values, as_integer, as_number, at_column,
    encoding, indices,
};
use super::{MAGIC, Source};
use crate::error::CodecError;

/// Most values of a column that is read as a whole, and of a row.
const MAX_VALUES: u64 = 1 << 22;
/// Most bytes of the texts of a column that is read as a whole.
const MAX_TEXT_BYTES: usize = 64 << 20;

/// An open table.
pub struct Table<S> {
    source: S,
    footer: Footer,
    /// The stream that the last value of [`Self::bytes`] came from.
    last: Option<Stream>,
}

/// Values with their lengths, in the order of a page.
struct Stream {
    /// Start of the page.
    page: u64,
    values: Bytes,
    /// Number of the next value.
    next: u64,
}

/// A page of a chunk with the slots that it holds, counted from the start of the chunk.
struct Located {
    page: Page,
    slots: Range<u64>,
}

impl<S: Source> Table<S> {
    /// Opens a table: reads its footer.
    ///
    /// # Errors
    /// Not a Parquet file, or a damaged one.
    pub fn open(source: S) -> Result<Self, CodecError> {
        let length = source.length();
        let other = || CodecError::new("is not a Parquet file, or is cut short");
        let read = |at: u64, bytes: &mut [u8]| -> Result<(), CodecError> {
            let mut reader = source.reader(at).map_err(|e| CodecError::new(format!("cannot be read ({e})")))?;
            reader.read_exact(bytes).map_err(|_| other())
        };
        let (mut head, mut tail) = ([0; 4], [0; 8]);
        let tail_at = length.checked_sub(8).filter(|at| *at >= 4).ok_or_else(other)?;
        read(0, &mut head)?;
        read(tail_at, &mut tail)?;
        let [a, b, c, d, magic @ ..] = tail;
        if &head != MAGIC || &magic != MAGIC {
            return Err(other());
        }
        let footer_length = u64::from(u32::from_le_bytes([a, b, c, d]));
        let at = tail_at.checked_sub(footer_length).filter(|at| *at >= 4 && footer_length <= MAX_FOOTER_BYTES);
        let at = at.ok_or_else(|| CodecError::new("has a footer that is longer than the file, or too long"))?;
        let reader = source.reader(at).map_err(|e| CodecError::new(format!("cannot be read ({e})")))?;
        let footer = Footer::read(BufReader::new(reader.take(footer_length)), at)?;
        Ok(Self { source, footer, last: None })
    }

    /// The number of rows.
    pub fn rows(&self) -> u64 {
        self.footer.groups.iter().map(|group| group.rows).sum()
    }

    /// Whether the table has a column.
    pub fn has(&self, column: &str) -> bool {
        self.footer.columns.iter().any(|other| other.name == column)
    }

    /// All values of a flat column of integers.
    ///
    /// # Errors
    /// No such column, another kind, a value that is not there, or a damaged page.
    pub fn integers(&self, column: &str) -> Result<Vec<i64>, CodecError> {
        self.flat(column, &mut as_integer)
    }

    /// All values of a flat column of numbers.
    ///
    /// # Errors
    /// As [`integers`](Self::integers).
    pub fn numbers(&self, column: &str) -> Result<Vec<f64>, CodecError> {
        self.flat(column, &mut as_number)
    }

    /// The numbers of each row of a column of lists. A row without a list has none.
    ///
    /// # Errors
    /// As [`integers`](Self::integers).
    pub fn lists(&self, column: &str) -> Result<Vec<Vec<f64>>, CodecError> {
        let (at, found) = self.whole(column)?;
        let mut rows: Vec<Vec<f64>> = Vec::new();
        for group in 0..self.footer.groups.len() {
            let before = rows.len() as u64;
            let slots = 0..self.chunk(at, group).slots;
            self.slots(found, at, group, slots, &mut as_number, &mut |is_first, value| {
                if is_first {
                    rows.push(Vec::new());
                }
                let row = rows.last_mut().ok_or_else(|| at_column(column, "begins in the middle of a list"))?;
                row.extend(value);
                Ok(())
            })?;
            self.check_rows(column, group, rows.len() as u64 - before)?;
        }
        Ok(rows)
    }

    /// The numbers of a row of a column of lists. `lengths` are those of the lists of all rows, which tell where the list begins:
    /// pages before it are passed over.
    ///
    /// # Errors
    /// As [`integers`](Self::integers); a list of another length, or no such row.
    pub fn list(&self, column: &str, row: u64, lengths: &[u32]) -> Result<Vec<f32>, CodecError> {
        let (at, found) = self.column(column)?;
        let (group, rows) = self.group_of(row)?;
        let slots = |length: &u32| u64::from(*length).max(1);
        let before = lengths.get(rows.start as usize..row as usize);
        let (before, length) = before.zip(lengths.get(row as usize)).ok_or_else(no_row)?;
        let start: u64 = before.iter().map(slots).sum();
        let mut values = Vec::new();
        let mut seen = 0;
        let other = || at_column(column, &format!("has in row {row} a list of another length than {length}"));
        // One slot more, if there is one, has to begin the next list.
        let end = (start + slots(length) + 1).min(self.chunk(at, group).slots);
        self.slots(found, at, group, start..end, &mut as_number, &mut |is_first, value| {
            let is_new = seen == 0 || seen == slots(length);
            seen += 1;
            if is_first != is_new {
                return Err(other());
            }
            values.extend(value.filter(|_| seen <= slots(length)).map(|value| value as f32));
            Ok(())
        })?;
        if seen < slots(length) || values.len() != *length as usize { Err(other()) } else { Ok(values) }
    }

    /// All texts of a flat column.
    ///
    /// # Errors
    /// As [`integers`](Self::integers); texts that are not UTF-8, or too many.
    pub fn texts(&self, column: &str) -> Result<Vec<String>, CodecError> {
        let mut left = MAX_TEXT_BYTES;
        self.flat(column, &mut |_, value| {
            let Value::Bytes(bytes) = value else { return Err(at_column(column, "holds numbers instead of texts")) };
            left = left.checked_sub(bytes.len()).ok_or_else(|| at_column(column, "has too many texts"))?;
            String::from_utf8(bytes).map_err(|_| at_column(column, "has a text that is not UTF-8"))
        })
    }

    /// The bytes of a row of a flat column, `limit` at most. Rows in ascending order are read in one pass; only the value is held.
    ///
    /// # Errors
    /// As [`integers`](Self::integers); no such row, or a longer value.
    pub fn bytes(&mut self, column: &str, row: u64, limit: u64) -> Result<Vec<u8>, CodecError> {
        let (at, found) = self.column(column)?;
        if found.physical != Physical::ByteArray || found.max_repetition > 0 {
            return Err(at_column(column, "does not hold bytes"));
        }
        let (group, rows) = self.group_of(row)?;
        let (chunk, slot) = (self.chunk(at, group), row - rows.start);
        let (mut dictionary, mut place) = (None, None);
        self.walk(column, chunk, &mut |located| {
            match located.page.kind {
                Kind::Dictionary => dictionary = Some(located.page),
                _ if located.slots.contains(&slot) => place = Some((located.page, slot - located.slots.start)),
                _ => return Ok(located.slots.end <= slot),
            }
            Ok(place.is_none())
        })?;
        let (page, slot) = place.ok_or_else(no_row)?;
        let opened = pages::open(&self.source, found, chunk, &page)?;
        if opened.definition.get(slot as usize).is_some_and(|&level| level < found.max_definition) {
            return Err(at_column(column, &format!("has no value in row {row}")));
        }
        let number = match opened.definition.get(..slot as usize) {
            Some(before) => before.iter().filter(|&&level| level == found.max_definition).count() as u64,
            None => slot,
        };
        let (from, number) = match page.encoding {
            PLAIN => (Stream { page: page.start, values: opened.values, next: 0 }, number),
            PLAIN_DICTIONARY | RLE_DICTIONARY => {
                let page = dictionary.ok_or_else(|| at_column(column, "lacks its dictionary"))?;
                let mut indices = indices(opened.values)?;
                indices.skip(number)?;
                let number = u64::from(indices.next()?);
                if number >= page.slots {
                    return Err(at_column(column, "names a value that its dictionary lacks"));
                }
                let values = pages::open(&self.source, found, chunk, &page)?.values;
                (Stream { page: page.start, values, next: 0 }, number)
            }
            other => return Err(encoding(column, other)),
        };
        // The stream of the row before goes on.
        let last = self.last.take().filter(|last| last.page == from.page && last.next <= number);
        let mut stream = last.unwrap_or(from);
        let value = loop {
            let mut length = [0; 4];
            pages::exact(&mut stream.values, &mut length)?;
            let length = u64::from(u32::from_le_bytes(length));
            stream.next += 1;
            if stream.next > number {
                if length > limit {
                    return Err(at_column(
                        column,
                        &format!("has in row {row} a value of {length} bytes, over {limit}"),
                    ));
                }
                break pages::held(&mut stream.values, length)?;
            }
            pages::pass(&mut stream.values, length)?;
        };
        self.last = Some(stream);
        Ok(value)
    }

    fn column(&self, name: &str) -> Result<(usize, &Column), CodecError> {
        let at = self.footer.columns.iter().position(|column| column.name == name);
        let at = at.ok_or_else(|| CodecError::new(format!("has no column {name}")))?;
        Ok((at, &self.footer.columns[at]))
    }

    /// A column that is small enough to be read as a whole.
    fn whole(&self, name: &str) -> Result<(usize, &Column), CodecError> {
        let (at, column) = self.column(name)?;
        let slots = self.footer.groups.iter().fold(0u64, |sum, group| sum.saturating_add(group.chunks[at].slots));
        let problem = || at_column(name, &format!("has {slots} values; {MAX_VALUES} are read at most"));
        if slots <= MAX_VALUES { Ok((at, column)) } else { Err(problem()) }
    }

    fn chunk(&self, column: usize, group: usize) -> &Chunk {
        &self.footer.groups[group].chunks[column]
    }

    /// The group of a row, and its rows.
    fn group_of(&self, row: u64) -> Result<(usize, Range<u64>), CodecError> {
        let mut start = 0;
        for (i, group) in self.footer.groups.iter().enumerate() {
            if row < start + group.rows {
                return Ok((i, start..start + group.rows));
            }
            start += group.rows;
        }
        Err(no_row())
    }

    fn check_rows(&self, column: &str, group: usize, rows: u64) -> Result<(), CodecError> {
        let told = self.footer.groups[group].rows;
        let problem = || at_column(column, &format!("has {rows} rows where its footer says {told}"));
        if rows == told { Ok(()) } else { Err(problem()) }
    }

    fn flat<T>(&self, column: &str, convert: Convert<T>) -> Result<Vec<T>, CodecError> {
        let (at, found) = self.whole(column)?;
        if found.max_repetition > 0 {
            return Err(at_column(column, "holds lists"));
        }
        let mut values = Vec::new();
        for group in 0..self.footer.groups.len() {
            let before = values.len();
            let slots = 0..self.chunk(at, group).slots;
            self.slots(found, at, group, slots, convert, &mut |_, value| {
                values.push(value.ok_or_else(|| at_column(column, "has a row without a value"))?);
                Ok(())
            })?;
            self.check_rows(column, group, (values.len() - before) as u64)?;
        }
        Ok(values)
    }

    /// Calls `take` for the slots of a group: whether a row begins there, and the value, if there is one.
    fn slots<T>(
        &self,
        column: &Column,
        at: usize,
        group: usize,
        slots: Range<u64>,
        convert: Convert<T>,
        take: &mut dyn FnMut(bool, Option<T>) -> Result<(), CodecError>,
    ) -> Result<(), CodecError> {
        let (name, chunk) = (&column.name, self.chunk(at, group));
        if slots.end.saturating_sub(slots.start) > MAX_VALUES {
            return Err(at_column(name, &format!("has too many values; {MAX_VALUES} are read at most")));
        }
        if column.max_repetition > 1 {
            return Err(at_column(name, "holds lists of lists"));
        }
        let mut dictionary = None;
        self.walk(name, chunk, &mut |located| {
            let Located { page, slots: held } = located;
            if page.kind == Kind::Dictionary {
                let mut opened = pages::open(&self.source, column, chunk, &page)?;
                dictionary = Some(Dictionary::read(column.physical, pages::rest(&mut opened.values)?));
                return Ok(true);
            }
            let wanted = slots.start.max(held.start)..slots.end.min(held.end);
            if wanted.start < wanted.end {
                let Opened { repetition, definition, values } = pages::open(&self.source, column, chunk, &page)?;
                let [from, to] = [wanted.start, wanted.end].map(|slot| slot - held.start);
                let is_there =
                    |slot: u64| definition.get(slot as usize).is_none_or(|&level| level == column.max_definition);
                let passed =
                    if definition.is_empty() { from } else { (0..from).filter(|&slot| is_there(slot)).count() as u64 };
                let mut values = Values::new(column, &page, values, dictionary.as_ref(), passed)?;
                for slot in from..to {
                    let value = is_there(slot)
                        .then(|| values.next().and_then(|value| convert(column.physical, value)))
                        .transpose()?;
                    take(repetition.get(slot as usize).is_none_or(|&level| level == 0), value)?;
                }
            }
            Ok(held.end < slots.end)
        })
    }

    /// Calls `visit` for the pages of a chunk until it returns false or all values are there.
    fn walk(
        &self,
        column: &str,
        chunk: &Chunk,
        visit: &mut dyn FnMut(Located) -> Result<bool, CodecError>,
    ) -> Result<(), CodecError> {
        let (mut at, mut slots) = (chunk.start, 0u64);
        while slots < chunk.slots {
            if at >= chunk.end {
                return Err(at_column(column, "has fewer values than its footer claims"));
            }
            let page = pages::page(&self.source, at, chunk.end)?;
            at = page.end;
            if page.kind == Kind::Other {
                continue;
            }
            let end = if page.kind == Kind::Data { slots.saturating_add(page.slots) } else { slots };
            if end > chunk.slots {
                return Err(at_column(column, "has a page that claims more values than its footer"));
            }
            if !visit(Located { page, slots: slots..end })? {
                return Ok(());
            }
            slots = end;
        }
        Ok(())
    }
}

fn no_row() -> CodecError {
    CodecError::new("lacks a row that was asked for")
}
