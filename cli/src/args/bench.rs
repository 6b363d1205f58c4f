//! The command line of `plat bench`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use render::cpu::Stage;
use train::importance::Order;

use super::DemoArgs;
use super::model::PruneCapture;
use super::sweep::{Named, Sweep};
use super::values::{Auto, Backend, Size, decibels, metres, order, share, views_per_step};
use crate::ablation_variants::{self, VARIANTS, Variant};
use crate::stability_cases::{self, CASES, Case};

#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Train every combination of captures and settings, measure the models, and append a result line for each
    Pareto(Box<ParetoArgs>),
    /// Redraw the chart and the tables of README and docs/src/performance.md from all result lines
    Chart(ChartArgs),
    /// Time the renderer's forward and backward passes
    Kernels(KernelsArgs),
    /// Train one block with variants of the recipe, and append the time that each took to reach target PSNRs
    Ablate(AblateArgs),
    /// Ingest a capture into an empty store, and append time, memory and bytes
    Ingest(IngestArgs),
    /// Compare the orders in which a model can be pruned, and append the figures
    Prune(BenchPruneArgs),
    /// Measure a tree at every level and at the seams between its blocks, and append the figures
    Tree(BenchTreeArgs),
    /// Run a job on clusters of several sizes, made of processes on this machine, and append the times
    Scale(ScaleArgs),
    /// Train on captures with known failures, without and with the counter-measure, and append the figures
    Stability(StabilityArgs),
    /// Build the demo, and append its time and quality
    Demo(BenchDemoArgs),
    /// Train a city of which one half is a bare plain, as a tree of fixed depth and as an adaptive tree, and append both
    Adaptive(AdaptiveArgs),
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ParetoArgs {
    /// Label of the runs in the chart; with several backends, the backend is added
    #[arg(long)]
    pub(crate) label: String,
    /// Name of the capture in the chart; NAME=PATH does the same
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of result lines; these are appended to plat.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// Also measure LPIPS with this network (ONNX), see plat eval --help
    #[arg(long, value_name = "FILE")]
    pub(crate) lpips: Option<PathBuf>,
    /// Also measure the error of the rendered depth, see plat eval --help
    #[arg(long)]
    pub(crate) depth: bool,
    /// Also measure how far what this detector (ONNX) finds on renders is what it finds on photos, see plat eval --help. Repeatable
    #[arg(long, value_name = "FILE")]
    pub(crate) detector: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) sweep: Sweep,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct IngestArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
    /// Name of the capture in the line; by default that of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of result lines; this one is appended to ingest.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct StabilityArgs {
    /// Cases to run; all by default
    #[arg(long = "case", value_name = "CASE,...", value_parser = stability_cases::named, value_delimiter = ',', default_values_t = CASES)]
    pub(crate) cases: Vec<Case>,
    /// Captures to use beside generated ones, each with the case that it is for
    #[arg(value_name = "CASE=PATH", value_parser = |text: &str| Ok::<_, String>(Named::from(PathBuf::from(text))))]
    pub(crate) captures: Vec<Named>,
    /// Folder for captures and models; captures that are there are used again
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Options of plat synth in all cases; those of a case replace them
    #[arg(
        long,
        value_name = "OPTIONS",
        allow_hyphen_values = true,
        default_value = "--area-km2 0.03 --views 112 --size 320x180 --aerial 0.2 --spacing 4 --traffic light"
    )]
    pub(crate) synth: String,
    /// Options of plat train in all cases; those of a case replace them
    #[arg(
        long,
        value_name = "OPTIONS",
        allow_hyphen_values = true,
        default_value = "--steps 2000 --budget 20000 --levels 1 --threads 1"
    )]
    pub(crate) train: String,
    /// Options of plat train for captures that are given, instead of --train; those of a case replace them
    #[arg(
        long,
        value_name = "OPTIONS",
        allow_hyphen_values = true,
        default_value = "--steps 1500 --budget 8000 --blocks whole --downscale 4 --threads 1"
    )]
    pub(crate) train_given: String,
    /// Seeds of the trainings
    #[arg(long = "seed", value_name = "S,...", value_delimiter = ',', default_value = "0,1,2")]
    pub(crate) seeds: Vec<u64>,
    /// Also measure how far what this detector (ONNX) finds on renders is what it finds on photos, see plat eval --help. Repeatable
    #[arg(long, value_name = "FILE")]
    pub(crate) detector: Vec<PathBuf>,
    /// Folder for a picture of each case: photos, renders without and with the counter-measure
    #[arg(long, value_name = "DIR")]
    pub(crate) pictures: Option<PathBuf>,
    /// File whose table between the markers is replaced by that of the cases
    #[arg(long, value_name = "FILE")]
    pub(crate) document: Option<PathBuf>,
    /// Folder of result lines; these are appended to stability.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct BenchPruneArgs {
    /// Folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles
    pub(crate) model: PathBuf,
    /// Folder of the capture
    pub(crate) capture: PathBuf,
    /// Name of the capture in the lines; by default that of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Orders to compare; all by default. With --detector or --zones also the order of plat prune with them
    #[arg(long, value_name = "ORDER", value_parser = order, value_delimiter = ',')]
    pub(crate) order: Vec<Order>,
    /// Shares of the splats to prune to, as plat prune --keep does
    #[arg(long, value_name = "F,...", value_parser = share, value_delimiter = ',', default_value = "0.5,0.25,0.1")]
    pub(crate) keep: Vec<f64>,
    /// Also measure how far what this detector (ONNX) finds on renders of held-out views is what it finds on their photos, see plat
    /// eval --help. Repeatable
    #[arg(long, value_name = "FILE")]
    pub(crate) judge: Vec<PathBuf>,
    /// Largest loss of PSNR, dB; 0 leaves this out
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Rounds of cutting and recovery at most; by default as plat prune
    #[arg(long, value_name = "N")]
    pub(crate) rounds: Option<u32>,
    /// Recovery steps of a round, as a share of the model's training steps; by default as plat prune. Rounds of under 80 steps become fewer and longer
    #[arg(long, value_name = "F", value_parser = healing)]
    pub(crate) healing: Option<f32>,
    /// How far below the allowed PSNR the first cut may go before recovery, dB; by default as plat prune
    #[arg(long, value_name = "X", value_parser = decibels)]
    pub(crate) drop_db: Option<f64>,
    /// Folder of result lines; these are appended to prune.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    #[command(flatten)]
    pub(crate) photos: PruneCapture,
}

fn stage(text: &str) -> Result<Stage, String> {
    let names = || Stage::ALL.map(Stage::name).join(", ");
    Stage::ALL.into_iter().find(|stage| stage.name() == text).ok_or_else(|| format!("give one of {}", names()))
}

fn healing(text: &str) -> Result<f32, String> {
    share(text).map(|share| share as f32)
}

#[derive(Debug, Clone, Args)]
pub(crate) struct BenchTreeArgs {
    /// Folder that `plat train` wrote
    pub(crate) model: PathBuf,
    /// Folder of the capture
    pub(crate) capture: PathBuf,
    /// Also measure this model at the tree's seams: one trained as one block on the same capture
    #[arg(long, value_name = "MODEL")]
    pub(crate) whole: Option<PathBuf>,
    /// Also measure what viewers draw within these budgets, as --budget of plat eval
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) budget: Vec<u32>,
    /// Name of the capture in the line; by default that of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// As --seam-metres of plat eval
    #[arg(long, value_name = "M", value_parser = metres)]
    pub(crate) seam_metres: Option<f64>,
    /// Folder of result lines; this one is appended to tree.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct BenchDemoArgs {
    /// Label of the run in the chart
    #[arg(long, default_value = "plat tree")]
    pub(crate) label: String,
    /// Folder of result lines; this one is appended to plat.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    #[command(flatten)]
    pub(crate) demo: DemoArgs,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct AdaptiveArgs {
    /// Folder for the city and the models
    #[arg(long, value_name = "DIR", default_value = "out/adaptive")]
    pub(crate) out: PathBuf,
    /// Seed of the training's random choices
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
    /// As --tolerance-db of plat train, for both trees
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) threads: u32,
    /// Folder of result lines; these are appended to plat.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ScaleArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    /// Numbers of workers; each worker has one thread
    #[arg(long, value_name = "N,N", value_delimiter = ',', default_value = "1,2", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub(crate) workers: Vec<u32>,
    /// Number of rounds
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(crate) rounds: u32,
    /// Also run on this store, s3://bucket/prefix, besides one in a folder
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
    /// Name of the capture in the lines; by default that of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of result lines; these are appended to scale.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// After --: plan options that are passed to plat submit
    #[arg(last = true, value_name = "OPTION")]
    pub(crate) plan: Vec<String>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ChartArgs {
    /// Folder of result lines; chart.svg is written there, and prune.svg of the lines that detectors judged
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// Folder of other trainers' figures; by default bench/reference if it exists
    #[arg(long, value_name = "DIR")]
    pub(crate) reference: Option<PathBuf>,
    /// File whose table between the markers is replaced by the best run of each scene; the table of all runs goes to
    /// docs/src/performance.md beside it, if that exists
    #[arg(long, value_name = "FILE", default_value = "README.md")]
    pub(crate) readme: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct AblateArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
    /// Optimiser steps; auto as in plat train
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) steps: Auto<u32>,
    /// Final number of splats; auto as in plat train
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) budget: Auto<u32>,
    /// Hold out every K-th view by name, starting with the first
    #[arg(long, value_name = "K", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) test_every: u32,
    /// Seeds; every variant is trained with each of them
    #[arg(long, value_name = "S", value_delimiter = ',', default_value = "0,1,2", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seeds: Vec<u64>,
    /// Target PSNR, dB
    #[arg(long, value_name = "DB", value_delimiter = ',', value_parser = decibels)]
    pub(crate) to: Vec<f64>,
    /// Target as a share of the PSNR that the variant default gains from its initial splats to its end; 0.9 without --to
    #[arg(long, value_name = "F", value_parser = share)]
    pub(crate) to_gain: Option<f64>,
    /// Variants of the recipe; all by default
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = ablation_variants::named, default_values = VARIANTS.map(|v| v.name))]
    pub(crate) variants: Vec<Variant>,
    /// Measurements during training, evenly spaced over the steps; clocks are paused during them
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(crate) looks: u32,
    /// Backend to train on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Name of the capture in the lines; by default that of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of result lines; these are appended to ablation.jsonl
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct KernelsArgs {
    /// Backend to time
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Instead compare the GPU's stages with the CPU's, from this one on, and report the first that differs
    #[arg(long, value_name = "STAGE", value_parser = stage, conflicts_with_all = ["backend", "results", "passes"])]
    pub(crate) from_stage: Option<Stage>,
    /// Render this model instead of random splats [needs --cameras]
    #[arg(long, value_name = "MODEL", requires = "cameras", conflicts_with = "splats")]
    pub(crate) model: Option<PathBuf>,
    /// Cameras for --model: a capture or a transforms.json
    #[arg(long, value_name = "CAPTURE|FILE", requires = "model")]
    pub(crate) cameras: Option<PathBuf>,
    /// Number of random splats
    #[arg(long, value_name = "N", default_value_t = 12_000, value_parser = clap::value_parser!(u32).range(1..=50_000_000))]
    pub(crate) splats: u32,
    /// Size of the picture
    #[arg(long, value_name = "WxH", default_value = "270x480")]
    pub(crate) size: Size,
    /// Views that a GPU renders in one pass; times are per view
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = views_per_step(), conflicts_with = "from_stage")]
    pub(crate) views: u32,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Append the line to kernels.jsonl in this folder; it does not appear in chart and table
    #[arg(long, value_name = "DIR")]
    pub(crate) results: Option<PathBuf>,
    /// Passes; times are their medians
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) passes: u32,
}
