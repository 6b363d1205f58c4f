//! A whole cluster in one process, over the same wire: a coordinator on a loopback port, workers, one job.

use std::fmt;
use std::future::Future;
use std::time::Duration;

use proto::watch_event::Event as News;
use proto::{Access, Outcome};
use scene::ArtefactId;
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::results::{LocalError, Results, of_status};
use crate::{Options, Security, serve};

/// After the job, workers have this long to put down what they do.
const GOODBYE: Duration = Duration::from_secs(10);

/// Runs a plan that lies in `options.store` to its end: hosts a coordinator on 127.0.0.1, starts `workers` workers with
/// `start_worker(coordinator_url, number, shutdown)`, submits the plan and hands every news of the job to `on_news`.
/// Returns the tasks' results in the plan's order. `options.drain` is taken as true, and the workers are taken to share
/// one machine ([`Settings::one_machine`](cluster::Settings::one_machine)).
///
/// Nobody else has its port, so `options.security` is left out.
///
/// When `stop` is cancelled the job is cancelled and the workers are told. (The workers come in as a function because a
/// coordinator must not depend on what trains.)
///
/// # Errors
/// [`LocalError`], with the first task that failed, why, and how many others were not run because of it.
pub async fn run_local<W, E>(
    options: Options,
    plan: ArtefactId,
    workers: usize,
    start_worker: impl Fn(String, usize, CancellationToken) -> W,
    mut on_news: impl FnMut(&News),
    stop: CancellationToken,
) -> Result<Vec<ArtefactId>, LocalError>
where
    W: Future<Output = Result<(), E>> + Send + 'static,
    E: fmt::Display + Send + 'static,
{
    let listener = TcpListener::bind("127.0.0.1:0").await.map_err(failed("cannot listen on 127.0.0.1"))?;
    let address = listener.local_addr().map_err(failed("cannot listen on 127.0.0.1"))?;
    let url = format!("http://{address}");
    let store_url = options.store.url().to_string();
    let home = CancellationToken::new();
    // If this future is dropped, everything that it started ends.
    let _dropped = home.clone().drop_guard();
    let (settings, security) = (options.settings.one_machine(), Security::default());
    let hosting = Options { drain: true, settings, security, ..options };
    let server = tokio::spawn(serve(listener, hosting, home.child_token().cancelled_owned()));

    let mut client = proto::connect(&url, &Access::default()).map_err(failed("the coordinator's address"))?;
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url };
    let job = client.submit(telemetry::traced(request)).await.map_err(of_status)?.into_inner();

    // Watched before anyone works: a report that came earlier would be told to nobody.
    let mut news = client.watch(proto::WatchRequest { job: job.job }).await.map_err(of_status)?.into_inner();
    let leave = home.child_token();
    let mut crew = JoinSet::new();
    for number in 0..workers {
        crew.spawn(start_worker(url.clone(), number, leave.clone()));
    }
    let mut results = Results::new(job.tasks);
    let mut trouble: Option<String> = None;
    let mut cancelled = false;
    let outcome = loop {
        // Without workers the job would wait for ever. (If it is over already, there is nothing left to cancel.)
        if !cancelled && (stop.is_cancelled() || crew.is_empty()) {
            cancelled = true;
            client.cancel(proto::CancelRequest { job: job.job }).await.map_err(of_status)?;
        }
        tokio::select! {
            () = stop.cancelled(), if !cancelled => {}
            Some(ended) = crew.join_next() => {
                let ended = ended.map_err(|error| error.to_string());
                trouble = trouble.or(ended.and_then(|worker| worker.map_err(|error| error.to_string())).err());
            }
            event = news.message() => {
                let event = event.map_err(of_status)?.and_then(|event| event.event);
                let lost = || LocalError::Failed("the coordinator stopped telling the news of the job".into());
                let event = event.ok_or_else(lost)?;
                on_news(&event);
                match event {
                    News::Changed(changed) => results.note(changed)?,
                    News::Finished(finished) => break finished.outcome(),
                    News::Reported(_) => {}
                }
            }
        }
    };

    leave.cancel();
    let _ = tokio::time::timeout(GOODBYE, async { while crew.join_next().await.is_some() {} }).await;
    drop((client, news));
    home.cancel();
    if let Ok(Err(error)) = server.await {
        tracing::warn!("{error}");
    }
    match outcome {
        Outcome::Done => results.all(),
        Outcome::Cancelled if stop.is_cancelled() => Err(LocalError::Cancelled),
        Outcome::Cancelled => {
            let trouble = trouble.unwrap_or_else(|| "all have left".into());
            Err(LocalError::Failed(format!("no worker is left: {trouble}")))
        }
        Outcome::Incomplete => Err(results.failure()),
    }
}

fn failed<E: fmt::Display>(what: &'static str) -> impl Fn(E) -> LocalError {
    move |error| LocalError::Failed(format!("{what}: {error}"))
}
