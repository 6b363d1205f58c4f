//! A line of `metrics.jsonl`: a report of a training, as `plat train` writes it and the dashboard reads it.

use serde::{Deserialize, Serialize};

/// One report of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReportLine {
    /// The block, as `L/x/y`.
    pub task: String,
    /// Number of the attempt, from 1.
    pub attempt: u32,
    /// Steps done.
    pub step: u64,
    /// Steps of the attempt.
    pub steps: u64,
    /// Since the start of the command, seconds; evaluation is left out.
    pub cpu_seconds: f64,
    /// Likewise.
    pub wall_seconds: f64,
    /// Splats under training.
    pub splats: u64,
    /// Training loss.
    pub loss: Option<f64>,
    /// PSNR of the merged model so far over the held-out views, dB; null if it was not measured.
    pub psnr: Option<f64>,
    /// Splats of that model.
    pub merged_splats: Option<u64>,
    /// Mean of the perception-aligned loss since the last line, over windows with objects; left out if it was not computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aligned_loss: Option<f64>,
    /// CPU milliseconds that it took in a step, mean since the last line.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aligned_cpu_ms: Option<f64>,
}
