//! Refined poses through a whole job: all blocks use those of the root, and held-out views are measured from fitted poses.

mod common;

use std::path::Path;

use blocks::Plan;
use city::faults::{Fault, FaultKind};
use common::{done, refused};
use dataset::synth::{self, Settings};
use scene::{ArtefactId, BlockId, Poses, frame, transforms};
use serde_json::Value;

fn train(at: &Path, out: &str, more: &[&str]) -> Value {
    let job = ["train", "city", "--out", out, "--steps", "1500", "--budget", "4000", "--tolerance-db", "0"];
    done(at, &[&job[..], more].concat())
}

#[test]
fn poses_come_from_the_root_and_do_not_change() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let faults = vec![Fault { kind: FaultKind::PoseNoise, strength: 0.2, seed: 0 }];
    let settings = Settings { faults, ..common::small(32, 80, 60) };
    synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
    train(at, "on", &["--levels", "1", "--refine-poses", "--evaluate", "--threads", "1"]);
    train(at, "again", &["--levels", "1", "--refine-poses", "--evaluate", "--threads", "1", "--workers", "2"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    for file in ["merged.ply", "cameras.json", "model/model.json", "model/poses.plat"] {
        let same = bytes(&format!("on/{file}")) == bytes(&format!("again/{file}"));
        assert!(same, "{file} depends on the number of workers");
    }

    // All training views and no others have poses, which all blocks refer to.
    let poses = Poses::from_frame(&bytes("on/model/poses.plat")).unwrap();
    let trained: Vec<u32> = (0..32u32).filter(|&view| !view.is_multiple_of(8)).collect();
    assert_eq!(poses.iter().map(|(view, _)| view).collect::<Vec<_>>(), trained);
    let plan = Plan::from_frame(&bytes("on/model/plan.plat")).unwrap();
    assert!(plan.tasks.len() > 1);
    for task in &plan.tasks {
        let BlockId { level, x, y } = task.block;
        let (_, about) = frame::decode_result(&bytes(&format!("on/model/blocks/{level}-{x}-{y}.plat"))).unwrap();
        assert_eq!(about.poses, Some(ArtefactId::of(&bytes("on/model/poses.plat"))), "{}", task.block);
    }

    // Other programs read the same cameras.
    let cameras = transforms::read(&bytes("on/cameras.json")).unwrap();
    let given = transforms::read(&bytes("city/transforms.json")).unwrap();
    assert_eq!(cameras.frames.len(), trained.len());
    let mut moved = 0;
    for (camera, (_, pose)) in cameras.frames.iter().zip(poses.iter()) {
        let pose = pose.camera_from_world;
        assert!((camera.camera_from_world.translation - pose.translation).length() < 1e-9);
        let given = given.frames.iter().find(|frame| frame.file_path.ends_with(&camera.file_path)).unwrap();
        let change = (given.camera_from_world.inverse().translation - pose.inverse().translation).length();
        assert!(change < 5.0, "{}: moved by {change} m", camera.file_path);
        moved += usize::from(change > 1e-4);
    }
    assert!(moved > trained.len() / 2, "only {moved} cameras were moved");

    // The job's own figures are those of `plat eval`.
    let of_job: Value = serde_json::from_slice(&bytes("on/eval/report.json")).unwrap();
    let evaluated = done(at, &["eval", "on", "city", "--backend", "cpu"]);
    let figure = |report: &Value, name: &str| report[name].as_f64().unwrap();
    assert_eq!(figure(&of_job, "psnr_refined"), figure(&evaluated, "psnr_refined"));
    assert!(figure(&evaluated, "psnr_refined") > figure(&evaluated, "psnr"));
    assert!(evaluated["views"][0]["psnr_refined"].is_f64() && evaluated["views"][0]["psnr_fitted"].is_null());
    let fitted = done(at, &["eval", "on/merged.ply", "city", "--fit-exposure"]);
    assert!(figure(&fitted, "psnr_fitted") > 5.0 && fitted.get("psnr_refined").is_none());

    refused(at, &["train", "city", "--out", "flat", "--blocks", "flat", "--refine-poses"], "--refine-poses");
}
