//! A whole job on a GPU: as good as on the CPU, the same bytes when it was killed, and refused in one line where it cannot be.

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use render::gpu::Gpu;
use serde_json::Value;

const JOB: [&str; 8] = ["train", "city", "--steps", "100", "--budget", "500", "--levels", "1"];

fn job(at: &Path, backend: &str, words: &[&str]) -> Command {
    common::command(at, &[&JOB[..], &["--backend", backend], words].concat())
}

fn done(at: &Path, backend: &str, words: &[&str]) -> Value {
    common::json_of(&mut job(at, backend, words))
}

/// The GPU's name, or a line that says why the test is skipped. With PLAT_GPU=required there has to be one.
fn gpu() -> Option<String> {
    match Gpu::open() {
        Ok(gpu) => Some(gpu.name().to_owned()),
        Err(error) if std::env::var("PLAT_GPU").is_ok_and(|value| value == "required") => panic!("{error}"),
        Err(error) => {
            println!("skipped: no adapter ({error})");
            None
        }
    }
}

#[test]
fn a_job_on_a_gpu_is_as_good_and_survives_kills() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let psnr = |report: &Value| report["psnr"].as_f64().expect("held-out views are measured");
    let cpu = done(at, "cpu", &["--out", "cpu", "--store", "store"]);
    // In one store: what the CPU left there is not taken for the GPU's.
    let gpu = done(at, "gpu", &["--out", "calm", "--store", "store"]);
    println!("{:.2} dB on {}, {:.2} dB on {}", psnr(&cpu), cpu["backend"], psnr(&gpu), gpu["backend"]);
    assert!(gpu["backend"] == name.as_str() && cpu["backend"] != gpu["backend"]);
    assert_eq!(gpu["resumed"], 0);
    assert!((psnr(&cpu) - psnr(&gpu)).abs() < 0.2);
    let plan = |out: &str| -> Value {
        serde_json::from_slice(&std::fs::read(at.join(out).join("plan.json")).unwrap()).expect("a plan")
    };
    assert_eq!(plan("calm")["backend"], name.as_str());

    // Killed after so many lines of its journal: within the root, and within leaves.
    let mut kills = 0;
    for lines in [1, 4] {
        let mut run = job(at, "gpu", &["--out", "killed", "--checkpoint-every", "0"]);
        let mut run = run.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let journal = at.join("killed/metrics.jsonl");
        let _ = std::fs::remove_file(&journal);
        while run.try_wait().unwrap().is_none() {
            if std::fs::read_to_string(&journal).map_or(0, |text| text.lines().count()) >= lines {
                run.kill().unwrap();
                run.wait().unwrap();
                kills += 1;
                break;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    assert!(kills > 0, "no kill found it at work");
    let resumed = done(at, "gpu", &["--out", "killed"]);
    assert!(resumed["resumed"].as_u64() >= Some(1), "{resumed}");
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("calm/merged.ply") == bytes("killed/merged.ply"), "a kill shows in the result");
}

#[test]
fn too_little_memory_ends_the_job_and_names_the_block() {
    if gpu().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 64, 48);
    let capped = |cap: &str| {
        let mut job = job(at, "gpu", &["--out", "o", "--quiet"]);
        job.env("PLAT_GPU_MEMORY", cap);
        job
    };
    let line = common::stopped(&mut capped("2MiB"), 1, "of 2097152 that PLAT_GPU_MEMORY allows");
    println!("{line}");
    assert!(line.contains("block 0/0/0"), "{line}");
    assert!(!at.join("o/merged.ply").exists());
    common::stopped(&mut capped("much"), 2, "PLAT_GPU_MEMORY is \"much\"");
    // What there was is not taken for a result: with memory, the same command does the work.
    let done = common::json_of(&mut capped("1GiB"));
    assert!(done["splats"].as_u64() > Some(0));
}

#[test]
fn what_cannot_be_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 64, 48);
    let mut elsewhere = job(at, "gpu", &["--out", "o"]);
    common::stopped(elsewhere.env("PLAT_GPU_ADAPTER", "an adapter that nobody has"), 2, "--backend");
    common::stopped(&mut job(at, "gpu", &["--out", "o", "--exposure"]), 2, "--exposure");
}

const KERNELS: [&str; 6] = ["bench", "kernels", "--splats", "300", "--size", "96x64"];

#[test]
fn the_stages_of_a_gpu_are_timed_and_compared() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let timed = common::done(at, &[&KERNELS[..], &["--backend", "gpu", "--passes", "3", "--results", "r"]].concat());
    println!("{timed}");
    assert_eq!((&timed["kind"], timed["backend"].as_str()), (&"kernels".into(), Some(&*name)));
    assert!(
        ["discrete", "integrated", "virtual", "software", "other"].contains(&timed["adapter_class"].as_str().unwrap())
    );
    assert!(["device", "wall"].contains(&timed["clock"].as_str().unwrap()));
    assert!(timed["pairs"].as_u64() > Some(300) && timed["forward_wall_millis"].as_f64() > Some(0.0));
    let stages = timed["stages"].as_array().unwrap();
    let names: Vec<&str> = stages.iter().map(|stage| stage["stage"].as_str().unwrap()).collect();
    assert_eq!(names, ["project", "sort", "bin", "rasterize", "rasterize_backward", "reduce", "project_backward"]);
    assert!(stages.iter().all(|stage| stage["device_millis"].as_f64() >= Some(0.0) && stage["cpu_millis"].is_null()));
    assert!(stages.iter().any(|stage| stage["device_millis"].as_f64() > Some(0.0)));
    assert_eq!(std::fs::read_to_string(at.join("r/kernels.jsonl")).unwrap().lines().count(), 1);

    let compared = common::done(at, &[&KERNELS[..], &["--from-stage", "project"]].concat());
    println!("{compared}");
    assert!(compared["first_mismatch"].is_null() && compared["stages"].as_array().unwrap().len() == 7);
    assert!(compared["stages"].as_array().unwrap().iter().all(|stage| stage["within"] == true));
    assert!(compared["stages"][2]["of"].as_u64() > Some(300), "tiles have splats");
    let late = common::done(at, &[&KERNELS[..], &["--from-stage", "reduce"]].concat());
    assert_eq!((late["stages"].as_array().unwrap().len(), &late["stages"][0]), (2, &compared["stages"][5]));
}

#[test]
fn kernels_without_a_gpu_are_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for words in [["--backend", "gpu"], ["--from-stage", "bin"]] {
        let mut elsewhere = common::command(folder.path(), &[&KERNELS[..], &words].concat());
        common::stopped(elsewhere.env("PLAT_GPU_ADAPTER", "an adapter that nobody has"), 2, "no GPU adapter");
    }
    common::refused(folder.path(), &[&KERNELS[..], &["--from-stage", "blur"]].concat(), "rasterize_backward");
    common::refused(folder.path(), &[&KERNELS[..], &["--from-stage", "bin", "--passes", "2"]].concat(), "--passes");
}
