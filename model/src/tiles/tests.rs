use glam::{DVec2, Vec3};
use scene::{Splat, spz};

use super::*;

const fn block(level: u8, x: u32, y: u32) -> BlockId {
    BlockId { level, x, y }
}

/// A root with two of its four children, one of which has all four.
const TREE: [BlockId; 7] =
    [BlockId::ROOT, block(1, 0, 0), block(1, 1, 1), block(2, 2, 2), block(2, 3, 2), block(2, 2, 3), block(2, 3, 3)];

fn ground() -> Ground {
    let min = DVec2::new(-20.0, -8.0);
    // World y is down, z ahead.
    let ground_from_world = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    Ground { ground_from_world, min, edge_metres: 64.0, height_metres: 2.0, near_metres: 100.0 }
}

/// Splats on a grid over the root (ground axes), and some that are background. The red of a splat tells its level.
fn splats_of(level: u8, step: f32) -> Splats {
    let mut splats = Splats::new(1);
    let mut push = |at: DVec3, size: f32| {
        let colour = Vec3::new(0.2 * f32::from(level), 0.5, 0.5);
        splats.push(&Splat::round(ground().to_world(at).as_vec3(), size, colour, 0.8));
    };
    let side = (80.0 / step) as usize;
    for (x, y) in (0..side).flat_map(|x| (0..side).map(move |y| (x, y))) {
        push(DVec3::new(f64::from(x as f32 * step - 27.9), f64::from(y as f32 * step - 15.9), 1.0), step.ln());
    }
    (-2..3).for_each(|x| push(DVec3::new(f64::from(x) * 40.0, 0.0, 300.0), 2.0));
    splats
}

fn write(out: &Path, is_tree: bool, blocks: &[BlockId], step: f32) -> Exported {
    let mut writer = Writer::new(out, ground(), is_tree, blocks, false);
    for &block in blocks {
        let splats = splats_of(block.level, step / f32::from(1u8 << block.level));
        writer.add(block, &splats, 1.0 / f64::from(1u8 << block.level)).unwrap();
    }
    let place = GeoOrigin { latitude_degrees: 48.0, longitude_degrees: 11.0, altitude_metres: 500.0 };
    writer.finish(Some(place)).unwrap()
}

fn tileset(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join(TILESET)).unwrap()).unwrap()
}

/// The splats of a file with their places in ground axes, read as a viewer does that takes SPZ as stored.
fn content(out: &Path, tile: &Value) -> Vec<(DVec3, f32)> {
    let bytes = std::fs::read(out.join(tile["content"]["uri"].as_str().unwrap())).unwrap();
    let text = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let document: Value = serde_json::from_slice(&bytes[20..20 + text]).unwrap();
    let length = document["bufferViews"][0]["byteLength"].as_u64().unwrap() as usize;
    let (splats, _) = spz::read(&bytes[28 + text..28 + text + length]).unwrap();
    let matrix: Vec<f64> = serde_json::from_value(document["nodes"][0]["matrix"].clone()).unwrap();
    let matrix = DMat4::from_cols_slice(&matrix);
    let place = |i: usize| {
        let stored = splats.mean(i).as_dvec3() * DVec3::new(1.0, -1.0, -1.0);
        assert!(stored.length() < 700.0, "stored about the middle of its square");
        let y_up = matrix.transform_point3(stored);
        DVec3::new(y_up.x, -y_up.z, y_up.y)
    };
    (0..splats.len()).map(|i| (place(i), splats.col(column::SH)[i])).collect()
}

fn is_in(tile: &Value, at: DVec3) -> bool {
    let of: Vec<f64> = serde_json::from_value(tile["boundingVolume"]["box"].clone()).unwrap();
    let vector = |k: usize| DVec3::from_slice(&of[3 * k..]);
    let from_middle = at - vector(0);
    (1..4).all(|k| from_middle.dot(vector(k)).abs() <= vector(k).length_squared() * 1.001 + 1e-3)
}

/// The places that are shown where every tile coarser than `error` is refined.
fn shown(out: &Path, tile: &Value, error: f64) -> Vec<(DVec3, f32)> {
    let children = tile["children"].as_array().cloned().unwrap_or_default();
    let is_refined = !children.is_empty() && tile["geometricError"].as_f64().unwrap() > error;
    let mut all: Vec<(DVec3, f32)> = Vec::new();
    if is_refined {
        for child in &children {
            assert!(child["geometricError"].as_f64().unwrap() <= tile["geometricError"].as_f64().unwrap());
            all.extend(shown(out, child, error));
        }
    }
    if !tile["content"].is_null() && (!is_refined || tile["refine"] == "ADD") {
        all.extend(content(out, tile));
    }
    assert!(all.iter().all(|(at, _)| is_in(tile, *at)), "a splat outside of its tile's box");
    all
}

#[test]
fn every_cut_of_the_tiles_covers_the_ground_once() {
    let folder = tempfile::tempdir().unwrap();
    let exported = write(folder.path(), true, &TREE, 4.0);
    let tileset = tileset(folder.path());
    assert_eq!(
        (&tileset["root"]["refine"], &tileset["root"]["children"][0]["refine"]),
        (&json!("ADD"), &json!("REPLACE"))
    );
    let mut by_cut = Vec::new();
    for error in [1e6, 20.0, 10.0, 0.0] {
        let all = shown(folder.path(), &tileset["root"], error);
        let near: Vec<_> = all.iter().filter(|(at, _)| at.z < 100.0).collect();
        assert_eq!(all.len() - near.len(), 5, "the backdrop is always shown");
        by_cut.push(near.len());
        if error >= 1e6 {
            assert!(near.is_empty(), "the root shows its backdrop only");
            continue;
        }
        // By which block: the red of a splat tells its level.
        for y in 0..8 {
            for x in 0..8 {
                let min = ground().min + DVec2::new(f64::from(x), f64::from(y)) * 8.0;
                let here = |at: &DVec3| at.truncate().cmpge(min).all() && at.truncate().cmplt(min + 8.0).all();
                let reds: BTreeSet<u32> =
                    near.iter().filter(|(at, _)| here(at)).map(|(_, red)| red.to_bits()).collect();
                assert_eq!(reds.len(), 1, "cell {x}, {y} at {error} m shows one level");
            }
        }
    }
    assert!(by_cut[1] < by_cut[2] && by_cut[2] < by_cut[3], "{by_cut:?}");
    assert_eq!(exported.splats as usize, by_cut[3] + 5);
    assert_eq!(by_cut[1], 20 * 20, "the coarsest has the root's splats");
    let transform: Vec<f64> = serde_json::from_value(tileset["root"]["transform"].clone()).unwrap();
    let length = DVec3::from_slice(&transform[12..]).length();
    assert!((6_350_000.0..6_380_000.0).contains(&length), "{length} m from the middle of the Earth");

    let again = tempfile::tempdir().unwrap();
    write(again.path(), true, &TREE, 4.0);
    for entry in std::fs::read_dir(folder.path()).unwrap() {
        let name = entry.unwrap().file_name();
        let same =
            std::fs::read(folder.path().join(&name)).unwrap() == std::fs::read(again.path().join(&name)).unwrap();
        assert!(same, "{name:?}: not the same bytes twice");
    }
}

#[test]
fn the_finest_tiles_are_read_where_the_model_had_them() {
    let folder = tempfile::tempdir().unwrap();
    let exported = write(folder.path(), true, &TREE, 4.0);
    let back = crate::read(folder.path()).unwrap();
    assert_eq!((back.splats.len() as u64, back.splats.sh_degree(), back.antialiased), (exported.splats, 1, false));
    let found = back.geo_origin.unwrap();
    assert!((found.latitude_degrees - 48.0).abs() < 1e-9 && (found.longitude_degrees - 11.0).abs() < 1e-9, "{found:?}");
    assert!((found.altitude_metres - 500.0).abs() < 1e-6, "{found:?}");

    let place = |at: DVec3| (at * 100.0).round().to_array().map(|v| v as i64);
    let sorted = |mut places: Vec<_>| {
        places.sort_unstable();
        places
    };
    // What viewers show, in the axes of the ground, and what is read, in those of the world, which was y down.
    let shown = shown(folder.path(), &tileset(folder.path())["root"], 0.0);
    let shown = shown.into_iter().map(|(at, red)| (place(ground().to_world(at)), red.to_bits())).collect();
    let read = |i: usize| (place(back.splats.mean(i).as_dvec3()), back.splats.col(column::SH)[i].to_bits());
    assert!(sorted((0..back.splats.len()).map(read).collect()) == sorted(shown));

    // Another export keeps the place on Earth.
    let again = tempfile::tempdir().unwrap();
    write_tiles(folder.path(), &again.path().join("tiles"), &mut |_, _| ()).unwrap();
    crate::write_rad(folder.path(), &again.path().join("a.rad"), &mut |_, _| ()).unwrap();
    crate::write_streamed_sog(folder.path(), &again.path().join("sog"), &mut |_, _| ()).unwrap();
    for name in ["tiles", "a.rad", "sog"] {
        let origin = crate::read(&again.path().join(name)).unwrap().geo_origin.unwrap();
        assert!((origin.latitude_degrees - 48.0).abs() < 1e-9, "{name}: {origin:?}");
    }
}

#[test]
fn crowded_tiles_are_quartered() {
    let folder = tempfile::tempdir().unwrap();
    let exported = write(folder.path(), false, &[BlockId::ROOT], 0.1);
    let tileset = tileset(folder.path());
    let city = &tileset["root"]["children"][0];
    assert!(city["content"].is_null() && city["children"].as_array().unwrap().len() == 4, "{city}");
    let all = shown(folder.path(), &tileset["root"], 0.0);
    assert_eq!((exported.splats as usize, exported.levels), (all.len(), 1));
    assert_eq!(all.len(), splats_of(0, 0.1).len());
}

#[test]
fn what_cannot_be_exported_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let empty = Writer::new(folder.path(), ground(), true, &[BlockId::ROOT], false).finish(None);
    assert!(empty.unwrap_err().to_string().contains("no splat"));
    std::fs::write(folder.path().join("a.ply"), scene::ply::write(&splats_of(0, 8.0), &[])).unwrap();
    let (model, out) = (folder.path().join("a.ply"), folder.path().join("out"));
    let exported = write_tiles(&model, &out, &mut |_, _| ()).unwrap();
    assert!(exported.splats == 105 && tileset(&out)["root"]["transform"].is_null());
    let again = write_tiles(&model, &out, &mut |_, _| ()).unwrap_err().to_string();
    assert!(again.contains("is not empty"), "{again}");
}
