//! Parses PLY headers and reads elements as columns.

use crate::error::CodecError;

/// Rows transposed at a time: few enough to stay in cache, enough for long runs in each column.
const ROWS: usize = 256;
/// Largest number of declared elements.
const MAX_ELEMENTS: usize = 64;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

/// A scalar type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Kind {
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

/// A scalar type of columns.
pub(super) trait Number: Copy + std::str::FromStr {
    fn from_f32(value: f32) -> Self;
    fn from_f64(value: f64) -> Self;
    fn from_u32(value: u32) -> Self;
}

macro_rules! number {
    ($type:ty) => {
        impl Number for $type {
            fn from_f32(value: f32) -> Self {
                value as $type
            }
            fn from_f64(value: f64) -> Self {
                value as $type
            }
            fn from_u32(value: u32) -> Self {
                value as $type
            }
        }
    };
}
number!(f32);
number!(f64);
number!(u32);

pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
    /// Bytes from the start of a binary row.
    offset: usize,
}

struct ElementDeclaration {
    name: String,
    count: usize,
    properties: Vec<Property>,
    /// Bytes of a binary row.
    stride: usize,
    /// True without list properties: all rows have the same length.
    regular: bool,
}

/// A header and the bytes that follow it.
pub(super) struct Header<'a> {
    encoding: Encoding,
    pub(super) comments: Vec<String>,
    elements: Vec<ElementDeclaration>,
    body: &'a [u8],
}

/// An element whose rows were checked to fit the body.
pub(super) struct Element<'a> {
    name: &'a str,
    encoding: Encoding,
    /// The number of rows.
    pub(super) count: usize,
    pub(super) properties: &'a [Property],
    stride: usize,
    /// Bytes from the first row on.
    body: &'a [u8],
}

impl<'a> Header<'a> {
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Self, CodecError> {
        let mut body = bytes;
        let mut next_line = || {
            let end = body.iter().position(|&b| b == b'\n')?;
            let line = &body[..end];
            body = &body[end + 1..];
            Some((line.strip_suffix(b"\r").unwrap_or(line), body))
        };
        match next_line() {
            Some((b"ply", _)) => {}
            _ => return Err(CodecError::new("not a PLY: it does not begin with the line 'ply'")),
        }
        let (mut encoding, mut comments, mut elements) = (None, Vec::new(), Vec::<ElementDeclaration>::new());
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
                (Some("element"), Some(name), Some(number)) if elements.len() < MAX_ELEMENTS => {
                    let count = number.parse().map_err(|_| bad())?;
                    let name = name.to_owned();
                    elements.push(ElementDeclaration { name, count, properties: Vec::new(), stride: 0, regular: true });
                }
                (Some("property"), Some(kind), Some(name)) => {
                    let element = elements.last_mut().ok_or_else(bad)?;
                    match Kind::parse(kind) {
                        Some(kind) => {
                            element.properties.push(Property { name: name.to_owned(), kind, offset: element.stride });
                            element.stride += kind.size();
                        }
                        None if kind == "list" => element.regular = false,
                        None => return Err(bad()),
                    }
                }
                (Some("end_header"), None, None) => {
                    let encoding = encoding.ok_or_else(|| CodecError::new("the PLY header has no format"))?;
                    return Ok(Self { encoding, comments, elements, body });
                }
                _ => return Err(bad()),
            }
        }
    }

    /// The `vertex` element, which has to be the first.
    pub(super) fn vertices(&self) -> Result<Element<'_>, CodecError> {
        match self.elements.first() {
            None => Err(CodecError::new("the PLY header has no vertex element")),
            Some(first) if first.name == "vertex" => self.element("vertex"),
            Some(first) => Err(CodecError::new(format!(
                "the first element is {:?}, expected 'vertex'",
                first.name.chars().take(80).collect::<String>()
            ))),
        }
    }

    /// True if the header declares this element with this property.
    pub(super) fn declares(&self, element: &str, property: &str) -> bool {
        let element = self.elements.iter().find(|e| e.name == element);
        element.is_some_and(|e| e.properties.iter().any(|p| p.name == property))
    }

    /// True if the header declares this element.
    pub(super) fn has(&self, element: &str) -> bool {
        self.elements.iter().any(|e| e.name == element)
    }

    /// The element of this name. Checks that its rows fit the body before anything is allocated. In a text PLY only the
    /// first element can be read.
    pub(super) fn element(&self, name: &str) -> Result<Element<'_>, CodecError> {
        let mut body = self.body;
        for element in &self.elements {
            if !element.regular {
                return Err(CodecError::new(format!("element '{name}' has a list, or one comes before it")));
            }
            let ElementDeclaration { count, properties, stride, .. } = element;
            let needed = match self.encoding {
                // A number takes at least a digit and a separator, which the last one may lack.
                Encoding::Ascii => count.checked_mul(2 * properties.len()).map(|n| n.saturating_sub(1)),
                Encoding::Little | Encoding::Big => count.checked_mul(*stride),
            };
            let Some(needed) = needed.filter(|&n| n <= body.len() && (*stride > 0 || *count == 0)) else {
                let has = body.len();
                let what = if element.name == "vertex" { "vertices" } else { "rows" };
                return Err(CodecError::new(format!("cut short: {has} bytes cannot hold {count} {what}")));
            };
            if element.name == name {
                let (encoding, count, stride) = (self.encoding, *count, *stride);
                return Ok(Element { name: &element.name, encoding, count, properties, stride, body });
            }
            if self.encoding == Encoding::Ascii {
                return Err(CodecError::new(format!("element '{name}' is not the first of a PLY in text")));
            }
            body = &body[needed..];
        }
        Err(CodecError::new(format!("the PLY has no element '{name}'")))
    }
}

impl Element<'_> {
    /// Index of a property.
    pub(super) fn find(&self, name: &str) -> Result<usize, CodecError> {
        (self.properties.iter().position(|p| p.name == name))
            .ok_or_else(|| CodecError::new(format!("the {} element has no property '{name}'", self.name)))
    }

    /// Reads these properties as columns.
    pub(super) fn columns<T: Number>(&self, wanted: &[usize]) -> Result<Vec<Vec<T>>, CodecError> {
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
        // One loop per type and byte order, so that the loops have no branches.
        macro_rules! extend {
            ($type:ty, $into:expr) => {{
                let bytes = |row: &[u8]| *row.first_chunk().expect("a row is as long as its properties");
                match self.encoding {
                    Encoding::Big => column.extend(values.map(|row| $into(<$type>::from_be_bytes(bytes(row))))),
                    _ => column.extend(values.map(|row| $into(<$type>::from_le_bytes(bytes(row))))),
                }
            }};
        }
        match property.kind {
            Kind::I8 => extend!(i8, |v| T::from_f32(f32::from(v))),
            Kind::U8 => extend!(u8, |v| T::from_u32(u32::from(v))),
            Kind::I16 => extend!(i16, |v| T::from_f32(f32::from(v))),
            Kind::U16 => extend!(u16, |v| T::from_u32(u32::from(v))),
            Kind::I32 => extend!(i32, |v| T::from_f64(f64::from(v))),
            Kind::U32 => extend!(u32, T::from_u32),
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
