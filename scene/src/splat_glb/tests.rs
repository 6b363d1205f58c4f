use glam::Vec3;

use super::*;
use crate::Splat;

#[test]
fn the_file_has_its_chunks_and_the_splats_in_them() {
    for sh_degree in 0..=3 {
        let mut splats = Splats::new(sh_degree);
        for i in 0..37 {
            splats.push(&Splat::round(Vec3::new(i as f32, 2.0, -3.0), -1.0, Vec3::splat(0.4), 0.7));
        }
        let bytes = write(&splats, true, DMat4::from_translation(DVec3::X)).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let text = word(12);
        assert_eq!((text % 4, &bytes[16..20]), (0, &b"JSON"[..]));
        let document: Value = serde_json::from_slice(&bytes[20..20 + text]).unwrap();
        assert_eq!((word(20 + text), &bytes[24 + text..28 + text]), (bytes.len() - 28 - text, &b"BIN\0"[..]));
        let length = document["bufferViews"][0]["byteLength"].as_u64().unwrap() as usize;
        let (back, antialiased) = spz::read(&bytes[28 + text..28 + text + length]).unwrap();
        assert!(back.len() == 37 && back.sh_degree() == sh_degree && antialiased);
        let primitive = &document["meshes"][0]["primitives"][0];
        let attributes = primitive["attributes"].as_object().unwrap();
        let coefficients = attributes.keys().filter(|name| name.contains("SH_DEGREE")).count();
        assert_eq!(coefficients, [0, 3, 8, 15][usize::from(sh_degree)]);
        let positions = &document["accessors"][attributes["POSITION"].as_u64().unwrap() as usize];
        assert_eq!(positions["min"], json!([0.0, -2.0, 3.0]));
        // The node undoes what SPZ stored: (1, 2, -3) stored as (1, -2, 3), and one further by `place`.
        let matrix: Vec<f64> = serde_json::from_value(document["nodes"][0]["matrix"].clone()).unwrap();
        let matrix = DMat4::from_cols_slice(&matrix);
        assert_eq!(matrix.transform_point3(DVec3::new(1.0, -2.0, 3.0)), DVec3::new(2.0, 2.0, -3.0));
    }
    assert!(write(&Splats::new(1), false, DMat4::IDENTITY).is_err());
}

/// A file of this JSON and these bytes.
fn file(document: &Value, binary: &[u8]) -> Vec<u8> {
    let text = document.to_string().into_bytes();
    let chunk =
        |kind: u32, bytes: &[u8]| [&(bytes.len() as u32).to_le_bytes()[..], &kind.to_le_bytes(), bytes].concat();
    let body = [chunk(JSON_CHUNK, &text), chunk(BINARY_CHUNK, binary)].concat();
    let head = [MAGIC, 2, 12 + body.len() as u32].map(u32::to_le_bytes);
    [head.as_flattened(), &body].concat()
}

/// Two splats of SH degree 1, uncompressed, in rows of 88 bytes; the opacities lie behind them as bytes.
fn plain() -> (Value, Vec<u8>) {
    let mut binary = Vec::new();
    for i in [0.0f32, 1.0] {
        let row = [i, 2.0, 3.0, 0.5, 1.0, 2.0, 0.0, 0.6, 0.0, 0.8];
        let sh = (0..12).map(|k| 0.1 * k as f32 + i);
        binary.extend(row.into_iter().chain(sh).flat_map(f32::to_le_bytes));
    }
    binary.extend([255u8, 51]);
    let mut names = vec!["POSITION".into(), format!("{SPLATTING}:SCALE"), format!("{SPLATTING}:ROTATION")];
    names.push(format!("{SPLATTING}:SH_DEGREE_0_COEF_0"));
    names.extend((0..3).map(|n| format!("{SPLATTING}:SH_DEGREE_1_COEF_{n}")));
    let mut accessors: Vec<Value> = [0, 12, 24, 40, 52, 64, 76]
        .map(|offset| {
            let kind = if offset == 24 { "VEC4" } else { "VEC3" };
            json!({ "bufferView": 0, "byteOffset": offset, "componentType": FLOAT, "count": 2, "type": kind })
        })
        .to_vec();
    let opacity = json!({
        "bufferView": 1, "componentType": UNSIGNED_BYTE, "normalized": true, "count": 2, "type": "SCALAR"
    });
    accessors.push(opacity);
    names.push(format!("{SPLATTING}:OPACITY"));
    let attributes: Map<String, Value> = names.into_iter().zip((0..).map(|k| json!(k))).collect();
    let document = json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }],
        "nodes": [
            { "children": [1], "translation": [10, 0, 0], "rotation": [0, 0, 1, 0] },
            { "mesh": 0, "scale": [2, 2, 2], "translation": [1, 0, 0] },
        ],
        "meshes": [{ "primitives": [{ "mode": 0, "attributes": attributes, "extensions": { SPLATTING: { "kernel": "ellipse" } } }] }],
        "accessors": accessors,
        "bufferViews": [
            { "buffer": 0, "byteLength": 176, "byteStride": 88 },
            { "buffer": 0, "byteOffset": 176, "byteLength": 2 },
        ],
        "buffers": [{ "byteLength": 178 }],
    });
    (document, binary)
}

#[test]
fn what_is_written_is_read_with_its_place() {
    let place = DMat4::from_rotation_translation(glam::DQuat::from_rotation_z(0.3), DVec3::new(1e5, 2.0, 3.0));
    let mut splats = Splats::new(3);
    for i in 0..9 {
        let mut splat = Splat::round(Vec3::new(i as f32, 2.0, -3.0), -1.0, Vec3::splat(0.4), 0.7);
        splat.sh[5 + i] = [0.25, -0.5, 0.125];
        splats.push(&splat);
    }
    let parts = read(&write(&splats, true, place).unwrap()).unwrap();
    let [part] = parts.as_slice() else { panic!("{}", parts.len()) };
    assert!(part.antialiased && part.place.abs_diff_eq(place, 1e-9), "{}", part.place);
    let alone = spz::write(&splats, true, Version::V3).unwrap();
    assert_eq!(part.splats, spz::read(&alone).unwrap().0);
}

#[test]
fn splats_without_compression_are_read() {
    let (document, binary) = plain();
    let parts = read(&file(&document, &binary)).unwrap();
    let Part { splats, antialiased, place } = &parts[0];
    assert_eq!((parts.len(), splats.len(), splats.sh_degree(), *antialiased), (1, 2, 1, false));
    let splat = splats.get(1);
    assert_eq!((splat.mean, splat.quat), (Vec3::new(1.0, 2.0, 3.0), [0.8, 0.0, 0.6, 0.0]));
    assert_eq!(splat.log_scale, Vec3::new(0.5f32.ln(), 0.0, 2.0f32.ln()));
    assert_eq!((splat.sh[0], splat.sh[3]), ([1.0, 1.1, 1.2], [0.1 * 9.0 + 1.0, 2.0, 0.1 * 11.0 + 1.0]));
    assert!((splat.opacity_logit - (0.2f32 / 0.8).ln()).abs() < 1e-6);
    assert!(splats.get(0).opacity_logit.is_finite());
    // The child's scale and place first, then half a turn of its parent about z.
    assert!(place.transform_point3(DVec3::X).abs_diff_eq(DVec3::new(7.0, 0.0, 0.0), 1e-12));
}

#[test]
fn files_that_are_damaged_or_something_else_are_refused() {
    let (document, binary) = plain();
    let refused = |pointer: &str, value: Value| {
        let mut document = document.clone();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        match document.pointer_mut(parent).unwrap() {
            Value::Array(values) => values[key.parse::<usize>().unwrap()] = value,
            values => values[key] = value,
        }
        let error = read(&file(&document, &binary)).unwrap_err().to_string();
        assert!(!error.contains('\n'), "{error}");
        error
    };
    let primitive = "/meshes/0/primitives/0";
    for (pointer, value, wanted) in [
        ("/extensionsRequired", json!(["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        ("/scene", json!(1), "without a scene"),
        ("/scenes/0/nodes", json!([0, 1]), "node 1 is in two places"),
        ("/scenes/0/nodes", json!([7]), "node 7"),
        ("/scenes/0/nodes", json!([]), "without splats"),
        ("/nodes/1/children", json!([0]), "node 0 is in two places"),
        ("/nodes/1/mesh", json!(3), "mesh 3"),
        ("/nodes/1/matrix", json!([1, 2]), "JSON"),
        (&format!("{primitive}/mode"), json!(4), "something else"),
        (&format!("{primitive}/extensions"), json!({}), "something else"),
        (&format!("{primitive}/extensions/{SPLATTING}/kernel"), json!("box"), "box"),
        (&format!("{primitive}/extensions/{SPLATTING}/colorSpace"), json!("lin_rec709_display"), "lin_rec709_display"),
        (&format!("{primitive}/extensions/{SPLATTING}/extensions"), json!({ COMPRESSION: { "bufferView": 0 } }), "SPZ"),
        (&format!("{primitive}/attributes/POSITION"), json!(9), "missing"),
        ("/accessors/0/count", json!(u64::MAX), "cannot hold"),
        ("/accessors/0/count", json!(3), "beyond"),
        ("/accessors/0/count", json!(0), "no rows"),
        ("/accessors/1/count", json!(1), "another count"),
        ("/accessors/2/type", json!("VEC3"), "type \"VEC3\""),
        ("/accessors/2/componentType", json!(5126 + 4), "5130"),
        ("/accessors/3/byteOffset", json!(u64::MAX), "beyond"),
        ("/accessors/3/bufferView", json!(null), "no data"),
        ("/accessors/3/sparse", json!({}), "sparse"),
        ("/bufferViews/0/byteStride", json!(8), "beyond"),
        ("/bufferViews/0/byteStride", json!(u64::MAX), "beyond"),
        ("/bufferViews/0/byteLength", json!(u64::MAX), "ends beyond the file"),
        ("/bufferViews/0/buffer", json!(1), "another file"),
        ("/buffers/0/uri", json!("../a.bin"), "another file"),
    ] {
        let error = refused(pointer, value);
        assert!(error.contains(wanted), "{pointer}: {error}");
    }
    let mut infinite = binary.clone();
    infinite[4..8].copy_from_slice(&f32::INFINITY.to_le_bytes());
    assert!(read(&file(&document, &infinite)).unwrap_err().0.contains("not finite"));
    let whole = file(&document, &binary);
    (0..whole.len()).for_each(|end| assert!(read(&whole[..end]).is_err(), "cut at {end}"));
    let many = format!("{}{}", document, " ".repeat(read::MAX_JSON));
    let head = [MAGIC, 2, 0, many.len() as u32, JSON_CHUNK].map(u32::to_le_bytes);
    let problem = read(&[head.as_flattened(), many.as_bytes()].concat()).unwrap_err().0;
    assert!(problem.contains("bytes of JSON"), "{problem}");
}

#[test]
fn a_mesh_shown_again_and_again_is_refused() {
    let mut splats = Splats::new(3);
    (0..4000).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::ONE, 0.5)));
    let bytes = write(&splats, false, DMat4::IDENTITY).unwrap();
    let (text, binary) = read::chunks(&bytes).unwrap();
    let mut document: Value = serde_json::from_slice(text).unwrap();
    document["nodes"] = json!(vec![json!({ "mesh": 0 }); 1000]);
    document["scenes"][0]["nodes"] = (0..1000).collect();
    let problem = read(&file(&document, binary)).unwrap_err().0;
    assert!(problem.contains("cannot hold 4000 splats"), "{problem}");

    // Nor one of no splats.
    let empty = spz::write(&Splats::new(3), false, Version::V3).unwrap();
    document["bufferViews"][0]["byteLength"] = json!(empty.len());
    let primitive = document["meshes"][0]["primitives"][0].clone();
    document["meshes"][0]["primitives"] = json!(vec![primitive; 20]);
    let problem = read(&file(&document, &empty)).unwrap_err().0;
    assert!(problem.contains("cannot hold 0 splats"), "{problem}");
}
