//! What was measured of one part of plat: lines beside those of the runs, told from them by their `kind`, that chart
//! and table leave out.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::file::SaveError;

use crate::CurvePoint;

/// A measurement of a part, as one line of JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum PartLine {
    /// The renderer's passes.
    Kernels(Kernels),
    /// Photos to artefacts.
    Ingest(Ingest),
    /// A model with fewer splats.
    Prune(Prune),
    /// A tree's levels, and its faces between blocks.
    Tree(Tree),
    /// Training in another way.
    Ablation(Ablation),
    /// A job on a cluster.
    Scale(Scale),
}

/// How long the renderer's passes take: medians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Kernels {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// Backend and its instruction set or adapter.
    pub backend: String,
    /// What sort of adapter it is: `discrete`, `integrated`, `virtual`, `software` or `other`; null on the CPU.
    #[serde(default)]
    pub adapter_class: Option<String>,
    /// Threads of the host.
    pub threads: u32,
    /// Splats drawn.
    pub splats: u64,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Views that a GPU drew side by side; pairs and times are a share of theirs, of one view. Null where one was drawn alone.
    #[serde(default)]
    pub views: Option<u32>,
    /// Pairs of splat and tile.
    pub pairs: u64,
    /// Blocks of 4×4 pixels that the CPU's rasterizer visited, each for one splat.
    #[serde(default)]
    pub visits: Option<u64>,
    /// What one core can do, measured beside: fused multiply-adds, 10⁹ operations a second, a fused one counted as two.
    #[serde(default)]
    pub ceiling_gflops: Option<f64>,
    /// What one core can move between memory and registers: 10⁹ bytes a second of a sum of two long arrays into a third.
    #[serde(default)]
    pub ceiling_gbytes: Option<f64>,
    /// The stages.
    #[serde(default)]
    pub stages: Vec<StageTime>,
    /// What timed the stages of a GPU: `device` (its own clock) or `wall` (a pass up to a stage's end less one up to its
    /// beginning, each submitted and waited for); null on the CPU.
    #[serde(default)]
    pub clock: Option<String>,
    /// CPU time of the process, milliseconds.
    pub forward_cpu_millis: f64,
    /// CPU time of the process, milliseconds.
    pub backward_cpu_millis: f64,
    /// Wall time, milliseconds.
    pub forward_wall_millis: f64,
    /// Wall time, milliseconds.
    pub backward_wall_millis: f64,
    /// The command that made the line.
    pub command: String,
}

/// How long a stage takes, and how much it does in that time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// Its name.
    pub stage: String,
    /// CPU time, milliseconds: median; null on a GPU.
    pub cpu_millis: Option<f64>,
    /// Time on the device, milliseconds: median; null on the CPU.
    #[serde(default)]
    pub device_millis: Option<f64>,
    /// Arithmetic by the count of the stage's inner loop, 10⁹ operations a second and core; null where it is not what the
    /// stage is about.
    pub gflops: Option<f64>,
    /// Bytes that it must read and write at least, 10⁹ a second and core; null likewise.
    pub gbytes: Option<f64>,
    /// The larger of the two over its ceiling.
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
    /// Photos were used at one over this of their size.
    pub downscale: u32,
    /// Backend and its instruction set or adapter.
    pub backend: String,
    /// Threads.
    pub threads: u32,
    /// What was changed.
    pub variant: String,
    /// The run's seed.
    pub seed: u64,
    /// Steps.
    pub steps: u32,
    /// Splats to end with.
    pub budget: u32,
    /// How long it took to reach what.
    pub reached: Vec<Reached>,
    /// Held-out views at the end, dB.
    pub psnr: f64,
    /// Splats at the end.
    pub splats: u64,
    /// User and system time of all threads.
    pub cpu_seconds: f64,
    /// Seconds.
    pub wall_seconds: f64,
    /// Held-out PSNR along the way; the first point is the model that training starts from.
    pub curve: Vec<CurvePoint>,
    /// The command that made the line.
    pub command: String,
}

/// A job on a cluster of processes of one machine, whose store was empty.
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
    /// The plan's name.
    pub plan: String,
    /// `file` or `s3`.
    pub store: String,
    /// Workers.
    pub workers: u32,
    /// Threads of each.
    pub threads: u32,
    /// Tasks.
    pub tasks: u64,
    /// From when the job was accepted, its photos in the store, until it was done.
    pub job_seconds: f64,
    /// User and system time of all workers from their start to their end.
    pub cpu_seconds: f64,
    /// What all workers read from the store.
    pub bytes_read: u64,
    /// What all workers wrote to it.
    pub bytes_written: u64,
    /// What of the reading was for windows of photos.
    pub window_bytes_read: u64,
    /// The part of it that the windows' own pixels take of their tiles.
    pub window_bytes_used: u64,
    /// The command that made the line.
    pub command: String,
}

/// When a curve first reached a PSNR.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reached {
    /// Held-out views, dB.
    pub psnr: f64,
    /// Interpolated between the curve's points; null if it never did.
    pub cpu_seconds: Option<f64>,
}

/// What an ingest into an empty store took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ingest {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Photos were used at one over this of their size.
    pub downscale: u32,
    /// Threads.
    pub threads: u32,
    /// Photos.
    pub photos: u64,
    /// Their pixels at full size.
    pub pixels: u64,
    /// Seconds, the capture's cameras and points included.
    pub wall_seconds: f64,
    /// User and system time of all threads, likewise.
    pub cpu_seconds: f64,
    /// Largest resident memory of the process, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Bytes written to the store.
    pub bytes_written: u64,
    /// The command that made the line.
    pub command: String,
}

/// A model cut to a share of its splats, or pruned and healed within a tolerance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Prune {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Photos were used at one over this of their size.
    pub downscale: u32,
    /// What went first.
    pub order: String,
    /// Share kept, without healing; null where it follows from a tolerance.
    pub keep: Option<f64>,
    /// Loss allowed on the views that it was pruned by, dB, after healing.
    pub tolerance_db: Option<f64>,
    /// Splats before.
    pub splats_before: u64,
    /// Splats now.
    pub splats: u64,
    /// PSNR on the views that it was pruned by: before and now, dB.
    pub held_in_psnr: [f64; 2],
    /// PSNR on the held-out views: before and now, dB.
    pub held_out_psnr: [f64; 2],
    /// User and system time of all threads.
    pub cpu_seconds: f64,
    /// The command that made the line.
    pub command: String,
}

/// What the levels of a tree lose, and what shows of the faces between its blocks. Figures are means over the held-out views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tree {
    /// The program's git commit.
    pub commit: String,
    /// See [`crate::machine`].
    pub machine: String,
    /// The capture's name.
    pub scene: String,
    /// Photos were used at one over this of their size.
    pub downscale: u32,
    /// Splats of the finest model.
    pub splats: u64,
    /// The cuts of the tree, coarsest first.
    pub levels: Vec<TreeLevel>,
    /// The faces; null where the finest model is one block.
    pub faces: Option<TreeFaces>,
    /// The command that made the line.
    pub command: String,
}

/// A cut of a tree at one level, and at its viewing distance: where its pixels are as large as the picture's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TreeLevel {
    /// Its level.
    pub level: u8,
    /// Splats in it.
    pub splats: f64,
    /// PSNR at full size, dB.
    pub psnr: Option<f64>,
    /// The viewing distance, as a mip of the photos.
    pub away_mip: f64,
    /// PSNR there, dB: the cut's, the finest model's, and that of the finest model's most important splats, as many.
    pub away_psnr: [Option<f64>; 3],
}

/// The faces between the blocks of a finest model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TreeFaces {
    /// What counts as near a face, metres.
    pub seam_metres: f64,
    /// Share of pixels near a face.
    pub seam_share: f64,
    /// PSNR near faces and elsewhere in the same views, dB.
    pub psnr: [Option<f64>; 2],
    /// SSIM likewise.
    pub ssim: [Option<f64>; 2],
    /// ꟻLIP likewise.
    pub flip: [Option<f64>; 2],
    /// Step of the mean error across a face, mean over faces, levels of 255.
    pub step: Option<f64>,
    /// PSNR at the same places of a model of the same capture that has no faces there, dB.
    pub without_psnr: Option<[Option<f64>; 2]>,
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
            Self::Prune(line) => (line.held_in_psnr.iter().chain(&line.held_out_psnr))
                .chain([&line.cpu_seconds])
                .chain(line.keep.iter().chain(&line.tolerance_db))
                .all(|value| value.is_finite()),
            Self::Tree(line) => {
                let of_levels = line.levels.iter().flat_map(|level| level.away_psnr.into_iter().chain([level.psnr]));
                let of_faces = line.faces.iter().flat_map(|faces| {
                    let without = faces.without_psnr.into_iter().flatten();
                    without.chain(faces.psnr).chain(faces.ssim).chain(faces.flip).chain([faces.step])
                });
                of_levels.chain(of_faces).flatten().all(f64::is_finite)
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

/// Appends a measurement to a results file, which it makes if need be.
///
/// # Errors
/// As [`crate::append`].
pub fn append_part(path: &Path, line: &PartLine) -> Result<(), SaveError> {
    crate::append_line(path, line, line.is_finite())
}
