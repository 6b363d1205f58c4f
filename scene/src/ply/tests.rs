use super::*;
use proptest::prelude::*;

fn splats(sh_degree: u8, bits: &[u32]) -> Splats {
    let columns = column::SH + 3 * sh_coefficients(sh_degree);
    let rows = bits.len() / columns;
    let column = |k: usize| bits[k * rows..(k + 1) * rows].iter().map(|&b| f32::from_bits(b)).collect();
    Splats::from_columns((0..columns).map(column).collect()).unwrap()
}

fn bits(splats: &Splats) -> Vec<Vec<u32>> {
    splats.columns().iter().map(|c| c.iter().map(|v| v.to_bits()).collect()).collect()
}

proptest! {
    #[test]
    fn round_trips_bit_for_bit(sh_degree in 0u8..=3, seed in prop::collection::vec(any::<u32>(), 0..200)) {
        let splats = splats(sh_degree, &seed);
        let bytes = write(&splats, &["antialiased", "two\nlines"]);
        prop_assert_eq!(comments(&bytes), vec!["antialiased", "two lines"]);
        prop_assert_eq!(bits(&read(&bytes).unwrap()), bits(&splats));
        if !splats.is_empty() {
            for end in 0..bytes.len() {
                prop_assert!(read(&bytes[..end]).is_err());
            }
        }
    }

    #[test]
    fn damaged_headers_do_not_panic(at in 0usize..400, byte in any::<u8>()) {
        let mut bytes = write(&splats(0, &[1; 14]), &[]);
        let at = at % bytes.len();
        bytes[at] = byte;
        let _ = (read(&bytes), read_points(&bytes), comments(&bytes));
    }
}

#[test]
fn rows_beyond_one_block_round_trip() {
    let seed: Vec<u32> = (0..59 * 300).map(|i: u32| i.wrapping_mul(2_654_435_761)).collect();
    let splats = splats(3, &seed);
    assert_eq!(bits(&read(&write(&splats, &[])).unwrap()), bits(&splats));
}

#[test]
fn nan_payloads_survive() {
    let mut seed = vec![0; 14];
    (seed[0], seed[10]) = (0x7f80_0001, 0xffc1_2345);
    assert_eq!(bits(&read(&write(&splats(0, &seed), &[])).unwrap()).concat(), seed);
}

#[test]
fn higher_sh_coefficients_are_channel_major() {
    let seed: Vec<u32> = (0..23).map(|k| (k as f32).to_bits()).collect();
    let bytes = write(&splats(1, &seed), &[]);
    let body: Vec<f32> = bytes[bytes.len() - 4 * 26..].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    // Columns: mean 0-2, log scale 3-5, quaternion 6-9, opacity 10, SH from 11 on with the channel fastest.
    let expected = [
        [0, 1, 2].as_slice(),
        &[0, 0, 0],
        &[11, 12, 13],
        &[14, 17, 20, 15, 18, 21, 16, 19, 22],
        &[10],
        &[3, 4, 5],
        &[6, 7, 8, 9],
    ]
    .concat();
    assert_eq!(body, expected.iter().map(|&k| k as f32).collect::<Vec<_>>());
}

/// A file of SH degree 0 with another property order, additional properties and mixed scalar types.
fn unusual_file(encoding: &str, newline: &str) -> Vec<u8> {
    let properties = [
        ("uchar", "red"),
        ("double", "x"),
        ("float", "rot_3"),
        ("float", "rot_0"),
        ("float", "rot_1"),
        ("float", "rot_2"),
        ("int", "f_dc_2"),
        ("short", "f_dc_1"),
        ("float", "f_dc_0"),
        ("float", "opacity"),
        ("float", "y"),
        ("float32", "z"),
        ("float", "scale_0"),
        ("float", "scale_1"),
        ("float", "scale_2"),
        ("float64", "confidence"),
        ("uint8", "green"),
        ("uchar", "blue"),
    ];
    let mut lines = vec!["ply".to_owned(), format!("format {encoding} 1.0"), "comment  hello  there".into()];
    lines.extend(["obj_info nothing".into(), "element vertex 2".into()]);
    lines.extend(properties.iter().map(|(kind, name)| format!("property {kind} {name}")));
    lines.extend(["element face 1", "property list uchar int vertex_indices", "end_header"].map(String::from));
    let mut bytes = (lines.join(newline) + newline).into_bytes();
    for row in 0..2 {
        for (k, (kind, _)) in properties.iter().enumerate() {
            let value = row * 100 + k as i32;
            let mut number = match *kind {
                _ if encoding == "ascii" => format!("{value} ").into_bytes(),
                "uchar" | "uint8" => vec![value as u8],
                "short" => (value as i16).to_le_bytes().to_vec(),
                "int" => value.to_le_bytes().to_vec(),
                "double" | "float64" => f64::from(value).to_le_bytes().to_vec(),
                _ => (value as f32).to_le_bytes().to_vec(),
            };
            if encoding == "binary_big_endian" {
                number.reverse();
            }
            bytes.extend(number);
        }
        if encoding == "ascii" {
            bytes.extend(newline.bytes());
        }
    }
    bytes.extend(b"3 0 1 1");
    bytes
}

#[test]
fn any_order_type_and_encoding_is_read() {
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        for newline in ["\n", "\r\n"] {
            let bytes = unusual_file(encoding, newline);
            let splats = read(&bytes).unwrap();
            let row: Vec<f32> = splats.columns().iter().map(|c| c[1] - 100.0).collect();
            assert_eq!(row, [1, 10, 11, 12, 13, 14, 3, 4, 5, 2, 9, 8, 7, 6].map(|k| k as f32), "{encoding}");
            assert_eq!(comments(&bytes), [" hello  there"]);
            let (points, colours) = read_points(&bytes).unwrap();
            assert_eq!(points, [DVec3::new(1.0, 10.0, 11.0), DVec3::new(101.0, 110.0, 111.0)]);
            assert_eq!(colours, [[0, 16, 17], [100, 116, 117]]);
            let header = bytes.len() - 7;
            for end in (0..header - 3).step_by(5) {
                assert!(read(&bytes[..end]).is_err() || encoding == "ascii" && end + 20 > header, "{encoding} {end}");
            }
        }
    }
}

#[test]
fn points_without_colours_are_grey_and_must_be_finite() {
    let text = |x: &str| {
        let header =
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\n";
        format!("{header}end_header\n{x} 2.25 3\n").into_bytes()
    };
    let expected = (vec![DVec3::new(0.1, 2.25, 3.0)], vec![[128; 3]]);
    assert_eq!(read_points(&text("0.1")), Ok(expected));
    for bad in ["nan", "inf", "one", "1e999"] {
        assert!(read_points(&text(bad)).is_err(), "{bad}");
    }
}

#[test]
fn impossible_headers_are_refused_before_allocation() {
    let names: String = column_names(0).iter().map(|name| format!("property float {name}\n")).collect();
    for count in ["18446744073709551615", "4611686018427387904", "1000000000000", "-1", "1e3", "99999999999999999999"] {
        for encoding in ["ascii", "binary_little_endian"] {
            for properties in [names.as_str(), ""] {
                let text = format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n");
                assert!(read(text.as_bytes()).is_err() && read_points(text.as_bytes()).is_err(), "{text}");
            }
        }
    }
    let good = String::from_utf8(write(&Splats::new(1), &[])).unwrap();
    assert_eq!(read(good.as_bytes()), Ok(Splats::new(1)));
    for (from, to) in [
        ("property float opacity\n", ""),
        ("property float f_rest_8\n", ""),
        ("f_rest_8", "f_rest_9"),
        ("property float x", "property quad x"),
        ("property float nx", "property list uchar float nx"),
        ("format binary_little_endian 1.0\n", ""),
        ("element vertex 0", "element chunk 1\nproperty float a\nelement vertex 0"),
        ("ply\n", "PLY\n"),
        ("end_header", "end"),
    ] {
        assert!(read(good.replacen(from, to, 1).as_bytes()).is_err(), "{from} -> {to}");
    }
}

#[test]
fn inria_file_round_trips() {
    let shared = std::env::var("PLAT_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared").into());
    let path = "data/splats/inria_style_ply/point_cloud/iteration_7000/point_cloud.ply";
    let Ok(bytes) = std::fs::read(std::path::Path::new(&shared).join(path)) else {
        println!("skipped: ../shared/data not present");
        return;
    };
    let splats = read(&bytes).unwrap();
    assert_eq!((splats.len(), splats.sh_degree()), (9080, 3));
    let again = write(&splats, &[]);
    assert_eq!(bits(&read(&again).unwrap()), bits(&splats));
    let body = |bytes: &[u8]| bytes[bytes.len() - 9080 * 62 * 4..].to_vec();
    let normals_are_zero = body(&bytes).chunks_exact(62 * 4).all(|row| row[12..24].iter().all(|&b| b == 0));
    if normals_are_zero {
        assert!(body(&again) == body(&bytes), "the bodies differ");
    }
}

#[test]
fn attributes_are_uint_properties() {
    let mut labelled = splats(1, &[3, 5, 7, 11]);
    labelled.set_attribute("block", (0..labelled.len() as u32).collect());
    labelled.set_attribute("label", vec![u32::MAX; labelled.len()]);
    let bytes = write(&labelled, &[]);
    let header = String::from_utf8_lossy(&bytes[..bytes.len() - rows(&labelled).len()]).into_owned();
    assert!(header.contains("property uint block\nproperty uint label\nend_header\n"), "{header}");
    let read_back = read(&bytes).unwrap();
    assert_eq!(read_back.attributes(), labelled.attributes());
    assert_eq!(bits(&read_back), bits(&labelled));
    // Names that are not valid, and types other than uint, are ignored as before.
    let changed = header.replace("uint block", "uint Block").replace("uint label", "int label");
    let bytes = [changed.as_bytes(), &rows(&labelled)].concat();
    assert_eq!(read(&bytes).unwrap().attributes(), []);
}
