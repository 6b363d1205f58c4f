//! `plat garage`: a vehicle of one model stands and drives in another, whose other files stay as they are.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use common::{done, refused};
use serde_json::{Value, json};

/// All files below a folder.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                all.insert(path.clone(), fs::read(path).unwrap());
            }
        }
    }
    all
}

#[test]
fn a_vehicle_moves_from_one_model_into_another() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 96, 64);
    done(at, &["train", "city", "--steps", "80", "--budget", "2000", "--levels", "1", "--out", "model"]);
    // The middle of the model: a box there holds something.
    let cameras: Value = serde_json::from_slice(&fs::read(at.join("city/transforms.json")).unwrap()).unwrap();
    let points = cameras["frames"].as_array().unwrap();
    let mean = |row: usize| {
        let sum: f64 = points.iter().map(|frame| frame["transform_matrix"][row][3].as_f64().unwrap()).sum();
        sum / points.len() as f64
    };
    let area = format!("{},{},-20,30,60,60,60", mean(0), mean(1));
    let said = done(at, &["garage", "add", "garage", "--model", "model", "--box", &area, "--name", "piece"]);
    println!("{said}");
    let splats = said["vehicle"]["splats"].as_u64().unwrap();
    assert!(splats > 10, "{said}");
    let listed = done(at, &["garage", "list", "garage"]);
    assert_eq!((&listed["vehicles"][0]["name"], listed["vehicles"].as_array().unwrap().len()), (&"piece".into(), 1));

    let before = files(&at.join("model"));
    let place = ["garage", "place", "garage", "piece", "--model", "model"];
    done(at, &[&place[..], &["--at", "3,-4,0.5,90", "--id", "parked"]].concat());
    let path = json!({"tracks": [{"id": "7", "class": "car", "low": [0, 0, 0], "high": [1, 1, 1], "poses": [
        [0, [0, 0, 0], [0, 0, 0, 1]], [10, [50, 0, 0], [0, 0, 0, 1]]
    ]}]});
    fs::write(at.join("path.json"), path.to_string()).unwrap();
    let said = done(at, &[&place[..], &["--path", "path.json"]].concat());
    assert_eq!((&said["id"], said["poses"].as_u64(), said["until"].as_f64()), (&"piece".into(), Some(2), Some(10.0)));
    let after = files(&at.join("model"));
    assert!(before.iter().all(|(path, bytes)| after[path] == *bytes), "a file of the model has changed");
    let new: Vec<String> = after
        .keys()
        .filter(|path| !before.contains_key(*path))
        .map(|path| path.strip_prefix(at).unwrap().display().to_string())
        .collect();
    assert_eq!(new, ["model/objects/parked.ply", "model/objects/paths.json", "model/objects/piece.ply"]);

    // It is drawn where it is at a time, and can be left out.
    let render = |out: &str, more: &[&str]| {
        let words = ["render", "model", "--cameras", "city", "--out", out, "--size", "64x48"];
        let said = done(at, &[&words[..], more].concat());
        (files(&at.join(out)).into_values().collect::<Vec<_>>(), said["objects"].as_u64().unwrap())
    };
    let (early, count) = render("early", &["--time", "1"]);
    let (late, _) = render("late", &["--time", "9"]);
    let (without, left) = render("without", &["--time", "1", "--without", "all"]);
    assert_eq!((count, left), (2, 0));
    assert!(early != late && early != without);
    // An object of a model goes into a garage as well.
    done(at, &["garage", "add", "garage", "--model", "model", "--object", "parked", "--name", "again"]);
    assert_eq!(done(at, &["garage", "list", "garage"])["vehicles"][0]["splats"].as_u64(), Some(splats));

    let bad = |words: &[&str], says: &str| refused(at, words, says);
    bad(&[&place[..], &["--path", "path.json"]].concat(), "already");
    bad(&[&place[..], &["--path", "path.json", "--track", "8", "--id", "x"]].concat(), "no object '8'");
    bad(&[&place[..], &["--at", "1,2,3"]].concat(), "--at");
    bad(&[&place[..], &["--at", "1,2,3,0", "--id", "../x"]].concat(), "name");
    bad(&["garage", "place", "garage", "none", "--model", "model", "--at", "1,2,3,0"], "piece");
    bad(&["garage", "place", "garage", "piece", "--model", "model/merged.ply", "--at", "1,2,3,0"], "one file");
    bad(&["garage", "add", "garage", "--model", "model", "--object", "8"], "parked, piece");
    bad(&["garage", "add", "garage", "--model", "model", "--box", &area, "--name", "piece"], "already");
    bad(&["garage", "add", "garage", "--model", "model", "--box", "1e5,0,0,0,1,1,1", "--name", "far"], "no splats");
    bad(&["garage", "add", "garage", "--model", "model", "--box", "0,0,0,0,1,1,0", "--name", "flat"], "--box");
    bad(&["garage", "add", "garage", "--model", "model"], "--object");
    assert!(!at.join("garage/far.ply").exists());
}
