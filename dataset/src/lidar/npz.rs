//! Points in an npz file: a zip archive of NumPy arrays.

use std::io::{Cursor, Read};

use scene::{CodecError, npy};
use zip::ZipArchive;

/// Most bytes that an array may take when it is decompressed.
const MAX_ARRAY_BYTES: u64 = 128 << 20;
/// Most numbers in a row.
const MAX_COLUMNS: usize = 64;

/// The rows of the array `data`, or of the first array, as f32 little endian, and their number of columns.
///
/// # Errors
/// Not an npz file, too large, or an array without rows of three or more numbers.
pub(super) fn rows(bytes: &[u8]) -> Result<(Vec<u8>, usize), CodecError> {
    let damaged = |e: &dyn std::error::Error| CodecError::new(format!("is not an npz file ({e})"));
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| damaged(&e))?;
    let number = archive.index_for_name("data.npy").unwrap_or(0);
    let mut array = Vec::new();
    let entry = archive.by_index(number).map_err(|e| damaged(&e))?;
    entry.take(MAX_ARRAY_BYTES + 1).read_to_end(&mut array).map_err(|e| damaged(&e))?;
    if array.len() as u64 > MAX_ARRAY_BYTES {
        return Err(CodecError::new(format!("has an array of over {} MB", MAX_ARRAY_BYTES >> 20)));
    }
    let (shape, values) = npy::read_f32(&array)?;
    match shape[..] {
        [_, columns] if (3..=MAX_COLUMNS).contains(&columns) => {
            Ok((values.iter().flat_map(|value| value.to_le_bytes()).collect(), columns))
        }
        _ => Err(CodecError::new(format!("has an array of shape {shape:?} instead of rows x, y, z"))),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zip::write::{SimpleFileOptions, ZipWriter};

    use super::*;

    fn archive(arrays: &[(&str, Vec<u8>)]) -> Vec<u8> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        for (name, array) in arrays {
            zip.start_file(*name, SimpleFileOptions::default()).unwrap();
            zip.write_all(array).unwrap();
        }
        zip.finish().unwrap().into_inner()
    }

    #[test]
    fn rows_of_the_array_are_read_and_others_refused() {
        let points = npy::write_f32(&[2, 4], &[1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.5]);
        let other = npy::write_f32(&[3], &[0.0; 3]);
        let both = archive(&[("other.npy", other.clone()), ("data.npy", points.clone())]);
        let (bytes, columns) = rows(&both).unwrap();
        assert_eq!((bytes.len(), columns, &bytes[16..20]), (32, 4, &4f32.to_le_bytes()[..]));
        assert_eq!(rows(&archive(&[("points.npy", points)])).unwrap(), (bytes, columns));
        assert!(rows(&archive(&[("data.npy", other)])).is_err() && rows(&archive(&[])).is_err());
        for end in [0, 10, both.len() / 2, both.len() - 1] {
            assert!(rows(&both[..end]).is_err(), "cut at {end}");
        }
        let bomb = archive(&[("data.npy", vec![0; (MAX_ARRAY_BYTES + 1000) as usize])]);
        assert!(rows(&bomb).unwrap_err().to_string().contains("over 128 MB"));
    }
}
