//! Tasks of a job that measure the merged model: `plat train --evaluate`.

mod common;

use common::{done, plat, refused, stopped};
use serde_json::Value;
use store::Store;

#[test]
fn evaluation_tasks_give_the_figures_of_plat_eval_and_change_no_model() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 96, 64);
    let job = ["train", "city", "--steps", "300", "--budget", "900", "--levels", "1", "--blocks", "tree", "--out"];
    let train = |out: &str, words: &[&str]| done(at, &[&job, &[out][..], words].concat());
    train("plain", &[]);
    let report = train("measured", &["--evaluate", "--workers", "2"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    let json = |path: &str| -> Value { serde_json::from_slice(&bytes(path)).unwrap() };
    assert!(bytes("plain/merged.ply") == bytes("measured/merged.ply"), "evaluation changes the model");
    let tasks = json("measured/plan.json")["eval_tasks"].as_array().unwrap().len();
    assert!(tasks == 1 && report["tasks"].as_u64() > Some(2), "{report}");
    assert!(json("plain/plan.json")["eval_tasks"] == Value::Array(Vec::new()));

    let by_job = json("measured/eval/report.json");
    let by_eval = done(at, &["eval", "measured", "city", "--out", "eval"]);
    assert_eq!(by_job["views"].as_array().unwrap().len(), 3);
    for key in ["views", "psnr", "cc_psnr", "ssim", "perceptual", "splats", "scene"] {
        assert_eq!(by_job[key], by_eval[key], "{key}");
    }
    for key in ["psnr", "ssim", "perceptual"] {
        assert_eq!(report[key], by_eval[key], "{key}");
    }

    // A second run finds every task's result, of either kind.
    let again = train("measured", &["--evaluate", "--workers", "2"]);
    assert_eq!(again["resumed"].as_u64(), Some(report["tasks"].as_u64().unwrap() + tasks as u64));
    assert_eq!(json("measured/eval/report.json")["views"], by_job["views"]);

    let plan = plat(at, &["plan", "city", "--evaluate"]);
    assert!(String::from_utf8(plan.stdout).unwrap().contains(" and 1 evaluation task, "));
    refused(at, &["train", "city", "--out", "x", "--evaluate", "--test-every", "0"], "no view is held out");
}

#[test]
fn plans_of_every_mode_are_evaluated() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    for blocks in ["whole", "flat"] {
        let job =
            ["train", "city", "--steps", "60", "--budget", "600", "--levels", "1", "--minutes", "5", "--evaluate"];
        let levels = if blocks == "whole" { &job[..6] } else { &job[..8] };
        let report = done(at, &[levels, &job[8..], &["--blocks", blocks, "--out", blocks]].concat());
        let measured = done(at, &["eval", blocks, "city", "--out", "eval"]);
        assert!(report["psnr"].is_f64() && report["psnr"] == measured["psnr"], "{blocks}: {report}");
    }
    refused(at, &["bench", "pareto", "city", "--label", "x", "--evaluate", "--out", "x"], "--evaluate");
}

#[test]
fn a_failed_evaluation_leaves_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let job = ["train", "city", "--steps", "60", "--budget", "600", "--levels", "1", "--store", "store", "--out"];
    let plain = done(at, &[&job[..], &["plain"]].concat());
    // Damages the photo of the first held-out view.
    let store = Store::open(&at.join("store").display().to_string()).unwrap().blocking();
    let capture = dataset::ingest::load_capture(&store, plain["capture"].as_str().unwrap().parse().unwrap()).unwrap();
    let name = capture.views[0].mips[0].to_string();
    let file = at.join("store/artefacts").join(&name[..2]).join(&name);
    // Of the same size: photos are not ingested again.
    let size = std::fs::read(&file).unwrap().len();
    std::fs::write(&file, vec![7; size]).unwrap();

    let line = stopped(
        &mut common::command(at, &[&job[..], &["measured", "--evaluate", "--quiet"]].concat()),
        1,
        "the model is complete in measured, and plat eval measures it",
    );
    assert!(line.contains("task ") && line.contains("failed in attempt"), "{line}");
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("plain/merged.ply") == bytes("measured/merged.ply"));
    assert!(at.join("measured/report.json").is_file() && !at.join("measured/eval/report.json").exists());
}
