//! Shows a folder that `plat train` wrote: its plan, its curves, its model. The folder is read again when it changes, so it may be one
//! that a training still writes.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bench::ReportLine;
use blocks::Plan;
use dataset::ingest::load_capture;
use eval::ViewFigures;
use model::Manifest;
use proto::watch_event::Event as Update;
use proto::{Outcome, Report, TaskChanged, TaskReported, TaskState};
use scene::BadInput;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use store::Store;
use tokio_util::sync::CancellationToken;

use crate::feed::Feed;
use crate::job::JobRecord;
use crate::project::{Face, Project, Results};
use crate::views::Server;

/// Number of the job that a folder is shown as, the first of several.
pub(crate) const JOB: u64 = 1;
/// Interval at which the folder is looked at.
const PERIOD: Duration = Duration::from_secs(2);
/// Largest JSON file that is read, bytes.
const FILE_BYTES_LIMIT: u64 = 1 << 30;
const FILES: [&str; 5] = ["plan.json", "metrics.jsonl", "report.json", "eval/report.json", "model/model.json"];

/// What is shown of `report.json`.
#[derive(Deserialize)]
struct Figures {
    cpu_seconds: Option<f64>,
    splats: Option<u64>,
    psnr: Option<f64>,
    ssim: Option<f64>,
    perceptual: Option<f64>,
    #[serde(default)]
    views: Vec<ViewFigures>,
    seams: Option<Seams>,
}

/// What `plat eval --seams` says.
#[derive(Deserialize)]
struct Seams {
    faces: Vec<Face>,
}

/// Shows the folder until `stop`, and what is in it at once.
///
/// # Errors
/// A folder without a plan.
pub(crate) fn show(feed: Arc<Feed>, job: u64, folder: PathBuf, stop: CancellationToken) -> Result<(), BadInput> {
    let mut seen = changes(&folder);
    load(&feed, job, &folder)?;
    tokio::spawn(async move {
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                () = tokio::time::sleep(PERIOD) => {}
            }
            let (feed, folder, before) = (feed.clone(), folder.clone(), seen.clone());
            let looked = tokio::task::spawn_blocking(move || {
                let now = changes(&folder);
                if now != before
                    && let Err(error) = load(&feed, job, &folder)
                {
                    tracing::warn!("{error}");
                }
                now
            });
            seen = looked.await.unwrap_or_default();
        }
    });
    Ok(())
}

/// Shows what a training left that was followed until now, in place of its job.
///
/// # Errors
/// A folder without a plan, if the job was never followed.
pub(crate) fn finish(feed: &Feed, folder: &Path) -> Result<(), BadInput> {
    let server = feed.board().server.clone();
    let mut board = feed.board();
    board.set_server(Server { controls: false, coordinator: None, ..server });
    let Some(job) = board.remeasured(JOB) else {
        drop(board);
        return load(feed, JOB, folder);
    };
    job.outcome.get_or_insert(Outcome::Done);
    job.ended_unix_ms.get_or_insert(feed.now());
    job.merging = false;
    set_figures(job, folder);
    board.coordinator_ended(feed.now());
    Ok(())
}

/// Takes the figures of the reports over, where there are any.
fn set_figures(job: &mut JobRecord, folder: &Path) {
    if let Ok(report) = json::<Figures>(folder, "report.json") {
        (job.cpu_seconds, job.psnr) = (report.cpu_seconds, report.psnr.or(job.psnr));
        job.merged_splats = report.splats;
    }
    if let Ok(evaluated) = json::<Figures>(folder, "eval/report.json") {
        (job.psnr, job.ssim, job.perceptual) = (evaluated.psnr, evaluated.ssim, evaluated.perceptual);
        job.project.add_figures(evaluated.views);
        job.project.set_faces(evaluated.seams.map_or(Vec::new(), |seams| seams.faces));
    }
}

/// When the files changed last.
fn changes(folder: &Path) -> Vec<Option<SystemTime>> {
    FILES.iter().map(|file| fs::metadata(folder.join(file)).and_then(|about| about.modified()).ok()).collect()
}

/// Reads everything, and replaces the job.
fn load(feed: &Feed, number: u64, folder: &Path) -> Result<(), BadInput> {
    let bad = |file: &str, problem: String| {
        BadInput::new(folder.join(file).display().to_string(), problem, "give a folder that plat train wrote")
    };
    let plan = read(folder, "model/plan.plat").ok().and_then(|bytes| Plan::from_frame(&bytes).ok());
    let plan = match plan {
        Some(plan) => plan,
        None => json::<Plan>(folder, "plan.json").map_err(|problem| bad("plan.json", problem))?,
    };
    let store = folder.join("store");
    let store = store.is_dir().then(|| Store::open(&store.display().to_string()).ok()).flatten();
    let store = store.map(|store| store.blocking());
    let capture = store.as_ref().and_then(|store| load_capture(store, plan.capture).ok());
    let name = folder.file_name().map_or("model".into(), |name| name.to_string_lossy().into_owned());
    let results = Results::Folder(folder.join("model/blocks"));
    let project = Arc::new(Project::new(name, plan, results, capture.map(|capture| (capture, store))));

    let lines = read(folder, "metrics.jsonl").unwrap_or_default();
    let manifest: Option<Manifest> = json(folder, "model/model.json").ok();
    let ended = |file: &str| unix_ms(fs::metadata(folder.join(file)).ok()?.modified().ok()?);
    let (now, ended_unix_ms) = (feed.now(), ended("model/model.json"));

    let mut board = feed.board();
    board.add(number, project.clone());
    for line in lines.split(|byte| *byte == b'\n') {
        let Ok(line) = serde_json::from_slice::<ReportLine>(line) else { continue };
        let Some(task) = line.task.parse().ok().and_then(|block| project.task_of(block)) else { continue };
        let leased = TaskState::Leased.into();
        let changed =
            TaskChanged { task, state: leased, attempt: line.attempt, worker: "local".into(), ..Default::default() };
        let ReportLine { step, steps, cpu_seconds, wall_seconds, splats, loss, psnr, merged_splats, attempt, .. } =
            line;
        let report =
            Report { step, steps, loss, splats, cpu_seconds, wall_seconds, psnr, merged_splats, ..Report::default() };
        board.update(now, number, &Update::Changed(changed));
        board.update(now, number, &Update::Reported(TaskReported { task, attempt, report: Some(report) }));
    }
    let Some(job) = board.job_mut(number) else { return Ok(()) };
    for (task, entry) in manifest
        .iter()
        .flat_map(|manifest| &manifest.blocks)
        .filter_map(|entry| Some((project.task_of(entry.block)?, entry)))
    {
        job.set_done(task as usize, entry.artefact.0.to_vec(), Some(entry.splats));
    }
    if manifest.is_some() {
        for task in project.blocks()..project.plan.len() {
            job.set_done(task, Vec::new(), None);
        }
        (job.outcome, job.ended_unix_ms, job.started_unix_ms) = (Some(Outcome::Done), ended_unix_ms, None);
        job.set_attempts_unknown();
    }
    set_figures(job, folder);
    Ok(())
}

fn unix_ms(time: SystemTime) -> Option<u64> {
    time.duration_since(SystemTime::UNIX_EPOCH).ok().map(|since| since.as_millis() as u64)
}

fn read(folder: &Path, file: &str) -> Result<Vec<u8>, String> {
    let path = folder.join(file);
    let bytes = fs::metadata(&path).map_err(|error| format!("cannot be read ({error})"))?.len();
    if bytes > FILE_BYTES_LIMIT {
        return Err(format!("has {bytes} bytes, which is too large"));
    }
    fs::read(&path).map_err(|error| format!("cannot be read ({error})"))
}

fn json<T: DeserializeOwned>(folder: &Path, file: &str) -> Result<T, String> {
    serde_json::from_slice(&read(folder, file)?).map_err(|error| error.to_string())
}
