//! `plat eval --depth` and `--detector` as run by scripts.

mod common;

use std::fs;
use std::path::PathBuf;

use common::{done, plat, refused, small};
use dataset::synth::{self, Settings};
use serde_json::Value;

/// A file of the data shared between machines.
fn shared(name: &str) -> Option<PathBuf> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
    let found = path.canonicalize().ok();
    if found.is_none() {
        println!("skipped: ../shared/data not present");
    }
    found
}

#[test]
fn depth_is_compared_with_the_truth_and_with_lidar() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let settings = Settings { truth: true, lidar: true, ..small(32, 96, 64) };
    synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
    let job = ["train", "city", "--steps", "400", "--budget", "3000", "--tolerance-db", "0", "--blocks", "whole"];
    let train = |out: &str, more: &[&str]| done(at, &[&job[..], &["--no-lidar", "--out", out], more].concat());
    train("plain", &[]);
    train("deep", &["--depth-weight", "1", "--depths", "city/depth"]);

    let plain = done(at, &["eval", "plain", "city", "--depth", "--trained", "2", "--test-every", "4"]);
    let depth = &plain["depth"];
    let figure = |of: &Value, key: &str| of[key].as_f64().unwrap_or(f64::NAN);
    assert_eq!((&depth["source"], &depth["views"]), (&"truth".into(), &8.into()));
    assert_eq!(depth["by_view"].as_array().unwrap().len(), 10);
    for of in [depth, &depth["aerial"], &depth["street"], &depth["trained_on"]] {
        assert!(figure(of, "absrel") > 0.0 && figure(of, "rmse") > 0.0, "{of}");
        assert!((0.0..=1.0).contains(&figure(of, "delta1")) && figure(of, "pixels") > 1000.0, "{of}");
    }
    let sum = figure(&depth["aerial"], "pixels") + figure(&depth["street"], "pixels");
    assert_eq!(sum, figure(depth, "pixels"));
    // The other figures are as without it, and a model that was trained by true depths has better ones.
    let alone = done(at, &["eval", "plain", "city", "--test-every", "4"]);
    assert!(alone.get("depth").is_none() && alone["views"] == plain["views"]);
    let deep = done(at, &["eval", "deep", "city", "--depth", "--test-every", "4"]);
    let [before, after] = [depth, &deep["depth"]].map(|of| figure(of, "absrel"));
    assert!(after < before, "{after} {before}");
    assert!(figure(&deep["depth"], "delta1") > figure(depth, "delta1"));
    let text = String::from_utf8(plat(at, &["eval", "plain", "city", "--depth"]).stdout).unwrap();
    assert!(text.contains("depth against truth") && text.contains("held out, street"), "{text}");

    // A benchmark's line has them too.
    let run = ["bench", "pareto", "city", "--label", "l", "--results", "r", "--out", "p", "--depth", "--no-lidar"];
    let line = done(at, &[&run[..], &["--steps", "20", "--budget", "300", "--blocks", "whole"]].concat());
    assert!(figure(&line, "depth_absrel") > 0.0 && figure(&line, "depth_delta1") <= 1.0, "{line}");

    // Files of views that are not evaluated are not read.
    let photos: Vec<String> = plain["depth"]["by_view"].as_array().unwrap()[..8]
        .iter()
        .map(|view| view["view"].as_str().unwrap().trim_end_matches(".png").to_owned())
        .collect();
    for file in fs::read_dir(at.join("city/depth")).unwrap().map(|file| file.unwrap().path()) {
        if !photos.contains(&file.file_stem().unwrap().to_string_lossy().into_owned()) {
            fs::write(file, "none").unwrap();
        }
    }
    let words = ["eval", "plain", "city", "--depth", "--test-every", "4", "--quiet"];
    assert_eq!(done(at, &words)["depth"]["absrel"], depth["absrel"]);
    let first = format!("{}.npy", photos[0]);
    fs::write(at.join("city/depth").join(&first), "none").unwrap();
    refused(at, &words, &first);
    fs::remove_dir_all(at.join("city/depth")).unwrap();
    refused(at, &words, "manifest.json says");

    // Without truth its lidar, which sees little of what cars see; without lidar nothing.
    fs::remove_file(at.join("city/manifest.json")).unwrap();
    let lidar = done(at, &words);
    let found = &lidar["depth"];
    assert_eq!(found["source"], "lidar");
    assert!((1.0..figure(depth, "pixels")).contains(&figure(found, "pixels")), "{found}");
    fs::remove_dir_all(at.join("city/lidar")).unwrap();
    refused(at, &words, "has no depths to compare with");
}

#[test]
fn detectors_are_run_on_photos_and_renders() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 96, 64);
    done(at, &["train", "city", "--out", "out", "--steps", "60", "--budget", "600", "--tolerance-db", "0"]);
    let words = |file: &'static str| ["eval", "out", "city", "--quiet", "--detector", file];
    fs::write(at.join("text.onnx"), "no network").unwrap();
    refused(at, &words("text.onnx"), "text.onnx: is not an ONNX graph");
    refused(at, &words("missing.onnx"), "missing.onnx");

    // A network of random weights, which takes a card.
    let tiny = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../perceive/tests/yolov8_tiny.onnx");
    fs::copy(tiny, at.join("tiny.onnx")).unwrap();
    refused(at, &words("tiny.onnx"), "1×7×126 out, and a detector has");
    let card = |text: &str| fs::write(at.join("tiny.toml"), text).unwrap();
    card("classes = ['car']");
    refused(at, &words("tiny.onnx"), "yolov8 of 1 classes");
    card("classes = ['car', 'person', 'bench']\ncolour = 'rgb'");
    refused(at, &words("tiny.onnx"), "unknown field `colour`");
    card("classes = ['car', 'person', 'bench']\n[map]\nlion = 'cat'");
    refused(at, &words("tiny.onnx"), "lion");
    fs::write(at.join("tiny.toml"), [0xff, 0xfe]).unwrap();
    refused(at, &words("tiny.onnx"), "tiny.toml");
    card("classes = ['car', 'person', 'bench']\nscore = 0.9\n[map]\nbench = 'seat'");
    let said = done(at, &words("tiny.onnx"));
    let [found] = &said["detections"].as_array().unwrap()[..] else { panic!("{said}") };
    assert_eq!((&found["detector"], &found["views"]), (&"tiny.onnx".into(), &2.into()));
    assert!(found["map"].as_f64().is_some_and(|map| (0.0..=1.0).contains(&map)), "{found}");
    assert!(
        found["mean_iou"].is_number() && found["zone_psnr"].is_number() && found["zone_ssim"].is_number(),
        "{found}"
    );
    assert_eq!(
        found["misses"].as_u64(),
        found["all"]["photos"].as_u64().zip(found["all"]["kept"].as_u64()).map(|(a, b)| a - b)
    );
    // Two views have no correlation; the city tells what is there.
    assert!(found["correlations"]["psnr"].is_null() && found["correlations"]["views"] == 2, "{found}");
    let truth = &found["truth"];
    assert!(
        truth["boxes"].is_u64() && truth["left_out"].as_u64().unwrap() > 0 && truth["photos"].is_object(),
        "{truth}"
    );
    assert_eq!((&said["detections_kept"], &said["zone_psnr"]), (&found["share_kept"], &found["zone_psnr"]));
    // Nothing at all is found: figures are null.
    card("classes = ['car', 'person', 'bench']\nscore = 1.0");
    let said = done(at, &words("tiny.onnx"));
    let found = &said["detections"][0];
    for key in ["share_kept", "map", "map50", "mean_iou", "zone_psnr", "zone_ssim"] {
        assert!(found.get(key).is_some_and(Value::is_null), "{found}");
    }
    let text = String::from_utf8(plat(at, &words("tiny.onnx")).stdout).unwrap();
    assert!(text.contains("tiny.onnx: detections with a score of 1") && text.contains("0 missed"), "{text}");
    let lines = fs::read(at.join("city/boxes3d.json")).unwrap();
    fs::write(at.join("city/boxes3d.json"), "[]").unwrap();
    refused(at, &words("tiny.onnx"), "boxes3d.json: has no line of a photo");
    fs::write(at.join("city/boxes3d.json"), lines).unwrap();
    card("classes = ['car', 'person', 'bench']\nbins = 4");
    refused(at, &words("tiny.onnx"), "bins");
    card("classes = ['car', 'person', 'bench']");
    fs::remove_dir_all(at.join("city/truth")).unwrap();
    assert!(done(at, &words("tiny.onnx"))["detections"][0].get("truth").is_none());

    let networks = ["yolox_nano_416.onnx", "fastestdet_352.onnx"];
    let [Some(yolox), Some(fastestdet)] = networks.map(|name| shared(&format!("detectors/{name}"))) else { return };
    let [yolox, fastestdet] = [yolox, fastestdet].map(|path| path.display().to_string());
    let both = ["eval", "out", "city", "--quiet", "--detector", &yolox, "--detector", &fastestdet];
    let said = done(at, &both);
    let found = said["detections"].as_array().unwrap();
    assert_eq!((found.len(), &found[0]["score"], &found[1]["score"]), (2, &0.3.into(), &0.65.into()));
    for (found, name) in found.iter().zip(networks) {
        assert_eq!((&found["detector"], found["by_view"].as_array().unwrap().len()), (&name.into(), 2));
        for group in ["vehicles", "people", "all"] {
            let count = |key: &str| found[group][key].as_u64().unwrap();
            assert!(count("kept") <= count("photos") && count("kept") + count("extra") == count("renders"), "{found}");
        }
    }
}
