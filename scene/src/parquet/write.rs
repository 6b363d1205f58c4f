//! Writes tables: groups of rows, each column of a group in one page, plain and uncompressed.

use super::MAGIC;
use super::levels::push_run;
use super::thrift::{BINARY, Fields, I32, STRUCT, integer, text};

/// The cells of a column in a group of rows, one a row.
#[derive(Debug, Clone, PartialEq)]
pub enum Cells {
    /// 8-bit integers.
    Int8(Vec<i8>),
    /// 32-bit integers.
    Int32(Vec<i32>),
    /// 64-bit integers.
    Int64(Vec<i64>),
    /// 32-bit numbers.
    Float(Vec<f32>),
    /// 64-bit numbers.
    Double(Vec<f64>),
    /// Texts.
    Text(Vec<String>),
    /// Bytes, such as photos.
    Bytes(Vec<Vec<u8>>),
    /// Lists of 8-bit integers.
    Int8s(Vec<Vec<i8>>),
    /// Lists of 32-bit integers.
    Int32s(Vec<Vec<i32>>),
    /// Lists of 32-bit numbers.
    Floats(Vec<Vec<f32>>),
    /// Lists of 64-bit numbers.
    Doubles(Vec<Vec<f64>>),
}

/// A column as the schema has it: name, number of its physical type and of its converted one, and whether it holds lists.
type Leaf = (&'static str, i32, Option<i32>, bool);

impl Cells {
    /// The number of rows.
    pub fn rows(&self) -> usize {
        match self {
            Self::Int8(cells) => cells.len(),
            Self::Int32(cells) => cells.len(),
            Self::Int64(cells) => cells.len(),
            Self::Float(cells) => cells.len(),
            Self::Double(cells) => cells.len(),
            Self::Text(cells) => cells.len(),
            Self::Bytes(cells) => cells.len(),
            Self::Int8s(cells) => cells.len(),
            Self::Int32s(cells) => cells.len(),
            Self::Floats(cells) => cells.len(),
            Self::Doubles(cells) => cells.len(),
        }
    }

    /// Numbers of the physical and the converted type, and whether it holds lists.
    fn kind(&self) -> (i32, Option<i32>, bool) {
        let is_list = matches!(self, Self::Int8s(_) | Self::Int32s(_) | Self::Floats(_) | Self::Doubles(_));
        let (physical, converted) = match self {
            Self::Int8(_) | Self::Int8s(_) => (1, Some(15)),
            Self::Int32(_) | Self::Int32s(_) => (1, None),
            Self::Int64(_) => (2, None),
            Self::Float(_) | Self::Floats(_) => (4, None),
            Self::Double(_) | Self::Doubles(_) => (5, None),
            Self::Text(_) => (6, Some(0)),
            Self::Bytes(_) => (6, None),
        };
        (physical, converted, is_list)
    }

    /// The number of slots of its page, and the page: levels and values.
    fn page(&self) -> (usize, Vec<u8>) {
        fn flat<T, const N: usize>(cells: &[T], bytes: impl Fn(&T) -> [u8; N]) -> (usize, Vec<u8>) {
            (cells.len(), cells.iter().flat_map(bytes).collect())
        }
        fn blobs<'a>(cells: impl ExactSizeIterator<Item = &'a [u8]>) -> (usize, Vec<u8>) {
            let (count, mut page) = (cells.len(), Vec::new());
            for cell in cells {
                page.extend((cell.len() as u32).to_le_bytes());
                page.extend(cell);
            }
            (count, page)
        }
        fn lists<T, const N: usize>(cells: &[Vec<T>], bytes: impl Fn(&T) -> [u8; N]) -> (usize, Vec<u8>) {
            let [mut repetition, mut definition] = [Vec::new(), Vec::new()];
            for cell in cells {
                push_run(&mut repetition, false, 1);
                push_run(&mut repetition, true, cell.len().saturating_sub(1));
                push_run(&mut definition, !cell.is_empty(), cell.len().max(1));
            }
            let mut page = Vec::new();
            for levels in [repetition, definition] {
                page.extend((levels.len() as u32).to_le_bytes());
                page.extend(levels);
            }
            page.extend(cells.iter().flatten().flat_map(bytes));
            (cells.iter().map(|cell| cell.len().max(1)).sum(), page)
        }
        match self {
            Self::Int8(cells) => flat(cells, |v| i32::from(*v).to_le_bytes()),
            Self::Int32(cells) => flat(cells, |v| v.to_le_bytes()),
            Self::Int64(cells) => flat(cells, |v| v.to_le_bytes()),
            Self::Float(cells) => flat(cells, |v| v.to_le_bytes()),
            Self::Double(cells) => flat(cells, |v| v.to_le_bytes()),
            Self::Text(cells) => blobs(cells.iter().map(String::as_bytes)),
            Self::Bytes(cells) => blobs(cells.iter().map(Vec::as_slice)),
            Self::Int8s(cells) => lists(cells, |v| i32::from(*v).to_le_bytes()),
            Self::Int32s(cells) => lists(cells, |v| v.to_le_bytes()),
            Self::Floats(cells) => lists(cells, |v| v.to_le_bytes()),
            Self::Doubles(cells) => lists(cells, |v| v.to_le_bytes()),
        }
    }
}

/// Writes a table group by group: the bytes that it returns, one after the other, are the file.
#[derive(Debug, Default)]
pub struct Writer {
    columns: Vec<Leaf>,
    /// Encoded metadata of the groups.
    groups: Vec<Vec<u8>>,
    /// Bytes returned so far.
    length: u64,
    rows: usize,
}

impl Writer {
    /// The bytes of a group of rows. Groups have the same columns, and their columns the same number of rows; a column of a group
    /// takes less than 2 GB.
    ///
    /// # Panics
    /// Other columns or rows.
    pub fn group(&mut self, columns: Vec<(&'static str, Cells)>) -> Vec<u8> {
        let leaf = |(name, cells): &(&'static str, Cells)| {
            let (physical, converted, is_list) = cells.kind();
            (*name, physical, converted, is_list)
        };
        let leaves: Vec<Leaf> = columns.iter().map(leaf).collect();
        let mut bytes = if self.length == 0 { MAGIC.to_vec() } else { Vec::new() };
        if self.columns.is_empty() {
            self.columns.clone_from(&leaves);
        }
        assert_eq!(self.columns, leaves, "groups have the same columns");
        let rows = columns.first().map_or(0, |(_, cells)| cells.rows());
        assert!(columns.iter().all(|(_, cells)| cells.rows() == rows), "columns have the same number of rows");
        let (mut chunks, mut total) = (Vec::new(), 0);
        for ((_, cells), leaf) in columns.iter().zip(&leaves) {
            let start = self.length + bytes.len() as u64;
            let (slots, page) = cells.page();
            let length = i32::try_from(page.len()).expect("a column of a group takes less than 2 GB");
            let head = Fields::default().i32(1, slots as i32).i32(2, 0).i32(3, 3).i32(4, 3);
            bytes.extend(Fields::default().i32(1, 0).i32(2, length).i32(3, length).structure(5, head).end());
            bytes.extend(page);
            let size = (self.length + bytes.len() as u64 - start) as i64;
            chunks.push(chunk(leaf, slots, start as i64, size));
            total += size;
        }
        let group = Fields::default().list(1, STRUCT, &chunks).i64(2, total).i64(3, rows as i64);
        self.groups.push(group.end());
        self.rows += rows;
        self.length += bytes.len() as u64;
        bytes
    }

    /// The footer's bytes.
    pub fn finish(self) -> Vec<u8> {
        let mut schema = vec![Fields::default().text(4, "schema").i32(5, self.columns.len() as i32).end()];
        for &(name, physical, converted, is_list) in &self.columns {
            let name = if is_list {
                schema.push(Fields::default().i32(3, 0).text(4, name).i32(5, 1).i32(6, 3).end());
                schema.push(Fields::default().i32(3, 2).text(4, "list").i32(5, 1).end());
                "element"
            } else {
                name
            };
            let mut leaf = Fields::default().i32(1, physical).i32(3, 0).text(4, name);
            if let Some(converted) = converted {
                leaf = leaf.i32(6, converted);
            }
            schema.push(leaf.end());
        }
        let footer = Fields::default().i32(1, 1).list(2, STRUCT, &schema).i64(3, self.rows as i64);
        let footer = footer.list(4, STRUCT, &self.groups).text(6, "plat").end();
        let mut bytes = if self.length == 0 { MAGIC.to_vec() } else { Vec::new() };
        bytes.extend(&footer);
        bytes.extend((footer.len() as u32).to_le_bytes());
        bytes.extend(MAGIC);
        bytes
    }
}

/// The metadata of a column's chunk.
fn chunk(&(name, physical, _, is_list): &Leaf, slots: usize, start: i64, size: i64) -> Vec<u8> {
    let encodings = [0, 3].map(integer);
    let path: Vec<Vec<u8>> =
        [name, "list", "element"][..if is_list { 3 } else { 1 }].iter().map(|name| text(name)).collect();
    let data = Fields::default()
        .i32(1, physical)
        .list(2, I32, &encodings)
        .list(3, BINARY, &path)
        .i32(4, 0)
        .i64(5, slots as i64)
        .i64(6, size)
        .i64(7, size)
        .i64(9, start);
    Fields::default().i64(2, start).structure(3, data).end()
}
