use std::fs;
use std::path::Path;

use glam::Vec3;
use scene::{Splat, Splats, column, ply, rad, sog};

use super::*;
use crate::{Model, write_rad, write_streamed_sog, write_tiles};

/// A street of splats with a place that SPZ, SOG and RAD can round, and colours that vary with it.
fn street(count: usize) -> Splats {
    let mut splats = Splats::new(1);
    for i in 0..count {
        let (x, y) = ((i % 100) as f32 * 0.7, (i / 100) as f32 * 0.7);
        let mean = Vec3::new(x + 300.0, y - 20.0, (0.3 * x).sin());
        let mut splat = Splat::round(mean, -2.0 + 0.01 * y, Vec3::new(0.2, 0.4, x / 70.0), 0.7);
        splat.sh[2] = [0.1, -0.2, 0.05];
        splat.quat = [0.9, 0.1 * (0.1 * x).sin(), 0.3, -0.2];
        splats.push(&splat);
    }
    splats
}

fn model(splats: Splats) -> Model {
    Model::of(splats, true)
}

/// Both have the same splats, in any order, within these steps of place (metres), log scale, colour, opacity and direction.
fn assert_near(a: &Splats, b: &Splats, [place, scale, colour, opacity, angle]: [f32; 5]) {
    assert_eq!((a.len(), a.sh_degree()), (b.len(), b.sh_degree()));
    let order = |splats: &Splats| {
        let mut rows: Vec<usize> = (0..splats.len()).collect();
        // The street is a grid of 0.7 m.
        rows.sort_by_key(|&i| (splats.mean(i) / 0.7).truncate().round().to_array().map(|v| v as i64));
        rows
    };
    for (i, j) in order(a).into_iter().zip(order(b)) {
        let (a, b) = (a.get(i), b.get(j));
        let alpha = |logit: f32| 1.0 / (1.0 + (-logit).exp());
        let far = |a: &[[f32; 3]; 16], b: &[[f32; 3]; 16]| {
            a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        let [p, q] = [a.quat, b.quat].map(|[w, x, y, z]| glam::Quat::from_xyzw(x, y, z, w).normalize());
        assert!(a.mean.distance(b.mean) <= place, "{} {}", a.mean, b.mean);
        assert!((a.log_scale - b.log_scale).abs().max_element() <= scale, "{} {}", a.log_scale, b.log_scale);
        assert!(far(&a.sh, &b.sh) <= colour, "{:?} {:?}", a.sh, b.sh);
        assert!((alpha(a.opacity_logit) - alpha(b.opacity_logit)).abs() <= opacity);
        assert!(1.0 - p.dot(q).abs() <= angle, "{p} {q}");
    }
}

#[test]
fn what_export_writes_is_read_back_within_the_steps_of_the_format() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let model = model(street(3000));
    fs::write(at("a.ply"), model.to_ply()).unwrap();
    fs::write(at("a.spz"), model.to_spz().unwrap()).unwrap();
    write_streamed_sog(&at("a.ply"), &at("streamed"), &mut |_, _| ()).unwrap();
    write_rad(&at("a.ply"), &at("a.rad"), &mut |_, _| ()).unwrap();
    write_tiles(&at("a.ply"), &at("tiles"), &mut |_, _| ()).unwrap();
    let files = sog::write(&model.splats, true).unwrap();
    fs::write(at("a.sog"), sog::bundle(&files).unwrap()).unwrap();
    fs::create_dir(at("files")).unwrap();
    files.iter().for_each(|file| fs::write(at("files").join(&file.name), &file.bytes).unwrap());
    // By content, whatever the name.
    fs::rename(at("a.rad"), at("model.bin")).unwrap();

    let spz_steps = [0.001, 0.032, 0.04, 0.003, 1e-5];
    let sog_steps = [0.02, 0.03, 0.02, 0.003, 1e-4];
    for (name, wanted, steps) in [
        ("a.ply", Kind::Ply, [0.0, 0.0, 0.0, 0.0, 1e-6]),
        ("a.spz", Kind::Spz, spz_steps),
        ("tiles", Kind::Tiles, spz_steps),
        ("tiles/tileset.json", Kind::Tiles, spz_steps),
        ("a.sog", Kind::Sog, sog_steps),
        ("files", Kind::Sog, sog_steps),
        ("files/meta.json", Kind::Sog, sog_steps),
        ("streamed", Kind::StreamedSog, sog_steps),
        ("streamed/lod-meta.json", Kind::StreamedSog, sog_steps),
        ("model.bin", Kind::Rad, [0.001, 0.03, 0.02, 0.003, 1e-3]),
    ] {
        assert_eq!(kind(&at(name)).unwrap().0, wanted, "{name}");
        let back = crate::read(&at(name)).unwrap();
        println!("{name}");
        assert!(back.antialiased, "{name}");
        // RAD and streamed SOG of a file take the antialiasing of its comment.
        assert_near(&model.splats, &back.splats, steps);
    }
}

#[test]
fn the_finest_level_of_every_leaf_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let splats = street(90);
    for (name, rows) in [("fine.sog", 0..60u32), ("coarse.sog", 60..90)] {
        let files = sog::write(&splats.select(&rows.collect::<Vec<u32>>()), false).unwrap();
        fs::write(at(name), sog::bundle(&files).unwrap()).unwrap();
    }
    let read = |lods: &str| {
        let tree = format!(r#"{{"filenames": ["fine.sog", "coarse.sog"], "environment": null, "tree": {lods}}}"#);
        fs::write(at(LOD), tree).unwrap();
        crate::read(folder.path()).map(|model| model.splats.len()).map_err(|error| error.to_string())
    };
    const LOD: &str = "lod-meta.json";
    let leaf = |lod: u8, file: usize, offset: usize, count: usize| {
        format!(
            r#"{{"lods": {{"{lod}": {{"file": {file}, "offset": {offset}, "count": {count}}}, "9": {{"file": 1, "offset": 0, "count": 1}}}}}}"#
        )
    };
    let two = |a: &str, b: &str| format!(r#"{{"children": [{a}, {b}]}}"#);
    assert_eq!(read(&two(&leaf(0, 0, 0, 40), &leaf(0, 0, 40, 20))), Ok(60));
    assert_eq!(read(&two(&leaf(0, 0, 0, 40), &leaf(1, 1, 10, 20))), Ok(60));
    for (tree, wanted) in [
        (two(&leaf(0, 0, 0, 40), &leaf(0, 0, 39, 20)), "same splats"),
        (leaf(0, 0, 50, 40), "beyond the 60 splats"),
        (leaf(0, 0, usize::MAX, 40), "beyond"),
        (leaf(0, 7, 0, 40), "no name for file 7"),
        ("{\"children\": 3}".into(), "lod-meta.json"),
    ] {
        let problem = read(&tree).unwrap_err();
        assert!(problem.contains(wanted) && problem.contains("lod-meta.json"), "{wanted}: {problem}");
    }
    for (name, wanted) in [
        ("../fine.sog", "leads out"),
        ("/etc/passwd", "leads out"),
        ("http://a.b/fine.sog", "leads out"),
        ("", "leads out"),
        ("none.sog", "cannot be read"),
        ("link.sog", "is no file in the folder"),
        ("fine.sog\", \"fine.sog", "twice"),
    ] {
        #[cfg(unix)]
        let _ = std::os::unix::fs::symlink("/dev/null", at("link.sog"));
        let leaves = two(&leaf(0, 0, 0, 1), &leaf(0, 1, 0, 1));
        let tree = format!(r#"{{"filenames": ["{name}", "coarse.sog"], "tree": {leaves}}}"#);
        fs::write(at(LOD), tree).unwrap();
        let problem = crate::read(folder.path()).unwrap_err().to_string();
        assert!(problem.contains(wanted), "{wanted}: {problem}");
    }
}

#[test]
fn small_files_of_a_streamed_sog_are_limited_together() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut flat = Splats::new(0);
    (0..310_000).for_each(|_| flat.push(&Splat::round(Vec3::ZERO, 0.0, Vec3::ONE, 0.5)));
    sog::write(&flat, false).unwrap().iter().for_each(|file| fs::write(at(&file.name), &file.bytes).unwrap());
    // The same pictures by another name.
    fs::copy(at("meta.json"), at("again.json")).unwrap();
    let read = |environment: &str| {
        let run = r#"{"lods": {"0": {"file": 0, "offset": 0, "count": 310000}}}"#;
        let tree = format!(r#"{{"filenames": ["meta.json"], "environment": {environment}, "tree": {run}}}"#);
        fs::write(at("lod-meta.json"), tree).unwrap();
        crate::read(folder.path()).map(|model| model.splats.len()).map_err(|error| error.to_string())
    };
    assert_eq!(read("null"), Ok(310_000));
    let problem = read("\"again.json\"").unwrap_err();
    assert!(problem.contains("lod-meta.json: has files that are too short for the 620000 splats"), "{problem}");
}

#[test]
fn files_that_are_no_model_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes, wanted) in [
        ("a.sog", &b"PK\x03\x04 and no more"[..], "archive"),
        ("a.rad", b"RAD0\0\0", "RAD"),
        ("a.json", b"{\"a\": 1}", "no model's"),
        ("b.json", b"{", "no JSON"),
        ("a.ply", b"\x89PNG", "no model"),
        ("meta.json", b"{\"means\": 1}", "meta.json"),
        ("empty", b"", "no model"),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let problem = crate::read(&path).unwrap_err().to_string();
        assert!(problem.contains(name) && problem.contains(wanted) && !problem.contains('\n'), "{name}: {problem}");
    }
}

#[test]
fn origins_of_rad_that_leave_the_numbers_are_refused() {
    let splats = street(3);
    let written = |comment: &str| rad::write(&splats, glam::DVec3::ZERO, Some(comment)).unwrap();
    let moved = super::rad::read(&written(r#"{"origin": [1000, 0, 0.5], "antialiased": true}"#)).unwrap();
    assert!(moved.antialiased && moved.splats.col(column::MEAN).iter().all(|&x| x >= 1300.0));
    let plain = super::rad::read(&written("made by hand")).unwrap();
    assert!(plain.splats.len() == 3 && !plain.antialiased && plain.geo_origin.is_none());
    assert!(super::rad::read(&written(r#"{"origin": [1e300, 0, 0]}"#)).is_err());
}

/// What PlayCanvas' own program wrote, where it is there.
#[test]
fn streamed_sog_of_splat_transform_is_read() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/splats/playcanvas/playbot/6_0");
    if path.is_dir() {
        let model = crate::read(&path).unwrap();
        assert_eq!((model.splats.len(), model.splats.sh_degree()), (1873, 2));
        assert!(ply::write(&model.splats, &[]).len() > 1873 * 38 * 4);
    }
}
