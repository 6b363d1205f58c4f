//! The files of a SOG in one: a ZIP archive without compression, as the pictures have theirs. Archives with deflate are read too, as
//! other programs make them.
//!
//! Source: PKWARE's APPNOTE, 4.3.

use std::collections::BTreeMap;
use std::io::Read;

use flate2::Crc;
use flate2::read::DeflateDecoder;

use super::File;
use crate::error::CodecError;

/// Version that is needed to unpack: 1.0, as nothing is compressed.
const VERSION: u16 = 10;
/// 1 January 1980, the first date that ZIP has: the bytes do not depend on the clock.
const DATE: u16 = 1 << 5 | 1;
/// What the end of an archive starts with, its length without the comment, and the longest comment.
const END: &[u8] = b"PK\x05\x06";
const END_BYTES: usize = 22;
const MAX_COMMENT: usize = 65_535;
/// Length of an entry of the directory before its name.
const DIRECTORY_BYTES: usize = 46;
/// Largest length of a file that is read: this many bytes plus this factor times its compressed length. JSON shrinks to a third,
/// pictures hardly.
const PLAIN_BYTES: usize = 1 << 20;
const PLAIN_FACTOR: usize = 8;

/// The bytes of a `.sog`.
///
/// # Errors
/// 4 GiB or more.
pub fn bundle(files: &[File]) -> Result<Vec<u8>, CodecError> {
    let mut bytes = Vec::new();
    let mut directory = Vec::new();
    for File { name, bytes: content } in files {
        let mut crc = Crc::new();
        crc.update(content);
        let offset = size(bytes.len())?;
        let mut entry = Vec::new();
        // No flags, no compression.
        [VERSION, 0, 0, 0, DATE].iter().for_each(|word| entry.extend(word.to_le_bytes()));
        [crc.sum(), size(content.len())?, size(content.len())?]
            .iter()
            .for_each(|word| entry.extend(word.to_le_bytes()));
        [name.len() as u16, 0].iter().for_each(|word| entry.extend(word.to_le_bytes()));
        bytes.extend(b"PK\x03\x04");
        bytes.extend(&entry);
        bytes.extend(name.as_bytes());
        bytes.extend(content);
        directory.extend(b"PK\x01\x02");
        directory.extend(VERSION.to_le_bytes());
        directory.extend(&entry);
        // No comment, the first disk, no attributes.
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let (start, length, count) = (size(bytes.len())?, size(directory.len())?, files.len() as u16);
    bytes.extend(directory);
    bytes.extend(b"PK\x05\x06");
    [0, 0, count, count].iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    [length, start].iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    bytes.extend([0; 2]);
    Ok(bytes)
}

/// An archive that is read.
pub(super) struct Archive<'a> {
    bytes: &'a [u8],
    entries: BTreeMap<&'a [u8], Entry>,
}

#[derive(Clone, Copy)]
struct Entry {
    method: u16,
    compressed: usize,
    length: usize,
    crc: u32,
    /// Where its local header starts.
    offset: usize,
}

impl<'a> Archive<'a> {
    /// Reads the directory.
    ///
    /// # Errors
    /// No archive, or one whose directory does not lie in it.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, CodecError> {
        let wrong = || CodecError::new("not a ZIP archive, or one that is cut short");
        let last = bytes.len().checked_sub(END_BYTES).ok_or_else(wrong)?;
        let first = last.saturating_sub(MAX_COMMENT);
        let end = (first..=last).rev().find(|&at| bytes[at..].starts_with(END)).ok_or_else(wrong)?;
        let count = half(bytes, end + 10).ok_or_else(wrong)?;
        let mut at = word(bytes, end + 16).ok_or_else(wrong)?;
        let mut entries = BTreeMap::new();
        for _ in 0..count {
            let header = bytes.get(at..).filter(|rest| rest.starts_with(b"PK\x01\x02")).ok_or_else(wrong)?;
            let [name, extra, comment] = [28, 30, 32].map(|k| half(header, k).map(usize::from));
            let (name, more) = (name.ok_or_else(wrong)?, extra.zip(comment).ok_or_else(wrong)?);
            let entry = Entry {
                method: half(header, 10).ok_or_else(wrong)?,
                crc: word(header, 16).ok_or_else(wrong)? as u32,
                compressed: word(header, 20).ok_or_else(wrong)?,
                length: word(header, 24).ok_or_else(wrong)?,
                offset: word(header, 42).ok_or_else(wrong)?,
            };
            let text = header.get(DIRECTORY_BYTES..DIRECTORY_BYTES + name).ok_or_else(wrong)?;
            entries.insert(text, entry);
            at += DIRECTORY_BYTES + name + more.0 + more.1;
        }
        Ok(Self { bytes, entries })
    }

    /// The bytes of a file.
    ///
    /// # Errors
    /// No such file, a method other than deflate, a length or a checksum that does not fit.
    pub(super) fn file(&self, name: &str) -> Result<Vec<u8>, CodecError> {
        let wrong = |what: &str| CodecError::new(format!("{name:?} {what} in the archive"));
        let entry = *self.entries.get(name.as_bytes()).ok_or_else(|| wrong("is not"))?;
        let local = self.bytes.get(entry.offset..).filter(|rest| rest.starts_with(b"PK\x03\x04"));
        let start = local.and_then(|local| Some(30 + usize::from(half(local, 26)?) + usize::from(half(local, 28)?)));
        let stored = local.zip(start).and_then(|(local, start)| local.get(start..)?.get(..entry.compressed));
        let stored = stored.ok_or_else(|| wrong("ends beyond its end"))?;
        if entry.length > PLAIN_BYTES + PLAIN_FACTOR * stored.len() {
            return Err(wrong("is compressed too much"));
        }
        let mut plain = Vec::new();
        match entry.method {
            0 => plain.extend_from_slice(stored),
            8 => {
                let read = DeflateDecoder::new(stored).take(entry.length as u64 + 1).read_to_end(&mut plain);
                read.map_err(|_| wrong("is damaged"))?;
            }
            method => return Err(wrong(&format!("is compressed by method {method}, which cannot be read,"))),
        }
        let mut crc = Crc::new();
        crc.update(&plain);
        if plain.len() == entry.length && crc.sum() == entry.crc { Ok(plain) } else { Err(wrong("is damaged")) }
    }
}

fn half(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..at + 2)?.try_into().ok().map(u16::from_le_bytes)
}

fn word(bytes: &[u8], at: usize) -> Option<usize> {
    bytes.get(at..at + 4)?.try_into().ok().map(|word| u32::from_le_bytes(word) as usize)
}

fn size(bytes: usize) -> Result<u32, CodecError> {
    u32::try_from(bytes).map_err(|_| CodecError::new("SOG of 4 GiB or more"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_directory_leads_to_every_file() {
        let file = |name: &str, bytes: &[u8]| File { name: name.into(), bytes: bytes.into() };
        let files = [file("meta.json", b"{}"), file("quats.webp", b"123456789")];
        let bytes = bundle(&files).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let end = bytes.len() - 22;
        assert_eq!((&bytes[end..end + 4], word(end + 8)), (&b"PK\x05\x06"[..], 2 | 2 << 16));
        let mut at = word(end + 16) as usize;
        for File { name, bytes: content } in &files {
            assert_eq!((&bytes[at..at + 4], word(at + 24) as usize), (&b"PK\x01\x02"[..], content.len()));
            assert_eq!(bytes[at + 46..].get(..name.len()), Some(name.as_bytes()));
            let local = word(at + 42) as usize;
            assert_eq!((&bytes[local..local + 4], word(local + 14)), (&b"PK\x03\x04"[..], word(at + 16)));
            assert!(bytes[local + 30 + name.len()..].starts_with(content));
            assert_eq!(&Archive::open(&bytes).unwrap().file(name).unwrap(), content);
            at += 46 + name.len();
        }
        // The check value that CRC-32 is known by.
        assert_eq!((at, word(word(end - 14) as usize + 14)), (end, 0xcbf4_3926));
    }
}
