//! The command line of `plat bench`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use render::cpu::Stage;
use train::importance::Order;

use super::{Auto, Backend, DemoArgs, PruneCapture, Size, Sweep, decibels, metres, order, share};
use crate::variants::{self, VARIANTS, Variant};

#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Train every combination of some captures and settings, measure the results, and append a line for each
    Pareto(Box<ParetoArgs>),
    /// Redraw the chart and the tables of README and docs/src/performance.md from all results
    Chart(ChartArgs),
    /// Time the renderer's forward and backward passes
    Kernels(KernelsArgs),
    /// Train one block by variants of the recipe, and append how long each took to reach what
    Ablate(AblateArgs),
    /// Ingest a capture into a store of its own, and append what it took to the results
    Ingest(IngestArgs),
    /// Compare the orders to prune a model by, and append the figures to the results
    Prune(BenchPruneArgs),
    /// Measure a tree level by level and at the faces between its blocks, and append the figures to the results
    Tree(BenchTreeArgs),
    /// Run a job on clusters of several sizes, processes of this machine, in turns, and append what each took to the results
    Scale(ScaleArgs),
    /// Build the demo, and append what it took and how good it is to the results
    Demo(BenchDemoArgs),
    /// Train a city whose one half is a bare plain, as a tree of one depth and as one that follows the need; keep both
    Adaptive(AdaptiveArgs),
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ParetoArgs {
    /// What the chart calls the runs; of several backends, with theirs
    #[arg(long)]
    pub(crate) label: String,
    /// What the chart calls the capture; as NAME=PATH says otherwise
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of the result lines; these go to plat.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// Also measure LPIPS with this network (ONNX), see plat eval --help
    #[arg(long, value_name = "FILE")]
    pub(crate) lpips: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) sweep: Sweep,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct IngestArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    /// Compensate opacity for the pixel's blur: the model may be drawn at any resolution by viewers that do the same, for
    /// 0.2 to 0.6 dB at its own
    #[arg(long)]
    pub(crate) antialiased: bool,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
    /// What the line calls the capture; by default the name of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of the result lines; this one goes to ingest.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct BenchPruneArgs {
    /// Folder that `plat train` wrote, a .ply or a .spz
    pub(crate) model: PathBuf,
    /// Folder of the capture
    pub(crate) capture: PathBuf,
    /// What the lines call the capture; by default the name of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Orders to compare; all by default
    #[arg(long, value_name = "ORDER", value_parser = order, value_delimiter = ',')]
    pub(crate) order: Vec<Order>,
    /// Loss of PSNR allowed
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Rounds of cut and healing at most; by default as plat prune
    #[arg(long, value_name = "N")]
    pub(crate) rounds: Option<u32>,
    /// Steps of healing in a round, as a share of the model's; by default as plat prune. Rounds of under 80 steps become fewer and longer
    #[arg(long, value_name = "F", value_parser = healing)]
    pub(crate) healing: Option<f32>,
    /// How far below the floor the first cut goes, dB; by default as plat prune
    #[arg(long, value_name = "X", value_parser = decibels)]
    pub(crate) drop_db: Option<f64>,
    /// Folder of the result lines; these go to prune.jsonl there
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
    /// Also measure this model at the tree's faces: one block trained on the same capture
    #[arg(long, value_name = "MODEL")]
    pub(crate) whole: Option<PathBuf>,
    /// What the line calls the capture; by default the name of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// As of plat eval
    #[arg(long, value_name = "M", value_parser = metres)]
    pub(crate) seam_metres: Option<f64>,
    /// Folder of the result lines; this one goes to tree.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct BenchDemoArgs {
    /// What the chart calls the run
    #[arg(long, default_value = "plat tree")]
    pub(crate) label: String,
    /// Folder of the result lines; this one goes to plat.jsonl there
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
    /// Seed of all random choices of the training
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
    /// As of `plat train`, for both
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) threads: u32,
    /// Folder of the result lines; these go to plat.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ScaleArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    /// Numbers of workers, each of one thread
    #[arg(long, value_name = "N,N", value_delimiter = ',', default_value = "1,2", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub(crate) workers: Vec<u32>,
    /// How often each
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(crate) rounds: u32,
    /// Also on this store, s3://bucket/prefix, beside one in a folder
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
    /// What the lines call the capture; by default the name of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of the result lines; these go to scale.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// After --: what plat submit is to be told of the plan
    #[arg(last = true, value_name = "OPTION")]
    pub(crate) plan: Vec<String>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ChartArgs {
    /// Folder of the result lines; chart.svg goes there too
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
    /// Folder of what other trainers reached; by default bench/reference where it is
    #[arg(long, value_name = "DIR")]
    pub(crate) reference: Option<PathBuf>,
    /// File whose table between the markers is replaced by the best run of each scene; the table of all runs goes to
    /// docs/src/performance.md beside it, where that exists
    #[arg(long, value_name = "FILE", default_value = "README.md")]
    pub(crate) readme: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct AblateArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
    /// Optimiser steps; auto as plat train
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) steps: Auto<u32>,
    /// Splats to end with; auto as plat train
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) budget: Auto<u32>,
    /// Hold out every K-th view by name, starting with the first
    #[arg(long, value_name = "K", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) test_every: u32,
    /// Seeds; every variant is trained with each
    #[arg(long, value_name = "S", value_delimiter = ',', default_value = "0,1,2", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seeds: Vec<u64>,
    /// PSNR to reach, dB
    #[arg(long, value_name = "DB", value_delimiter = ',', value_parser = decibels)]
    pub(crate) to: Vec<f64>,
    /// Share to reach of what the variant default gains from its first splats to its end; 0.9 where no --to is given
    #[arg(long, value_name = "F", value_parser = share)]
    pub(crate) to_gain: Option<f64>,
    /// Variants of the recipe; all by default
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = variants::named, default_values = VARIANTS.map(|v| v.name))]
    pub(crate) variants: Vec<Variant>,
    /// Measurements on the way, evenly spaced over the steps; clocks stand still meanwhile
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(crate) looks: u32,
    /// What computes
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// What the lines call the capture; by default the name of its folder
    #[arg(long)]
    pub(crate) scene: Option<String>,
    /// Folder of the result lines; these go to ablation.jsonl there
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct KernelsArgs {
    /// What draws
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Compare the GPU's stages with the CPU's instead, from this one on, and name the first that differs
    #[arg(long, value_name = "STAGE", value_parser = stage, conflicts_with_all = ["backend", "results", "passes"])]
    pub(crate) from_stage: Option<Stage>,
    /// Draw this model instead of random splats (needs --cameras)
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
    /// Views that a GPU draws side by side; times are then of one of them
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = super::views_per_step(), conflicts_with = "from_stage")]
    pub(crate) views: u32,
    /// Threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) threads: u32,
    /// Append to kernels.jsonl in this folder of result lines; the line is kept out of chart and table
    #[arg(long, value_name = "DIR")]
    pub(crate) results: Option<PathBuf>,
    /// Passes to take the median of
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) passes: u32,
}
