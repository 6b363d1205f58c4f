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

/// The manifest of a synthetic capture.
fn manifest_of(at: &std::path::Path, name: &str) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(at.join(name).join("manifest.json")).unwrap()).unwrap()
}

#[test]
fn cars_drive_streets_closely_and_inspect_tells_the_spacing() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let compact = ["synth", "--area-km2", "0.005", "--views", "120", "--size", "64x48", "--traffic", "none"];
    let synth = |more: &[&str]| done(at, &[&compact[..], more].concat());
    let made = synth(&["--out", "close", "--spacing", "2", "--aerial", "0"]);
    assert_eq!((&made["views"], &made["driven"]["stops"]), (&120.into(), &20.into()));
    assert_eq!((&made["driven"]["metres"], &made["driven"]["rig"]), (&40.0.into(), &"six".into()));
    assert!(made["driven"]["share"].as_f64().unwrap() < 0.5, "{made}");
    let manifest = manifest_of(at, "close");
    assert_eq!((&manifest["settings"]["spacing"], &manifest["summary"]["driven"]), (&2.0.into(), &made["driven"]));
    let inspected = done(at, &["inspect", "close"]);
    let spacing = inspected["density"]["street"]["spacing_metres"].as_f64().unwrap();
    assert!((spacing - 2.0).abs() < 0.4, "{inspected}");

    // One camera, thinned evenly over all streets as without --spacing.
    let made = synth(&["--out", "front", "--rig", "front", "--views", "24"]);
    assert_eq!((&made["views"], &made["driven"]), (&24.into(), &serde_json::Value::Null));
    assert_eq!(manifest_of(at, "front")["settings"]["rig"], "front");
    let names = std::fs::read_dir(at.join("front/images")).unwrap().map(|entry| entry.unwrap().file_name());
    let names: Vec<String> = names.map(|name| name.into_string().unwrap()).collect();
    assert_eq!(names.iter().filter(|name| name.starts_with("street-front-0")).count(), 12, "{names:?}");

    // The drawing shows what the figures say.
    let inspected = done(at, &["inspect", "front", "--svg", "front.svg"]);
    let thin = inspected["density"]["street"]["thin_cells"].as_u64().unwrap() as usize;
    let svg = std::fs::read_to_string(at.join("front.svg")).unwrap();
    assert_eq!(svg.matches("class=\"thin-street\"").count(), thin + 1, "{inspected}");
    assert!(svg.starts_with("<svg") && svg.contains("12 street views") && svg.contains("12 aerial views"));
    refused(at, &["synth", "--out", "o", "--spacing", "0.01"], "spacing");
}

#[test]
fn held_out_stretches_are_never_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let city =
        ["synth", "--out", "city", "--area-km2", "0.005", "--views", "120", "--size", "64x48", "--traffic", "none"];
    done(at, &[&city[..], &["--spacing", "3", "--rig", "front"]].concat());
    let plan_of = |more: &[&str]| -> serde_json::Value {
        done(at, &[&["plan", "city", "--out", "plan.json"][..], more].concat());
        serde_json::from_slice(&std::fs::read(at.join("plan.json")).unwrap()).unwrap()
    };
    let views = |plan: &serde_json::Value, list: &str| -> std::collections::BTreeSet<u64> {
        let tasks = plan["tasks"].as_array().unwrap().iter();
        let used = tasks.flat_map(|task| task[list].as_array().unwrap());
        used.map(|used| used["view"].as_u64().unwrap()).collect()
    };
    let plan = plan_of(&["--test-stretches", "20"]);
    assert_eq!(plan["settings"]["test_stretches"], 20.0);
    let (trained, held_out) = (views(&plan, "views"), views(&plan, "test_views"));
    assert!(trained.is_disjoint(&held_out) && trained.len() > 60, "{} trained", trained.len());
    let stretches: Vec<u64> = held_out.iter().copied().filter(|view| view % 8 != 0).collect();
    assert!(!stretches.is_empty() && held_out.contains(&0), "{held_out:?}");
    // Views are in name order: 60 aerial ones come first, which are in no stretch.
    assert!(stretches.iter().all(|view| *view >= 60), "{stretches:?}");
    assert!(views(&plan_of(&[]), "test_views").iter().all(|view| view % 8 == 0));
    refused(at, &["plan", "city", "--test-stretches", "nan"], "--test-stretches");

    // Both splits are reported beside each other, apart by kind; evaluation knows the split from the model.
    let train =
        ["train", "city", "--out", "out", "--steps", "20", "--budget", "500", "--levels", "0", "--backend", "cpu"];
    let report = done(at, &[&train[..], &["--test-stretches", "20", "--evaluate"]].concat());
    assert_eq!(
        report["stretches"]["views"].as_u64().unwrap() as usize,
        report["stretches"]["figures"].as_array().unwrap().len()
    );
    let evaluated = done(at, &["eval", "out", "city", "--trained", "10", "--backend", "cpu"]);
    for key in ["aerial", "street", "stretches"] {
        assert!(
            evaluated[key]["psnr"].as_f64().unwrap() > 5.0 && evaluated[key]["worst_psnr"].is_number(),
            "{evaluated}"
        );
        let [a, b] = [&evaluated, &report].map(|of| of[key]["psnr"].as_f64().unwrap());
        assert!((a - b).abs() < 1e-6, "{key}: {a} {b}");
    }
    assert_eq!(evaluated["trained_on"]["views"], 10);
    assert!(evaluated["trained_on"]["aerial"]["views"].as_u64().unwrap() > 0, "{evaluated}");
    let all = evaluated["aerial"]["views"].as_u64().unwrap() + evaluated["street"]["views"].as_u64().unwrap();
    assert_eq!(all as usize, evaluated["views"].as_array().unwrap().len());
}
