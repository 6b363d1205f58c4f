//! Training, rendering and evaluation on a GPU: they agree with the CPU, training survives kills, and a missing adapter is refused in
//! one line.

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use render::gpu::Gpu;
use scene::npy;
use serde_json::Value;

const JOB: [&str; 8] = ["train", "city", "--steps", "100", "--budget", "500", "--levels", "1"];

fn job(at: &Path, backend: &str, words: &[&str]) -> Command {
    common::command(at, &[&JOB[..], &["--backend", backend], words].concat())
}

fn done(at: &Path, backend: &str, words: &[&str]) -> Value {
    common::json_of(&mut job(at, backend, words))
}

/// The GPU's name. Without one it prints why the test is skipped, or fails if PLAT_GPU=required.
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
fn auto_is_a_gpu_with_memory_of_its_own_and_never_a_software_adapter() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let is_dedicated = Gpu::open().is_ok_and(|gpu| ["discrete", "virtual"].contains(&gpu.class()));
    let words = ["train", "city", "--steps", "10", "--budget", "300", "--blocks", "whole", "--out", "auto"];
    let backend = common::json_of(&mut common::command(at, &words))["backend"].as_str().unwrap().to_owned();
    println!("{backend}, where --backend gpu is {name}");
    assert!(if is_dedicated { backend == name } else { backend.starts_with("cpu-") }, "{backend}");
    // A variable that is not understood is an error on any machine.
    common::stopped(common::command(at, &words).env("PLAT_GPU_PATH", "quick"), 2, "PLAT_GPU_PATH");
}

#[test]
fn a_job_on_a_gpu_is_as_good_and_survives_kills() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let psnr = |report: &Value| report["psnr"].as_f64().expect("held-out views are measured");
    let cpu = done(at, "cpu", &["--out", "cpu", "--store", "store"]);
    // In one store: results of the CPU must not be reused for the GPU.
    let gpu = done(at, "gpu", &["--out", "calm", "--store", "store"]);
    println!("{:.2} dB on {}, {:.2} dB on {}", psnr(&cpu), cpu["backend"], psnr(&gpu), gpu["backend"]);
    assert!(gpu["backend"] == name.as_str() && cpu["backend"] != gpu["backend"]);
    assert_eq!(gpu["resumed"], 0);
    assert!((psnr(&cpu) - psnr(&gpu)).abs() < 0.2);
    let plan = |out: &str| -> Value {
        serde_json::from_slice(&std::fs::read(at.join(out).join("plan.json")).unwrap()).expect("a plan")
    };
    assert_eq!(plan("calm")["backend"], name.as_str());

    // Killed after this many lines of metrics.jsonl: within the root, and within leaves.
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
    assert!(kills > 0, "it ended before every kill");
    let resumed = done(at, "gpu", &["--out", "killed"]);
    assert!(resumed["resumed"].as_u64() >= Some(1), "{resumed}");
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("calm/merged.ply") == bytes("killed/merged.ply"), "a kill changes the result");
}

#[test]
fn exposures_and_poses_train_on_a_gpu_as_on_the_cpu() {
    if gpu().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let words = |out| ["--out", out, "--exposure", "--refine-poses"];
    let psnr = |report: Value| report["psnr"].as_f64().expect("held-out views are measured");
    let [cpu, one, _] =
        [("cpu", "cpu"), ("gpu", "one"), ("gpu", "two")].map(|(on, out)| psnr(done(at, on, &words(out))));
    println!("{cpu:.2} dB on the CPU, {one:.2} dB on the GPU");
    assert!((cpu - one).abs() < 0.2, "{cpu} {one}");
    let bytes = |path: String| std::fs::read(at.join(path)).unwrap();
    for file in ["merged.ply", "cameras.json", "model/exposures.plat", "model/poses.plat"] {
        assert!(bytes(format!("one/{file}")) == bytes(format!("two/{file}")), "{file} differs from run to run");
        assert!(file == "merged.ply" || bytes(format!("cpu/{file}")) != bytes(format!("one/{file}")), "{file}");
    }
}

#[test]
fn a_detectors_loss_is_in_training_on_a_gpu_as_on_the_cpu() {
    if gpu().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 96, 64);
    common::write_tiny(at);
    let train = |on, out, weight| {
        let words = ["--detector", "tiny.onnx", "--zone-weight", "0", "--aligned-weight", weight, "--out", out];
        done(at, on, &words)["psnr"].as_f64().unwrap()
    };
    let [cpu, one, _, _] = [("cpu", "cpu", "0.1"), ("gpu", "one", "0.1"), ("gpu", "two", "0.1"), ("gpu", "plain", "0")]
        .map(|(on, out, weight)| train(on, out, weight));
    println!("{cpu:.2} dB on the CPU, {one:.2} dB on the GPU");
    assert!((cpu - one).abs() < 0.3, "{cpu} {one}");
    let bytes = |out: &str| std::fs::read(at.join(out).join("merged.ply")).unwrap();
    assert!(bytes("one") == bytes("two") && bytes("one") != bytes("plain"));
    let values = |out: &str| -> Vec<f64> {
        let log = std::fs::read_to_string(at.join(out).join("metrics.jsonl")).unwrap();
        let lines = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.filter_map(|line| line["aligned_loss"].as_f64()).collect()
    };
    let (on_cpu, on_gpu) = (values("cpu"), values("one"));
    println!("{on_cpu:?} {on_gpu:?}");
    assert!(on_cpu.iter().any(|loss| *loss > 0.0) && on_gpu.iter().any(|loss| *loss > 0.0));
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
    let line = common::stopped(&mut capped("2MiB"), 1, "PLAT_GPU_MEMORY allows 2097152");
    println!("{line}");
    assert!(line.contains("block 0/0/0"), "{line}");
    assert!(!at.join("o/merged.ply").exists());
    common::stopped(&mut capped("much"), 2, "PLAT_GPU_MEMORY is \"much\"");
    // The failed attempt leaves no result: with enough memory the same command succeeds.
    let done = common::json_of(&mut capped("1GiB"));
    assert!(done["splats"].as_u64() > Some(0));
}

#[test]
fn training_without_an_adapter_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 64, 48);
    let mut elsewhere = job(at, "gpu", &["--out", "o"]);
    common::stopped(elsewhere.env("PLAT_GPU_ADAPTER", "no such adapter"), 2, "--backend");
}

/// A trained model in the folder `model`.
fn trained(at: &Path) {
    common::city(at, 20, 64, 48);
    done(at, "cpu", &["--out", "model", "--test-every", "5"]);
}

/// Mean and largest absolute difference of two slices.
fn difference(a: &[f32], b: &[f32]) -> (f32, f32) {
    assert!(a.len() == b.len() && !a.is_empty());
    let apart = || a.iter().zip(b).map(|(a, b)| (a - b).abs());
    (apart().sum::<f32>() / a.len() as f32, apart().fold(0.0, f32::max))
}

#[test]
fn pictures_and_depth_rendered_on_a_gpu_agree_with_the_cpu() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    trained(at);
    let render = |backend: &str| {
        let words = ["render", "model", "--cameras", "city", "--depth", "--backend", backend, "--out", backend];
        common::done(at, &words)
    };
    let (cpu, gpu) = (render("cpu"), render("gpu"));
    assert!(gpu["backend"] == name.as_str() && cpu["backend"].as_str().unwrap().starts_with("cpu-"), "{gpu}");
    assert_eq!((&gpu["views"], &gpu["splats"]), (&cpu["views"], &cpu["splats"]));
    assert_eq!(render("auto")["backend"], cpu["backend"]);

    let mut compared = 0;
    let mut folders = vec![at.join("cpu")];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let other = at.join("gpu").join(path.strip_prefix(at.join("cpu")).unwrap());
            let (mean, largest) = if path.extension().is_some_and(|extension| extension == "png") {
                let levels = |path: &Path| -> Vec<f32> {
                    image::open(path).unwrap().to_rgb8().into_raw().into_iter().map(f32::from).collect()
                };
                difference(&levels(&path), &levels(&other))
            } else {
                let depth = |path: &Path| npy::read_f32(&std::fs::read(path).unwrap()).unwrap();
                let ((shape, ours), (other_shape, theirs)) = (depth(&path), depth(&other));
                assert!(shape == other_shape && ours.iter().any(|&depth| depth > 0.0), "{}", path.display());
                difference(&ours, &theirs)
            };
            // A rounding difference may add a splat to a pixel or take one from it, at the threshold of alpha.
            println!("{}: mean difference {mean}, largest {largest}", other.display());
            assert!(mean < 0.01, "{}: mean difference {mean}, largest {largest}", other.display());
            compared += 1;
        }
    }
    assert_eq!(Some(compared), gpu["views"].as_u64().map(|views| 2 * views));
}

#[test]
fn an_evaluation_on_a_gpu_agrees_with_the_cpu() {
    let Some(name) = gpu() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    trained(at);
    let eval = |backend: &str| {
        let words = ["eval", "model", "city", "--level", "all", "--seams", "--backend", backend, "--out", backend];
        common::done(at, &words)
    };
    let (cpu, gpu) = (eval("cpu"), eval("gpu"));
    assert!(gpu["backend"] == name.as_str() && cpu["backend"].as_str().unwrap().starts_with("cpu-"), "{gpu}");
    let close = |pointer: &str, tolerance: f64| {
        let [ours, theirs] = [&gpu, &cpu].map(|report| report.pointer(pointer).and_then(Value::as_f64));
        println!("{pointer}: {ours:?} on the GPU, {theirs:?} on the CPU");
        let (Some(ours), Some(theirs)) = (ours, theirs) else { panic!("{pointer} is missing") };
        assert!((ours - theirs).abs() <= tolerance, "{pointer}: {ours} on the GPU, {theirs} on the CPU");
    };
    close("/psnr", 0.02);
    close("/cc_psnr", 0.02);
    close("/ssim", 0.001);
    close("/views/0/psnr", 0.05);
    for cut in 0..2 {
        close(&format!("/cuts/{cut}/full/psnr"), 0.02);
        close(&format!("/cuts/{cut}/away/classic/psnr"), 0.1);
        close(&format!("/cuts/{cut}/away_mip"), 0.5);
    }
    close("/cuts/1/loss_db", 0.0);
    close("/seams/seam_share", 0.01);
    close("/seams/seam_psnr", 0.1);
    close("/seams/interior_psnr", 0.1);
    assert!(at.join("gpu/sheet.png").exists() && at.join("gpu/seams_birdseye.png").exists());
}

#[test]
fn rendering_without_an_adapter_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for words in [&["render", "model", "--cameras", "city", "--out", "o"][..], &["eval", "model", "city"]] {
        let mut elsewhere = common::command(folder.path(), &[words, &["--backend", "gpu"]].concat());
        common::stopped(elsewhere.env("PLAT_GPU_ADAPTER", "no such adapter"), 2, "--backend");
    }
    common::refused(folder.path(), &["eval", "model", "city", "--backend", "cuda"], "cuda");
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
        common::stopped(elsewhere.env("PLAT_GPU_ADAPTER", "no such adapter"), 2, "no GPU adapter");
    }
    common::refused(folder.path(), &[&KERNELS[..], &["--from-stage", "blur"]].concat(), "rasterize_backward");
    common::refused(folder.path(), &[&KERNELS[..], &["--from-stage", "bin", "--passes", "2"]].concat(), "--passes");
}
