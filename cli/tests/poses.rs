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

#[test]
fn errors_of_sensors_are_written_and_do_not_depend_on_workers() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let faults = vec![Fault { kind: FaultKind::ClockSkew, strength: 0.5, seed: 0 }];
    let settings = Settings { faults, aerial: 0.2, ..common::small(48, 80, 60) };
    synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
    train(at, "on", &["--levels", "1", "--refine-sensors", "--threads", "1", "--evaluate"]);
    train(at, "again", &["--levels", "1", "--refine-sensors", "--threads", "1", "--evaluate", "--workers", "2"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    for file in ["merged.ply", "cameras.json", "sensors.json", "model/poses.plat"] {
        let same = bytes(&format!("on/{file}")) == bytes(&format!("again/{file}"));
        assert!(same, "{file} depends on the number of workers");
    }

    let sensors: Vec<Value> = serde_json::from_slice(&bytes("on/sensors.json")).unwrap();
    let poses = Poses::from_frame(&bytes("on/model/poses.plat")).unwrap();
    assert_eq!(sensors.len(), poses.sensors.len());
    assert!(sensors.iter().any(|sensor| sensor["sensor"].as_str().unwrap().contains("street")), "{sensors:?}");
    let moved = |sensor: &&Value| sensor["clock_seconds"].as_f64().unwrap().abs() > 1e-3;
    assert!(sensors.iter().filter(moved).count() > sensors.len() / 2, "{sensors:?}");
    // A focal length belongs to all photos of a sensor, in the cameras that other programs read as well.
    let frames = |path: &str| -> Vec<Value> {
        let Value::Array(frames) = serde_json::from_slice::<Value>(&bytes(path)).unwrap()["frames"].take() else {
            panic!("{path}");
        };
        frames
    };
    let given = frames("city/transforms.json");
    for camera in frames("on/cameras.json") {
        let path = camera["file_path"].as_str().unwrap();
        let before = given.iter().find(|frame| frame["file_path"].as_str().unwrap().ends_with(path)).unwrap();
        let factor = camera["fl_x"].as_f64().unwrap() / before["fl_x"].as_f64().unwrap();
        let of_sensor = |sensor: &&Value| {
            path.contains(&format!("/{}-", sensor["sensor"].as_str().unwrap()))
                || path.starts_with(&format!("{}-", sensor["sensor"].as_str().unwrap()))
        };
        let found = sensors.iter().find(of_sensor).map_or(1.0, |sensor| sensor["focal_factor"].as_f64().unwrap());
        assert!((factor / found - 1.0).abs() < 1e-9, "{path}: {factor}, {found} in sensors.json");
    }

    // Held-out photos were taken by the same sensors. A file of splats knows nothing of them, and is drawn from the given cameras.
    // Photos as small as these do not tell which are better (docs/decisions/0093 has larger ones).
    let of_job: Value = serde_json::from_slice(&bytes("on/eval/report.json")).unwrap();
    let evaluate = |model: &str| done(at, &["eval", model, "city", "--backend", "cpu"])["psnr"].as_f64().unwrap();
    let [corrected, given] = ["on", "on/merged.ply"].map(evaluate);
    assert_eq!(of_job["psnr"].as_f64(), Some(corrected));
    assert!(corrected != given && (corrected - given).abs() < 2.0, "{corrected} {given}");

    // Pruning keeps what was found.
    done(at, &["prune", "on", "--out", "pruned", "--keep", "0.5"]);
    assert_eq!(bytes("on/sensors.json"), bytes("pruned/sensors.json"));
    refused(at, &["train", "city", "--out", "flat", "--blocks", "flat", "--refine-sensors"], "--refine-sensors");
}
