//! Runs plat as scripts do and checks exit codes and output.
#![allow(dead_code, reason = "each test program uses some of it")]

#[cfg(unix)]
pub(crate) mod cluster;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use city::{CitySettings, Layout, Traffic};
use dataset::synth::{self, Settings};
use serde_json::Value;

/// A small detector of random weights, with its card.
pub(crate) fn write_tiny(at: &Path) -> Vec<u8> {
    let onnx = fs::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../perceive/tests/yolov8_tiny.onnx")).unwrap();
    fs::write(at.join("tiny.onnx"), &onnx).unwrap();
    fs::write(at.join("tiny.toml"), "classes = ['car', 'person', 'bench']\nscore = 0.5").unwrap();
    onnx
}

/// The command with these arguments in a folder, not yet started.
pub(crate) fn command(folder: &Path, words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_plat"));
    command.args(words).current_dir(folder);
    command
}

/// Runs a command.
pub(crate) fn plat(folder: &Path, words: &[&str]) -> Output {
    command(folder, words).output().expect("plat runs")
}

/// Runs a command that must succeed, and returns its JSON.
pub(crate) fn done(folder: &Path, words: &[&str]) -> Value {
    json_of(&mut command(folder, words))
}

/// As [`done`] for a command with further settings.
pub(crate) fn json_of(command: &mut Command) -> Value {
    let output = command.arg("--json").output().expect("plat runs");
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(text.lines().last().expect("an object on the last line")).unwrap()
}

/// Runs a command that must exit with 2 and one line that contains `wanted`.
pub(crate) fn refused(folder: &Path, words: &[&str], wanted: &str) {
    stopped(&mut command(folder, words), 2, wanted);
}

/// Runs a command that must exit with this code and one line that contains `wanted`; returns the line.
pub(crate) fn stopped(command: &mut Command, code: i32, wanted: &str) -> String {
    let output = command.output().expect("plat runs");
    let line = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{command:?}: {line}");
    assert!(line.contains(wanted) && line.trim_end().lines().count() == 1, "{command:?}: {line}");
    assert!(output.stdout.is_empty(), "{command:?}");
    line
}

/// A small city without traffic, mostly from the air, so that few photos cover it.
pub(crate) fn small(views: u32, width: u32, height: u32) -> Settings {
    let city = CitySettings { seed: 3, layout: Layout::Grid, traffic: Traffic::None, ..CitySettings::default() };
    Settings { city, views, width, height, aerial: 0.75, ..Settings::default() }
}

/// Writes the capture of a small city into the folder `city`.
pub(crate) fn city(folder: &Path, views: u32, width: u32, height: u32) {
    synth::write(&folder.join("city"), &small(views, width, height), &|_, _, _| ()).unwrap();
}
