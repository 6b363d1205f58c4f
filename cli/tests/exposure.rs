//! Exposures and the backdrop through a whole job: all blocks use those of the root.

mod common;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Output};

use blocks::Plan;
use city::CitySettings;
use dataset::synth::{self, Settings};
use scene::{ArtefactId, BlockId, Exposures, Splats, frame, ply};
use serde_json::Value;

fn plat(folder: &Path, words: &[&str]) -> Output {
    let program = env!("CARGO_BIN_EXE_plat");
    Command::new(program).args(words).arg("--json").current_dir(folder).output().expect("plat runs")
}

fn done(folder: &Path, words: &[&str]) -> Value {
    let output = plat(folder, words);
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(text.lines().last().expect("an object on the last line")).unwrap()
}

/// Multiplies each training photo by a gain from 0.7 to 1.2. Returns the gains by view; held-out photos have gain 1.
fn expose_photos(images: &Path) -> Vec<f64> {
    let mut names: Vec<_> = std::fs::read_dir(images).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    let gain = |view: usize| {
        if view.is_multiple_of(8) { 1.0 } else { 0.7 + 0.5 * f64::from(train::random::uniform(5, view as u64)) }
    };
    for (view, name) in names.iter().enumerate() {
        let mut photo = image::open(name).unwrap().to_rgb8();
        photo.iter_mut().for_each(|byte| *byte = (f64::from(*byte) * gain(view)).round().min(255.0) as u8);
        photo.save(name).unwrap();
    }
    (0..names.len()).map(gain).collect()
}

/// Rows of the background splats as bits, sorted.
fn far(splats: &Splats, plan: &Plan) -> Vec<Vec<u32>> {
    let is_far = |&i: &usize| plan.ground.is_background(splats.mean(i).as_dvec3());
    let row = |i: usize| splats.columns().iter().map(|column| column[i].to_bits()).collect();
    let mut rows: Vec<_> = (0..splats.len()).filter(is_far).map(row).collect();
    rows.sort();
    rows
}

/// Standard error of a command.
fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn train(at: &Path, out: &str, more: &[&str]) -> Value {
    let job = ["train", "city", "--out", out, "--steps", "1500", "--budget", "4000", "--tolerance-db", "0"];
    done(at, &[&job[..], more].concat())
}

#[test]
fn exposures_and_the_backdrop_come_from_the_root_and_do_not_change() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let settings = common::small(32, 80, 60);
    synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
    let gains = expose_photos(&at.join("city/images"));
    train(at, "on", &["--levels", "2", "--exposure", "--threads", "1"]);
    train(at, "again", &["--levels", "2", "--exposure", "--threads", "2"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    for file in ["merged.ply", "model/model.json", "model/exposures.plat"] {
        let same = bytes(&format!("on/{file}")) == bytes(&format!("again/{file}"));
        assert!(same, "{file} depends on the number of threads");
    }
    check_exposures(at, &gains);
    check_backdrop(at);
    check_quality(at);
    check_pruning(at, settings);

    let refused = plat(at, &["train", "city", "--out", "flat", "--blocks", "flat", "--exposure"]);
    assert_eq!(refused.status.code(), Some(2));
    let line = stderr(&refused);
    assert!(line.contains("--exposure") && line.trim_end().lines().count() == 1, "{line}");
}

fn plan_and_results(at: &Path) -> (Plan, impl Fn(BlockId) -> (Splats, Option<ArtefactId>)) {
    let folder = at.join("on/model");
    let plan = Plan::from_frame(&std::fs::read(folder.join("plan.plat")).unwrap()).unwrap();
    let result = move |block: BlockId| {
        let BlockId { level, x, y } = block;
        let bytes = std::fs::read(folder.join(format!("blocks/{level}-{x}-{y}.plat"))).unwrap();
        let (splats, about) = frame::decode_result(&bytes).unwrap();
        (splats, about.exposures)
    };
    (plan, result)
}

/// All training views and no others have exposures; their mean is the identity; all blocks refer to the same file.
fn check_exposures(at: &Path, gains: &[f64]) {
    let file = std::fs::read(at.join("on/model/exposures.plat")).unwrap();
    let exposures = Exposures::from_frame(&file).unwrap();
    let trained: Vec<u32> = (0..32).filter(|view: &u32| !view.is_multiple_of(8)).collect();
    assert_eq!(exposures.iter().map(|(view, _)| view).collect::<Vec<_>>(), trained);
    let mean = |of: &dyn Fn(u32) -> f64| trained.iter().map(|&view| of(view)).sum::<f64>() / trained.len() as f64;
    let found = |view: u32| f64::from(exposures.of(view).unwrap().gain());
    assert!((mean(&found) - 1.0).abs() < 1e-4, "{}", mean(&found));
    let given = |view: u32| gains[view as usize] / mean(&|view| gains[view as usize]);
    let [a, b] = [mean(&|view| (found(view) - 1.0) * (given(view) - 1.0)), mean(&|view| (given(view) - 1.0).powi(2))];
    assert!(a > 0.4 * b, "of the given deviations {a} of {b} was found");
    let (plan, result) = plan_and_results(at);
    assert!(plan.levels == 2 && plan.tasks.len() > 5, "{}", plan.tasks.len());
    let named: BTreeSet<_> = plan.tasks.iter().map(|task| result(task.block).1).collect();
    assert_eq!(named, BTreeSet::from([Some(ArtefactId::of(&file))]));
}

/// The merged model has the root's backdrop exactly once, and no other block has any of it.
fn check_backdrop(at: &Path) {
    let (plan, result) = plan_and_results(at);
    let root = far(&result(BlockId::ROOT).0, &plan);
    assert!(root.len() > 150, "the backdrop has only {} splats", root.len());
    let merged = ply::read(&std::fs::read(at.join("on/merged.ply")).unwrap()).unwrap();
    assert!(far(&merged, &plan) == root, "the backdrop was doubled, lost or changed");
    for task in plan.tasks.iter().filter(|task| task.block != BlockId::ROOT) {
        let (splats, _) = result(task.block);
        let strayed = far(&splats, &plan).len();
        assert!(strayed * 100 <= splats.len(), "block {} has {strayed} background splats", task.block);
    }
}

/// With exposures the model is closer to unchanged photos, in the mean over seeds: four photos are held out. One block is trained, as
/// the root of a tree of so small a city sees too little to be exact.
fn check_quality(at: &Path) {
    const SEEDS: [&str; 3] = ["0", "1", "2"];
    let mean = |exposure: &[&str]| -> [f64; 2] {
        let mut sums = [0.0; 2];
        for seed in SEEDS {
            let out = format!("whole-{}-{seed}", exposure.len());
            train(at, &out, &[&["--blocks", "whole", "--seed", seed], exposure].concat());
            assert_eq!(at.join(&out).join("model/exposures.plat").exists(), !exposure.is_empty());
            let report = done(at, &["eval", &out, "city"]);
            let [psnr, corrected] = ["psnr", "cc_psnr"].map(|key| report[key].as_f64().unwrap());
            assert!(corrected > psnr && report["views"][0]["cc_psnr"].is_f64());
            sums = [sums[0] + psnr, sums[1] + corrected];
        }
        sums.map(|sum| sum / SEEDS.len() as f64)
    };
    let (on, off) = (mean(&["--exposure"]), mean(&[]));
    println!("PSNR, and after a colour transform: {on:.2?} dB with exposures, {off:.2?} without");
    assert!(on[0] > off[0] && on[1] > off[1], "{on:?} {off:?}");
}

/// Pruning keeps the exposures, and uses them only with the photos that they belong to.
fn check_pruning(at: &Path, settings: Settings) {
    let prune = |capture: &str, out: &str| {
        plat(at, &["prune", "on", "--capture", capture, "--downscale", "1", "--keep", "0.6", "--out", out])
    };
    let pruned = prune("city", "pruned");
    assert!(pruned.status.success() && !stderr(&pruned).contains("exposures"), "{}", stderr(&pruned));
    let [kept, before] = ["pruned", "on"].map(|out| std::fs::read(at.join(out).join("model/exposures.plat")).unwrap());
    assert_eq!(kept, before);
    let other = Settings { city: CitySettings { seed: 4, ..settings.city }, ..settings };
    synth::write(&at.join("other"), &other, &|_, _, _| ()).unwrap();
    let pruned = prune("other", "by_others");
    assert!(stderr(&pruned).contains("exposures are left out"), "{}", stderr(&pruned));
}
