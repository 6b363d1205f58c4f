//! The program as run by scripts: exit codes, files, bytes.

mod common;

use common::{city, done, plat, refused};
use glam::Vec3;
use scene::{Splat, Splats, npy, ply};
use serde_json::Value;

/// One red splat five metres in front of the origin.
fn red_splat() -> Vec<u8> {
    let mut splats = Splats::new(0);
    splats.push(&Splat::round(Vec3::new(0.0, 0.0, -5.0), 0.0, Vec3::new(0.9, 0.1, 0.1), 0.99));
    ply::write(&splats, &[])
}

/// Two views from the origin along -z (OpenGL's forward), whose photos do not exist; one lies in a sub-folder.
const CAMERAS: &str = r#"{"w": 20, "h": 10, "fl_x": 10, "fl_y": 10, "cx": 10, "cy": 5, "frames": [
    {"file_path": "front/a.jpg", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
    {"file_path": "b.png", "transform_matrix": [[-1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}]}"#;

#[test]
fn bad_usage_and_bad_input_exit_with_2_and_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("whole.ply"), red_splat()).unwrap();
    std::fs::write(at.join("cut.ply"), &red_splat()[..300]).unwrap();
    std::fs::write(at.join("cut2.ply"), &red_splat()[..red_splat().len() - 1]).unwrap();
    std::fs::write(at.join("notes.txt"), "notes").unwrap();
    std::fs::write(at.join("cameras.json"), CAMERAS).unwrap();
    std::fs::write(at.join("bad.toml"), "stepps = 3\n").unwrap();
    std::fs::create_dir(at.join("empty")).unwrap();
    city(at, 16, 64, 48);
    refused(at, &[], "plat demo");
    refused(at, &["fly"], "fly");
    refused(at, &["train", "city", "--out", "o", "--speed", "9"], "--speed");
    refused(at, &["train", "city"], "--out");
    refused(at, &["train", "missing", "--out", "o"], "missing");
    refused(at, &["train", "empty", "--out", "o"], "empty");
    refused(at, &["train", "city", "--out", "o", "--steps", "0"], "--steps");
    refused(at, &["train", "city", "--out", "o", "--downscale", "40"], "--downscale");
    refused(at, &["train", "city", "--out", "o", "--store", "ftp://x"], "ftp");
    for minutes in ["0", "-1", "nan", "inf", "soon"] {
        refused(at, &["train", "city", "--out", "o", &format!("--minutes={minutes}")], "--minutes");
    }
    refused(at, &["train", "city", "--out", "o", "--config", "bad.toml"], "stepps");
    refused(at, &["plan", "city", "--levels", "99"], "levels");
    refused(at, &["inspect", "missing"], "missing");
    for model in ["missing.ply", "cut.ply", "cut2.ply", "notes.txt", "empty"] {
        refused(at, &["render", model, "--cameras", "cameras.json", "--out", "o"], model);
        refused(at, &["export", model, "--to", "ply", "--out", "o.ply"], model);
        refused(at, &["import", model, "--out", "o.ply"], model);
    }
    refused(at, &["render", "whole.ply", "--cameras", "notes.txt", "--out", "o"], "notes.txt");
    refused(at, &["eval", "whole.ply", "missing"], "missing");
    refused(at, &["bench", "chart"], "bench/results");
    let train = plat(at, &["train", "--help"]);
    assert!(train.status.success() && !train.stdout.is_empty());
}

#[test]
fn views_are_rendered_from_cameras_without_photos() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("red.ply"), red_splat()).unwrap();
    std::fs::write(at.join("cameras.json"), CAMERAS).unwrap();
    let said = done(at, &["render", "red.ply", "--cameras", "cameras.json", "--out", "o", "--depth"]);
    assert_eq!((&said["views"], &said["splats"], &said["antialiased"]), (&2.into(), &1.into(), &false.into()));
    let front = image::open(at.join("o/front/a.png")).unwrap().to_rgb8();
    assert_eq!(front.dimensions(), (20, 10));
    let [red, green, _] = front.get_pixel(10, 5).0;
    assert!(red > 200 && green < 40, "{red} {green}");
    let back = image::open(at.join("o/b.png")).unwrap().to_rgb8();
    assert!(back.pixels().all(|pixel| pixel.0 == [0; 3]), "the view in the opposite direction is not black");
    let (shape, depth) = npy::read_f32(&std::fs::read(at.join("o/front/a.depth.npy")).unwrap()).unwrap();
    assert_eq!(shape, [10, 20]);
    assert!((depth[5 * 20 + 10] - 5.0).abs() < 1e-4 && depth[0] == 0.0, "{} {}", depth[5 * 20 + 10], depth[0]);

    done(at, &["render", "red.ply", "--cameras", "cameras.json", "--out", "large", "--size", "40x20"]);
    assert_eq!(image::image_dimensions(at.join("large/b.png")).unwrap(), (40, 20));
    std::fs::write(at.join("out.json"), CAMERAS.replace("front/a.jpg", "../a.jpg")).unwrap();
    let output = plat(at, &["render", "red.ply", "--cameras", "out.json", "--out", "o2"]);
    assert!(output.status.code() == Some(2) && !at.join("a.png").exists());
}

#[test]
fn a_city_is_trained_measured_and_exported_reproducibly() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 20, 64, 48);
    let train = |out: &str, threads: &str| {
        let options = ["--steps", "60", "--budget", "800", "--levels", "1", "--eval-every", "20", "--threads", threads];
        done(at, &[&["train", "city", "--out", out][..], &options].concat())
    };
    let report = train("one", "1");
    train("two", "2");
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("one/merged.ply") == bytes("two/merged.ply"), "the number of threads changes the result");
    assert_eq!(bytes("one/plan.json"), bytes("two/plan.json"));

    let text = |path: &str| String::from_utf8(bytes(path)).unwrap();
    let lines: Vec<Value> = text("one/metrics.jsonl").lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert!(lines.iter().all(|l| l["task"].is_string() && l["cpu_seconds"].is_f64() && l["splats"].is_u64()));
    assert!(
        lines.is_sorted_by_key(|l| l["cpu_seconds"].as_f64().map(|s| (s * 1e6) as u64)),
        "times are not increasing"
    );
    assert!(lines.iter().any(|l| l["psnr"].is_f64()));
    assert!(text("one/plan.svg").starts_with("<svg"));
    let stored: Value = serde_json::from_slice(&bytes("one/report.json")).unwrap();
    assert_eq!((&stored["plan"], &stored["command"], &report["seed"]), (&report["plan"], &"train".into(), &0.into()));
    for key in ["commit", "machine", "scene", "config_hash", "backend", "lpips", "zone_psnr", "bytes_moved", "fps"] {
        assert!(report.get(key).is_some(), "{key}");
    }
    let antialiased = ply::comments(&bytes("one/merged.ply")).iter().any(|c| c == "antialiased");
    assert_eq!(report["antialiased"], antialiased);

    // The configuration file of a run gives the same plan.
    done(at, &["train", "city", "--out", "three", "--config", "one/config.toml", "--threads", "2"]);
    assert!(bytes("three/merged.ply") == bytes("one/merged.ply"));

    let measured = done(at, &["eval", "one", "city"]);
    assert_eq!(measured["views"].as_array().unwrap().len(), 3);
    // The merged model is measured during training, so the last figures are those of the model.
    assert_eq!(report["psnr"], measured["psnr"]);
    let on_the_way: Vec<&Value> = lines.iter().filter(|l| l["psnr"].is_f64()).collect();
    let tasks = report["tasks"].as_u64().unwrap() as usize;
    assert!(tasks > 2 && on_the_way.len() > 2 * tasks, "{tasks} {}", on_the_way.len());
    let last = on_the_way.last().unwrap();
    assert_eq!((&last["psnr"], &last["merged_splats"]), (&measured["psnr"], &report["splats"]));
    assert!(report["bytes_moved"].as_u64() > report["bytes"].as_u64(), "{}", report["bytes_moved"]);
    assert!(measured["psnr"].as_f64().unwrap() > 8.0 && at.join("one/eval/sheet.png").is_file());
    let again = done(at, &["eval", "one/merged.ply", "city"]);
    assert_eq!(again["psnr"], measured["psnr"], "merged.ply differs from the model");
    done(at, &["export", "one", "--to", "ply", "--out", "deep/er/city.ply"]);
    assert!(bytes("deep/er/city.ply") == bytes("one/merged.ply"));
    let streamed = done(at, &["export", "one", "--to", "sog", "--out", "streamed"]);
    let merged = scene::ply::read(&bytes("one/merged.ply")).unwrap().len();
    assert_eq!((&streamed["splats"], &streamed["levels"]), (&merged.into(), &2.into()));
    assert!(text("streamed/lod-meta.json").contains("\"lodLevels\": 2"));
    refused(at, &["export", "one", "--to", "sog", "--out", "streamed"], "streamed");
    let tree = done(at, &["export", "one", "--to", "rad", "--out", "tree/one.rad"]);
    let leaves = scene::rad::read(&bytes("tree/one.rad")).unwrap().leaves();
    assert_eq!((&tree["splats"], leaves.len()), (&merged.into(), merged));
    assert_eq!(at.join("tree").read_dir().unwrap().count(), 1, "scratch files are removed");

    // What was exported is read as it is, and imported as a file.
    done(at, &["export", "one", "--to", "tiles", "--out", "tiles"]);
    for (from, format) in [("streamed", "streamed SOG"), ("tree/one.rad", "RAD"), ("tiles", "3D Tiles")] {
        let back = done(at, &["import", from, "--out", "back.ply"]);
        assert_eq!((&back["splats"], &back["format"]), (&merged.into(), &format.into()));
        assert_eq!(back["antialiased"], antialiased);
        let loss =
            measured["psnr"].as_f64().unwrap() - done(at, &["eval", "back.ply", "city"])["psnr"].as_f64().unwrap();
        assert!(loss.abs() < 0.3, "{format} costs {loss} dB");
    }
    refused(at, &["import", "streamed", "--out", "back.sog"], "back.sog");
    std::fs::remove_file(at.join("streamed/0_0/quats.webp")).unwrap();
    refused(at, &["import", "streamed", "--out", "back.ply"], "quats.webp");

    // Rendering needs cameras, but no photos.
    std::fs::remove_dir_all(at.join("city/images")).unwrap();
    let drawn = done(at, &["render", "one", "--cameras", "city", "--out", "views"]);
    assert_eq!((&drawn["views"], &drawn["antialiased"]), (&20.into(), &antialiased.into()));
}

#[test]
fn captures_are_inspected_and_planned() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 20, 64, 48);
    let found = done(at, &["inspect", "city"]);
    assert_eq!((&found["views"], &found["format"]), (&20.into(), &"colmap".into()));
    assert!(found["estimate"]["memory_bytes"].as_u64().unwrap() > 0 && found["problem"].is_null());
    let planned = done(at, &["plan", "city", "--out", "plan.json", "--svg", "plan.svg", "--levels", "1"]);
    assert!(planned["tasks"].as_u64().unwrap() >= 2);
    let plan: blocks::Plan = serde_json::from_slice(&std::fs::read(at.join("plan.json")).unwrap()).unwrap();
    assert_eq!(planned["plan"], plan.id().to_string());
    // Training uses the same plan, except for the contents of the photos.
    done(at, &["train", "city", "--out", "o", "--levels", "1", "--steps", "1", "--blocks", "tree"]);
    let trained: blocks::Plan = serde_json::from_slice(&std::fs::read(at.join("o/plan.json")).unwrap()).unwrap();
    let same = done(at, &["plan", "city", "--out", "one.json", "--levels", "1", "--steps", "1"]);
    let one: blocks::Plan = serde_json::from_slice(&std::fs::read(at.join("one.json")).unwrap()).unwrap();
    assert!(same["plan"] != trained.id().to_string() && one.tasks == trained.tasks);
    assert!(std::fs::read_to_string(at.join("plan.svg")).unwrap().starts_with("<svg"));
    let human = plat(at, &["plan", "city"]);
    assert!(human.status.success() && String::from_utf8(human.stdout).unwrap().contains("level 0"));
}

#[test]
fn a_time_limit_shortens_every_task_and_gives_a_complete_model() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 20, 64, 48);
    // Without the limit this would take half an hour.
    let options = ["--steps", "1000000", "--budget", "800", "--levels", "1", "--minutes", "0.05", "--store", "store"];
    for blocks in ["whole", "tree"] {
        let train = ["train", "city", "--out", blocks, "--blocks", blocks];
        let report = done(at, &[&train[..], &options].concat());
        assert_eq!(report["capped"], true, "{blocks}");
        let plan: blocks::Plan =
            serde_json::from_slice(&std::fs::read(at.join(blocks).join("plan.json")).unwrap()).unwrap();
        let metrics = std::fs::read_to_string(at.join(blocks).join("metrics.jsonl")).unwrap();
        let lines: Vec<Value> = metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        for task in &plan.tasks {
            let of_task = |line: &&Value| line["task"] == task.block.to_string();
            let last = lines.iter().rfind(of_task).expect("every task has its say");
            assert!(last["step"].as_u64() >= Some(1) && last["step"].as_u64() < Some(task.steps.into()), "{last}");
        }
        let splats = ply::read(&std::fs::read(at.join(blocks).join("merged.ply")).unwrap()).unwrap();
        assert_eq!(report["splats"], splats.len());
        assert!(done(at, &["eval", blocks, "city"])["psnr"].is_f64());
    }
    // A limit that is not reached changes nothing.
    let options = ["--steps", "20", "--budget", "800", "--levels", "0", "--store", "store"];
    let free = done(at, &[&["train", "city", "--out", "free"][..], &options].concat());
    let far = done(at, &[&["train", "city", "--out", "far", "--minutes", "600"][..], &options].concat());
    assert_eq!((&free["capped"], &far["capped"]), (&false.into(), &false.into()));
    let bytes = |out: &str| std::fs::read(at.join(out).join("merged.ply")).unwrap();
    assert!(bytes("free") == bytes("far"));
}

/// A field of a protocol buffer: a message, text or bytes.
fn field(number: u8, bytes: impl AsRef<[u8]>) -> Vec<u8> {
    let bytes = bytes.as_ref();
    assert!(bytes.len() < 1 << 14);
    [&[number << 3 | 2, bytes.len() as u8 | 0x80, (bytes.len() >> 7) as u8][..], bytes].concat()
}

/// A field of a protocol buffer: a number.
fn number(field: u8, value: u8) -> Vec<u8> {
    vec![field << 3, value]
}

/// An ONNX graph with the signature of LPIPS that returns the mean squared difference of the first and the last of its `inputs`.
fn squares(inputs: usize) -> Vec<u8> {
    let node = |operator: &str, inputs: [&str; 2], output: &str| {
        let inputs = inputs.iter().filter(|input| !input.is_empty()).flat_map(|input| field(1, input));
        field(1, [inputs.collect(), field(2, output), field(4, operator)].concat())
    };
    let value = |at: u8, name: &str, dimensions: Vec<u8>| {
        let tensor = [number(1, 1), field(2, dimensions)].concat();
        field(at, [field(1, name), field(2, field(1, tensor))].concat())
    };
    let image = || [field(1, number(1, 1)), field(1, number(1, 3)), field(1, field(2, "h")), field(1, field(2, "w"))];
    let names = ["a", "b"];
    let mut graph = [
        node("Sub", ["a", names[inputs - 1]], "difference"),
        node("Mul", ["difference", "difference"], "squared"),
        node("ReduceMean", ["squared", ""], "distance"),
        field(2, "squares"),
    ]
    .concat();
    for name in &names[..inputs] {
        graph.extend(value(11, name, image().concat()));
    }
    graph.extend(value(12, "distance", [(); 4].map(|()| field(1, number(1, 1))).concat()));
    [number(1, 8), field(7, graph), field(8, [field(1, ""), number(2, 13)].concat())].concat()
}

#[test]
fn lpips_is_measured_with_the_given_network() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    std::fs::write(at.join("red.ply"), red_splat()).unwrap();
    std::fs::write(at.join("net.onnx"), squares(2)).unwrap();
    assert!(done(at, &["eval", "red.ply", "city", "--out", "o"])["lpips"].is_null());
    let measured = done(at, &["eval", "red.ply", "city", "--lpips", "net.onnx", "--out", "o"]);
    for view in measured["views"].as_array().unwrap() {
        // Values are in -1..1, so differences are doubled.
        let expected = 4.0 * 10f64.powf(-0.1 * view["psnr"].as_f64().unwrap());
        assert!((view["lpips"].as_f64().unwrap() - expected).abs() < 1e-4 * expected, "{view} {expected}");
    }
    assert!(measured["lpips"].is_f64());
    let human = plat(at, &["eval", "red.ply", "city", "--lpips", "net.onnx", "--out", "o"]);
    assert!(String::from_utf8(human.stdout).unwrap().contains("LPIPS"));

    let whole = squares(2);
    std::fs::write(at.join("one.onnx"), squares(1)).unwrap();
    std::fs::write(at.join("text.onnx"), "no network\n").unwrap();
    std::fs::write(at.join("none.onnx"), "").unwrap();
    // (Truncation after the operators is not detected.)
    for (i, length) in (1..whole.len() / 2).step_by(17).enumerate() {
        std::fs::write(at.join(format!("cut{i}.onnx")), &whole[..length]).unwrap();
        refused(at, &["eval", "red.ply", "city", "--quiet", "--lpips", &format!("cut{i}.onnx")], "cut");
    }
    for bad in ["one.onnx", "text.onnx", "none.onnx", "missing.onnx", "city"] {
        refused(at, &["eval", "red.ply", "city", "--quiet", "--lpips", bad], bad);
    }
}

#[test]
fn measurements_are_appended_as_lines() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    let lines = |file: &str| -> Vec<Value> {
        let text = std::fs::read_to_string(at.join("results").join(file)).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    };
    done(at, &["bench", "ingest", "city", "--results", "results"]);
    let said = done(at, &["bench", "ingest", "city", "--results", "results", "--scene", "town", "--downscale", "2"]);
    let ingests = lines("ingest.jsonl");
    assert_eq!((ingests.len(), &ingests[1]), (2, &said));
    assert_eq!((&said["kind"], &said["scene"], &said["photos"]), (&"ingest".into(), &"town".into(), &16.into()));
    assert!(ingests[0]["bytes_written"].as_u64() > said["bytes_written"].as_u64(), "{ingests:?}");
    let kernels = ["bench", "kernels", "--splats", "50", "--size", "32x32", "--passes", "1"];
    done(at, &kernels);
    let said = done(at, &[&kernels[..], &["--results", "results"]].concat());
    assert_eq!(lines("kernels.jsonl"), [said]);

    std::fs::write(at.join("net.onnx"), squares(2)).unwrap();
    let pareto = ["bench", "pareto", "--label", "l", "--scene", "s", "--results", "results", "--lpips", "net.onnx"];
    let train = ["--out", "o", "city", "--steps", "40", "--budget", "800", "--levels", "1", "--eval-every", "10"];
    let run = done(at, &[&pareto[..], &train].concat());
    assert!(
        run["lpips"].is_f64() && run["bytes_moved"].is_u64() && run["curve"].as_array().unwrap().len() > 4,
        "{run}"
    );
    // The chart shows the run and ignores other lines.
    std::fs::write(at.join("README.md"), "<!-- bench:begin -->\n<!-- bench:end -->\n").unwrap();
    assert_eq!(done(at, &["bench", "chart", "--results", "results"])["lines"], 1);
}
