//! `plat train`: ingests a capture, plans it, trains its blocks, and merges them.
//!
//! A coordinator and its workers run in this process and use the same protocol as a cluster.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use bench::CurvePoint;
use blocks::Plan;
use coordinator::{LocalError, Results, run_local};
use dataset::ingest::Ingested;
use eval::{ByKind, Group};
use model::save_json;
use proto::Access;
use proto::watch_event::Event as Update;
use scene::{ArtefactId, Capture};
use serde::Serialize;
use store::Store;
use store::file::save;
use tokio_util::sync::CancellationToken;
use worker::estimate::Estimate;
use worker::merged_eval::is_evaluated;
use worker::speed::relative_speed;
use worker::time_limit::TimeLimit;
use worker::{PlanExecutor, Shared, TrainerOptions};

use crate::args::TrainArgs;
use crate::captures::ingest_photos;
use crate::clock::Stopwatch;
use crate::dashboard::Dashboard;
use crate::eval_results;
use crate::failure::{Failure, make_folder};
use crate::metrics_log::{MetricsLog, Totals};
use crate::objects::{Objects, note_found};
use crate::output::{Output, beside};
use crate::planning::{check_plan, plan_of};
use crate::run_record::Record;
use crate::{backend, captures, clock, config};

/// Bytes of decoded photo windows that each worker keeps. The planner's memory estimate assumes this value.
pub(crate) const CACHE_BYTES: usize = 128 << 20;

/// Results of training, besides the model's folder.
pub(crate) struct Trained {
    pub(crate) capture: Capture,
    pub(crate) report: Report,
    /// Held-out PSNR of the merged model during training.
    pub(crate) curve: Vec<CurvePoint>,
    /// With `--serve`; it stays until the command's end.
    pub(crate) dashboard: Option<Dashboard>,
}

/// `report.json`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Report {
    #[serde(flatten)]
    pub(crate) record: Record,
    pub(crate) plan: ArtefactId,
    pub(crate) capture: ArtefactId,
    pub(crate) tasks: usize,
    /// Objects that move, with splats of their own.
    pub(crate) objects: usize,
    pub(crate) levels: u8,
    pub(crate) antialiased: bool,
    pub(crate) ingest_cpu_seconds: f64,
    /// Whether `--minutes` left fewer steps than planned, so that another run may give other bytes.
    pub(crate) capped: bool,
    /// Tasks that an earlier run had finished or started; that run's time is not in this report.
    pub(crate) resumed: u32,
    /// Blocks finished by this run that stayed at their parent's resolution.
    pub(crate) settled: u32,
    /// The plan's estimate.
    pub(crate) predicted: Estimate,
    /// With `--evaluate`: of the held-out views, if both kinds are among them.
    #[serde(flatten)]
    pub(crate) by_kind: ByKind,
    /// With `--evaluate` and `--test-stretches`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) stretches: Option<Group>,
}

pub(crate) fn run(args: &TrainArgs, output: &Output) -> Result<(), Failure> {
    let trained = train(args, output)?;
    let Report { record, tasks, objects, .. } = &trained.report;
    let psnr = record.psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB held out"));
    let text = format!(
        "{} splats in {tasks} block{}{}{psnr}, {:.1} CPU seconds, {:.1} seconds\n{}",
        record.splats,
        if *tasks == 1 { "" } else { "s" },
        beside(*objects),
        record.cpu_seconds.unwrap_or_default(),
        record.wall_seconds.unwrap_or_default(),
        args.out.join("merged.ply").display(),
    );
    output.result(&trained.report, &text)?;
    trained.dashboard.map_or(Ok(()), |dashboard| dashboard.stay(output))
}

/// A capture that is ingested and planned.
struct Prepared {
    capture: Capture,
    capture_id: ArtefactId,
    plan: Plan,
    plan_id: ArtefactId,
    config_hash: ArtefactId,
    backend: train::Backend,
    store: Store,
    ingest_cpu_seconds: f64,
}

/// What the job left in its store.
struct Finished {
    /// Of the plan's tasks, or of the training tasks if evaluation failed.
    results: Vec<ArtefactId>,
    /// Why evaluation tasks failed.
    evaluation_failed: Option<Failure>,
    totals: Totals,
    resumed: u32,
    settled: u32,
    capped: bool,
    bytes_moved: u64,
}

/// Trains and writes everything under `--out`.
pub(crate) fn train(args: &TrainArgs, output: &Output) -> Result<Trained, Failure> {
    let name = captures::name_of(&args.capture);
    let dashboard = args.serve.map(|address| Dashboard::open(address, name, &args.out, output)).transpose()?;
    let clock = Stopwatch::start();
    let prepared = prepare(args, &clock, output)?;
    let finished = train_plan(args, &prepared, dashboard.as_ref(), clock, output)?;
    // Between the clocks, as it takes half a CPU second.
    let predicted = Estimate::of(&prepared.plan, relative_speed());

    let clock = Stopwatch::start();
    let Prepared { capture, capture_id, plan, plan_id, config_hash, store, ingest_cpu_seconds, .. } = prepared;
    let (store, downscale) = (store.blocking(), args.plan.downscale);
    if finished.evaluation_failed.is_none() {
        note_found(&plan, &capture, &finished.results, &store, output)?;
    }
    let written = model::write(&args.out, &plan, &finished.results, &store, &capture, downscale)?;
    let totals = finished.totals;
    let mut record = Record {
        scene: captures::name_of(&args.capture),
        downscale,
        config_hash: Some(config_hash.to_string()),
        steps: Some(plan.settings.steps),
        budget: Some(plan.settings.budget),
        tolerance_db: Some(plan.settings.tolerance_db),
        backend: plan.backend.clone(),
        workers: args.workers,
        threads: threads_of(args),
        wall_seconds: Some(totals.wall_seconds + clock.wall_seconds()),
        cpu_seconds: Some(totals.cpu_seconds + clock.cpu_seconds()),
        predicted_cpu_seconds: Some(predicted.cpu_seconds),
        // Concurrent tasks do not see each other's last splats, so the last measurement is not of the final model.
        psnr: totals.last_psnr.filter(|_| args.workers == 1 || plan.tasks.len() == 1),
        splats: written.splats,
        bytes: Some(written.bytes),
        peak_memory_bytes: clock::peak_memory_bytes(),
        bytes_moved: Some(finished.bytes_moved),
        seed: Some(args.plan.seed),
        ..Record::new("train")
    };
    let failed = finished.evaluation_failed;
    let (mut by_kind, mut stretches) = (ByKind::default(), None);
    if failed.is_none()
        && let Some(evaluated) =
            eval_results::collect((&plan, &capture), &finished.results, &store, record.clone(), &args.out)?
    {
        record.set_quality(&evaluated.record);
        (by_kind, stretches) = (evaluated.by_kind, evaluated.stretches);
    }
    let report = Report {
        record,
        plan: plan_id,
        capture: capture_id,
        tasks: plan.tasks.len(),
        objects: written.objects,
        levels: plan.levels,
        antialiased: plan.settings.antialiased,
        ingest_cpu_seconds,
        capped: finished.capped,
        resumed: finished.resumed,
        settled: finished.settled,
        predicted,
        by_kind,
        stretches,
    };
    save_json(&args.out.join("report.json"), &report)?;
    if let Some(failure) = failed {
        return Err(eval_results::model_is_kept(failure, &plan, &args.out));
    }
    Ok(Trained { capture, report, curve: totals.curve, dashboard })
}

/// Plans and ingests the capture, and writes the configuration and the plan.
fn prepare(args: &TrainArgs, clock: &Stopwatch, output: &Output) -> Result<Prepared, Failure> {
    let source = captures::open_to_plan(&args.capture, &args.plan, output)?;
    // The plan is checked before any photo is read.
    let (planned_for, plan) = plan_of(&source, &args.plan)?;
    let backend = backend::open(args.backend)?;
    let objects = Objects::of((&args.zones, &args.aligned), (&args.capture, &source))?;
    let plan = objects.add_to(Plan { backend: backend.name(), ..plan }, &planned_for);
    check_plan(&plan, &planned_for, output)?;
    make_folder(&args.out)?;
    let store = Store::open(&store_url(args))?;
    let ingested = ingest_photos(&source, &store.blocking(), args.plan.downscale, output)?;
    let ingest_cpu_seconds = clock.cpu_seconds();

    let Ingested { capture, id: capture_id, .. } = ingested;
    let plan = objects.put(Plan { capture: capture_id, ..plan }, &capture, &store.blocking(), output)?;
    let (config_text, config_hash) = resolved(args, &plan);
    save(&args.out.join("config.toml"), config_text.as_bytes())?;
    save_json(&args.out.join("plan.json"), &plan)?;
    save(&args.out.join("plan.svg"), blocks::draw(&plan, &capture).as_bytes())?;
    let plan_id = store.blocking().put(plan.to_frame())?;
    Ok(Prepared { capture, capture_id, plan, plan_id, config_hash, backend, store, ingest_cpu_seconds })
}

/// Trains the plan's blocks on workers in this process; `clock` has run since the command started.
fn train_plan(
    args: &TrainArgs,
    prepared: &Prepared,
    dashboard: Option<&Dashboard>,
    clock: Stopwatch,
    output: &Output,
) -> Result<Finished, Failure> {
    let Prepared { plan, plan_id, backend, store, .. } = prepared;
    if plan.settings.test_every > 0 && !is_evaluated(plan) {
        let by = if plan.settings.evaluate { "tasks of the job measure" } else { "plat eval measures" };
        output.note(format!("the model is too large to be measured during training; {by} it afterwards"));
    }
    let metrics = args.out.join("metrics.jsonl");
    let mut log = MetricsLog::create(&metrics, plan, args.workers, clock.clone(), output.stages())?;
    let time_limit = args.minutes.map(|minutes| time_limit_of(minutes, clock, plan, args.workers));
    let shared = Arc::new(Shared { time_limit, ..Shared::default() });
    let metered = store.metered();
    let options = TrainerOptions {
        threads: threads_of(args) as usize,
        eval_every: args.eval_every,
        cache_bytes: CACHE_BYTES,
        memory_bytes: 0,
        resume: !args.fresh,
        checkpoint_seconds: args.checkpoint_every,
    };
    let trainers =
        (0..args.workers).map(|_| PlanExecutor::new(metered.blocking(), options, shared.clone(), backend.clone()));
    let trainers = trainers.map(|trainer| trainer.map(Arc::new)).collect::<Result<_, _>>().map_err(Failure::Work)?;
    let outcome = run_job(trainers, plan, store, *plan_id, dashboard, &mut log, output);
    let totals = log.close()?;
    let (results, evaluation_failed) = outcome?;
    let resumed = shared.resumed.load(Ordering::Relaxed);
    if resumed > 0 {
        let tasks = plan.len();
        output.note(format!("{resumed} of {tasks} tasks were resumed from an earlier run; --fresh starts over"));
    }
    let capped = shared.time_limit.as_ref().is_some_and(TimeLimit::is_shortened);
    if capped {
        output.note("--minutes left fewer steps than planned: another run may give other bytes");
    }
    Ok(Finished {
        results,
        evaluation_failed,
        totals,
        resumed,
        settled: shared.settled.load(Ordering::Relaxed),
        capped,
        bytes_moved: metered.traffic().read + metered.traffic().written,
    })
}

/// The time limit of training for a job that shall end after this many minutes, writing the model included.
fn time_limit_of(minutes: f64, clock: Stopwatch, plan: &Plan, workers: u32) -> TimeLimit {
    /// Wall seconds of merging and writing a splat.
    const SECONDS_PER_SPLAT: f64 = 2e-6;
    let seconds = 60.0 * minutes;
    let writing = SECONDS_PER_SPLAT * f64::from(plan.settings.budget);
    TimeLimit::new(clock, seconds - writing.min(0.1 * seconds), workers)
}

/// The configuration file of a run, with the values that the plan chose for `auto`, and the file's hash.
pub(crate) fn resolved(args: &TrainArgs, plan: &Plan) -> (String, ArtefactId) {
    let mut resolved = args.clone();
    resolved.plan.budget.0 = Some(plan.settings.budget);
    resolved.plan.steps.0 = Some(plan.settings.steps);
    resolved.threads.0 = Some(threads_of(args));
    config::resolved(&resolved)
}

/// URL of the store of photos and results.
pub(crate) fn store_url(args: &TrainArgs) -> String {
    args.store.clone().unwrap_or_else(|| args.out.join("store").display().to_string())
}

/// Threads of each worker.
fn threads_of(args: &TrainArgs) -> u32 {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    args.threads.0.unwrap_or(cores / args.workers).max(1)
}

/// Attempts of a task of a local job while its store fails, over three seconds.
const LOCAL_STORE_ATTEMPTS: u32 = 3;

/// Runs a coordinator and its workers in this process until the job ends. Ctrl-C cancels the job. Returns the results of all tasks; if
/// only evaluation tasks failed, those of the training tasks and the failure.
fn run_job(
    trainers: Vec<Arc<PlanExecutor>>,
    plan: &Plan,
    store: &Store,
    plan_id: ArtefactId,
    dashboard: Option<&Dashboard>,
    log: &mut MetricsLog,
    output: &Output,
) -> Result<(Vec<ArtefactId>, Option<Failure>), Failure> {
    let mut seen = Results::new(plan.len() as u32);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.map_err(|error| Failure::Work(format!("cannot start threads: {error}")))?;
    let start_worker = |coordinator_url: String, number: usize, shutdown| {
        dashboard.iter().for_each(|dashboard| dashboard.follow(&coordinator_url));
        let (worker_id, backend) = (format!("local-{number}"), plan.backend.clone());
        let access = Access::default();
        let options = worker::Options { coordinator_url, access, worker_id, backend, memory_bytes: 0 };
        worker::run(options, trainers[number].clone(), shutdown)
    };
    let _traced = tracing::info_span!("job").entered();
    let result = runtime.block_on(async {
        let stop = CancellationToken::new();
        let interrupted = tokio::spawn(cancel_on_ctrl_c(stop.clone(), *output));
        let mut hosting = coordinator::Options::new(store.clone());
        // A full disk is reported soon instead of retried for long. Finished tasks are kept.
        hosting.settings.infrastructure_failures_limit = LOCAL_STORE_ATTEMPTS;
        let on_update = |update: &Update| {
            if let Update::Changed(changed) = update {
                // An unknown task ends the job with an error.
                let _ = seen.update(changed.clone());
            }
            log.update(update);
        };
        let result = run_local(hosting, plan_id, trainers.len(), start_worker, on_update, stop).await;
        interrupted.abort();
        result
    });
    match result {
        Ok(results) => Ok((results, None)),
        Err(LocalError::Cancelled) => Err(Failure::Work(format!(
            "stopped by Ctrl-C; photos and finished blocks are kept in {}; the same command resumes from them",
            store.url()
        ))),
        Err(error) => match seen.first(plan.tasks.len()) {
            Some(trained) => Ok((trained, Some(error.into()))),
            None => Err(error.into()),
        },
    }
}

/// Cancels the job at the first Ctrl-C and ends the program at the second.
async fn cancel_on_ctrl_c(stop: CancellationToken, output: Output) {
    if tokio::signal::ctrl_c().await.is_ok() {
        output.note("stopping; press Ctrl-C again to end at once");
        stop.cancel();
        if tokio::signal::ctrl_c().await.is_ok() {
            std::process::exit(1);
        }
    }
}
