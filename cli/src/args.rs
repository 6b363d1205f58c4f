//! The command line, as data. Options without a meaning yet are not accepted.

mod bench;
mod cluster;
#[cfg(test)]
mod reference;
mod sweep;
mod synth;

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use blocks::{Mode, PlanSettings};
use clap::builder::TypedValueParser;
use clap::{Args, Parser, Subcommand, ValueEnum};
use scene::Capture;
use serde::{Serialize, Serializer};
use train::importance::Order;

pub(crate) use bench::{
    AblateArgs, AdaptiveArgs, BenchCommand, BenchDemoArgs, BenchPruneArgs, BenchTreeArgs, ChartArgs, IngestArgs,
    KernelsArgs, ParetoArgs, ScaleArgs,
};
pub(crate) use cluster::{
    Connection, CoordinatorArgs, JobArgs, JobsArgs, LogFormat, LogsArgs, RetryArgs, StatusArgs, SubmitArgs, TaskName,
    Told, WorkerArgs,
};
pub(crate) use sweep::{Named, Sweep};
pub(crate) use synth::SynthArgs;

/// Trains Gaussian-splat models of whole cities from photos with poses.
///
/// Exit codes: 0 done; 1 the work failed; 2 bad usage or bad input, with one line that says what to do.
#[derive(Debug, Parser)]
#[command(name = "plat", version, args_override_self = true, disable_help_subcommand = true)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
    /// Print one JSON object as the last line of stdout, and nothing else there
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// No progress and no notes on stderr
    #[arg(long, global = true)]
    pub(crate) quiet: bool,
    /// TOML file with options of the command, named as the flags are; flags win, unknown keys are refused
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Build, train and look at a small synthetic city: the first thing to type
    Demo(DemoArgs),
    /// Rehearse a capture in a generated city: photos, masks, cameras, points and, if asked for, all the truth behind them
    Synth(SynthArgs),
    /// Say what is in a capture, how it would be divided, and what that would take
    Inspect(InspectArgs),
    /// Divide a capture into blocks, check the plan and draw it
    Plan(PlanArgs),
    /// Train a capture to a merged model
    Train(TrainArgs),
    /// Measure a model against a capture's held-out photos
    Eval(EvalArgs),
    /// Draw a model from the cameras of a capture or of a transforms.json
    Render(RenderArgs),
    /// Leave out the splats that matter least
    Prune(PruneArgs),
    /// Write a model in a format that other programs read
    Export(ExportArgs),
    /// Host the jobs of a cluster, until it is told to stop
    Coordinator(CoordinatorArgs),
    /// Train blocks for a coordinator, until it is told to stop
    Worker(WorkerArgs),
    /// Give a capture to a cluster
    Submit(SubmitArgs),
    /// List a cluster's jobs
    Jobs(JobsArgs),
    /// Say how a job stands
    Status(StatusArgs),
    /// End a job; what is done stays done
    Cancel(JobArgs),
    /// Start no further task of a job; those under way go on
    Pause(JobArgs),
    /// Go on with a job that was paused
    Resume(JobArgs),
    /// Try a task again that failed
    Retry(RetryArgs),
    /// Forget a job that is over, and delete from the store what nothing else needs
    Forget(JobArgs),
    /// Say what happened in a job
    Logs(LogsArgs),
    /// Try out whether a store does what a cluster relies on, and how quick it is
    Doctor(DoctorArgs),
    /// Measure plat itself
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// A value, or `auto`: the program chooses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Auto<T>(pub(crate) Option<T>);

impl<T: FromStr> FromStr for Auto<T> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self(None)),
            text => text.parse().map(|value| Self(Some(value))).map_err(|_| "give a whole number or auto".into()),
        }
    }
}

impl<T: fmt::Display> fmt::Display for Auto<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(value) => value.fmt(f),
            None => f.write_str("auto"),
        }
    }
}

impl<T: Serialize> Serialize for Auto<T> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match &self.0 {
            Some(value) => value.serialize(to),
            None => to.serialize_str("auto"),
        }
    }
}

/// Width and height in pixels, written `640x480`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

/// Longest side of a picture that the program draws.
const SIDE_LIMIT: u32 = 16_384;

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let side = |text: &str| text.parse().ok().filter(|side| (1..=SIDE_LIMIT).contains(side));
        let sides = text.split_once('x').and_then(|(w, h)| Some((side(w)?, side(h)?)));
        let (width, height) = sides.ok_or_else(|| format!("give it as 640x480, sides from 1 to {SIDE_LIMIT}"))?;
        Ok(Self { width, height })
    }
}

/// How the scene is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Blocks {
    /// Level-of-detail tree: blocks start from their parent, against their neighbours
    Tree,
    /// Only the leaves, each for itself from the sparse points
    Flat,
    /// One block
    Whole,
}

/// What computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Backend {
    /// The CPU: GPUs have yet to be measured against it
    Auto,
    /// SIMD and threads
    Cpu,
    /// Vulkan, Metal or DirectX 12; PLAT_GPU_ADAPTER chooses an adapter by a part of its name
    Gpu,
}

/// The usual `--residual`.
pub(crate) const RESIDUAL: f64 = 0.4;

/// Options that decide the plan.
#[derive(Debug, Clone, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct PlanOptions {
    /// How the scene is divided
    #[arg(long, value_enum, default_value = "tree")]
    pub(crate) blocks: Blocks,
    /// Levels below the root; auto chooses from extent, resolution, views and points
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) levels: Auto<u8>,
    /// Optimiser steps, counted in full images of the whole scene: every division costs about the same; auto takes 60 for
    /// each view, from 500
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) steps: Auto<u32>,
    /// Draw N windows, at most 16, before splats move, in steps √N times as long. Steps are counted in windows all the same: this
    /// fills a large GPU where photos are small, and saves a CPU nothing
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = views_per_step())]
    pub(crate) views_per_step: u32,
    /// Splats of the merged model before pruning; auto takes three for each sparse point, from 5,000 to 2,000,000
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) budget: Auto<u32>,
    /// Prune the finest blocks within this loss of PSNR on the views that they are trained on; 0 prunes nothing
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Refine a block only where its parent's splats are off, in the block's own photos, by more than R times what the root is
    /// off by in all (root mean squares), and look at fine pixels and add splats only while that pays; 0 adapts nothing
    #[arg(long, value_name = "R", value_parser = residual, default_value_t = RESIDUAL)]
    pub(crate) residual: f64,
    /// Seed of all random choices
    #[arg(long, value_name = "S", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seed: u64,
    /// Hold out every K-th view by name, starting with the first; 0 holds out none
    #[arg(long, value_name = "K", default_value_t = 8)]
    pub(crate) test_every: u32,
    /// Compensate opacity for the pixel's blur: the model may be drawn at any resolution by viewers that do the same, for
    /// 0.2 to 0.6 dB at its own
    #[arg(long)]
    pub(crate) antialiased: bool,
    /// Train an exposure of each view where the whole scene is trained, and give it to all blocks below. For photos whose
    /// exposure or white balance differs; not with --blocks flat
    #[arg(long)]
    pub(crate) exposure: bool,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
}

impl PlanOptions {
    /// The planner's settings for a capture.
    ///
    /// More splats or steps than its points and views support fit the photos that are trained on and spoil the others:
    /// at a quarter of its size `street_lund` (25 views, 1,540 points) has 16.1 dB held out with 6,000 splats and 1,500 steps,
    /// 15.3 with 20,000 and 3,000.
    pub(crate) fn settings(&self, capture: &Capture) -> PlanSettings {
        let times = |count: usize, each: u32| u32::try_from(count).unwrap_or(u32::MAX).saturating_mul(each);
        let budget = || times(capture.points.len(), 3).clamp(5000, 2_000_000);
        let steps = || times(capture.views.len(), 60).max(500);
        PlanSettings {
            mode: match self.blocks {
                Blocks::Tree => Mode::Tree,
                Blocks::Flat => Mode::Flat,
                Blocks::Whole => Mode::Whole,
            },
            levels: self.levels.0,
            seed: self.seed,
            steps: self.steps.0.unwrap_or_else(steps),
            views_per_step: self.views_per_step,
            budget: self.budget.0.unwrap_or_else(budget),
            tolerance_db: self.tolerance_db,
            residual: self.residual,
            test_every: self.test_every,
            antialiased: self.antialiased,
            exposure: self.exposure,
            ..PlanSettings::default()
        }
    }
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArgs {
    /// Folder for the city and everything made of it
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    pub(crate) out: PathBuf,
    /// A smaller city, trained for under a minute
    #[arg(long)]
    pub(crate) quick: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DoctorArgs {
    /// The store: a folder, file:///path or s3://bucket/prefix (reached as AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION
    /// and AWS_ENDPOINT_URL say)
    #[arg(long, value_name = "URL")]
    pub(crate) store: String,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct InspectArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PlanArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    /// Write the plan as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Draw the plan over cameras and points
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
}

#[derive(Debug, Clone, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct TrainArgs {
    /// Folder of the capture: COLMAP or transforms.json
    #[serde(skip)]
    pub(crate) capture: PathBuf,
    /// Folder for the model and all that is said about it
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub(crate) out: PathBuf,
    /// Store of photos and results: a folder or its file:// URL; by default the folder `store` under --out
    #[arg(long, value_name = "URL")]
    #[serde(skip)]
    pub(crate) store: Option<String>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) plan: PlanOptions,
    /// What computes
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Blocks trained at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) workers: u32,
    /// Threads of each worker; auto shares out the cores
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) threads: Auto<u32>,
    /// Measure held-out PSNR of the merged model so far every N steps of a task; 0 measures only at its end
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) eval_every: u32,
    /// Train all anew, whatever an earlier run of the same plan left in the store
    #[arg(long)]
    #[serde(skip)]
    pub(crate) fresh: bool,
    /// Seconds between two checkpoints of a block, from which the same command goes on after it was stopped or killed
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = seconds)]
    #[serde(skip)]
    pub(crate) checkpoint_every: f64,
    /// Be done within M minutes of wall time: every task takes its share, in fewer steps if need be. What was shortened
    /// so depends on the machine's speed: its bytes are not the same twice
    #[arg(long, value_name = "M", value_parser = minutes)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) minutes: Option<f64>,
}

fn minutes(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|minutes: &f64| *minutes > 0.0 && minutes.is_finite());
    value.ok_or_else(|| "give minutes above 0, such as 30 or 0.5".into())
}

#[derive(Debug, Clone, Default, Args)]
pub(crate) struct EvalArgs {
    /// Folder that `plat train` wrote, a .ply or a .spz
    pub(crate) model: PathBuf,
    /// Folder of the capture
    pub(crate) capture: PathBuf,
    /// Held out is every K-th view; by default as the model was trained, else 8
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) test_every: Option<u32>,
    /// Use photos at one N-th of their size; by default as the model was trained, else 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: Option<u32>,
    /// Folder for the contact sheet and the figures; by default `eval` beside the model
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Store of the photos; by default the model's own where it is there, else a temporary one
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
    /// Also measure LPIPS with this network (ONNX)
    #[arg(long, value_name = "FILE", long_help = LPIPS_HELP)]
    pub(crate) lpips: Option<PathBuf>,
    /// Also measure the tree cut at level L, or at every level, against the finest model
    #[arg(long, value_name = "L|all")]
    pub(crate) level: Option<Level>,
    /// Also measure what a viewer shows with at most N splats: for each view the sharpest cut of the tree
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) budget: Option<u32>,
    /// Also measure near the faces between blocks against elsewhere in the same views, and the jump across each face
    #[arg(long)]
    pub(crate) seams: bool,
    /// As --seams, at the faces of that model: say, of a tree, where MODEL is one block trained on the same capture
    #[arg(long, value_name = "MODEL")]
    pub(crate) seams_of: Option<PathBuf>,
    /// What counts as near a face, and implies --seams; by default 2 metres where the capture says where on Earth it lies,
    /// else 1/32 of the edge of the smallest block; never more than 1/8 of it
    #[arg(long, value_name = "M", value_parser = metres)]
    pub(crate) seam_metres: Option<f64>,
}

fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|metres: &f64| *metres > 0.0 && metres.is_finite());
    value.ok_or_else(|| "give metres above 0, such as 2 or 0.5".into())
}

/// A level of the tree, or `all`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Level {
    All,
    Only(u8),
}

impl FromStr for Level {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            text => text.parse().map(Self::Only).map_err(|_| "give a level from 0, or all".into()),
        }
    }
}

const LPIPS_HELP: &str = "\
Also measure LPIPS with this network, an ONNX file with the weights inside: two inputs (1, 3, height, width) of sRGB
values in -1..1, one output, a number. The Python package lpips exports one (net='alex', as most papers):

    import lpips, torch
    x = torch.zeros(1, 3, 64, 64)
    free = {2: 'height', 3: 'width'}
    torch.onnx.export(lpips.LPIPS(net='alex').eval(), (x, x), 'lpips.onnx', input_names=['a', 'b'],
                      output_names=['distance'], dynamic_axes={'a': free, 'b': free}, dynamo=False)
";

#[derive(Debug, Clone, Args)]
pub(crate) struct RenderArgs {
    /// Folder that `plat train` wrote, a .ply or a .spz
    pub(crate) model: PathBuf,
    /// Cameras to draw from: the folder of a capture, whose photos need not be there, or a transforms.json
    #[arg(long, value_name = "CAPTURE|FILE")]
    pub(crate) cameras: PathBuf,
    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Size of the pictures; by default that of each camera
    #[arg(long, value_name = "WxH")]
    pub(crate) size: Option<Size>,
    /// Also write depth as <view>.depth.npy: float32, metres, 0 = nothing
    #[arg(long)]
    pub(crate) depth: bool,
    /// Compensate opacity for the pixel's blur; by default as the model says
    #[arg(long, overrides_with = "classic")]
    pub(crate) antialiased: bool,
    /// Draw as the original 3DGS rasterizer does; by default as the model says
    #[arg(long, overrides_with = "antialiased")]
    pub(crate) classic: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PruneArgs {
    /// Folder that `plat train` wrote, a .ply or a .spz
    pub(crate) model: PathBuf,
    /// Where the pruned model goes: a folder if the model is one, else a file of the same kind
    #[arg(long, value_name = "MODEL2")]
    pub(crate) out: PathBuf,
    /// Keep this share of the splats, in 0..1
    #[arg(long, value_name = "F", value_parser = share, conflicts_with = "tolerance_db")]
    pub(crate) keep: Option<f64>,
    /// Lose at most so much PSNR on the views that are not held out; 0.1 if --keep is not given either [needs --capture]
    #[arg(long, value_name = "X", value_parser = decibels)]
    pub(crate) tolerance_db: Option<f64>,
    /// Photos to judge and heal by; without them only --keep, by opacity and size
    #[arg(long)]
    pub(crate) capture: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) photos: PruneCapture,
}

/// How a capture is read to prune by.
#[derive(Debug, Clone, Args)]
pub(crate) struct PruneCapture {
    /// Leave out every K-th view; by default as the model was trained, else 8
    #[arg(long, value_name = "K")]
    pub(crate) test_every: Option<u32>,
    /// Use photos at one N-th of their size; by default as the model was trained, else 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: Option<u32>,
    /// Store of the photos; by default the model's own where it is there, else a temporary one
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
}

fn views_per_step() -> impl TypedValueParser<Value = u32> {
    clap::value_parser!(u32).range(1..=i64::from(blocks::MAX_VIEWS_PER_STEP))
}

fn share(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|share: &f64| *share > 0.0 && *share <= 1.0);
    value.ok_or_else(|| "give a share above 0 and at most 1, such as 0.5".into())
}

fn seconds(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|seconds: &f64| *seconds >= 0.0 && seconds.is_finite());
    value.ok_or_else(|| "give seconds from 0, such as 60".into())
}

fn decibels(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|db: &f64| *db >= 0.0 && db.is_finite());
    value.ok_or_else(|| "give decibels from 0, such as 0.1".into())
}

fn residual(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|share: &f64| (0.0..1.0).contains(share));
    value.ok_or_else(|| "give a share from 0 to 1, such as 0.25".into())
}

fn order(text: &str) -> Result<Order, String> {
    let names = || Order::ALL.map(Order::name).join(", ");
    Order::ALL.into_iter().find(|order| order.name() == text).ok_or_else(|| format!("give one of {}", names()))
}

/// A format that other programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// INRIA's PLY, which every viewer and trainer reads
    Ply,
    /// Niantic's SPZ, version 3: a tenth of the size, rounded
    Spz,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ExportArgs {
    /// Folder that `plat train` wrote, a .ply or a .spz
    pub(crate) model: PathBuf,
    /// Format
    #[arg(long, value_enum)]
    pub(crate) to: Format,
    /// File to write
    #[arg(long, value_name = "PATH")]
    pub(crate) out: PathBuf,
}
