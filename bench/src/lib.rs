//! Result lines of measured runs, and the chart and tables that are drawn from them.
//!
//! `bench/results/*.jsonl` holds one [`ResultLine`] per run and is never edited by hand. Chart and tables are functions of these lines and of
//! other trainers' figures ([`reference`]). Lines with a `kind` are measurements of a component ([`PartLine`]).

pub mod chart;
mod judged;
pub mod parts;
pub mod reference;
mod report_line;
pub mod seeds;
pub mod table;

use std::fs;
use std::path::{Path, PathBuf};

use scene::BadInput;
use serde::{Deserialize, Serialize};
use store::file::SaveError;

pub use chart::{chart, pruning_chart};
pub use judged::Judged;
pub use parts::{PartLine, append_part};
pub use report_line::ReportLine;
pub use seeds::{Averaged, averaged};
pub use table::{replace_table, short_table, table};

/// One run as one line of JSON. Figures that were not measured are null.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ResultLine {
    /// Label of the run in the chart: `plat tree`, `OpenSplat`.
    pub label: String,
    /// The program's git commit.
    pub commit: String,
    /// CPU model and cores, see [`machine`].
    pub machine: String,
    /// The capture's name: `fox`, `street_lund`.
    pub scene: String,
    /// Divisor of the photos' size.
    #[serde(default = "one")]
    pub downscale: u32,
    /// Hash of the resolved configuration.
    pub config_hash: Option<String>,
    /// Planned optimiser steps; null in old lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<u32>,
    /// Planned number of splats; null in old lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<u32>,
    /// Tolerance of pruning, dB; 0 = no pruning; null in old lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance_db: Option<f64>,
    /// Backend and its instruction set or adapter.
    pub backend: String,
    /// Number of workers.
    pub workers: u32,
    /// Wall time of training, seconds.
    pub wall_seconds: Option<f64>,
    /// User and system time of training, seconds; with image loading, without evaluation.
    pub cpu_seconds: f64,
    /// `cpu_seconds` as estimated before training; null in old lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted_cpu_seconds: Option<f64>,
    /// PSNR over held-out views, dB.
    pub psnr: f64,
    /// PSNR over held-out views after an affine colour correction of each view, dB.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cc_psnr: Option<f64>,
    /// SSIM over held-out views, 0..1.
    pub ssim: Option<f64>,
    /// LPIPS over held-out views.
    pub lpips: Option<f64>,
    /// SSIMULACRA2 over held-out views, up to 100.
    pub perceptual: Option<f64>,
    /// PSNR inside object zones, dB.
    pub zone_psnr: Option<f64>,
    /// Share of the detections on photos that are also detected on renders, of the first detector.
    pub detections_kept: Option<f64>,
    /// What each detector finds on the held-out views.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub judged: Vec<Judged>,
    /// Mean relative error of the rendered depth over held-out views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_absrel: Option<f64>,
    /// Share of their pixels whose depth is within a factor of 1.25.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_delta1: Option<f64>,
    /// dB of the pixels within the boxes of objects that move, mean over the held-out views that show some (PSNR*).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moving_psnr: Option<f64>,
    /// Figures of the held-out aerial views, where the capture has both kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aerial: Option<KindFigures>,
    /// Those of the held-out street views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub street: Option<KindFigures>,
    /// Final number of splats.
    pub splats: Option<u64>,
    /// Size of the model, bytes.
    pub bytes: Option<u64>,
    /// Largest resident memory, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Bytes moved between workers and store.
    pub bytes_moved: Option<u64>,
    /// Rendered frames per second.
    pub fps: Option<f64>,
    /// The run's seed.
    pub seed: Option<u64>,
    /// The command that wrote the line.
    pub command: String,
    /// Held-out PSNR during training, in order of time.
    #[serde(default)]
    pub curve: Vec<CurvePoint>,
    /// Source of a reference's figures; null for runs of plat.
    pub source: Option<String>,
}

/// Figures of the held-out views of one kind, aerial or street; as those of [`ResultLine`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct KindFigures {
    /// dB.
    pub psnr: f64,
    /// 0..1.
    pub ssim: Option<f64>,
    /// SSIMULACRA2, up to 100.
    pub perceptual: Option<f64>,
    /// Largest gain of a view's PSNR by an affine colour correction, dB.
    pub worst_cc_gap: Option<f64>,
    /// Mean relative error of the rendered depth.
    pub depth_absrel: Option<f64>,
    /// Share of pixels whose depth is within a factor of 1.25.
    pub depth_delta1: Option<f64>,
    /// Share of the detections on photos that are also detected on renders.
    pub detections_kept: Option<f64>,
}

impl KindFigures {
    fn is_finite(&self) -> bool {
        let more = [self.ssim, self.perceptual, self.worst_cc_gap, self.depth_absrel, self.depth_delta1];
        self.psnr.is_finite() && more.iter().chain(&[self.detections_kept]).flatten().all(|v| v.is_finite())
    }
}

/// A measurement during training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// CPU seconds since the start, as [`ResultLine::cpu_seconds`].
    pub cpu_seconds: f64,
    /// PSNR over held-out views, dB.
    pub psnr: f64,
    /// Splats at that time.
    pub splats: Option<u64>,
}

fn one() -> u32 {
    1
}

/// CPU seconds until a curve first reaches this PSNR, interpolated linearly between its points; `None` if it never does.
pub fn cpu_seconds_to(curve: &[CurvePoint], psnr: f64) -> Option<f64> {
    let reached = curve.iter().position(|p| p.psnr >= psnr)?;
    let at = curve[reached];
    let Some(before) = reached.checked_sub(1).map(|i| curve[i]) else { return Some(at.cpu_seconds) };
    let share = (psnr - before.psnr) / (at.psnr - before.psnr);
    Some(before.cpu_seconds + share * (at.cpu_seconds - before.cpu_seconds))
}

impl ResultLine {
    /// [`cpu_seconds_to`] of this run's curve.
    pub fn cpu_seconds_to(&self, psnr: f64) -> Option<f64> {
        cpu_seconds_to(&self.curve, psnr)
    }

    /// The highest PSNR of the curve and the end, dB.
    pub fn best_psnr(&self) -> f64 {
        self.curve.iter().map(|p| p.psnr).fold(self.psnr, f64::max)
    }

    fn is_finite(&self) -> bool {
        let numbers = [Some(self.cpu_seconds), Some(self.psnr), self.wall_seconds, self.ssim, self.lpips];
        let more = [self.tolerance_db, self.cc_psnr, self.perceptual, self.zone_psnr, self.detections_kept, self.fps];
        let depth = [self.depth_absrel, self.depth_delta1, self.moving_psnr];
        self.judged.iter().all(Judged::is_finite)
            && numbers.iter().chain(&more).chain(&depth).flatten().all(|v| v.is_finite())
            && [self.aerial, self.street].iter().flatten().all(KindFigures::is_finite)
            && self.curve.iter().all(|p| p.cpu_seconds.is_finite() && p.psnr.is_finite())
    }
}

/// Appends a line to a results file; creates the file if it does not exist.
///
/// # Errors
/// A number that is not finite, which JSON cannot hold, or a file that cannot be written.
pub fn append(path: &Path, line: &ResultLine) -> Result<(), SaveError> {
    append_line(path, line, line.is_finite())
}

fn append_line(path: &Path, line: &impl Serialize, is_finite: bool) -> Result<(), SaveError> {
    let refuse = |e: std::io::Error| SaveError::new(path, &e);
    if !is_finite {
        return Err(refuse(std::io::Error::other("the result has a number that is not finite; measure it again")));
    }
    let mut text = serde_json::to_string(line).expect("a result line is plain data");
    text.push('\n');
    let mut file = fs::OpenOptions::new().create(true).append(true).open(path).map_err(refuse)?;
    store::file::append(&mut file, text.as_bytes()).map_err(refuse)
}

/// Whether a line is a [`PartLine`].
fn is_part(line: &str) -> bool {
    #[derive(Deserialize)]
    struct Kind {
        kind: Option<serde::de::IgnoredAny>,
    }
    serde_json::from_str(line).is_ok_and(|Kind { kind }| kind.is_some())
}

/// The runs of a results file, in order. Empty lines and component measurements are skipped.
///
/// # Errors
/// A file that cannot be read, or a line that is not a result.
pub fn read(path: &Path) -> Result<Vec<ResultLine>, BadInput> {
    let name = path.display().to_string();
    let refuse = |e: std::io::Error| BadInput::new(name.clone(), format!("cannot be read: {e}"), "check the path");
    let text = fs::read_to_string(path).map_err(refuse)?;
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !is_part(line));
    let parse = |(i, line): (usize, &str)| -> Result<ResultLine, BadInput> {
        let bad =
            |what: String| BadInput::new(format!("{name}:{}", i + 1), what, "restore the line from version control");
        let line: ResultLine = serde_json::from_str(line).map_err(|e| bad(format!("is not a result line: {e}")))?;
        if line.is_finite() { Ok(line) } else { Err(bad("has a number that is not finite".into())) }
    };
    lines.map(parse).collect()
}

/// The measurements of parts in a results file.
///
/// # Errors
/// As [`read`].
pub fn read_parts(path: &Path) -> Result<Vec<PartLine>, BadInput> {
    let name = path.display().to_string();
    let refuse = |e: std::io::Error| BadInput::new(name.clone(), format!("cannot be read: {e}"), "check the path");
    let text = fs::read_to_string(path).map_err(refuse)?;
    let lines = text.lines().enumerate().filter(|(_, line)| is_part(line));
    let parse = |(i, line): (usize, &str)| {
        serde_json::from_str(line).map_err(|e| {
            let problem = format!("is not a measurement: {e}");
            BadInput::new(format!("{name}:{}", i + 1), problem, "restore the line from version control")
        })
    };
    lines.map(parse).collect()
}

/// All lines of a folder's `*.jsonl` files, files in name order.
///
/// # Errors
/// As [`read`].
pub fn read_folder(folder: &Path) -> Result<Vec<ResultLine>, BadInput> {
    let mut lines = Vec::new();
    for path in files(folder, "jsonl")? {
        lines.extend(read(&path)?);
    }
    Ok(lines)
}

/// The files of a folder with this extension, in name order.
fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>, BadInput> {
    let refuse = |e: std::io::Error| {
        BadInput::new(folder.display().to_string(), format!("cannot be read: {e}"), "name a folder of results")
    };
    let entries = fs::read_dir(folder).map_err(refuse)?.collect::<Result<Vec<_>, _>>().map_err(refuse)?;
    let mut paths: Vec<_> = entries.into_iter().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|e| e == extension));
    paths.sort();
    Ok(paths)
}

/// CPU model and number of cores of this machine, without its host name: `Intel(R) Xeon(R) CPU @ 2.50GHz, 2 cores`.
pub fn machine() -> String {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    let model = model.map_or(std::env::consts::ARCH, |(_, model)| model.trim());
    format!("{model}, {cores} core{}", if cores == 1 { "" } else { "s" })
}

/// Scenes in the order of chart and table: the benchmark scenes first, then others in order of appearance.
fn scenes<'a>(lines: impl Iterator<Item = &'a ResultLine>) -> Vec<&'a str> {
    const KNOWN: [&str; 4] = ["fox", "aerial_caliterra", "street_lund", "building_sceaux"];
    let mut scenes: Vec<&str> = Vec::new();
    for line in lines {
        if !scenes.contains(&line.scene.as_str()) {
            scenes.push(&line.scene);
        }
    }
    scenes.sort_by_key(|s| KNOWN.iter().position(|k| k == s).unwrap_or(KNOWN.len()));
    scenes
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn line(label: &str, scene: &str, curve: &[(f64, f64)]) -> ResultLine {
        let curve: Vec<CurvePoint> =
            curve.iter().map(|&(cpu_seconds, psnr)| CurvePoint { cpu_seconds, psnr, splats: Some(12_010) }).collect();
        let last = *curve.last().unwrap();
        ResultLine {
            label: label.into(),
            scene: scene.into(),
            downscale: 1,
            backend: "cpu-avx2".into(),
            workers: 1,
            cpu_seconds: last.cpu_seconds,
            psnr: last.psnr,
            splats: last.splats,
            curve,
            ..Default::default()
        }
    }

    #[test]
    fn lines_round_trip_through_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs.jsonl");
        let lines = [line("plat tree", "fox", &[(1.0, 20.0)]), line("plat whole", "fox", &[(2.0, 21.5)])];
        lines.iter().for_each(|l| append(&path, l).unwrap());
        assert_eq!(read_folder(folder.path()).unwrap(), lines);
        let part = parts::Ingest {
            commit: "unknown".into(),
            machine: machine(),
            scene: "fox".into(),
            downscale: 1,
            threads: 2,
            photos: 50,
            pixels: 1000,
            wall_seconds: 1.0,
            cpu_seconds: 2.0,
            peak_memory_bytes: None,
            bytes_written: 3000,
            command: "plat bench ingest".into(),
        };
        append_part(&path, &PartLine::Ingest(part.clone())).unwrap();
        assert!(append_part(&path, &PartLine::Ingest(parts::Ingest { cpu_seconds: f64::NAN, ..part })).is_err());
        assert_eq!(read_folder(folder.path()).unwrap(), lines, "component lines are not runs");
        let not_finite = ResultLine { psnr: f64::NAN, ..lines[0].clone() };
        assert!(append(&path, &not_finite).is_err());
        assert_eq!(read(&path).unwrap().len(), 2);
        fs::write(&path, "{\"label\":\n").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("runs.jsonl:1"));
    }

    #[test]
    fn unmeasured_figures_are_null_in_the_file() {
        let text = serde_json::to_string(&line("plat tree", "fox", &[(1.0, 20.0)])).unwrap();
        assert!(text.contains("\"lpips\":null") && text.contains("\"zone_psnr\":null"), "{text}");
    }

    #[test]
    fn time_to_a_quality_is_interpolated() {
        let run = line("plat", "fox", &[(10.0, 20.0), (20.0, 24.0), (30.0, 23.0)]);
        assert_eq!(run.cpu_seconds_to(22.0), Some(15.0));
        assert_eq!(run.cpu_seconds_to(19.0), Some(10.0));
        assert_eq!(run.cpu_seconds_to(24.1), None);
        assert_eq!(run.best_psnr(), 24.0);
    }
}
