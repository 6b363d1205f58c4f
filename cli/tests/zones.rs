//! Objects on photos that count more, as scripts use them: found by a detector or listed in a file. Masks are in `masks.rs`.

mod common;

use std::fs;
use std::path::Path;

use common::{city, done, refused, write_tiny};
use serde_json::{Value, json};

const TRAIN: [&str; 9] = ["train", "city", "--steps", "60", "--budget", "600", "--levels", "1", "--quiet"];

fn names(at: &Path) -> Vec<String> {
    let transforms: Value = serde_json::from_slice(&fs::read(at.join("city/transforms.json")).unwrap()).unwrap();
    let frames = transforms["frames"].as_array().unwrap();
    let name = |frame: &Value| frame["file_path"].as_str().unwrap().trim_start_matches("images/").to_owned();
    frames.iter().map(name).collect()
}

/// Boxes of one class, in COCO's layout: of each photo of 96×64 pixels this one.
fn boxes(at: &Path, bbox: [f64; 4]) -> Value {
    let names = names(at);
    let image = |(id, name): (usize, &String)| json!({"id": id, "file_name": name, "width": 96, "height": 64});
    let annotation = |id: usize| json!({"image_id": id, "category_id": 3, "bbox": bbox, "score": 0.5});
    json!({
        "images": names.iter().enumerate().map(image).collect::<Vec<_>>(),
        "annotations": (0..names.len()).map(annotation).collect::<Vec<_>>(),
        "categories": [{"id": 3, "name": "car"}],
    })
}

fn write(at: &Path, name: &str, boxes: &Value) {
    fs::write(at.join(name), boxes.to_string()).unwrap();
}

#[test]
fn pixels_of_zones_change_training_and_pruning_reproducibly() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 96, 64);
    write(at, "boxes.json", &boxes(at, [20.0, 10.0, 40.0, 30.0]));
    let train = |out: &str, more: &[&str]| {
        let said = done(at, &[&TRAIN[..], &["--out", out], more].concat());
        let plan: Value = serde_json::from_slice(&fs::read(at.join(out).join("plan.json")).unwrap()).unwrap();
        (said["capture"].clone(), plan["zones"].clone(), fs::read(at.join(out).join("merged.ply")).unwrap())
    };
    let (capture, none, plain) = train("plain", &[]);
    let (same, zones, weighed) = train("weighed", &["--zones", "boxes.json"]);
    assert!(none.is_null() && !zones.is_null() && capture == same && plain != weighed);
    let (_, again, other_threads) = train("again", &["--zones", "boxes.json", "--threads", "1", "--workers", "2"]);
    assert!(again == zones && other_threads == weighed, "the same zones give another model");
    let (_, again, configured) = train("configured", &["--config", "weighed/config.toml"]);
    assert!(again == zones && configured == weighed, "the saved configuration leaves the zones out");
    let (_, zones, unweighed) = train("unweighed", &["--zones", "boxes.json", "--zone-weight", "0"]);
    assert!(!zones.is_null() && unweighed == plain, "zones of no weight change the model");

    let prune = |out: &str, more: &[&str]| {
        let words = ["prune", "plain", "--capture", "city", "--keep", "0.5", "--out", out];
        done(at, &[&words[..], more].concat());
        fs::read(at.join(out).join("merged.ply")).unwrap()
    };
    assert!(prune("half", &[]) != prune("half-weighed", &["--zones", "boxes.json"]));
    refused(
        at,
        &["prune", "plain/merged.ply", "--keep", "0.5", "--out", "o.ply", "--zones", "boxes.json"],
        "--capture",
    );

    // A network of random weights finds something; the second run reads what the first one recorded.
    write_tiny(at);
    let detector = ["--detector", "tiny.onnx", "--zone-weight", "2"];
    let (_, zones, found) = train("detected", &detector);
    let recorded = fs::read_dir(at.join("detected/store/names/zones")).map_or(0, Iterator::count);
    // Tasks of the job look for them, so the plan does not know them.
    assert!(zones.is_null() && found != plain && recorded == names(at).len(), "{recorded} records");
    assert_eq!(
        train("detected-again", &[&detector[..], &["--store", "detected/store"]].concat()),
        (capture, zones, found)
    );
}

/// A network with an operator whose gradient is not known.
fn with_other_operator(onnx: &[u8]) -> Vec<u8> {
    let mut other = onnx.to_vec();
    let places: Vec<usize> = (0..other.len() - 4).filter(|&i| &other[i..i + 4] == b"Tanh").collect();
    places.into_iter().for_each(|i| other[i..i + 4].copy_from_slice(b"Ceil"));
    other
}

#[test]
fn pruning_keeps_what_a_detector_finds_on_renders() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 96, 64);
    let onnx = write_tiny(at);
    done(at, &[&TRAIN[..], &["--tolerance-db", "0", "--out", "model"]].concat());
    let prune = |out: &str, more: &[&str]| {
        let words = ["prune", "model", "--capture", "city", "--detector", "tiny.onnx", "--tolerance-db", "6"];
        done(at, &[&words[..], &["--out", out], more].concat())
    };
    let free = prune("free", &[]);
    assert!(free["objects"].is_null() && free["tolerance_detections"].is_null(), "{free}");
    let any = prune("any", &["--tolerance-detections", "1"]);
    let none = prune("none", &["--tolerance-detections", "0"]);
    println!("{free}\n{any}\n{none}");
    let objects = |said: &Value| [0, 1].map(|i| said["objects"][i].as_u64().unwrap());
    let [before, kept] = objects(&none);
    assert!(before > 0 && kept == before, "{none}");
    assert!(objects(&any)[0] == before && any["splats"] == free["splats"], "a tolerance of all changes the result");
    assert!(none["splats"].as_u64() >= any["splats"].as_u64());

    // Recoveries that ask the detector give another model, the same each time.
    let of = |out: &str, weight: &str| {
        prune(out, &["--aligned-weight", weight]);
        fs::read(at.join(out).join("merged.ply")).unwrap()
    };
    let (asked, unasked) = (of("asked", "0.1"), of("unasked", "0"));
    assert!(
        unasked == fs::read(at.join("free/merged.ply")).unwrap() && asked != unasked && of("again", "0.1") == asked
    );

    let words = ["prune", "model", "--capture", "city", "--out", "o"];
    let refused_with = |more: &[&str], says: &str| refused(at, &[&words[..], more].concat(), says);
    refused_with(&["--tolerance-detections", "0"], "--detector");
    refused_with(&["--aligned-weight", "0.1"], "--detector");
    // A detector that runs, but whose gradient is not known.
    fs::write(at.join("other.onnx"), with_other_operator(&onnx)).unwrap();
    fs::copy(at.join("tiny.toml"), at.join("other.toml")).unwrap();
    refused_with(&["--detector", "other.onnx", "--aligned-weight", "0.1"], "Ceil");
    let detector = ["--detector", "tiny.onnx", "--tolerance-detections"];
    for share in ["-0.1", "1.5", "nan", "few"] {
        refused_with(
            &[&detector[..2], &[&format!("--tolerance-detections={share}")]].concat(),
            "--tolerance-detections",
        );
    }
    refused_with(&[&detector[..], &["0", "--keep", "0.5"]].concat(), "--keep");
}

#[test]
fn a_detectors_loss_changes_training_reproducibly() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 96, 64);
    let onnx = write_tiny(at);
    let train = |out: &str, more: &[&str]| {
        done(at, &[&TRAIN[..], &["--detector", "tiny.onnx", "--zone-weight", "0", "--out", out], more].concat());
        let plan: Value = serde_json::from_slice(&fs::read(at.join(out).join("plan.json")).unwrap()).unwrap();
        (plan["detector"].clone(), fs::read(at.join(out).join("merged.ply")).unwrap())
    };
    let (none, plain) = train("plain", &["--aligned-weight", "0"]);
    let (network, aligned) = train("aligned", &["--aligned-weight", "0.1"]);
    assert!(none.is_null() && !network.is_null() && plain != aligned);
    let more = ["--aligned-weight", "0.1", "--threads", "1", "--workers", "2"];
    assert!(train("again", &more) == (network.clone(), aligned.clone()), "the same plan gives another model");
    assert!(train("configured", &["--config", "aligned/config.toml"]) == (network, aligned));
    let log = fs::read_to_string(at.join("aligned/metrics.jsonl")).unwrap();
    let lines = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let computed: Vec<Value> = lines.filter(|line| !line["aligned_cpu_ms"].is_null()).collect();
    let has_loss = |line: &Value| line["aligned_loss"].as_f64().is_some_and(|loss| loss > 0.0);
    assert!(!computed.is_empty() && computed.iter().any(has_loss), "{log}");

    let refused_with = |more: &[&str], says: &str| refused(at, &[&TRAIN[..], &["--out", "o"], more].concat(), says);
    refused_with(&["--aligned-weight", "0.1"], "--detector");
    for weight in ["-1", "1001", "nan", "much"] {
        refused_with(&["--detector", "tiny.onnx", &format!("--aligned-weight={weight}")], "--aligned-weight");
    }
    // A detector that runs, but whose gradient is not known.
    fs::write(at.join("other.onnx"), with_other_operator(&onnx)).unwrap();
    fs::copy(at.join("tiny.toml"), at.join("other.toml")).unwrap();
    refused_with(&["--detector", "other.onnx", "--aligned-weight", "0.1"], "Ceil");
}

#[test]
fn boxes_that_do_not_fit_are_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 96, 64);
    let good = boxes(at, [20.0, 10.0, 40.0, 30.0]);
    let change = |name: &'static str, change: &dyn Fn(&mut Value), says: &str| {
        let mut bad = good.clone();
        change(&mut bad);
        write(at, name, &bad);
        refused(at, &[&TRAIN[..], &["--out", "out", "--zones", name]].concat(), says);
    };
    change("outside.json", &|b| b["annotations"][0]["bbox"] = json!([90.0, 10.0, 40.0, 30.0]), "outside");
    change("flat.json", &|b| b["annotations"][0]["bbox"] = json!([20.0, 10.0, 0.0, 30.0]), "outside");
    change("score.json", &|b| b["annotations"][0]["score"] = json!(2.0), "outside");
    change("image.json", &|b| b["annotations"][0]["image_id"] = json!(99), "image 99");
    change("class.json", &|b| b["annotations"][0]["category_id"] = json!(4), "category 4");
    change(
        "others.json",
        &|b| b["images"] = json!([{"id": 0, "file_name": "x.png", "width": 9, "height": 9}]),
        "x.png",
    );
    change("empty.json", &|b| b["images"][0]["width"] = json!(0), "0×64 pixels");
    change("huge.json", &|b| b["images"][0]["width"] = json!(u32::MAX), "4294967295×64 pixels");
    let mask = |b: &mut Value, mask: Value| b["annotations"][0]["segmentation"] = mask;
    change("far.json", &|b| mask(b, json!([[0, 0, 99, 0, 0, 60]])), "a polygon with the point 99, 0 outside");
    change("odd.json", &|b| mask(b, json!([[0, 0, 9, 0, 0, 60, 1]])), "an x without its y");
    change("runs.json", &|b| mask(b, json!({"size": [64, 96], "counts": [u32::MAX, 9]})), "4294967304 pixels in all");
    change("size.json", &|b| mask(b, json!({"size": [96, 64], "counts": [6144]})), "run lengths of 64×96 pixels");
    change("letters.json", &|b| mask(b, json!({"size": [64, 96], "counts": "ooooooooo"})), "damaged string");
    change("kind.json", &|b| mask(b, json!("mask")), "kind.json: has no objects to use");
    change("none.json", &|b| b["annotations"][0]["bbox"] = json!(null), "neither bbox nor segmentation");
    change("bbox.json", &|b| b["annotations"][0]["bbox"] = json!([1, 2, 3]), "bbox.json");
    let many = |b: &mut Value| b["annotations"] = vec![b["annotations"][0].clone(); 10_000].into();
    change("many.json", &many, "more than 1000 objects");
    fs::write(at.join("text.json"), "no boxes").unwrap();
    for (name, says) in [("text.json", "text.json"), ("missing.json", "missing.json")] {
        refused(at, &[&TRAIN[..], &["--out", "out", "--zones", name]].concat(), says);
    }
    // A plan is made before anything is known of the photos: it takes no objects.
    refused(at, &["plan", "city", "--zones", "text.json"], "--zones");
    refused(at, &[&TRAIN[..], &["--out", "out", "--zone-weight", "3"]].concat(), "--detector");
    refused(at, &[&TRAIN[..], &["--out", "out", "--zones", "good", "--detector", "x.onnx"]].concat(), "--detector");
    fs::write(at.join("text.onnx"), "no network").unwrap();
    refused(at, &[&TRAIN[..], &["--out", "out", "--detector", "text.onnx"]].concat(), "is not an ONNX graph");
}
