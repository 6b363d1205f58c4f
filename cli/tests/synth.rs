//! `plat synth` as run by scripts.

mod common;

use common::{done, plat, refused};

/// The smallest city, with few small photos.
const TINY: [&str; 7] = ["synth", "--area-km2", "0.05", "--views", "24", "--size", "96x54"];

fn tiny<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&TINY[..], more].concat()
}

#[test]
fn a_synthetic_capture_can_be_planned_and_matches_its_manifest() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let made = done(at, &tiny(&["--out", "city", "--fault", "fog=0.3", "--fault", "pose-noise=0.1", "--seed", "4"]));
    assert_eq!(made["views"], 24);
    let points = made["points"].as_u64().unwrap();
    assert!(points > 200, "{made}");
    let manifest: serde_json::Value =
        serde_json::from_slice(&std::fs::read(at.join("city/manifest.json")).unwrap()).unwrap();
    assert_eq!((&manifest["complete"], &manifest["settings"]["city"]["seed"]), (&true.into(), &4.into()));
    let faults: Vec<_> = manifest["settings"]["faults"].as_array().unwrap().iter().map(|f| &f["kind"]).collect();
    assert_eq!(faults, ["fog", "pose-noise"]);
    let inspected = done(at, &["inspect", "city"]);
    assert!(inspected.to_string().contains("24"), "{inspected}");
    let planned = plat(at, &["plan", "city", "--out", "plan.json"]);
    assert!(planned.status.success() && at.join("plan.json").is_file());
    // Another city in the same folder would leave photos of both.
    refused(at, &tiny(&["--out", "city", "--seed", "5", "--quiet"]), "not empty");
}

#[test]
fn bad_settings_are_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    for (words, wanted) in [
        (&["--area-km2", "0"][..], "area"),
        (&["--area-km2", "nan"], "area"),
        (&["--views", "0"], "views"),
        (&["--size", "8x8"], "width"),
        (&["--layout", "hexagonal"], "curved-corridor"),
        (&["--traffic", "wild"], "medium"),
        (&["--fault", "fogg"], "lens-dirt"),
        (&["--fault", "fog=2"], "strength"),
        (&["--aerial", "0.8", "--fixed", "0.3"], "shares"),
        (&["--occupancy", "0.001"], "voxel"),
        (&["--occupancy", "0.1", "--occupancy-around", "1,2,3"], "degrees"),
        (&["--occupancy", "0.1", "--occupancy-around", "1,2,3,900"], "voxels"),
        (&["--occupancy-around", "1,2,3,4"], "--occupancy"),
        (&["--plain", "0.9"], "plain"),
    ] {
        refused(at, &[&["synth", "--out", "o"], words].concat(), wanted);
    }
    refused(at, &["synth"], "--out");
    assert!(!at.join("o").exists());
}

#[test]
fn a_synthetic_capture_can_be_trained() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let voxels = ["--occupancy", "0.5", "--occupancy-around", "0,0,1,4,30"];
    let made = done(at, &[&tiny(&["--out", "city", "--views", "40", "--aerial", "1"])[..], &voxels].concat());
    assert!(at.join("city/occupancy/around_000.npz").is_file() && !at.join("city/occupancy/000_000.npz").exists());
    assert!(made["moving"].as_u64().unwrap() > 0);
    let train = |out: &str, steps: &str| {
        let words = ["train", "city", "--out", out, "--steps", steps, "--budget", "4000", "--levels", "1"];
        done(at, &[&words[..], &["--threads", "2", "--store", "store"]].concat());
        done(at, &["eval", out, "city"])["psnr"].as_f64().unwrap()
    };
    let (begun, trained) = (train("begun", "1"), train("trained", "400"));
    assert!(at.join("trained/merged.ply").is_file() && at.join("trained/model/model.json").is_file());
    assert!(trained > begun + 0.5 && trained > 18.0, "{begun} dB, then {trained} dB");
}

#[test]
fn the_gallery_is_a_single_picture() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    done(at, &["synth", "--area-km2", "0.05", "--size", "48x28", "--gallery", "all.png"]);
    let picture = image::open(at.join("all.png")).unwrap();
    // Six panes a row of 31, each with a frame and a line of text.
    assert_eq!((picture.width(), picture.height()), (6 * 50, 6 * 40));
    assert_eq!(std::fs::read_dir(at).unwrap().count(), 1);
    refused(at, &["synth", "--gallery", "all.png", "--out", "o"], "--out");
}
