//! The files of a SOG in one: a ZIP archive without compression, as the pictures have theirs.
//!
//! Source: PKWARE's APPNOTE, 4.3.

use flate2::Crc;

use super::File;
use crate::error::CodecError;

/// Version that is needed to unpack: 1.0, as nothing is compressed.
const VERSION: u16 = 10;
/// 1 January 1980, the first date that ZIP has: the bytes do not depend on the clock.
const DATE: u16 = 1 << 5 | 1;

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
            at += 46 + name.len();
        }
        // The check value that CRC-32 is known by.
        assert_eq!((at, word(word(end - 14) as usize + 14)), (end, 0xcbf4_3926));
    }
}
