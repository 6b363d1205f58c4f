//! `plat update`: a car is parked in a generated city, eight fixed cameras see it, and the city's model gets it.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use common::{done, refused};
use serde_json::Value;

const CITY: [&str; 11] =
    ["synth", "--area-km2", "0.006", "--layout", "grid", "--traffic", "none", "--size", "240x160", "--seed", "3"];

/// All files of a model's blocks.
fn blocks(model: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let folder = fs::read_dir(model.join("model/blocks")).unwrap();
    folder
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.file_name().unwrap().into(), fs::read(&path).unwrap()))
        .collect()
}

fn numbers(of: &Value) -> Vec<f64> {
    of.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn listed(numbers: &[f64]) -> String {
    numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(",")
}

#[test]
fn a_parked_car_appears_in_a_finished_city_and_nothing_else_changes() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    done(at, &[&CITY[..], &["--views", "80", "--aerial", "0.3", "--out", "city"]].concat());
    done(
        at,
        &[
            "train",
            "city",
            "--steps",
            "500",
            "--budget",
            "9000",
            "--levels",
            "1",
            "--tolerance-db",
            "0",
            "--out",
            "model",
        ],
    );
    let watch = ["--watch", "5,5,8", "--views", "8"];
    let seen = done(at, &[&CITY[..], &watch, &["--parked", "--out", "new"]].concat());
    let again = done(at, &[&CITY[..], &watch, &["--out", "empty"]].concat());
    assert_eq!(seen["watched"]["place"], again["watched"]["place"]);
    assert!(again["watched"]["parked"].is_null() && seen["views"].as_u64() >= Some(6), "{seen}");
    let place = numbers(&seen["watched"]["place"]);
    let [area, car] = [listed(&[&place[..], &[5.0]].concat()), listed(&numbers(&seen["watched"]["parked"]))];

    let update = |out: &str, photos: &str, more: &[&str]| {
        let words = ["update", "model", "--area", &area, "--photos", photos, "--steps", "150", "--out", out];
        let words = [&words[..], &["--box", &car, "--backend", "cpu"], more].concat();
        let said = done(at, &words);
        println!("{said}");
        said
    };
    let said = update("updated", "new", &["--garage", "garage", "--name", "parked", "--test-every", "4"]);
    let gain = |of: &str| said[of]["after"].as_f64().unwrap() - said[of]["before"].as_f64().unwrap();
    assert!(gain("trained_on_box") > 3.0 && gain("held_out_box") > 1.5, "{said}");
    assert!(gain("trained_on") > 0.5, "{said}");

    // Blocks away from it have the same bytes, and within the others all splats away from it.
    let (before, after) = (blocks(&at.join("model")), blocks(&at.join("updated")));
    let changed = before.iter().filter(|(name, bytes)| after[*name] != **bytes).count() as u64;
    assert_eq!(
        (before.len() as u64, changed),
        (said["blocks"][1].as_u64().unwrap(), said["blocks"][0].as_u64().unwrap())
    );
    assert!(before.keys().eq(after.keys()) && changed > 0);
    let far = |model: &str| {
        let splats = scene::ply::read(&fs::read(at.join(model).join("merged.ply")).unwrap()).unwrap();
        let centre = glam::DVec3::new(place[0], place[1], place[2]);
        let rows = (0..splats.len()).filter(|&i| splats.mean(i).as_dvec3().distance(centre) > 6.0 + 1e-3);
        let mut rows: Vec<Vec<u32>> = rows.map(|i| splats.columns().iter().map(|c| c[i].to_bits()).collect()).collect();
        rows.sort();
        rows
    };
    let kept = far("model");
    assert!(kept.len() > 1000 && kept == far("updated"), "a splat away from the area has changed");

    // The same photos give the same bytes.
    update("twice", "new", &["--test-every", "4"]);
    let bytes = |model: &str| fs::read(at.join(model).join("merged.ply")).unwrap();
    assert!(bytes("updated") == bytes("twice") && after == blocks(&at.join("twice")));
    // The car is in the garage, and stands in the old model.
    let vehicles = done(at, &["garage", "list", "garage"]);
    assert!(vehicles["vehicles"][0]["splats"].as_u64() > Some(50), "{vehicles}");
    let stand = listed(&[&place[..], &[0.0]].concat());
    done(at, &["garage", "place", "garage", "parked", "--model", "model", "--at", &stand]);
    // A model of one file is updated too.
    let words = ["update", "model/merged.ply", "--area", &area, "--photos", "new", "--steps", "40", "--out", "one.ply"];
    let said = done(at, &words);
    assert!(said["blocks"].is_null() && at.join("one.ply").is_file(), "{said}");

    let bad = |words: &[&str], says: &str| refused(at, words, says);
    let words = ["update", "model", "--photos", "new", "--out", "bad", "--quiet"];
    bad(&[&words[..], &["--area", "1,2,3"]].concat(), "--area");
    bad(&[&words[..], &["--area", "1,2,3,0"]].concat(), "--area");
    bad(&[&words[..], &["--area", "1,2,nan,3"]].concat(), "--area");
    bad(&[&words[..], &["--area", "9000,9000,0,3"]].concat(), "no photo that shows the area");
    bad(&[&words[..], &["--area", &area, "--garage", "garage"]].concat(), "--box");
    let taken = ["--area", &area, "--box", &car, "--garage", "garage", "--name", "parked", "--steps", "1"];
    bad(&[&words[..], &taken].concat(), "already");
    bad(&["update", "model", "--photos", "new", "--quiet", "--out", "model", "--area", &area], "itself");
    bad(&["update", "model", "--photos", "none", "--out", "bad", "--area", &area], "none");
    assert!(!at.join("bad").exists());
}
