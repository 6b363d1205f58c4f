//! Runs a whole cluster in one process over the same protocol: a coordinator on a loopback port, workers, one job.

use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::time::Duration;

use proto::watch_event::Event as Update;
use proto::{Access, Outcome};
use scene::ArtefactId;
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::options::Options;
use crate::results::{LocalError, Results, of_status};
use crate::security::Security;
use crate::serve::serve;

/// Time limit of the workers' shutdown after the job.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(10);

/// Runs a plan in `options.store` to its end: hosts a coordinator on 127.0.0.1, starts `workers` workers with
/// `start_worker(coordinator_url, number, shutdown)`, submits the plan and passes every update of the job to `on_update`. Returns the
/// tasks' results in the plan's order. `options.drain` is set, and the workers share one machine
/// ([`Settings::one_machine`](cluster::Settings::one_machine)). `options.security` is ignored, as no other process learns the port.
///
/// When `stop` is cancelled, the job is cancelled and the workers shut down. (Workers are started by a function because the coordinator
/// must not depend on the trainer.)
///
/// # Errors
/// [`LocalError`], with the first task that failed, its error, and how many others were not run because of it.
pub async fn run_local<W, E>(
    options: Options,
    plan: ArtefactId,
    workers: usize,
    start_worker: impl Fn(String, usize, CancellationToken) -> W + Send + Sync,
    mut on_update: impl FnMut(&Update) + Send,
    stop: CancellationToken,
) -> Result<Vec<ArtefactId>, LocalError>
where
    W: Future<Output = Result<(), E>> + Send + 'static,
    E: fmt::Display + Send + 'static,
{
    let start_worker = |url: String, number: usize, stop: CancellationToken| -> Running {
        let worker = start_worker(url, number, stop);
        Box::pin(async move { worker.await.map_err(|error| error.to_string()) })
    };
    compiled_here(options, plan, workers, &start_worker, &mut on_update, stop).await
}

/// A worker; the text of its error.
type Running = Pin<Box<dyn Future<Output = Result<(), String>> + Send>>;

/// Behind a pointer, as in [`serve`].
fn compiled_here<'a>(
    options: Options,
    plan: ArtefactId,
    workers: usize,
    start_worker: &'a (dyn Fn(String, usize, CancellationToken) -> Running + Send + Sync),
    on_update: &'a mut (dyn FnMut(&Update) + Send),
    stop: CancellationToken,
) -> Pin<Box<dyn Future<Output = Result<Vec<ArtefactId>, LocalError>> + Send + 'a>> {
    Box::pin(run(options, plan, workers, start_worker, on_update, stop))
}

async fn run(
    options: Options,
    plan: ArtefactId,
    workers: usize,
    start_worker: &(dyn Fn(String, usize, CancellationToken) -> Running + Send + Sync),
    on_update: &mut (dyn FnMut(&Update) + Send),
    stop: CancellationToken,
) -> Result<Vec<ArtefactId>, LocalError> {
    let listener = TcpListener::bind("127.0.0.1:0").await.map_err(failed("cannot listen on 127.0.0.1"))?;
    let address = listener.local_addr().map_err(failed("cannot listen on 127.0.0.1"))?;
    let url = format!("http://{address}");
    let store_url = options.store.url().to_string();
    let shutdown = CancellationToken::new();
    // Everything that was started here ends when this future is dropped.
    let _guard = shutdown.clone().drop_guard();
    let (settings, security) = (options.settings.one_machine(), Security::default());
    let hosting = Options { drain: true, settings, security, ..options };
    let server = tokio::spawn(serve(listener, hosting, shutdown.child_token().cancelled_owned()));

    let mut client = proto::connect(&url, &Access::default()).map_err(failed("the coordinator's address"))?;
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url };
    let job = client.submit(telemetry::traced(request)).await.map_err(of_status)?.into_inner();

    // Subscribed before workers start, so that no report is missed.
    let mut updates = client.watch(proto::WatchRequest { job: job.job }).await.map_err(of_status)?.into_inner();
    let stop_workers = shutdown.child_token();
    let mut running = JoinSet::new();
    for number in 0..workers {
        running.spawn(start_worker(url.clone(), number, stop_workers.clone()));
    }
    let mut results = Results::new(job.tasks);
    let mut worker_error: Option<String> = None;
    let mut cancelled = false;
    let outcome = loop {
        // Without workers the job would wait for ever. (Cancelling a finished job has no effect.)
        if !cancelled && (stop.is_cancelled() || running.is_empty()) {
            cancelled = true;
            client.cancel(proto::CancelRequest { job: job.job }).await.map_err(of_status)?;
        }
        tokio::select! {
            () = stop.cancelled(), if !cancelled => {}
            Some(ended) = running.join_next() => {
                let ended = ended.map_err(|error| error.to_string());
                worker_error = worker_error.or(ended.and_then(|worker| worker).err());
            }
            event = updates.message() => {
                let event = event.map_err(of_status)?.and_then(|event| event.event);
                let lost = || LocalError::Failed("the coordinator ended the stream of the job's updates".into());
                let event = event.ok_or_else(lost)?;
                on_update(&event);
                match event {
                    Update::Changed(changed) => results.update(changed)?,
                    Update::Finished(finished) => break finished.outcome(),
                    Update::Reported(_) => {}
                }
            }
        }
    };

    stop_workers.cancel();
    let _ = tokio::time::timeout(SHUTDOWN_TIMEOUT, async { while running.join_next().await.is_some() {} }).await;
    drop((client, updates));
    shutdown.cancel();
    if let Ok(Err(error)) = server.await {
        tracing::warn!("{error}");
    }
    match outcome {
        Outcome::Done => results.all(),
        Outcome::Cancelled if stop.is_cancelled() => Err(LocalError::Cancelled),
        Outcome::Cancelled => {
            let reason = worker_error.unwrap_or_else(|| "all have left".into());
            Err(LocalError::Failed(format!("no worker is left: {reason}")))
        }
        Outcome::Incomplete => Err(results.failure()),
    }
}

fn failed<E: fmt::Display>(what: &'static str) -> impl Fn(E) -> LocalError {
    move |error| LocalError::Failed(format!("{what}: {error}"))
}
