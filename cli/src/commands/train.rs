//! `plat train`: capture → ingest → plan → train the blocks → merge. A coordinator and its workers run in this process,
//! over the same wire as anywhere else.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bench::CurvePoint;
use blocks::{Plan, Severity};
use coordinator::{LocalError, run_local};
use dataset::ingest::{IngestOptions, Ingested, ingest};
use dataset::open::Source;
use proto::Access;
use render::gpu::Gpu;
use scene::{ArtefactId, BadInput, Capture};
use serde::Serialize;
use store::file::save;
use store::{BlockingStore, Store};
use tokio_util::sync::CancellationToken;
use worker::cap::Cap;
use worker::estimate::Estimate;
use worker::execute::{BlockTrainer, Shared, TrainerOptions};
use worker::merged::is_measured;

use crate::args::{Backend, TrainArgs};
use crate::clock::{self, Stopwatch};
use crate::commands::plan::plan_of;
use crate::failure::{Failure, cannot};
use crate::model::{self, save_json};
use crate::output::Output;
use crate::record::Record;
use crate::{cameras, config, journal::Journal};

/// Windows of photos that each worker keeps decoded; the planner's estimate of memory counts on it.
pub(crate) const CACHE_BYTES: usize = 128 << 20;

/// What training left, beside the model's folder.
pub(crate) struct Trained {
    pub(crate) capture: Capture,
    pub(crate) report: Report,
    /// Held-out PSNR of the merged model on the way.
    pub(crate) curve: Vec<CurvePoint>,
}

/// `report.json`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Report {
    #[serde(flatten)]
    pub(crate) record: Record,
    pub(crate) plan: ArtefactId,
    pub(crate) capture: ArtefactId,
    pub(crate) tasks: usize,
    pub(crate) levels: u8,
    pub(crate) antialiased: bool,
    pub(crate) ingest_cpu_seconds: f64,
    /// Whether `--minutes` left fewer steps than planned, so that another run may give other bytes.
    pub(crate) capped: bool,
    /// Tasks that an earlier run had finished or begun; their time is not in this report.
    pub(crate) resumed: u32,
    /// Blocks that stayed at their parent's resolution, of those that this run finished.
    pub(crate) settled: u32,
    /// What the plan said before anything ran.
    pub(crate) predicted: Estimate,
}

pub(crate) fn run(args: &TrainArgs, output: &Output) -> Result<(), Failure> {
    let trained = train(args, output)?;
    let Report { record, tasks, .. } = &trained.report;
    let psnr = record.psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB held out"));
    let text = format!(
        "{} splats in {tasks} block{}{psnr}, {:.1} CPU seconds, {:.1} seconds\n{}",
        record.splats,
        if *tasks == 1 { "" } else { "s" },
        record.cpu_seconds.unwrap_or_default(),
        record.wall_seconds.unwrap_or_default(),
        args.out.join("merged.ply").display(),
    );
    output.result(&trained.report, &text)
}

/// Trains and writes everything under `--out`.
pub(crate) fn train(args: &TrainArgs, output: &Output) -> Result<Trained, Failure> {
    let mut clock = Stopwatch::start();
    let source = cameras::open(&args.capture, output)?;
    // What the plan refuses is said before any photo is read.
    let (planned_for, plan) = plan_of(&source.capture, &args.plan)?;
    let backend = backend_of(args)?;
    let plan = Plan { backend: backend.name(), ..plan };
    check_plan(&plan, &planned_for, output)?;
    fs::create_dir_all(&args.out).map_err(cannot("made", &args.out))?;
    let store_url = args.store.clone().unwrap_or_else(|| args.out.join("store").display().to_string());
    let store = Store::open(&store_url)?;
    let threads = threads_of(args);
    let ingested = ingest_photos(&source, &store.blocking(), args.plan.downscale, output)?;
    let ingest_cpu_seconds = clock.cpu_seconds();

    let Ingested { capture, id: capture_id, .. } = ingested;
    let plan = Plan { capture: capture_id, ..plan };
    let (config_text, config_hash) = resolved(args, &plan);
    save(&args.out.join("config.toml"), config_text.as_bytes())?;
    save_json(&args.out.join("plan.json"), &plan)?;
    save(&args.out.join("plan.svg"), blocks::draw(&plan, &capture).as_bytes())?;
    let plan_id = store.blocking().put(plan.to_frame())?;

    if plan.settings.test_every > 0 && !is_measured(&plan) {
        output.note("a model of so many splats is not measured on the way: plat eval measures it at the end");
    }
    let progress = output.progress("training", plan.tasks.iter().map(|task| u64::from(task.steps)).sum());
    let mut journal = Journal::create(&args.out.join("metrics.jsonl"), &plan, args.workers, clock.clone(), &progress)?;
    let cap = args.minutes.map(|minutes| cap_of(minutes, clock.clone(), &plan, args.workers));
    let shared = Arc::new(Shared { cap, ..Shared::default() });
    let metered = store.metered();
    let options = TrainerOptions {
        threads: threads as usize,
        eval_every: args.eval_every,
        cache_bytes: CACHE_BYTES,
        memory_bytes: 0,
        resume: !args.fresh,
        checkpoint_seconds: args.checkpoint_every,
    };
    let trainers =
        (0..args.workers).map(|_| BlockTrainer::new(metered.blocking(), options, shared.clone(), backend.clone()));
    let trainers = trainers.map(|trainer| trainer.map(Arc::new)).collect::<Result<_, _>>().map_err(Failure::Work)?;
    let outcome = train_blocks(trainers, &plan.backend, &store, plan_id, &mut journal, output);
    let spent = journal.close()?;
    drop(progress);
    let results = outcome?;
    let resumed = shared.resumed.load(Ordering::Relaxed);
    if resumed > 0 {
        output
            .note(format!("{resumed} of {} tasks went on from an earlier run (--fresh begins anew)", plan.tasks.len()));
    }
    let capped = shared.cap.as_ref().is_some_and(Cap::shortened);
    if capped {
        output.note("fewer steps than planned were taken to be done in time: another run may give other bytes");
    }

    clock = Stopwatch::start();
    let written = model::write(&args.out, &plan, &results, &store.blocking(), capture.geo_origin, args.plan.downscale)?;
    let record = Record {
        scene: cameras::name_of(&args.capture),
        downscale: args.plan.downscale,
        config_hash: Some(config_hash.to_string()),
        steps: Some(plan.settings.steps),
        budget: Some(plan.settings.budget),
        tolerance_db: Some(plan.settings.tolerance_db),
        backend: plan.backend.clone(),
        workers: args.workers,
        threads,
        wall_seconds: Some(spent.wall_seconds + clock.wall_seconds()),
        cpu_seconds: Some(spent.cpu_seconds + clock.cpu_seconds()),
        // Tasks that end side by side do not see each other's last splats.
        psnr: spent.last_psnr.filter(|_| args.workers == 1 || plan.tasks.len() == 1),
        splats: written.splats,
        bytes: Some(written.bytes),
        peak_memory_bytes: clock::peak_memory_bytes(),
        bytes_moved: Some(metered.traffic().read + metered.traffic().written),
        seed: Some(args.plan.seed),
        ..Record::new("train")
    };
    let report = Report {
        record,
        plan: plan_id,
        capture: capture_id,
        tasks: plan.tasks.len(),
        levels: plan.levels,
        antialiased: plan.settings.antialiased,
        ingest_cpu_seconds,
        capped,
        resumed,
        settled: shared.settled.load(Ordering::Relaxed),
        predicted: Estimate::of(&plan),
    };
    save_json(&args.out.join("report.json"), &report)?;
    Ok(Trained { capture, report, curve: spent.curve })
}

/// What lets the whole job end when its clock shows so many minutes: training has to end before.
fn cap_of(minutes: f64, clock: Stopwatch, plan: &Plan, workers: u32) -> Cap {
    /// Wall seconds of sewing and writing a splat.
    const SECONDS_PER_SPLAT: f64 = 2e-6;
    let seconds = 60.0 * minutes;
    let writing = SECONDS_PER_SPLAT * f64::from(plan.settings.budget);
    Cap::new(clock, seconds - writing.min(0.1 * seconds), workers)
}

/// What computes. The GPU's backend has run on a software adapter only, slower than the CPU's own: it serves who asks for it.
fn backend_of(args: &TrainArgs) -> Result<train::Backend, BadInput> {
    if args.backend == Backend::Gpu && args.plan.exposure {
        return Err(BadInput::new("--exposure", "is not trained on a GPU", "leave it, or give --backend cpu"));
    }
    compute_on(args.backend)
}

/// What was asked to compute.
pub(crate) fn compute_on(backend: Backend) -> Result<train::Backend, BadInput> {
    match backend {
        Backend::Auto | Backend::Cpu => Ok(train::Backend::Cpu),
        Backend::Gpu => open_gpu().map(train::Backend::Gpu),
    }
}

/// The GPU that was asked for.
pub(crate) fn open_gpu() -> Result<Arc<Gpu>, BadInput> {
    Gpu::open().map_err(|error| {
        BadInput::new("--backend", error.to_string(), "give --backend cpu, or name an adapter by PLAT_GPU_ADAPTER")
    })
}

/// What a run is configured to once its plan has chosen, as a file, and the file's hash.
pub(crate) fn resolved(args: &TrainArgs, plan: &Plan) -> (String, ArtefactId) {
    let mut resolved = args.clone();
    resolved.plan.budget.0 = Some(plan.settings.budget);
    resolved.plan.steps.0 = Some(plan.settings.steps);
    resolved.threads.0 = Some(threads_of(args));
    config::resolved(&resolved)
}

/// Threads of each worker.
fn threads_of(args: &TrainArgs) -> u32 {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    args.threads.0.unwrap_or(cores / args.workers).max(1)
}

/// Photos to artefacts, with progress.
pub(crate) fn ingest_photos(
    source: &Source,
    store: &BlockingStore,
    downscale: u32,
    output: &Output,
) -> Result<Ingested, Failure> {
    let _traced = tracing::info_span!("ingest").entered();
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let progress = output.progress("photos", source.photos.len() as u64);
    Ok(ingest(source, store, &IngestOptions { downscale, threads }, &|done, _| progress.at(done as u64, ""))?)
}

/// Says what the linter finds; errors refuse the plan.
pub(crate) fn check_plan(plan: &Plan, capture: &Capture, output: &Output) -> Result<(), Failure> {
    let findings = blocks::lint(plan, capture);
    for warning in findings.iter().filter(|finding| finding.severity == Severity::Warning) {
        output.note(warning);
    }
    let errors: Vec<_> = findings.iter().filter(|finding| finding.severity == Severity::Error).collect();
    let Some(first) = errors.first() else { return Ok(()) };
    let more = if errors.len() > 1 { format!(" (and {} more)", errors.len() - 1) } else { String::new() };
    Err(Failure::Input(format!("the plan cannot run: {first}{more}; plat plan shows all, other --levels may help")))
}

/// Times that a task of a local job is tried with a store that fails: over three seconds.
const LOCAL_TROUBLES: u32 = 3;

/// Runs the plan on workers in this process; Ctrl-C cancels the job.
fn train_blocks(
    trainers: Vec<Arc<BlockTrainer>>,
    backend: &str,
    store: &Store,
    plan: ArtefactId,
    journal: &mut Journal,
    output: &Output,
) -> Result<Vec<ArtefactId>, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.map_err(|error| Failure::Work(format!("cannot start threads: {error}")))?;
    let start_worker = |coordinator_url, number: usize, shutdown| {
        let (worker_id, backend) = (format!("local-{number}"), backend.to_owned());
        let access = Access::default();
        let options = worker::Options { coordinator_url, access, worker_id, backend, memory_bytes: 0 };
        worker::run(options, trainers[number].clone(), shutdown)
    };
    let _traced = tracing::info_span!("job").entered();
    let result = runtime.block_on(async {
        let stop = CancellationToken::new();
        let interrupted = tokio::spawn(interruption(stop.clone(), *output));
        let mut hosting = coordinator::Options::new(store.clone());
        // Whoever sits before it had better hear of a full disk than wait for room: what is done stays done.
        hosting.settings.troubles_limit = LOCAL_TROUBLES;
        let news = |news: &_| journal.note(news);
        let result = run_local(hosting, plan, trainers.len(), start_worker, news, stop).await;
        interrupted.abort();
        result
    });
    result.map_err(|error| match error {
        LocalError::Cancelled => Failure::Work(format!(
            "stopped as asked; photos and finished blocks stay in {}, the same command makes use of the photos",
            store.url()
        )),
        other => other.into(),
    })
}

/// The first Ctrl-C stops the job, the second the program.
async fn interruption(stop: CancellationToken, output: Output) {
    if tokio::signal::ctrl_c().await.is_ok() {
        output.note("stopping; Ctrl-C again to leave at once");
        stop.cancel();
        if tokio::signal::ctrl_c().await.is_ok() {
            std::process::exit(1);
        }
    }
}

/// A folder for `what` that exists.
pub(crate) fn make_folder(path: &Path) -> Result<(), Failure> {
    fs::create_dir_all(path).map_err(cannot("made", path))
}
