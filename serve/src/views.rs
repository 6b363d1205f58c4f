//! What the browser is told, as JSON: the types of the interface that docs/src/dashboard.md describes.
//!
//! `*_unix_ms` are milliseconds since 1970 in UTC. A figure that is not known or not measured is null.

use std::collections::BTreeMap;

use serde::Serialize;

/// Everything that the pages show at once. Deltas continue it.
#[derive(Debug, Serialize)]
pub(crate) struct Snapshot<'a> {
    pub(crate) seq: u64,
    pub(crate) now_unix_ms: u64,
    pub(crate) server: &'a Server,
    pub(crate) jobs: Vec<Job>,
    pub(crate) workers: Vec<Worker>,
    pub(crate) events: Vec<Event>,
}

/// What changed: whole objects.
#[derive(Debug, Serialize)]
pub(crate) struct Delta {
    pub(crate) now_unix_ms: u64,
    pub(crate) server: Option<Server>,
    pub(crate) jobs: Vec<Job>,
    pub(crate) workers: Vec<Worker>,
    pub(crate) events: Vec<Event>,
    /// By job.
    pub(crate) tasks: BTreeMap<u64, Vec<TaskChange>>,
}

/// The server itself.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Server {
    /// The program's version.
    pub version: &'static str,
    /// What it shows.
    pub kind: Kind,
    /// Whether the browser may control jobs.
    pub controls: bool,
    /// Where photos and results are.
    pub store_url: Option<String>,
    /// The coordinator, if there is one.
    pub coordinator: Option<Coordinator>,
}

/// What a server shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// The job of `plat train`, which runs in the same process.
    Train,
    /// The jobs of a coordinator.
    Coordinator,
    /// A folder that `plat train` wrote.
    Folder,
}

/// The connection to the coordinator.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Coordinator {
    /// Its URL.
    pub url: String,
    /// Whether it answers.
    pub reachable: bool,
    /// Since its last answer.
    pub silent_millis: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum JobState {
    Running,
    Paused,
    Done,
    Incomplete,
    Cancelled,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Phase {
    Detect,
    Train,
    Evaluate,
    Merge,
    Done,
}

/// Number of tasks by state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub(crate) struct Counts {
    pub(crate) waiting: u32,
    pub(crate) ready: u32,
    pub(crate) leased: u32,
    pub(crate) done: u32,
    pub(crate) failed: u32,
    pub(crate) quarantined: u32,
}

#[derive(Debug, Clone, Serialize)]
pub(crate) struct Job {
    pub(crate) id: u64,
    pub(crate) name: String,
    pub(crate) plan: String,
    pub(crate) state: JobState,
    pub(crate) phase: Phase,
    pub(crate) backend: String,
    pub(crate) priority: u32,
    pub(crate) weight: u32,
    pub(crate) blocks: usize,
    pub(crate) evaluations: usize,
    pub(crate) detections: usize,
    pub(crate) objects: usize,
    pub(crate) levels: u8,
    pub(crate) counts: Counts,
    pub(crate) started_unix_ms: Option<u64>,
    pub(crate) ended_unix_ms: Option<u64>,
    pub(crate) steps_done: u64,
    pub(crate) steps_all: u64,
    /// Photos on which objects were looked for, and all of them.
    pub(crate) photos_done: u64,
    pub(crate) photos_all: u64,
    pub(crate) splats: u64,
    pub(crate) cpu_seconds: f64,
    pub(crate) eta_seconds: Option<[f64; 2]>,
    pub(crate) eta_note: String,
    pub(crate) psnr: Option<f64>,
    pub(crate) ssim: Option<f64>,
    pub(crate) perceptual: Option<f64>,
    /// Whether at least one block is finished.
    pub(crate) model: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum WorkerState {
    Busy,
    Idle,
    Lost,
    Left,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Worker {
    pub(crate) name: String,
    pub(crate) backend: String,
    pub(crate) state: WorkerState,
    pub(crate) job: Option<u64>,
    pub(crate) task: Option<u32>,
    pub(crate) attempt: u32,
    pub(crate) heard_unix_ms: u64,
    pub(crate) since_unix_ms: u64,
    pub(crate) idle_reason: String,
    pub(crate) memory_bytes: u64,
    pub(crate) done: u32,
    pub(crate) failed: u32,
    pub(crate) steps_per_second: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Level {
    Info,
    Warn,
    Error,
}

/// A line of a job's log.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Event {
    pub(crate) number: u64,
    pub(crate) unix_ms: u64,
    pub(crate) job: Option<u64>,
    pub(crate) task: Option<u32>,
    pub(crate) attempt: u32,
    pub(crate) worker: String,
    pub(crate) level: Level,
    pub(crate) kind: EventKind,
    pub(crate) what: String,
}

/// What a line says of its attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum EventKind {
    Began,
    Done,
    Failed,
    Lost,
    Revoked,
    #[serde(rename = "")]
    Other,
}

/// A changed task; short keys, as there may be thousands.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct TaskChange {
    #[serde(rename = "t")]
    pub(crate) task: u32,
    #[serde(rename = "s")]
    pub(crate) state: char,
    #[serde(rename = "p")]
    pub(crate) permille: u16,
    #[serde(rename = "n")]
    pub(crate) splats: u64,
    #[serde(rename = "l")]
    pub(crate) loss: Option<f64>,
    #[serde(rename = "v")]
    pub(crate) speed: Option<f64>,
    #[serde(rename = "w")]
    pub(crate) worker: String,
    #[serde(rename = "a")]
    pub(crate) attempt: u32,
    #[serde(rename = "q")]
    pub(crate) psnr: Option<f64>,
}

/// All tasks of a job, as columns by task.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Tasks {
    pub(crate) seq: u64,
    pub(crate) state: String,
    pub(crate) progress: Vec<u16>,
    pub(crate) splats: Vec<u64>,
    pub(crate) loss: Vec<Option<f64>>,
    pub(crate) speed: Vec<Option<f64>>,
    pub(crate) worker: Vec<String>,
    pub(crate) attempt: Vec<u32>,
    pub(crate) psnr: Vec<Option<f64>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum AttemptEnd {
    Running,
    Done,
    Failed,
    /// The lease expired.
    Lost,
    /// Given back, or no longer needed.
    Revoked,
}

#[derive(Debug, Clone, Serialize)]
pub(crate) struct Attempt {
    pub(crate) number: u32,
    pub(crate) worker: String,
    pub(crate) began_unix_ms: u64,
    pub(crate) ended_unix_ms: Option<u64>,
    pub(crate) end: AttemptEnd,
    pub(crate) reason: String,
}

/// Reports of a task's attempts, thinned, as columns.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Curve {
    pub(crate) attempt: Vec<u32>,
    pub(crate) step: Vec<u64>,
    /// Of the attempt.
    pub(crate) steps: Vec<u64>,
    pub(crate) loss: Vec<Option<f64>>,
    pub(crate) splats: Vec<u64>,
    pub(crate) cpu_seconds: Vec<f64>,
    pub(crate) wall_seconds: Vec<f64>,
}

/// Tenth, median and ninetieth percentile over the blocks of a level, at shares of their steps.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Fleet {
    pub(crate) share: Vec<f64>,
    pub(crate) loss: Vec<[f64; 3]>,
    pub(crate) splats: Vec<[f64; 3]>,
}

#[derive(Debug, Serialize)]
pub(crate) struct Task {
    pub(crate) task: u32,
    pub(crate) block: Option<String>,
    pub(crate) kind: &'static str,
    pub(crate) state: char,
    pub(crate) steps: u32,
    pub(crate) budget: u32,
    pub(crate) rho_metres: f64,
    pub(crate) memory_bytes: u64,
    pub(crate) parent: Option<u32>,
    pub(crate) neighbours: Vec<u32>,
    pub(crate) attempts: Vec<Attempt>,
    pub(crate) curve: Curve,
    pub(crate) fleet: Fleet,
    pub(crate) psnr: Option<f64>,
}

/// Held-out PSNR of the merged model during training, as columns.
#[derive(Debug, Default, Clone, Serialize)]
pub(crate) struct QualityCurve {
    pub(crate) cpu_seconds: Vec<f64>,
    pub(crate) wall_seconds: Vec<f64>,
    pub(crate) psnr: Vec<f64>,
    pub(crate) splats: Vec<Option<u64>>,
}
