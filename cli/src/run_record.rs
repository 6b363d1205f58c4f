//! The figures of a run: the base of `report.json`, of the object of `--json`, and of bench's result lines.

use bench::{CurvePoint, ResultLine};
use eval::{ViewFigures, mean};
use serde::Serialize;

/// The figures of a run under the names of DESIGN section 8; those that were not measured are null.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct Record {
    pub(crate) command: &'static str,
    pub(crate) commit: &'static str,
    pub(crate) machine: String,
    /// The capture's name.
    pub(crate) scene: String,
    pub(crate) downscale: u32,
    pub(crate) config_hash: Option<String>,
    /// Planned optimiser steps.
    pub(crate) steps: Option<u32>,
    pub(crate) budget: Option<u32>,
    pub(crate) tolerance_db: Option<f64>,
    pub(crate) backend: String,
    pub(crate) workers: u32,
    pub(crate) threads: u32,
    /// Of ingest, training and merging; evaluation is left out.
    pub(crate) wall_seconds: Option<f64>,
    pub(crate) cpu_seconds: Option<f64>,
    /// As estimated before training; `report.json` has the whole estimate.
    #[serde(skip)]
    pub(crate) predicted_cpu_seconds: Option<f64>,
    /// dB over the held-out views.
    pub(crate) psnr: Option<f64>,
    /// dB over the held-out views, after the affine colour correction of each.
    pub(crate) cc_psnr: Option<f64>,
    pub(crate) ssim: Option<f64>,
    pub(crate) lpips: Option<f64>,
    /// SSIMULACRA2.
    pub(crate) perceptual: Option<f64>,
    pub(crate) zone_psnr: Option<f64>,
    pub(crate) detections_kept: Option<f64>,
    pub(crate) splats: u64,
    /// Size of the merged PLY.
    pub(crate) bytes: Option<u64>,
    pub(crate) peak_memory_bytes: Option<u64>,
    pub(crate) bytes_moved: Option<u64>,
    /// Rendered frames per second.
    pub(crate) fps: Option<f64>,
    pub(crate) seed: Option<u64>,
}

impl Record {
    /// A record of this program on this machine.
    pub(crate) fn new(command: &'static str) -> Self {
        Self { command, commit: commit(), machine: bench::machine(), ..Self::default() }
    }

    /// Sets the quality figures to the means over these views.
    pub(crate) fn set_figures(&mut self, views: &[ViewFigures]) {
        let of = |figure: fn(&ViewFigures) -> Option<f64>| mean(views.iter().map(figure));
        (self.psnr, self.cc_psnr) = (of(|view| view.psnr), of(|view| view.cc_psnr));
        (self.ssim, self.perceptual) = (of(|view| Some(view.ssim)), of(|view| view.perceptual));
        self.lpips = of(|view| view.lpips);
    }

    /// Copies the quality figures from an evaluation of the model.
    pub(crate) fn set_quality(&mut self, by: &Self) {
        (self.psnr, self.ssim, self.perceptual) = (by.psnr, by.ssim, by.perceptual);
        (self.lpips, self.fps, self.cc_psnr) = (by.lpips, by.fps, by.cc_psnr);
        (self.detections_kept, self.zone_psnr) = (by.detections_kept, by.zone_psnr);
    }

    /// A line of bench/results; `invoked` is the command line.
    pub(crate) fn line(&self, label: &str, invoked: String, curve: Vec<CurvePoint>) -> ResultLine {
        ResultLine {
            label: label.to_owned(),
            commit: self.commit.to_owned(),
            machine: self.machine.clone(),
            scene: self.scene.clone(),
            downscale: self.downscale,
            config_hash: self.config_hash.clone(),
            steps: self.steps,
            budget: self.budget,
            tolerance_db: self.tolerance_db,
            backend: self.backend.clone(),
            workers: self.workers,
            wall_seconds: self.wall_seconds,
            cpu_seconds: self.cpu_seconds.unwrap_or(f64::NAN),
            predicted_cpu_seconds: self.predicted_cpu_seconds,
            psnr: self.psnr.unwrap_or(f64::NAN),
            cc_psnr: self.cc_psnr,
            ssim: self.ssim,
            lpips: self.lpips,
            perceptual: self.perceptual,
            zone_psnr: self.zone_psnr,
            detections_kept: self.detections_kept,
            judged: Vec::new(),
            depth_absrel: None,
            depth_delta1: None,
            moving_psnr: None,
            aerial: None,
            street: None,
            splats: Some(self.splats),
            bytes: self.bytes,
            peak_memory_bytes: self.peak_memory_bytes,
            bytes_moved: self.bytes_moved,
            fps: self.fps,
            seed: self.seed,
            command: invoked,
            curve,
            source: None,
        }
    }
}

/// The commit that the program was built from, with `-dirty` if files differed; `unknown` outside a git checkout.
pub(crate) fn commit() -> &'static str {
    option_env!("PLAT_COMMIT").unwrap_or("unknown")
}

/// The command line, with the program by its plain name.
pub(crate) fn invocation() -> String {
    std::iter::once("plat".to_owned()).chain(std::env::args().skip(1)).collect::<Vec<_>>().join(" ")
}
