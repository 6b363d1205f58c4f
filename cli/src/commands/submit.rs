//! `plat submit`: ingests photos into the coordinator's store and submits their plan as a job.
//!
//! With `--wait` it follows the job to its end. With `--out` it also writes the model, with the bytes that `plat train` gives for the
//! same plan.

use std::path::Path;

use blocks::Plan;
use coordinator::Results;
use dataset::ingest::Ingested;
use model::save_json;
use proto::{Client, Outcome};
use scene::{ArtefactId, BadInput, Capture};
use serde::Serialize;
use store::BlockingStore;
use telemetry::traced;
use tracing::field::Empty;

use crate::args::{Backend, SubmitArgs};
use crate::captures::{self, ingest_photos};
use crate::clock::Stopwatch;
use crate::eval_results;
use crate::failure::{Failure, make_folder};
use crate::live_status::{LiveStatus, TaskNames};
use crate::objects::{Objects, note_found};
use crate::output::{Output, beside};
use crate::planning::{check_plan, plan_of};
use crate::remote::{Remote, result_of};
use crate::run_record::Record;

#[derive(Serialize)]
struct Submitted {
    command: &'static str,
    job: u64,
    plan: ArtefactId,
    capture: ArtefactId,
    backend: String,
    tasks: u32,
    /// Of the merged model, with `--out`.
    splats: Option<u64>,
    bytes: Option<u64>,
    /// Of the merged model over the held-out views in dB, with `--evaluate` and `--out`.
    psnr: Option<f64>,
    /// From the job's acceptance to its end, with `--wait`.
    job_seconds: Option<f64>,
    /// From the start of the command to the end of the job, with `--wait`.
    wall_seconds: Option<f64>,
}

pub(crate) fn run(args: &SubmitArgs, output: &Output) -> Result<(), Failure> {
    let clock = Stopwatch::start();
    let span = tracing::info_span!("submit", job = Empty, tasks = Empty, otel.kind = "client").entered();
    let source = captures::open_to_plan(&args.capture, &args.plan, output)?;
    // Plan and coordinator are checked before any photo is read.
    let (planned_for, plan) = plan_of(&source, &args.plan)?;
    let mut remote = Remote::open(&args.connection)?;
    let about = remote.call(async |client: &mut Client| client.about(proto::AboutRequest {}).await)?;
    let backend = backend_of(args, &about, output)?;
    let objects = Objects::of((&args.zones, &args.aligned), (&args.capture, &source))?;
    let plan = objects.add_to(Plan { backend: backend.clone(), ..plan }, &planned_for);
    check_plan(&plan, &planned_for, output)?;
    if let Some(out) = &args.out {
        make_folder(out)?;
    }
    let store = remote.store(&about)?;
    let Ingested { capture, id, .. } = ingest_photos(&source, &store.blocking(), args.plan.downscale, output)?;
    let plan = objects.put(Plan { capture: id, ..plan }, &capture, &store.blocking(), output)?;
    let plan_id = store.blocking().put(plan.to_frame())?;
    let request = proto::SubmitRequest { plan: plan_id.0.to_vec(), store_url: store.url().into() };
    let job = remote.call(async |client: &mut Client| client.submit(traced(request)).await)?;
    span.record("job", job.job).record("tasks", job.tasks);
    let accepted = Stopwatch::start();
    let mut submitted = Submitted {
        command: "submit",
        job: job.job,
        plan: plan_id,
        capture: id,
        backend,
        tasks: job.tasks,
        splats: None,
        bytes: None,
        psnr: None,
        job_seconds: None,
        wall_seconds: None,
    };
    let mut text = format!("job {} of {} tasks; plat status {} shows its progress", job.job, job.tasks, job.job);
    if args.wait {
        output.note(format!("job {} of {} tasks", job.job, job.tasks));
        let names = TaskNames::of(&plan);
        let mut live = LiveStatus::new(job.job, &names, output);
        let followed = remote.follow(job.job, job.tasks, output, |results, update| live.update(results, update))?;
        let Some((outcome, results)) = followed else {
            let advice = format!("plat status {0} --watch follows it, plat cancel {0} ends it", job.job);
            return Err(Failure::Work(format!("stopped waiting after Ctrl-C; job {} goes on: {advice}", job.job)));
        };
        submitted.job_seconds = Some(accepted.wall_seconds());
        text = format!("job {} is done: {} tasks", job.job, job.tasks);
        match &args.out {
            None => result_of(job.job, outcome, &results)?,
            Some(out) => {
                let finished = Finished { args, plan: &plan, store: &store.blocking(), capture: &capture, output };
                text = finished.write(out, (outcome, &results), &mut submitted)?;
            }
        }
        submitted.wall_seconds = Some(clock.wall_seconds());
        if let Some(out) = &args.out {
            save_json(&out.join("report.json"), &submitted)?;
        }
    }
    output.result(&submitted, &text)
}

/// A job that has ended, whose model is to be written.
struct Finished<'a> {
    args: &'a SubmitArgs,
    plan: &'a Plan,
    store: &'a BlockingStore,
    capture: &'a Capture,
    output: &'a Output,
}

impl Finished<'_> {
    /// Writes plan, model and figures under `out`; returns what to print. A model whose evaluation failed is written before the failure
    /// is returned.
    fn write(
        &self,
        out: &Path,
        (outcome, results): (Outcome, &Results),
        submitted: &mut Submitted,
    ) -> Result<String, Failure> {
        let Self { args, plan, store, capture, output } = *self;
        let trained = results.first(plan.tasks.len()).filter(|_| outcome == Outcome::Incomplete);
        let (results, failed) = match (result_of(submitted.job, outcome, results), trained) {
            (Ok(()), _) => (results.all()?, None),
            (Err(failure), Some(trained)) => (trained, Some(failure)),
            (Err(failure), None) => return Err(failure),
        };
        save_json(&out.join("plan.json"), plan)?;
        if failed.is_none() {
            note_found(plan, capture, &results, store, output)?;
        }
        let downscale = args.plan.downscale;
        let written = model::write(out, plan, &results, store, capture, downscale)?;
        if let Some(failure) = failed {
            return Err(eval_results::model_is_kept(failure, plan, out));
        }
        (submitted.splats, submitted.bytes) = (Some(written.splats), Some(written.bytes));
        let (scene, backend) = (captures::name_of(&args.capture), plan.backend.clone());
        let about = Record { scene, downscale, backend, splats: written.splats, ..Record::new("eval") };
        let evaluated = eval_results::collect((plan, capture), &results, store, about, out)?;
        submitted.psnr = evaluated.and_then(|evaluated| evaluated.record.psnr);
        let psnr = submitted.psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB held out"));
        let (splats, blocks, file) = (written.splats, plan.tasks.len(), out.join("merged.ply"));
        let objects = beside(written.objects);
        Ok(format!("{splats} splats in {blocks} blocks{objects}{psnr}\n{}", file.display()))
    }
}

/// The backend for the plan: of those that fit `--backend`, the one that most workers have. Without a worker it is this machine's CPU;
/// a GPU's name is only known from a worker.
fn backend_of(args: &SubmitArgs, about: &proto::AboutReply, output: &Output) -> Result<String, Failure> {
    let is_cpu = |name: &str| name.starts_with("cpu-");
    let fits = |name: &str| match args.backend {
        Backend::Auto => true,
        Backend::Cpu => is_cpu(name),
        Backend::Gpu => !is_cpu(name),
    };
    let fitting = about.backends.iter().filter(|of| fits(&of.backend)).max_by_key(|of| of.workers);
    let name = match fitting {
        Some(of) => of.backend.clone(),
        None if args.backend == Backend::Gpu => {
            let problem = "gpu: no worker has a GPU, and the plan must name it";
            return Err(BadInput::new("--backend", problem, "start a worker with --backend gpu first").into());
        }
        None => {
            let name = train::Backend::Cpu.name();
            output.note(format!("no worker has backend {name} yet; the job waits for one"));
            name
        }
    };
    Ok(name)
}
