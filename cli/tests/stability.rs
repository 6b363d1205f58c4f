//! `plat bench stability` and `plat bench prune` as run by scripts.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{city, done, refused};
use serde_json::Value;

const SYNTH: &str = "--area-km2 0.01 --views 24 --size 64x48 --traffic light --aerial 0.3";
const TRAIN: &str = "--steps 40 --budget 600 --levels 1 --threads 1";

fn lines(at: &Path, file: &str) -> Vec<Value> {
    let text = fs::read_to_string(at.join("results").join(file)).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// A detector of random weights that finds something everywhere.
fn detector(at: &Path) {
    let tiny = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../perceive/tests/yolov8_tiny.onnx");
    fs::copy(tiny, at.join("tiny.onnx")).unwrap();
    fs::write(at.join("tiny.toml"), "classes = ['car', 'person', 'bench']\nscore = 0.9").unwrap();
}

#[test]
fn cases_are_run_without_and_with_their_counter_measure() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    detector(at);
    fs::write(at.join("table.md"), "before\n<!-- bench:begin -->\n<!-- bench:end -->\nafter\n").unwrap();
    let run = |more: &[&'static str]| {
        let usual = ["bench", "stability", "--out", "o", "--results", "results", "--seed", "3", "--synth", SYNTH];
        [&usual[..], &["--train", TRAIN, "--detector", "tiny.onnx"], more].concat()
    };
    let cases =
        ["--case", "nan-poses,exposure-drift,motion-blur,memory-cap", "--pictures", "p", "--document", "table.md"];
    let said = done(at, &run(&cases));
    let [poses, exposure, blur, memory] = &said["rows"].as_array().unwrap()[..] else { panic!("{said}") };
    assert!(poses["refused"].as_str().unwrap().contains("transforms.json") && poses["on"].is_null(), "{poses}");
    assert!(exposure["off"]["fitted_psnr"].is_f64() && exposure["on"]["fitted_psnr"].is_f64(), "{exposure}");
    assert!(exposure["verdict"].is_string() && exposure["on"]["zone_psnr"].is_f64(), "{exposure}");
    assert!(blur["counter"].is_null() && blur["verdict"].is_null() && blur["on"].is_null(), "{blur}");
    assert!(blur["off"]["psnr"].is_f64(), "{blur}");
    assert!(
        memory["refused"].as_str().unwrap().contains("the limit is 160 MiB") && memory["off"].is_null(),
        "{memory}"
    );
    assert!(memory["on"]["psnr"].is_f64() && memory["verdict"] == "yes", "{memory}");
    let written = lines(at, "stability.jsonl");
    assert_eq!((said["lines"].as_array().unwrap().len(), written.len()), (6, 1 + 2 + 1 + 2));
    assert!(written.iter().all(|line| line["kind"] == "stability"));
    let options = written[2]["options"][1].as_str().unwrap();
    assert!(options.ends_with("--exposure") && written[2]["on"] == true && written[2]["seed"] == 3, "{options}");
    let document = fs::read_to_string(at.join("table.md")).unwrap();
    assert!(document.starts_with("before") && document.contains("| motion-blur |") && document.contains("remains"));
    assert!(at.join("p/exposure-drift-generated.png").is_file() && at.join("p/motion-blur-generated.png").is_file());

    // What was measured is not measured again; a capture of one's own is.
    done(at, &run(&cases));
    assert_eq!(lines(at, "stability.jsonl").len(), 6);
    let given = ["--train-given", "--steps 20 --budget 600 --threads 1"];
    let said = done(at, &run(&[&["--case", "seams", "seams=o/captures/exposure-drift-clean"], &given[..]].concat()));
    let [made, row] = &said["rows"].as_array().unwrap()[..] else { panic!("{said}") };
    assert!(made["capture"] == "generated" && made["off"]["seam_db"].is_f64(), "{made}");
    assert!(row["capture"] == "exposure-drift-clean" && row["off"]["seam_db"].is_f64(), "{row}");
    let written = lines(at, "stability.jsonl");
    assert_eq!(written.len(), 10);
    assert!(written[8]["options"][1].as_str().unwrap().starts_with(given[1]), "{}", written[8]);

    refused(at, &run(&["--quiet", "--case", "hail"]), "pose-noise");
    refused(at, &run(&["--quiet", "--case", "pose-noise", "pose-noise=o"]), "needs a generated capture");
    refused(at, &run(&["--quiet", "--case", "fog", "foggy=o"]), "foggy");
    refused(at, &["bench", "stability", "--out", "o", "--quiet", "--synth", "--views many"], "many");
}

#[test]
fn orders_of_pruning_are_judged_by_detectors() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 20, 96, 64);
    detector(at);
    done(
        at,
        &[
            "train",
            "city",
            "--out",
            "model",
            "--steps",
            "80",
            "--budget",
            "800",
            "--levels",
            "0",
            "--tolerance-db",
            "0",
        ],
    );
    let usual = ["bench", "prune", "model", "city", "--results", "results", "--keep", "0.5", "--judge", "tiny.onnx"];
    done(at, &[&usual[..], &["--order", "opacity,light-gaussian", "--detector", "tiny.onnx"]].concat());
    let written = lines(at, "prune.jsonl");
    let orders: Vec<&str> = written.iter().map(|line| line["order"].as_str().unwrap()).collect();
    let twice = |order| [order; 2];
    assert_eq!(orders[..1], ["none"]);
    assert_eq!(orders[1..], [twice("opacity"), twice("light-gaussian"), twice("energy-zones")].concat());
    let before = written[0]["splats"].as_u64().unwrap();
    for line in &written[1..] {
        let judged = &line["judged"][0];
        assert!(judged["detector"] == "tiny.onnx" && judged["objects"].as_u64() >= judged["misses"].as_u64(), "{line}");
        assert!(line["recovery_steps"].as_u64() > Some(0) && line["splats"].as_u64() < Some(before + 1), "{line}");
        if line["keep"] == 0.5 {
            assert_eq!(line["splats"], (before as f64 * 0.5).round() as u64);
        }
    }
    done(at, &[&usual[..], &["--order", "energy", "--tolerance-db", "0"]].concat());
    assert_eq!(lines(at, "prune.jsonl").len(), written.len() + 2);
    refused(at, &[&usual[..], &["--judge", "missing.onnx", "--quiet"]].concat(), "missing.onnx");
}
