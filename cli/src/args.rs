//! The command line as data.

mod bench;
mod cluster;
mod film;
mod garage;
mod model;
mod objects;
mod plan;
#[cfg(test)]
mod reference;
mod sweep;
mod synth;
mod update;
mod values;
mod zones;

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use serde::Serialize;

use cluster::socket_address;
use values::{minutes, seconds};

pub(crate) use bench::{
    AblateArgs, AdaptiveArgs, BenchCommand, BenchDemoArgs, BenchPruneArgs, BenchTreeArgs, ChartArgs, IngestArgs,
    KernelsArgs, ParetoArgs, ScaleArgs, StabilityArgs,
};
pub(crate) use cluster::{
    Connection, CoordinatorArgs, JobArgs, JobsArgs, LogFormat, LogsArgs, RetryArgs, ServeArgs, StatusArgs, SubmitArgs,
    TaskName, TelemetryArgs, WorkerArgs,
};
pub(crate) use film::FilmArgs;
pub(crate) use garage::{GarageAddArgs, GarageCommand, GarageListArgs, GaragePlaceArgs, Stand, VehicleBox};
pub(crate) use model::{EvalArgs, ExportArgs, Format, ImportArgs, PruneArgs, PruneCapture, RenderArgs};
pub(crate) use objects::{ObjectsCommand, PoseArgs, TrackArgs};
pub(crate) use plan::{BLOCK_MEMORY_MIB, Blocks, DepthKind, PlanOptions, RESIDUAL};
pub(crate) use sweep::Named;
pub(crate) use synth::{Rig, SynthArgs};
pub(crate) use update::UpdateArgs;
pub(crate) use values::{Auto, Backend, Size};
pub(crate) use zones::{AlignedOptions, OWN_LABELS, ZoneFinder, ZoneOptions};

/// Trains Gaussian-splat models of whole cities from photos with poses.
///
/// Exit codes: 0 done; 1 the work failed; 2 bad usage or bad input, with one line that says what to do.
#[derive(Debug, Parser)]
#[command(name = "plat", version, args_override_self = true, disable_help_subcommand = true)]
pub(crate) struct Cli {
    /// The command.
    #[command(subcommand)]
    pub(crate) command: Command,
    /// Print one JSON object as the last line of stdout, and nothing else there
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// Print no progress and no notes on stderr
    #[arg(long, global = true)]
    pub(crate) quiet: bool,
    /// TOML file with options of the command; keys are named like the flags. Flags override it, unknown keys are errors
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Build, train and render a small synthetic city: a first try of plat
    Demo(DemoArgs),
    /// Write a synthetic capture of a generated city: photos, masks, cameras, points and, on request, ground truth
    Synth(SynthArgs),
    /// Show what is in a capture, how it would be divided, and what training would cost
    Inspect(InspectArgs),
    /// Divide a capture into blocks, check the plan and draw it
    Plan(PlanArgs),
    /// Train a model of a capture
    Train(TrainArgs),
    /// Measure a model against a capture's held-out photos
    Eval(EvalArgs),
    /// Render a model from the cameras of a capture or of a transforms.json
    Render(RenderArgs),
    /// Remove the least important splats of a model
    Prune(PruneArgs),
    /// Train a place of a finished model on new photos of it; everything else stays as it is
    Update(UpdateArgs),
    /// Write a model in a format that other programs read
    Export(ExportArgs),
    /// Write a model of another program as PLY or SPZ; every command reads such models as they are, too
    Import(ImportArgs),
    /// Show jobs and models in a browser, and serve exported files
    Serve(ServeArgs),
    /// Work on objects that move
    #[command(subcommand)]
    Objects(ObjectsCommand),
    /// Keep vehicles of models, and place them in others
    #[command(subcommand)]
    Garage(GarageCommand),
    /// Run the coordinator of a cluster until it is stopped
    Coordinator(CoordinatorArgs),
    /// Run a worker that trains blocks for a coordinator until it is stopped
    Worker(WorkerArgs),
    /// Submit a capture to a cluster as a job
    Submit(SubmitArgs),
    /// List a cluster's jobs
    Jobs(JobsArgs),
    /// Show the state of a job
    Status(StatusArgs),
    /// Cancel a job; finished tasks are kept
    Cancel(JobArgs),
    /// Start no further tasks of a job; running tasks continue
    Pause(JobArgs),
    /// Resume a paused job
    Resume(JobArgs),
    /// Retry a failed task
    Retry(RetryArgs),
    /// Delete a job that has ended, and the artefacts that no other job needs
    Forget(JobArgs),
    /// Show the log of a job
    Logs(LogsArgs),
    /// Test whether a store has the guarantees that a cluster needs, and how fast it is
    Doctor(DoctorArgs),
    /// Measure plat itself
    #[command(subcommand)]
    Bench(BenchCommand),
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArgs {
    /// Folder for the city, its model and the pictures
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    pub(crate) out: PathBuf,
    /// Build a smaller city, trained in under a minute
    #[arg(long)]
    pub(crate) quick: bool,
    /// Show training and the city in a browser until Ctrl-C, on this port or address of the loopback interface
    #[arg(long, value_name = "ADDR|PORT", value_parser = socket_address)]
    #[arg(num_args = 0..=1, require_equals = true, default_missing_value = "7288")]
    pub(crate) serve: Option<SocketAddr>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct DoctorArgs {
    /// The store: a folder, file:///path or s3://bucket/prefix (configured by AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION
    /// and AWS_ENDPOINT_URL)
    #[arg(long, value_name = "URL")]
    pub(crate) store: String,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct InspectArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    /// Draw where too few photos see the ground from nearby, over cameras and points
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) finder: ZoneFinder,
    /// Folder for pictures of the photos with the objects of --detector or --zones: NAME.png of each, at most 1280 pixels a side, and
    /// objects.png, a sheet of some of them
    #[arg(long, value_name = "DIR", requires = "zone_source")]
    pub(crate) draw: Option<PathBuf>,
    /// Store that keeps the photos and what --detector finds, as that of plat train; by default a temporary one
    #[arg(long, value_name = "URL", requires = "zone_source")]
    pub(crate) store: Option<String>,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PlanArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    /// Write the plan as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Write a drawing of the plan over cameras and points
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
}

#[derive(Debug, Clone, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct TrainArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    #[serde(skip)]
    pub(crate) capture: PathBuf,
    /// Folder for the model and its reports
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
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) zones: ZoneOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) aligned: AlignedOptions,
    /// Backend to train on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Blocks trained at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub(crate) workers: u32,
    /// Threads of each worker; auto divides the cores
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) threads: Auto<u32>,
    /// Measure held-out PSNR of the merged model every N steps of a task; 0 measures only at the end of a task
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) eval_every: u32,
    /// Start over: ignore results and checkpoints of earlier runs of the same plan in the store
    #[arg(long)]
    #[serde(skip)]
    pub(crate) fresh: bool,
    /// Seconds between two checkpoints of a block; the same command resumes from them after it was stopped or killed
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = seconds)]
    #[serde(skip)]
    pub(crate) checkpoint_every: f64,
    /// Finish within M minutes of wall time: every task gets its share of the time, with fewer steps if needed. Such a
    /// result depends on the machine's speed and is not reproducible; not with --objects
    #[arg(long, value_name = "M", value_parser = minutes, conflicts_with = "objects")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) minutes: Option<f64>,
    /// Show training and the model in a browser until Ctrl-C, on this port or address of the loopback interface
    #[arg(long, value_name = "ADDR|PORT", value_parser = socket_address)]
    #[arg(num_args = 0..=1, require_equals = true, default_missing_value = "7288")]
    #[serde(skip)]
    pub(crate) serve: Option<SocketAddr>,
}
