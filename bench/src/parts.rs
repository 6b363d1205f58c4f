//! Result lines of component measurements. They have a `kind`; chart and tables skip them.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::file::SaveError;

use crate::{CurvePoint, Judged, ResultLine};

/// A measurement of one component, as one line of JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum PartLine {
    /// Times of the renderer's passes.
    Kernels(Kernels),
    /// Ingest of a capture.
    Ingest(Ingest),
    /// Pruning of a model.
    Prune(Prune),
    /// Levels and seams of a tree.
    Tree(Tree),
    /// Training with a variant of the recipe.
    Ablation(Ablation),
    /// A job on a cluster.
    Scale(Scale),
    /// A known failure, without or with its counter-measure.
    Stability(Stability),
}

/// Median times of the renderer's passes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Kernels {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// Backend and its instruction set or adapter.
    pub backend: String,
    /// Class of the adapter: `discrete`, `integrated`, `virtual`, `software` or `other`; null on the CPU.
    #[serde(default)]
    pub adapter_class: Option<String>,
    /// Threads of the host.
    pub threads: u32,
    /// Number of splats.
    pub splats: u64,
    /// Width of the picture, pixels.
    pub width: u32,
    /// Height of the picture, pixels.
    pub height: u32,
    /// Views that a GPU rendered in one pass; pairs and times are per view. Null for single views.
    #[serde(default)]
    pub views: Option<u32>,
    /// Pairs of splat and tile.
    pub pairs: u64,
    /// Blocks of 4×4 pixels visited by the CPU's rasterizer, summed over splats.
    #[serde(default)]
    pub visits: Option<u64>,
    /// Arithmetic ceiling of one core, measured in the same run: 10⁹ operations per second of fused multiply-adds, each counted as two.
    #[serde(default)]
    pub ceiling_gflops: Option<f64>,
    /// Memory ceiling of one core: 10⁹ bytes per second when adding two long arrays into a third.
    #[serde(default)]
    pub ceiling_gbytes: Option<f64>,
    /// The stages.
    #[serde(default)]
    pub stages: Vec<StageTime>,
    /// How the stages of a GPU were timed: `device` (timestamps) or `wall` (a pass that ends after the stage minus one that
    /// ends before it); null on the CPU.
    #[serde(default)]
    pub clock: Option<String>,
    /// CPU time of the forward pass, milliseconds.
    pub forward_cpu_millis: f64,
    /// CPU time of the backward pass, milliseconds.
    pub backward_cpu_millis: f64,
    /// Wall time of the forward pass, milliseconds.
    pub forward_wall_millis: f64,
    /// Wall time of the backward pass, milliseconds.
    pub backward_wall_millis: f64,
    /// The command that wrote the line.
    pub command: String,
}

/// Time and throughput of a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// Its name.
    pub stage: String,
    /// Median CPU time, milliseconds; null on a GPU.
    pub cpu_millis: Option<f64>,
    /// Median time on the device, milliseconds; null on the CPU.
    #[serde(default)]
    pub device_millis: Option<f64>,
    /// 10⁹ operations per second and core, by the operation count of the stage's inner loop; null for stages that are not bound by
    /// arithmetic.
    pub gflops: Option<f64>,
    /// 10⁹ bytes per second and core that the stage must at least read and write; null for stages that are not bound by memory.
    pub gbytes: Option<f64>,
    /// The throughput as a share of its ceiling.
    pub of_ceiling: Option<f64>,
}

/// Training one block with one variant of the recipe. Clocks leave out ingest and measurements.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Ablation {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// Backend and its instruction set or adapter.
    pub backend: String,
    /// Threads.
    pub threads: u32,
    /// Name of the variant.
    pub variant: String,
    /// The run's seed.
    pub seed: u64,
    /// Steps.
    pub steps: u32,
    /// Planned number of splats.
    pub budget: u32,
    /// Time to each target PSNR.
    pub reached: Vec<Reached>,
    /// Final PSNR over held-out views, dB.
    pub psnr: f64,
    /// Splats at the end.
    pub splats: u64,
    /// User and system time of all threads, seconds.
    pub cpu_seconds: f64,
    /// Wall time, seconds.
    pub wall_seconds: f64,
    /// Held-out PSNR during training; the first point is the initial model.
    pub curve: Vec<CurvePoint>,
    /// The command that wrote the line.
    pub command: String,
}

/// A job on a cluster of processes on one machine, with an empty store.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Backend and its instruction set.
    pub backend: String,
    /// Id of the plan.
    pub plan: String,
    /// `file` or `s3`.
    pub store: String,
    /// Number of workers.
    pub workers: u32,
    /// Threads per worker.
    pub threads: u32,
    /// Number of tasks.
    pub tasks: u64,
    /// Seconds from the acceptance of the job, with all photos in the store, to its end.
    pub job_seconds: f64,
    /// User and system time of all workers, seconds.
    pub cpu_seconds: f64,
    /// Bytes that all workers read from the store.
    pub bytes_read: u64,
    /// Bytes that all workers wrote to the store.
    pub bytes_written: u64,
    /// Bytes read for photo windows.
    pub window_bytes_read: u64,
    /// Part of these bytes for pixels inside the windows; the rest of each tile is outside.
    pub window_bytes_used: u64,
    /// The command that wrote the line.
    pub command: String,
}

/// The time at which a curve first reached a PSNR.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reached {
    /// Target PSNR over held-out views, dB.
    pub psnr: f64,
    /// Interpolated between the curve's points; null if it was never reached.
    pub cpu_seconds: Option<f64>,
}

/// Cost of an ingest into an empty store.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ingest {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// Threads.
    pub threads: u32,
    /// Number of photos.
    pub photos: u64,
    /// Pixels of all photos at full size.
    pub pixels: u64,
    /// Wall time, seconds; includes reading cameras and points.
    pub wall_seconds: f64,
    /// User and system time of all threads, seconds.
    pub cpu_seconds: f64,
    /// Largest resident memory of the process, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Bytes written to the store.
    pub bytes_written: u64,
    /// The command that wrote the line.
    pub command: String,
}

/// A model cut to a share of its splats, or pruned within a tolerance with recovery.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Prune {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// Order of pruning.
    pub order: String,
    /// Share kept; null with a tolerance.
    pub keep: Option<f64>,
    /// Training steps after cuts; null in lines of a share from before it was recorded, which had none.
    #[serde(default)]
    pub recovery_steps: Option<u32>,
    /// Allowed loss on the views that it was pruned by after recovery, dB.
    pub tolerance_db: Option<f64>,
    /// Number of splats before.
    pub splats_before: u64,
    /// Number of splats after.
    pub splats: u64,
    /// PSNR on the views that it was pruned by: before and after, dB.
    pub held_in_psnr: [f64; 2],
    /// PSNR on the held-out views: before and after, dB.
    pub held_out_psnr: [f64; 2],
    /// What detectors find on the held-out views, after.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub judged: Vec<Judged>,
    /// User and system time of all threads, seconds.
    pub cpu_seconds: f64,
    /// The command that wrote the line.
    pub command: String,
}

/// A model trained on a capture with a known failure. Figures are means over the held-out views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stability {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The failure.
    pub case: String,
    /// The capture's name; `generated` if the case made it.
    pub capture: String,
    /// Whether the counter-measure is on.
    pub on: bool,
    /// The counter-measure; null if there is none.
    pub counter: Option<String>,
    /// Seed of the training.
    pub seed: u64,
    /// Options of `plat synth` for the capture, and of `plat train`.
    pub options: [String; 2],
    /// The line that the capture was refused with. Then there are no figures.
    pub refused: Option<String>,
    /// Of all views, dB.
    pub psnr: Option<f64>,
    /// Of the street views, where there are aerial ones too, dB.
    pub street_psnr: Option<f64>,
    /// With an exposure fitted to the left half of each photo, of the right half, dB.
    pub fitted_psnr: Option<f64>,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// Mean error of depths as a share of the true one.
    pub depth_absrel: Option<f64>,
    /// PSNR near the faces between blocks less that elsewhere, dB.
    pub seam_db: Option<f64>,
    /// What detectors find.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub judged: Vec<Judged>,
    /// Number of splats.
    pub splats: u64,
    /// User and system time of all threads in training, seconds.
    pub cpu_seconds: f64,
    /// The command that wrote the line.
    pub command: String,
}

/// Quality of a tree's levels and at the seams between its blocks. Figures are means over the held-out views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tree {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// Splats of the finest cut.
    pub splats: u64,
    /// Levels of the tree, coarsest first.
    pub levels: Vec<TreeLevel>,
    /// Figures at the seams; null if the finest cut is one block.
    pub faces: Option<TreeFaces>,
    /// What viewers draw within budgets of splats. Lines of before have none.
    #[serde(default)]
    pub budgets: Vec<TreeBudget>,
    /// The command that wrote the line.
    pub command: String,
}

/// The cut of a tree at one level, at full resolution and at its viewing distance: where its pixels are as large as the picture's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TreeLevel {
    /// The level.
    pub level: u8,
    /// Splats of the cut.
    pub splats: f64,
    /// PSNR at full resolution, dB.
    pub psnr: Option<f64>,
    /// Viewing distance as a mip of the photos.
    pub away_mip: f64,
    /// PSNR there, dB: of the cut, of the finest cut, and of as many of the finest cut's most important splats.
    pub away_psnr: [Option<f64>; 3],
}

/// What a viewer draws of a tree within a budget.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TreeBudget {
    /// Splats at most.
    pub budget: u32,
    /// Splats drawn.
    pub drawn: f64,
    /// PSNR of what is drawn, of as many of the model's most important splats, and of the whole model, dB.
    pub psnr: [Option<f64>; 3],
}

/// Figures near the faces between the blocks of a finest cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TreeFaces {
    /// Half width of the band at a face, metres.
    pub seam_metres: f64,
    /// Share of pixels in the band.
    pub seam_share: f64,
    /// PSNR in the band and elsewhere in the same views, dB.
    pub psnr: [Option<f64>; 2],
    /// SSIM in the band and elsewhere.
    pub ssim: [Option<f64>; 2],
    /// ꟻLIP in the band and elsewhere.
    pub flip: [Option<f64>; 2],
    /// Step of the mean error across a face, mean over faces, levels of 255.
    pub step: Option<f64>,
    /// PSNR in the same regions of a model of the same capture without faces, dB.
    pub without_psnr: Option<[Option<f64>; 2]>,
}

impl Prune {
    /// The pruned model as a run, by its order.
    pub(crate) fn as_run(&self) -> ResultLine {
        ResultLine {
            label: self.order.clone(),
            commit: self.commit.clone(),
            machine: self.machine.clone(),
            scene: self.scene.clone(),
            downscale: self.downscale,
            // Each number of splats is a configuration of its own.
            budget: u32::try_from(self.splats).ok(),
            tolerance_db: self.tolerance_db,
            psnr: self.held_out_psnr[1],
            splats: Some(self.splats),
            judged: self.judged.clone(),
            cpu_seconds: self.cpu_seconds,
            seed: Some(0),
            command: self.command.clone(),
            ..ResultLine::default()
        }
    }
}

impl PartLine {
    fn is_finite(&self) -> bool {
        match self {
            Self::Kernels(line) => {
                let passes = [line.forward_cpu_millis, line.backward_cpu_millis];
                let walls = [line.forward_wall_millis, line.backward_wall_millis];
                let of_stages = line.stages.iter().flat_map(|stage| {
                    [stage.cpu_millis, stage.device_millis, stage.gflops, stage.gbytes, stage.of_ceiling]
                        .into_iter()
                        .flatten()
                });
                let ceilings = [line.ceiling_gflops, line.ceiling_gbytes].into_iter().flatten();
                passes.into_iter().chain(walls).chain(of_stages).chain(ceilings).all(f64::is_finite)
            }
            Self::Prune(line) => {
                line.judged.iter().all(Judged::is_finite)
                    && (line.held_in_psnr.iter().chain(&line.held_out_psnr))
                        .chain([&line.cpu_seconds])
                        .chain(line.keep.iter().chain(&line.tolerance_db))
                        .all(|value| value.is_finite())
            }
            Self::Tree(line) => {
                let of_levels = line.levels.iter().flat_map(|level| level.away_psnr.into_iter().chain([level.psnr]));
                let of_faces = line.faces.iter().flat_map(|faces| {
                    let without = faces.without_psnr.into_iter().flatten();
                    without.chain(faces.psnr).chain(faces.ssim).chain(faces.flip).chain([faces.step])
                });
                of_levels
                    .chain(of_faces)
                    .chain(line.budgets.iter().flat_map(|of| of.psnr))
                    .flatten()
                    .all(f64::is_finite)
            }
            Self::Stability(line) => {
                let figures =
                    [line.psnr, line.street_psnr, line.fitted_psnr, line.ssim, line.depth_absrel, line.seam_db];
                figures.into_iter().flatten().all(f64::is_finite)
                    && line.cpu_seconds.is_finite()
                    && line.judged.iter().all(Judged::is_finite)
            }
            Self::Scale(line) => line.job_seconds.is_finite() && line.cpu_seconds.is_finite(),
            Self::Ablation(line) => {
                let reached = line.reached.iter().flat_map(|reached| [Some(reached.psnr), reached.cpu_seconds]);
                let curve = line.curve.iter().flat_map(|point| [point.cpu_seconds, point.psnr]);
                let all = [line.psnr, line.cpu_seconds, line.wall_seconds].into_iter().chain(curve);
                all.chain(reached.flatten()).all(f64::is_finite)
            }
            Self::Ingest(line) => line.wall_seconds.is_finite() && line.cpu_seconds.is_finite(),
        }
    }
}

/// Appends a measurement to a results file; creates the file if it does not exist.
///
/// # Errors
/// As [`crate::append`].
pub fn append_part(path: &Path, line: &PartLine) -> Result<(), SaveError> {
    crate::append_line(path, line, line.is_finite())
}
