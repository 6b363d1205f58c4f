//! Tables written here and by pyarrow, whole and damaged.

use std::sync::Arc;

use super::*;
use crate::error::CodecError;

fn open(bytes: Vec<u8>) -> Result<Table<Arc<[u8]>>, CodecError> {
    Table::open(Arc::from(bytes))
}

/// Two groups, of three rows and of two.
fn written() -> Vec<u8> {
    let mut writer = Writer::default();
    let group = |writer: &mut Writer, rows: std::ops::Range<i32>| {
        let all = || rows.clone();
        writer.group(vec![
            ("key.camera_name", Cells::Int8(all().map(|row| row as i8).collect())),
            ("[C].whole", Cells::Int32(all().map(|row| -row).collect())),
            ("time", Cells::Int64(all().map(|row| i64::from(row) << 40).collect())),
            ("single", Cells::Float(all().map(|row| row as f32 / 3.0).collect())),
            ("double", Cells::Double(all().map(|row| f64::from(row) / 3.0).collect())),
            ("text", Cells::Text(all().map(|row| format!("object {row}")).collect())),
            ("photo", Cells::Bytes(all().map(|row| vec![row as u8; 100 * row as usize]).collect())),
            ("small", Cells::Int8s(all().map(|row| vec![1, row as i8]).collect())),
            ("shape", Cells::Int32s(all().map(|row| vec![row, 2, 4]).collect())),
            ("values", Cells::Floats(all().map(|row| (0..row).map(|i| (10 * row + i) as f32).collect()).collect())),
            ("pose", Cells::Doubles(all().map(|row| vec![f64::from(row); 16]).collect())),
        ])
    };
    let mut bytes = group(&mut writer, 0..3);
    bytes.extend(group(&mut writer, 3..5));
    bytes.extend(writer.finish());
    bytes
}

const LENGTHS: [u32; 5] = [0, 1, 2, 3, 4];

/// Checks a table with the columns and rows of [`written`].
fn check(table: &mut Table<Arc<[u8]>>) {
    assert_eq!((table.rows(), table.has("pose"), table.has("list")), (5, true, false));
    assert_eq!(table.integers("key.camera_name").unwrap(), [0, 1, 2, 3, 4]);
    assert_eq!(table.integers("[C].whole").unwrap(), [0, -1, -2, -3, -4]);
    assert_eq!(table.integers("time").unwrap(), [0, 1 << 40, 2 << 40, 3 << 40, 4 << 40]);
    assert_eq!(table.numbers("single").unwrap()[4], f64::from(4f32 / 3.0));
    assert_eq!(table.numbers("double").unwrap()[4], 4.0 / 3.0);
    assert_eq!(table.texts("text").unwrap()[3], "object 3");
    assert_eq!(table.lists("small").unwrap()[4], [1.0, 4.0]);
    assert_eq!(table.lists("shape").unwrap(), (0..5).map(|row| vec![f64::from(row), 2.0, 4.0]).collect::<Vec<_>>());
    assert_eq!(table.lists("pose").unwrap(), (0..5).map(|row| vec![f64::from(row); 16]).collect::<Vec<_>>());
    assert!(table.lists("values").unwrap()[0].is_empty());
    for row in [0u64, 1, 4, 2, 3, 3] {
        assert_eq!(table.bytes("photo", row, 400).unwrap(), vec![row as u8; 100 * row as usize], "row {row}");
        let expected: Vec<f32> = (0..row).map(|i| (10 * row + i) as f32).collect();
        assert_eq!(table.list("values", row, &LENGTHS).unwrap(), expected, "row {row}");
    }
    for (error, words) in [
        (table.integers("pose").unwrap_err(), "holds lists"),
        (table.integers("nothing").unwrap_err(), "no column nothing"),
        (table.integers("single").unwrap_err(), "another kind"),
        (table.integers("text").unwrap_err(), "another kind"),
        (table.texts("time").unwrap_err(), "instead of texts"),
        (table.bytes("photo", 4, 399).unwrap_err(), "400 bytes, over 399"),
        (table.bytes("photo", 5, 400).unwrap_err(), "lacks a row"),
        (table.bytes("time", 0, 400).unwrap_err(), "does not hold bytes"),
        (table.list("values", 1, &[0, 2, 2, 3, 4]).unwrap_err(), "another length than 2"),
        (table.list("values", 2, &[0, 1, 1, 3, 4]).unwrap_err(), "another length than 1"),
        (table.list("values", 2, &[2, 1, 2, 3, 4]).unwrap_err(), "another length than 2"),
        (table.list("values", 4, &[0, 1, 2, 3, 5]).unwrap_err(), "another length than 5"),
        (table.list("values", 4, &LENGTHS[..4]).unwrap_err(), "lacks a row"),
    ] {
        assert!(error.to_string().contains(words), "{words}: {error}");
    }
}

#[test]
fn written_tables_are_read() {
    check(&mut open(written()).unwrap());
    let empty = open(Writer::default().finish()).unwrap();
    assert_eq!((empty.rows(), empty.integers("a").is_err()), (0, true));
}

/// The same table written by pyarrow 26: groups of three rows, optional columns, in several compressions, with and without
/// dictionaries, in both versions of data pages, and with pages that are as small as they can be.
const BY_PYARROW: [(&str, &[u8]); 6] = [
    ("snappy", include_bytes!("by_pyarrow/snappy.parquet")),
    ("brotli", include_bytes!("by_pyarrow/brotli.parquet")),
    ("gzip", include_bytes!("by_pyarrow/gzip.parquet")),
    ("zstd, version 2", include_bytes!("by_pyarrow/zstd_v2.parquet")),
    ("snappy, version 2", include_bytes!("by_pyarrow/snappy_v2.parquet")),
    ("small pages", include_bytes!("by_pyarrow/small_pages.parquet")),
];

#[test]
fn tables_of_pyarrow_are_read() {
    for (name, bytes) in BY_PYARROW {
        println!("{name}");
        check(&mut open(bytes.to_vec()).unwrap());
    }
}

/// All values of a table, or the first error.
fn read_all(bytes: Vec<u8>) -> Result<(), CodecError> {
    let mut table = open(bytes)?;
    for name in ["key.camera_name", "[C].whole", "time"] {
        table.integers(name)?;
    }
    table.numbers("double")?;
    table.numbers("single")?;
    table.texts("text")?;
    for name in ["small", "shape", "pose", "values"] {
        table.lists(name)?;
    }
    for row in 0..table.rows().min(9) {
        table.bytes("photo", row, 1 << 20)?;
        table.list("values", row, &LENGTHS)?;
    }
    Ok(())
}

#[test]
fn damaged_tables_end_in_an_error_or_in_other_values() {
    let written = written();
    let all = [("written", &written[..])].into_iter().chain(BY_PYARROW);
    for (name, whole) in all {
        read_all(whole.to_vec()).unwrap();
        for end in (0..whole.len()).step_by(3) {
            assert!(read_all(whole[..end].to_vec()).is_err(), "{name} cut at {end}");
        }
        for at in 4..whole.len() {
            let mut damaged = whole.to_vec();
            damaged[at] ^= 1 << (at % 8);
            if let Err(error) = read_all(damaged) {
                assert!(!error.to_string().contains('\n'), "{name}, {at}: {error}");
            }
        }
    }
}
