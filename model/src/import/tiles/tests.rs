use std::fs;

use glam::{DVec3, Vec3};
use render::Options;
use render::cpu::Renderer;
use scene::{Camera, Pinhole, Rigid, Splat, Splats};
use serde_json::{Value, json};

use super::*;
use crate::write_tiles;

/// Splats of SH degree 3 before a camera at the origin that looks along z.
fn splats() -> Splats {
    let mut splats = Splats::new(3);
    for i in 0..60 {
        let (x, y) = ((i % 10) as f32 * 0.2 - 0.9, (i / 10) as f32 * 0.2 - 0.5);
        let mut splat =
            Splat::round(Vec3::new(x, y, 3.0 + 0.01 * i as f32), -2.2, Vec3::new(0.3, 0.5, 0.6 + 0.3 * x), 0.7);
        splat.log_scale.x -= 1.5;
        splat.quat = [0.8, 0.3 * x, 0.4, -0.2];
        let sh = splat.sh[1..].as_flattened_mut().iter_mut().enumerate();
        sh.for_each(|(k, value)| *value = 0.15 * (1.7 * k as f32 + x).sin());
        splats.push(&splat);
    }
    splats
}

fn drawn(splats: &Splats, camera_from_world: Rigid) -> Vec<f32> {
    let pinhole = Pinhole { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
    let camera = Camera { pinhole, camera_from_world };
    Renderer::default().forward(splats, &[], &camera, &Options::default()).colour.clone()
}

fn matrix(matrix: DMat4) -> Value {
    json!(matrix.to_cols_array())
}

/// An exported tileset, and what changes it.
struct Exported(tempfile::TempDir);

impl Exported {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("a.ply"), scene::ply::write(&splats(), &[])).unwrap();
        write_tiles(&folder.path().join("a.ply"), &folder.path().join("tiles"), &mut |_, _| ()).unwrap();
        Self(folder)
    }

    fn tileset(&self) -> Value {
        serde_json::from_slice(&fs::read(self.0.path().join("tiles").join(TILESET)).unwrap()).unwrap()
    }

    fn read(&self, tileset: &Value) -> Result<crate::Model, String> {
        self.read_text(&tileset.to_string())
    }

    fn read_text(&self, text: &str) -> Result<crate::Model, String> {
        fs::write(self.0.path().join("tiles").join(TILESET), text).unwrap();
        crate::read(&self.0.path().join("tiles")).map_err(|error| error.to_string())
    }
}

fn tile(value: Value) -> Value {
    let mut tile = json!({ "boundingVolume": { "sphere": [0, 0, 0, 9] }, "geometricError": 0, "refine": "REPLACE" });
    tile.as_object_mut().unwrap().extend(value.as_object().unwrap().clone());
    tile
}

#[test]
fn nested_transforms_turn_splats_and_their_colours() {
    let exported = Exported::new();
    let tileset = exported.tileset();
    let plain = exported.read(&tileset).unwrap();
    assert_eq!((plain.splats.len(), plain.splats.sh_degree(), plain.geo_origin), (60, 3, None));

    let (turn, away) = (DQuat::from_xyzw(0.2, 0.5, -0.3, 0.6).normalize(), DVec3::new(40.0, -7.0, 12.0));
    let mut nested = tileset.clone();
    let inner = matrix(DMat4::from_scale_rotation_translation(DVec3::splat(2.0), turn, DVec3::ZERO));
    nested["root"]["transform"] = inner;
    let outer = matrix(DMat4::from_translation(away));
    nested["root"] = tile(json!({ "transform": outer, "children": [nested["root"]] }));
    let moved = exported.read(&nested).unwrap();
    // The same camera, turned with them and twice as far from everything.
    let camera_from_world = Rigid { rotation: turn.inverse(), translation: -(turn.inverse() * away) };
    let same = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
    let (before, after) = (drawn(&plain.splats, same), drawn(&moved.splats, camera_from_world));
    let largest = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest(&before, &after) < 2e-3, "{}", largest(&before, &after));
    // Without its turn, SH would be seen from elsewhere.
    let mut unturned = moved.splats.clone();
    unturned.columns_mut()[14..].clone_from_slice(&plain.splats.columns()[14..]);
    assert!(largest(&before, &drawn(&unturned, camera_from_world)) > 0.05);
}

#[test]
fn tilesets_of_other_programs_lose_their_place_on_earth() {
    let exported = Exported::new();
    let mut tileset = exported.tileset();
    let plain = exported.read(&tileset).unwrap();
    tileset["asset"] = json!({ "version": "1.0", "extras": "made by hand" });
    let origin = GeoOrigin { latitude_degrees: -33.9, longitude_degrees: 151.2, altitude_metres: 40.0 };
    // Turned about the vertical, as some programs do; the root only holds it.
    let turn = DMat4::from_rotation_z(0.5);
    tileset["root"]["transform"] = matrix(origin.ecef_from_local() * turn);
    tileset["root"] = tile(json!({ "children": [tileset["root"]] }));
    let back = exported.read(&tileset).unwrap();
    let found = back.geo_origin.unwrap();
    assert!((found.latitude_degrees + 33.9).abs() < 1e-9 && (found.longitude_degrees - 151.2).abs() < 1e-9);
    for row in 0..60 {
        let wanted = turn.transform_point3(plain.splats.mean(row).as_dvec3());
        assert!(back.splats.mean(row).as_dvec3().distance(wanted) < 1e-5);
    }
}

#[test]
fn the_finest_tiles_are_chosen_by_refinement() {
    let exported = Exported::new();
    let glb = exported.tileset()["root"]["children"][0]["content"]["uri"].as_str().unwrap().to_owned();
    let at = |name: &str| exported.0.path().join("tiles").join(name);
    for name in ["b.glb", "c d.glb"] {
        fs::copy(at(&glb), at(name)).unwrap();
    }
    let of = |uri: &str| json!({ "uri": uri });
    let leaves = || vec![tile(json!({ "contents": [of("b.glb"), of("./c%20%64.glb")] }))];
    let read = |root: Value| {
        exported.read(&json!({ "asset": { "version": "1.1" }, "root": root })).map(|model| model.splats.len())
    };
    assert_eq!(read(tile(json!({ "content": of(&glb) }))), Ok(60));
    assert_eq!(read(tile(json!({ "content": of(&glb), "children": leaves() }))), Ok(120));
    assert_eq!(read(tile(json!({ "refine": "ADD", "content": of(&glb), "children": leaves() }))), Ok(180));
    // Refinement is inherited.
    let mut middle = tile(json!({ "content": of(&glb), "children": leaves() }));
    middle.as_object_mut().unwrap().remove("refine");
    assert_eq!(read(tile(json!({ "refine": "ADD", "children": [middle] }))), Ok(180));
}

#[test]
fn many_small_files_are_limited_together() {
    let folder = tempfile::tempdir().unwrap();
    let mut flat = Splats::new(3);
    (0..80_000).for_each(|_| flat.push(&Splat::round(Vec3::ZERO, 0.0, Vec3::ONE, 0.5)));
    let bytes = splat_glb::write(&flat, false, DMat4::IDENTITY).unwrap();
    let read = |names: &[&str]| {
        names.iter().for_each(|name| fs::write(folder.path().join(name), &bytes).unwrap());
        let contents: Vec<Value> = names.iter().map(|name| json!({ "uri": name })).collect();
        let tileset = json!({ "asset": { "version": "1.1" }, "root": tile(json!({ "contents": contents })) });
        fs::write(folder.path().join(TILESET), tileset.to_string()).unwrap();
        crate::read(folder.path()).map(|model| model.splats.len()).map_err(|error| error.to_string())
    };
    assert_eq!(read(&["a.glb"]), Ok(80_000));
    let problem = read(&["a.glb", "b.glb"]).unwrap_err();
    assert!(problem.contains("tileset.json: has files that are too short for the 160000 splats"), "{problem}");
}

#[test]
fn tilesets_that_cannot_be_read_are_named() {
    let exported = Exported::new();
    let tileset = exported.tileset();
    let at = |name: &str| exported.0.path().join("tiles").join(name);
    fs::write(at("cut.glb"), b"glTF\x02\0\0\0").unwrap();
    fs::write(at("other.json"), "{}").unwrap();
    fs::copy(at("../a.ply"), at("a.ply")).unwrap();
    let refused = |tileset: &Value, wanted: &str| {
        let problem = exported.read(tileset).unwrap_err();
        assert!(problem.contains(wanted) && !problem.contains('\n'), "{wanted}: {problem}");
    };
    let city = &tileset["root"]["children"][0];
    let with = |key: &str, value: Value| {
        let mut tileset = tileset.clone();
        tileset["root"]["children"][0][key] = value;
        tileset
    };
    for (uri, wanted) in [
        ("../a.glb", "leads out of the folder"),
        ("/etc/passwd", "leads out of the folder"),
        ("https://example.com/a.glb", "leads out of the folder"),
        ("", "leads out of the folder"),
        ("none.glb", "cannot be read"),
        ("cut.glb", "cut.glb: glTF without JSON"),
        ("%2e%2E/a.glb", "leads out of the folder"),
        ("https%3A//example.com/a.glb", "leads out of the folder"),
        ("a%2", "\"a%2\", in which a %"),
        ("a%+1.glb", "stands for no character"),
        ("%ff.glb", "stands for no character"),
        ("%é.glb", "stands for no character"),
        ("a%00.glb", "cannot be read"),
        ("other.json", "other.json: is JSON; tilesets"),
        ("a.ply", "a.ply: not binary glTF"),
    ] {
        refused(&with("content", json!({ "uri": uri })), wanted);
    }
    let scaled = |x: f64, y: f64| matrix(DMat4::from_scale(DVec3::new(x, y, 1.0)));
    for (transform, wanted) in [
        (scaled(1.0, 2.0), "uniform scale"),
        (scaled(-1.0, 1.0), "uniform scale"),
        (matrix(DMat4::from_translation(DVec3::X * 1e300)), "beyond what numbers can hold"),
        (json!([1, 2, 3]), "tileset.json: invalid length"),
    ] {
        refused(&with("transform", transform), wanted);
    }
    refused(&with("children", json!([city, city])), "twice");
    refused(&with("implicitTiling", json!({})), "implicit");
    refused(&with("refine", json!("SOMETIMES")), "SOMETIMES");
    refused(&with("geometricError", json!(null)), "tileset.json");
    refused(&json!({ "asset": { "version": "2.0" }, "root": tileset["root"] }), "\"2.0\"");
    refused(&json!({ "asset": { "version": "1.1" }, "root": tile(json!({})) }), "no content");
    let mut extended = tileset.clone();
    extended["extensionsRequired"] = json!([CONTENT, "3DTILES_implicit_tiling"]);
    refused(&extended, "3DTILES_implicit_tiling");
    let mut turned = tileset.clone();
    turned["asset"]["extras"]["groundFromWorld"] = json!([1, 1, 1, 1]);
    refused(&turned, "uniform scale");
    let deep = format!(r#"{}{}"#, r#"{"geometricError": 0, "children": ["#.repeat(9999), "]}".repeat(9999));
    let problem = exported.read_text(&format!(r#"{{"asset": {{"version": "1.1"}}, "root": {deep}}}"#)).unwrap_err();
    assert!(problem.contains("recursion limit"), "{problem}");
    assert_eq!(exported.read(&tileset).unwrap().splats.len(), 60);
}
