//! Speed against accuracy: the lines of a results folder, other trainers' figures, and this server's own jobs.

use std::path::Path;

use bench::ResultLine;
use serde_json::{Value, json};

use crate::board::Board;

/// Points of a curve that are sent.
const POINTS: usize = 200;

/// All results.
pub(crate) fn results(folder: Option<&Path>, own: Vec<Value>) -> Value {
    let mut all = own;
    if let Some(folder) = folder {
        let lines = bench::read_folder(folder).unwrap_or_default();
        let references = folder.parent().map(|parent| parent.join("reference"));
        let references = references.and_then(|folder| bench::reference::read_references(&folder).ok());
        all.extend(lines.iter().chain(references.iter().flatten()).map(of_line));
    }
    json!({"results": all})
}

fn of_line(line: &ResultLine) -> Value {
    let step = line.curve.len().div_ceil(POINTS).max(1);
    let curve: Vec<_> = line.curve.iter().step_by(step).collect();
    json!({
        "label": line.label, "scene": line.scene, "source": line.source, "commit": line.commit, "machine": line.machine,
        "backend": line.backend, "workers": line.workers, "downscale": line.downscale, "steps": line.steps,
        "budget": line.budget, "splats": line.splats, "cpu_seconds": line.cpu_seconds, "wall_seconds": line.wall_seconds,
        "psnr": line.psnr, "ssim": line.ssim, "lpips": line.lpips, "perceptual": line.perceptual,
        "split": split(&line.scene, line.downscale), "curve": curve, "own": false,
    })
}

/// The bench holds out every eighth view of a capture at the stated size.
fn split(scene: &str, downscale: u32) -> String {
    format!("{scene} at 1/{downscale}, every 8th view held out")
}

/// The jobs that have been measured.
pub(crate) fn own(board: &Board, now: u64) -> Vec<Value> {
    let measured = board.jobs.values().filter(|job| job.psnr.is_some());
    let line = |job: &crate::job::JobRecord| {
        let (view, settings) = (job.view(now), &job.project.plan.settings);
        let curve = |i: usize| json!({"cpu_seconds": job.quality.cpu_seconds[i], "psnr": job.quality.psnr[i], "splats": job.quality.splats[i]});
        let wall =
            view.started_unix_ms.map(|began| (view.ended_unix_ms.unwrap_or(now).saturating_sub(began)) as f64 / 1e3);
        json!({
            "label": format!("{}, job {}", view.name, view.id), "scene": view.name, "source": null,
            "commit": env!("CARGO_PKG_VERSION"), "machine": "", "backend": view.backend, "workers": null, "downscale": 1,
            "steps": settings.steps, "budget": settings.budget, "splats": view.splats, "cpu_seconds": view.cpu_seconds,
            "wall_seconds": wall, "psnr": view.psnr, "ssim": view.ssim, "lpips": null, "perceptual": view.perceptual,
            "split": format!("{}, every {}th view held out", view.name, settings.test_every),
            "curve": (0..job.quality.psnr.len()).map(curve).collect::<Vec<Value>>(), "own": true,
        })
    };
    measured.map(line).collect()
}
