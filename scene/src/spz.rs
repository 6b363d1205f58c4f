//! Reads and writes SPZ, Niantic's compressed splat format: reads versions 2 to 4, writes 2 and 3.
//!
//! Versions 2 and 3 are one gzip stream: a header of 16 bytes, then one plane per attribute: positions (24-bit fixed
//! point), opacities, colours, log scales, rotations (version 2: x, y, z with 8 bits; version 3: the three smaller
//! components with 10 bits) and SH coefficients. Version 4 has an uncompressed header and one zstd stream per
//! attribute.
//!
//! SPZ's axes are right, up, back; those of an INRIA PLY right, down, forward. y and z therefore change sign, as in
//! Niantic's converter, so that a viewer shows both formats the same way up.
//!
//! Source: `load-spz.cc` and `splat-types.h` of the SPZ library.

mod quantise;
mod write;

use std::io::{self, Read};

use flate2::bufread::GzDecoder;

use self::quantise::{Rotation, sh_sign};
use crate::error::CodecError;
use crate::splats::{Splats, column, sh_coefficients};

pub use self::write::{Layout, PLANES, Zipper, write};

const MAGIC: u32 = 0x5053_474e;
const GZIP: [u8; 2] = [0x1f, 0x8b];
const ANTIALIASED: u8 = 1;
const EXTENSIONS: u8 = 2;
/// Largest decoded size: this many bytes plus this factor times the file's size. Trained splats take at most 12 times
/// the file's size; more is a decompression bomb.
pub(crate) const MEMORY_BYTES: u64 = 32 << 20;
pub(crate) const MEMORY_FACTOR: u64 = 20;
/// Largest SH degree of the format. Coefficients above degree 3 are dropped.
const MAX_DEGREE: u8 = 4;

/// A version that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Version {
    /// 24-bit rotations, for old readers.
    V2,
    /// 32-bit rotations; all current readers accept it.
    V3,
}

struct Header {
    version: u32,
    count: usize,
    sh_degree: u8,
    fractional_bits: u8,
    antialiased: bool,
}

impl Header {
    fn parse(bytes: [u8; 16]) -> Result<Self, CodecError> {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        let [sh_degree, fractional_bits, flags] = [bytes[12], bytes[13], bytes[14]];
        let version = word(4);
        if word(0) != MAGIC {
            return Err(CodecError::new("not an SPZ file"));
        }
        if !(2..=4).contains(&version) {
            return Err(CodecError::new(format!("SPZ of version {version}; versions 2 to 4 can be read")));
        }
        if sh_degree > MAX_DEGREE || fractional_bits > 24 {
            let problem = format!("SPZ header with SH degree {sh_degree} and {fractional_bits} fractional bits");
            return Err(CodecError::new(problem));
        }
        if version < 4 && flags & EXTENSIONS != 0 {
            return Err(CodecError::new("SPZ extensions before version 4 are not supported"));
        }
        let antialiased = flags & ANTIALIASED != 0;
        Ok(Self { version, count: word(8) as usize, sh_degree, fractional_bits, antialiased })
    }

    /// Refuses more splats than a file of this length can hold, before anything is allocated.
    fn check_memory(&self, file_bytes: usize) -> Result<(), CodecError> {
        let columns = column::SH + 3 * sh_coefficients(self.sh_degree.min(3));
        if 4 * columns as u64 * self.count as u64 > MEMORY_BYTES + MEMORY_FACTOR * file_bytes as u64 {
            let count = self.count;
            return Err(CodecError::new(format!(
                "{file_bytes} bytes cannot hold the {count} splats that the header announces"
            )));
        }
        Ok(())
    }

    fn rotation(&self) -> Rotation {
        if self.version == 2 { Rotation::FirstThree } else { Rotation::SmallestThree }
    }

    /// Bytes per splat in each plane.
    fn plane_sizes(&self) -> [usize; 6] {
        [9, 1, 3, 3, self.rotation().bytes(), 3 * (sh_coefficients_of(self.sh_degree) - 1)]
    }
}

/// As [`sh_coefficients`], including the format's degree 4.
fn sh_coefficients_of(degree: u8) -> usize {
    (usize::from(degree) + 1).pow(2)
}

/// Decodes splats. The flag is true if they are to be rendered anti-aliased.
///
/// # Errors
/// Not SPZ, an unsupported version, truncated, damaged, or more splats than the file can hold.
pub fn read(bytes: &[u8]) -> Result<(Splats, bool), CodecError> {
    let short = || CodecError::new("SPZ file is cut short");
    if bytes.starts_with(&GZIP) {
        let mut stream = GzDecoder::new(bytes);
        let mut header = [0; 16];
        stream.read_exact(&mut header).map_err(|e| damaged(&e))?;
        let header = Header::parse(header)?;
        if header.version > 3 {
            return Err(CodecError::new("SPZ of version 4 inside gzip"));
        }
        header.check_memory(bytes.len())?;
        let splats = decode(&header, &mut stream)?;
        return match stream.read(&mut [0]) {
            Ok(0) => Ok((splats, header.antialiased)),
            Ok(_) => Err(CodecError::new("SPZ file has extra bytes at its end")),
            Err(error) => Err(damaged(&error)),
        };
    }
    let header = Header::parse(*bytes.first_chunk().ok_or_else(short)?)?;
    if header.version < 4 {
        return Err(CodecError::new("SPZ of a version below 4 that is not gzip"));
    }
    header.check_memory(bytes.len())?;
    let mut streams = Streams::new(bytes, &header)?;
    let splats = decode(&header, &mut streams)?;
    Ok((splats, header.antialiased))
}

fn decode(header: &Header, from: &mut impl Read) -> Result<Splats, CodecError> {
    let Header { count, .. } = *header;
    let mut splats = Splats::new(header.sh_degree.min(3));
    let columns = splats.columns_mut();
    columns.iter_mut().for_each(|column| column.reserve_exact(count));
    let [positions, opacities, colours, scales, rotations, sh] = header.plane_sizes();
    rows(from, count, positions, |row| {
        for axis in 0..3 {
            let value =
                quantise::from_position([row[3 * axis], row[3 * axis + 1], row[3 * axis + 2]], header.fractional_bits);
            columns[axis].push(quantise::FLIP[axis] * value);
        }
    })?;
    rows(from, count, opacities, |row| columns[column::OPACITY].push(crate::ply::logit_of_byte(row[0])))?;
    rows(from, count, colours, |row| {
        (0..3).for_each(|c| columns[column::SH + c].push(quantise::from_colour(row[c])));
    })?;
    rows(from, count, scales, |row| {
        (0..3).for_each(|k| columns[column::LOG_SCALE + k].push(quantise::from_log_scale(row[k])));
    })?;
    let rotation = header.rotation();
    rows(from, count, rotations, |row| {
        let word = row.iter().rev().fold(0, |word, &byte| word << 8 | u32::from(byte));
        rotation.unpack(word).into_iter().enumerate().for_each(|(k, v)| columns[column::QUAT + k].push(v));
    })?;
    rows(from, count, sh, |row| {
        for (place, column) in columns[column::SH + 3..].iter_mut().enumerate() {
            column.push(sh_sign(place / 3 + 1) * quantise::from_sh(row[place]));
        }
    })?;
    Ok(splats)
}

/// Calls `each` with every row of a plane of `size` bytes per row.
fn rows(from: &mut impl Read, count: usize, size: usize, mut each: impl FnMut(&[u8])) -> Result<(), CodecError> {
    const AT_ONCE: usize = 512;
    if size == 0 {
        return Ok(());
    }
    let mut buffer = vec![0; AT_ONCE * size];
    let mut left = count;
    while left > 0 {
        let some = &mut buffer[..left.min(AT_ONCE) * size];
        from.read_exact(some).map_err(|e| damaged(&e))?;
        some.chunks_exact(size).for_each(&mut each);
        left -= left.min(AT_ONCE);
    }
    Ok(())
}

fn damaged(error: &io::Error) -> CodecError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => CodecError::new("SPZ file is cut short"),
        _ => CodecError::new(format!("SPZ file is damaged ({error})")),
    }
}

/// The zstd streams of version 4, concatenated to the byte order of version 3.
struct Streams<'a> {
    /// Compressed bytes and decoded length of the remaining streams, last first.
    rest: Vec<(&'a [u8], usize)>,
    current: Option<(zstd::stream::read::Decoder<'static, &'a [u8]>, usize)>,
}

impl<'a> Streams<'a> {
    /// Reads the table of contents after the 32-byte header and the extensions, which are skipped.
    fn new(bytes: &'a [u8], header: &Header) -> Result<Self, CodecError> {
        let wrong = || CodecError::new("SPZ file's table of contents does not match the file");
        let expected: Vec<usize> = header.plane_sizes().into_iter().filter(|&size| size > 0).collect();
        let (streams, at) = (*bytes.get(15).ok_or_else(wrong)?, bytes.get(16..20).ok_or_else(wrong)?);
        let at = u32::from_le_bytes(at.try_into().expect("four bytes")) as usize;
        if usize::from(streams) != expected.len() || at < 32 {
            return Err(wrong());
        }
        let contents = bytes.get(at..).and_then(|rest| rest.split_at_checked(16 * expected.len())).ok_or_else(wrong)?;
        let (contents, mut body) = contents;
        let mut rest = Vec::with_capacity(expected.len());
        for (entry, size) in contents.chunks_exact(16).zip(expected) {
            let [compressed, length] = [0, 8].map(|k| u64::from_le_bytes(entry[k..k + 8].try_into().expect("eight")));
            let compressed = usize::try_from(compressed).map_err(|_| wrong())?;
            let (stream, others) = body.split_at_checked(compressed).ok_or_else(wrong)?;
            if length != (size * header.count) as u64 {
                return Err(wrong());
            }
            rest.push((stream, size * header.count));
            body = others;
        }
        rest.reverse();
        Ok(Self { rest, current: None })
    }
}

impl Read for Streams<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        loop {
            match &mut self.current {
                Some((_, 0)) => self.current = None,
                Some((decoder, left)) => {
                    let some = to.len().min(*left);
                    let read = decoder.read(&mut to[..some])?;
                    if read == 0 && some > 0 {
                        return Err(io::ErrorKind::UnexpectedEof.into());
                    }
                    *left -= read;
                    return Ok(read);
                }
                None => {
                    let Some((stream, length)) = self.rest.pop() else { return Ok(0) };
                    let mut decoder = zstd::stream::read::Decoder::with_buffer(stream)?;
                    // The frame's content size was checked. Limit the window to it, but to no less than the 8 MiB that
                    // decoders should accept (RFC 8878, 3.1.1.1.2).
                    decoder.window_log_max(length.max(8 << 20).next_power_of_two().ilog2().min(31))?;
                    self.current = Some((decoder, length));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
