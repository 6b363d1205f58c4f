//! Paths that cannot be written and full disks: exit code 1, one line, and no incomplete file under its final name.
//!
//! A full disk is simulated by a limit on file size (`ulimit -f`), which needs no privilege and fails a write in its middle, and by
//! `/dev/full`.
#![cfg(target_os = "linux")]

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{city, command, done, json_of, plat, stopped};
use glam::Vec3;
use scene::{ArtefactId, Splat, Splats, colmap, frame, npy, ply, spz};
use serde_json::Value;

/// Bytes per block of `ulimit -f`.
const BLOCK: u64 = 512;
const TRAIN: [&str; 12] =
    ["train", "city", "--steps", "20", "--budget", "400", "--levels", "1", "--threads", "2", "--checkpoint-every", "0"];

const SYNTH: [&str; 9] = ["synth", "--area-km2", "0.05", "--views", "8", "--size", "64x36", "--traffic", "light"];

/// The command with files limited to this many blocks.
fn limited(at: &Path, blocks: u64, words: &[&str]) -> Command {
    let mut shell = Command::new("sh");
    // Without the trap a signal would kill the program, which a full disk does not do.
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$@\"");
    shell.args(["-c", &script, "sh", env!("CARGO_BIN_EXE_plat")]).args(words).arg("--quiet").current_dir(at);
    shell
}

/// Creates a capture with cameras, a model as a file, and one as a folder.
fn create_inputs(at: &Path) {
    city(at, 16, 64, 48);
    let mut splats = Splats::new(0);
    for i in 0..40 {
        splats.push(&Splat::round(Vec3::new(i as f32, 0.0, 0.0), -1.0, Vec3::splat(0.5), 0.1 + 0.02 * i as f32));
    }
    fs::write(at.join("some.ply"), ply::write(&splats, &[])).unwrap();
    done(at, &[&TRAIN[..], &["--out", "model", "--store", "store"]].concat());
}

/// Asserts that all files under a folder are complete, and returns their contents.
fn whole(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let Ok(entries) = fs::read_dir(&folder) else { continue };
        for path in entries.map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let bytes = fs::read(&path).unwrap();
            assert!(is_whole(&path, &bytes), "{} of {} bytes", path.display(), bytes.len());
            files.insert(path, bytes);
        }
    }
    files
}

fn has(path: &Path, folder: &str) -> bool {
    path.components().any(|part| part.as_os_str() == folder)
}

fn is_whole(path: &Path, bytes: &[u8]) -> bool {
    let name = path.file_name().unwrap().to_str().unwrap();
    let text = || std::str::from_utf8(bytes).unwrap();
    match name.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "png" => image::load_from_memory(bytes).is_ok(),
        "ply" => ply::read(bytes).is_ok(),
        "spz" => spz::read(bytes).is_ok(),
        "npy" => npy::read_f32(bytes).is_ok(),
        "json" => serde_json::from_slice::<Value>(bytes).is_ok(),
        "jsonl" => text().lines().all(|line| serde_json::from_str::<Value>(line).is_ok()),
        "toml" => text().parse::<toml::Table>().is_ok(),
        "svg" => text().trim_end().ends_with("</svg>"),
        "plat" if name == "plan.plat" => blocks::Plan::from_frame(bytes).is_ok(),
        "plat" => frame::decode_splats(bytes).is_ok(),
        "bin" if name == "cameras.bin" => colmap::read_cameras_bin(bytes).is_ok(),
        "bin" if name == "images.bin" => colmap::read_images_bin(bytes).is_ok(),
        "bin" => colmap::read_points_bin(bytes).is_ok(),
        // A store: artefacts are named by their hash; records hold an id, a frame, or nothing.
        "" if has(path, "artefacts") => ArtefactId::of(bytes).to_string() == name,
        "" => has(path, "names") && (matches!(bytes.len(), 0 | 32) || bytes.starts_with(b"plat")),
        _ => false,
    }
}

#[test]
fn a_path_that_cannot_be_written_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    create_inputs(at);
    fs::write(at.join("notes.txt"), "notes").unwrap();
    fs::create_dir(at.join("locked")).unwrap();
    fs::set_permissions(at.join("locked"), fs::Permissions::from_mode(0o555)).unwrap();
    let mut places = vec!["notes.txt", "/proc"];
    // Root can write to locked folders.
    if fs::write(at.join("locked/probe"), "").is_err() {
        places.push("locked");
    }
    for place in places {
        let out = &format!("{place}/o");
        let [file, drawing] = [&format!("{place}/o.ply"), &format!("{place}/o.svg")];
        for words in [
            &[&TRAIN[..], &["--out", out]].concat()[..],
            &[&TRAIN[..], &["--out", "o", "--store", out]].concat(),
            &["plan", "city", "--out", out],
            &["plan", "city", "--svg", drawing],
            &["demo", "--quick", "--out", out],
            &[&SYNTH[..], &["--out", out]].concat(),
            &["render", "some.ply", "--cameras", "city", "--out", out],
            &["export", "model", "--to", "ply", "--out", file],
            &["export", "model", "--to", "rad", "--out", file],
            &["prune", "some.ply", "--keep", "0.5", "--out", file],
            &["prune", "model", "--keep", "0.5", "--out", out],
            &["eval", "some.ply", "city", "--out", out],
        ] {
            stopped(command(at, words).arg("--quiet"), 1, place);
        }
    }
    assert_eq!(fs::read_to_string(at.join("notes.txt")).unwrap(), "notes");
    fs::set_permissions(at.join("locked"), fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn a_full_device_is_an_error_and_is_not_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    create_inputs(at);
    let full = |name: &str| symlink("/dev/full", at.join(name)).unwrap();
    ["full.json", "full.svg", "full.ply"].into_iter().for_each(full);
    for words in [
        &["plan", "city", "--out", "full.json"][..],
        &["plan", "city", "--svg", "full.svg"],
        &["export", "model", "--to", "ply", "--out", "full.ply"],
        &["export", "model", "--to", "spz", "--out", "/dev/full"],
        &["prune", "some.ply", "--keep", "0.5", "--out", "full.ply"],
    ] {
        stopped(&mut command(at, words), 1, "the disk is full; free some space");
    }
    assert!(at.join("full.ply").is_symlink());
    // A metrics log that cannot be written fails the run at its end.
    fs::create_dir(at.join("o")).unwrap();
    full("o/metrics.jsonl");
    let train = [&TRAIN[..], &["--out", "o", "--quiet"]].concat();
    stopped(&mut command(at, &train), 1, "o/metrics.jsonl: cannot be written: the disk is full");
    assert!(!at.join("o/model").exists() && !at.join("o/merged.ply").exists());
    // The model folder appears only when it is complete.
    fs::remove_file(at.join("o/metrics.jsonl")).unwrap();
    fs::create_dir(at.join("o/merged.ply")).unwrap();
    stopped(&mut command(at, &train), 1, "o/merged.ply: cannot be replaced");
    assert!(!at.join("o/model/model.json").exists());

    // Standard output holds a result too. A closed pipe is not an error.
    let open = || fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    for words in [&["inspect", "city"][..], &["plan", "city", "--json"], &["--help"]] {
        let output = command(at, words).arg("--quiet").stdout(open()).output().unwrap();
        let line = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{words:?}: {line}");
        assert!(line.contains("standard output: cannot be written: the disk is full"), "{words:?}: {line}");
    }
    assert!(
        command(at, &["inspect", "city"]).stderr(open()).output().unwrap().status.success(),
        "a note that cannot be printed is an error"
    );
    // A reader that closes the pipe before the program writes.
    let mut early = command(at, &["inspect", "city"]).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    drop(early.stdout.take());
    assert!(early.wait().unwrap().success());
}

#[test]
fn a_full_disk_leaves_no_incomplete_file_under_its_final_name() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    create_inputs(at);
    // Each with the number of blocks that fits all of its files. Older files are kept or removed.
    let mut failures = 0;
    for words in [
        &["plan", "city", "--out", "out/plan.json"][..],
        &["plan", "city", "--svg", "out/plan.svg"],
        &["render", "some.ply", "--cameras", "city", "--depth", "--out", "out"],
        &["export", "model", "--to", "ply", "--out", "out/o.ply"],
        &["export", "model", "--to", "spz", "--out", "out/o.spz"],
        &["prune", "some.ply", "--keep", "0.5", "--out", "out/o.ply"],
        &["prune", "model", "--keep", "0.5", "--out", "out"],
        &["eval", "model", "city", "--store", "store", "--out", "out"],
    ] {
        let out = at.join("out");
        fs::create_dir_all(&out).unwrap();
        let most = json_and_longest(at, words, &out);
        let before = whole(&out);
        for blocks in [0, 1, most / 4, most / 2, most - 1] {
            stopped(&mut limited(at, blocks, words), 1, "cannot be written: ");
            failures += 1;
            for (path, bytes) in whole(&out) {
                assert!(before.get(&path) == Some(&bytes), "{words:?}: {}", path.display());
            }
        }
        json_of(&mut limited(at, most, words));
        assert_eq!(whole(&out).len(), before.len());
        fs::remove_dir_all(&out).unwrap();
    }
    assert_eq!(failures, 40);
}

/// Runs the command without a limit and returns the blocks of its longest file.
fn json_and_longest(at: &Path, words: &[&str], out: &Path) -> u64 {
    done(at, words);
    whole(out).values().map(|bytes| (bytes.len() as u64).div_ceil(BLOCK)).max().unwrap()
}

#[test]
fn training_on_a_full_disk_can_be_resumed_when_there_is_space() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    let train = |out: &'static str| [&TRAIN[..], &["--out", out]].concat();
    done(at, &train("calm"));
    let merged = |out: &str| fs::read(at.join(out).join("merged.ply")).unwrap();

    let mut failures = 0;
    for blocks in [0, 4, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192] {
        let mut run = limited(at, blocks, &train("o"));
        let output = run.output().unwrap();
        let files = whole(&at.join("o"));
        if output.status.success() {
            break;
        }
        stopped(&mut run, 1, "cannot");
        assert!(!at.join("o/model/model.json").exists(), "{blocks} blocks: {files:?}");
        failures += 1;
    }
    assert!(failures >= 4, "{failures} of the limits were too small");
    assert!(merged("o") == merged("calm"), "a full disk changes the result");
}

#[test]
fn a_demo_on_a_full_disk_leaves_no_capture() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    // First photos do not fit; then photos fit and the sparse points do not.
    for blocks in [8, 100] {
        stopped(&mut limited(at, blocks, &["demo", "--quick", "--out", "o"]), 1, "cannot be written: ");
        whole(&at.join("o"));
        let output = plat(at, &["inspect", "o/city"]);
        assert_eq!(output.status.code(), Some(2), "{blocks} blocks");
    }
}

#[test]
fn a_synthetic_capture_on_a_full_disk_is_incomplete_and_can_be_resumed_when_there_is_space() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let synth = |out: &'static str| [&SYNTH[..], &["--truth", "--occupancy", "2", "--out", out]].concat();
    done(at, &synth("calm"));
    let complete = |out: &str| -> Value {
        serde_json::from_slice::<Value>(&fs::read(at.join(out).join("manifest.json")).unwrap()).unwrap()["complete"]
            .clone()
    };
    // First the claim fails, then a photo, then depths, then voxels.
    let mut failures = 0;
    for blocks in [0, 4, 12, 40] {
        let mut run = limited(at, blocks, &synth("o"));
        if run.output().unwrap().status.success() {
            continue;
        }
        stopped(&mut run, 1, "cannot be written: ");
        failures += 1;
        if blocks > 0 {
            assert_eq!(complete("o"), false, "{blocks} blocks");
        }
    }
    assert!(failures >= 3, "{failures} of the limits were too small");
    done(at, &synth("o"));
    assert_eq!(complete("o"), true);
    let files = |out: &str| {
        let output = Command::new("find").args([".", "-type", "f"]).current_dir(at.join(out)).output().unwrap();
        let mut names: Vec<_> = String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect();
        names.sort();
        names.into_iter().map(|name| (fs::read(at.join(out).join(&name)).unwrap(), name)).collect::<Vec<_>>()
    };
    assert!(files("o") == files("calm"), "a full disk changes the capture");
}
