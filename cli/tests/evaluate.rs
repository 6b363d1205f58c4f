//! Tasks of a job that measure the merged model: `plat train --evaluate`.

mod common;

use common::{done, plat, refused};
use serde_json::Value;

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
