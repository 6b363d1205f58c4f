//! `plat submit`: photos into the coordinator's store, the plan of them to the coordinator; with `--wait` to its end, with
//! `--out` the model, byte for byte what `plat train` makes of the same plan.

use blocks::Plan;
use dataset::ingest::Ingested;
use proto::Client;
use scene::{ArtefactId, BadInput};
use serde::Serialize;
use telemetry::traced;
use tracing::field::Empty;

use crate::args::{Backend, SubmitArgs};
use crate::cameras;
use crate::clock::Stopwatch;
use crate::commands::plan::plan_of;
use crate::commands::train::{check_plan, ingest_photos, make_folder};
use crate::failure::Failure;
use crate::live::Live;
use crate::model::{self, save_json};
use crate::output::Output;
use crate::remote::{Remote, judge};

#[derive(Serialize)]
struct Submitted {
    command: &'static str,
    job: u64,
    plan: ArtefactId,
    capture: ArtefactId,
    backend: String,
    tasks: u32,
    /// Of the merged model, where it was waited for and written.
    splats: Option<u64>,
    bytes: Option<u64>,
    /// Of the job, from when it was accepted to its end, where it was waited for.
    job_seconds: Option<f64>,
    /// Since the command began, where it was waited for.
    wall_seconds: Option<f64>,
}

pub(crate) fn run(args: &SubmitArgs, output: &Output) -> Result<(), Failure> {
    let clock = Stopwatch::start();
    let span = tracing::info_span!("submit", job = Empty, tasks = Empty, otel.kind = "client").entered();
    let source = cameras::open(&args.capture, output)?;
    // What the plan or the coordinator refuses is said before any photo is read.
    let (planned_for, plan) = plan_of(&source.capture, &args.plan)?;
    let mut remote = Remote::open(&args.connection)?;
    let about = remote.call(async |client: &mut Client| client.about(proto::AboutRequest {}).await)?;
    let backend = backend_of(args, &about, output)?;
    let plan = Plan { backend: backend.clone(), ..plan };
    check_plan(&plan, &planned_for, output)?;
    if let Some(out) = &args.out {
        make_folder(out)?;
    }
    let store = remote.store(&about)?;
    let Ingested { capture, id, .. } = ingest_photos(&source, &store.blocking(), args.plan.downscale, output)?;
    let plan = Plan { capture: id, ..plan };
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
        job_seconds: None,
        wall_seconds: None,
    };
    let mut text = format!("job {} of {} tasks; plat status {} says how it stands", job.job, job.tasks, job.job);
    if args.wait {
        output.note(format!("job {} of {} tasks", job.job, job.tasks));
        let blocks = plan.tasks.iter().map(|task| task.block).collect();
        let mut live = Live::new(job.job, blocks, output);
        let followed = remote.follow(job.job, job.tasks, output, |results, news| live.note(results, news))?;
        let Some((outcome, results)) = followed else {
            let advice = format!("plat status {0} --watch goes on watching, plat cancel {0} ends it", job.job);
            return Err(Failure::Work(format!("stopped waiting as asked; job {} goes on: {advice}", job.job)));
        };
        submitted.job_seconds = Some(accepted.wall_seconds());
        judge(job.job, outcome, &results)?;
        text = format!("job {} is done: {} tasks", job.job, job.tasks);
        if let Some(out) = &args.out {
            let results = results.all()?;
            save_json(&out.join("plan.json"), &plan)?;
            let written =
                model::write(out, &plan, &results, &store.blocking(), capture.geo_origin, args.plan.downscale)?;
            (submitted.splats, submitted.bytes) = (Some(written.splats), Some(written.bytes));
            text = format!("{} splats in {} blocks\n{}", written.splats, job.tasks, out.join("merged.ply").display());
        }
        submitted.wall_seconds = Some(clock.wall_seconds());
        if let Some(out) = &args.out {
            save_json(&out.join("report.json"), &submitted)?;
        }
    }
    output.result(&submitted, &text)
}

/// What is to compute: what most workers have, of the kind that was asked for. Without any, this machine's CPU stands for theirs;
/// what a GPU is called only a worker that has it knows.
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
            let problem = "gpu: no worker has one, and the plan has to name it";
            return Err(BadInput::new("--backend", problem, "start a worker with --backend gpu first").into());
        }
        None => {
            let name = train::Backend::Cpu.name();
            output.note(format!("no worker computes on {name} yet: the job waits for one"));
            name
        }
    };
    if args.plan.exposure && !is_cpu(&name) {
        let advice = "leave it, or give --backend cpu";
        return Err(BadInput::new("--exposure", format!("is not trained on {name}"), advice).into());
    }
    Ok(name)
}
