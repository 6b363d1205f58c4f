//! Follows a coordinator as the command line does: its jobs, its workers, its log. The scheduler answers copies of its state; nothing
//! waits for a browser.

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use blocks::{Plan, PlannedTask};
use dataset::ingest::load_capture;
use proto::watch_event::Event as Update;
use proto::{Client, LogsRequest, TaskState, WatchRequest};
use scene::ArtefactId;
use store::{BlockingStore, Store};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::feed::Feed;
use crate::project::{Project, Results};
use crate::views::{Coordinator, Server};

/// Interval at which jobs, workers and logs are asked for.
const PERIOD: Duration = Duration::from_secs(1);
/// Longest pause between two attempts to reconnect.
const MAX_PAUSE: Duration = Duration::from_secs(5);
/// Largest plan that is read, bytes.
const PLAN_BYTES_LIMIT: u64 = 1 << 30;

/// Finds the coordinator: its client and its URL. Called again whenever it is lost, as another may lead then.
pub type Find = Arc<dyn Fn() -> Pin<Box<dyn Future<Output = Result<(Client, String), String>> + Send>> + Send + Sync>;

/// Follows until `stop`.
pub(crate) async fn follow(feed: Arc<Feed>, find: Find, name: Option<String>, stop: CancellationToken) {
    let mut follower = Follower { feed, name, logs: BTreeMap::new(), store: None, silent_since: None };
    let mut pause = Duration::from_millis(200);
    loop {
        let session = async {
            let (client, url) = find().await.map_err(Status::unavailable)?;
            follower.session(client, &url, &mut pause).await
        };
        let ended = tokio::select! {
            () = stop.cancelled() => return,
            ended = session => ended,
        };
        if let Err(status) = ended {
            tracing::debug!("the coordinator is lost: {}", proto::explain(&status));
        }
        follower.lost();
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(pause) => {}
        }
        pause = MAX_PAUSE.min(2 * pause);
    }
}

struct Follower {
    feed: Arc<Feed>,
    /// Of the only job, if it is known.
    name: Option<String>,
    /// The last line of each job's log that was read, and whether the job's end has been read.
    logs: BTreeMap<u64, (u64, bool)>,
    store: Option<Store>,
    silent_since: Option<u64>,
}

impl Follower {
    /// Follows one coordinator until it is lost.
    async fn session(&mut self, mut client: Client, url: &str, pause: &mut Duration) -> Result<(), Status> {
        let about = client.about(proto::AboutRequest {}).await?.into_inner();
        let store = Store::open(&about.store_url).map_err(|error| Status::failed_precondition(error.to_string()))?;
        // The next leader on a store goes on with the log of the one before; jobs of other stores have logs of their own.
        if self.store.as_ref().is_none_or(|before| before.url() != store.url()) {
            self.logs.clear();
        }
        self.store = Some(store);
        // Jobs whose stream is open, and those that were watched at all: one that has ended has to be watched once.
        let (mut open, mut seen) = (BTreeSet::new(), BTreeSet::new());
        let mut watching = JoinSet::new();
        let mut period = tokio::time::interval(PERIOD);
        period.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            period.tick().await;
            let jobs = client.jobs(proto::JobsRequest {}).await?.into_inner().jobs;
            self.heard(url, &about.store_url);
            *pause = Duration::from_millis(200);
            for status in &jobs {
                let is_known = self.feed.board().jobs.contains_key(&status.job);
                if !is_known {
                    match self.project(status).await {
                        Ok(project) => self.feed.board().add(status.job, project),
                        Err(problem) => {
                            tracing::warn!("job {} is not shown: {problem}", status.job);
                            continue;
                        }
                    }
                }
                self.feed.board().status(self.feed.now(), status);
                let is_new = seen.insert(status.job);
                if (is_new || status.outcome.is_none()) && open.insert(status.job) {
                    watching.spawn(watch(self.feed.clone(), client.clone(), status.job));
                }
            }
            let known: BTreeSet<u64> = jobs.iter().map(|status| status.job).collect();
            self.feed.board().retain(&known);
            let connected = client.workers(proto::WorkersRequest {}).await?.into_inner();
            self.feed.board().set_workers(self.feed.now(), &connected.workers, connected.lease_millis);
            for status in &jobs {
                self.read_log(&mut client, status.job, status.outcome.is_some()).await?;
            }
            // A stream ends with its job, which may be retried later, or because this server lagged; then it starts over.
            while let Some(ended) = watching.try_join_next() {
                if let Ok(job) = ended {
                    open.remove(&job);
                }
            }
        }
    }

    async fn project(&self, status: &proto::StatusReply) -> Result<Arc<Project>, String> {
        let store = self.store.clone().ok_or("no store")?.blocking();
        let plan = proto::artefact_id(&status.plan).map_err(|status| status.message().to_owned())?;
        let name = self.name.clone().unwrap_or_else(|| format!("job {}", status.job));
        let read = tokio::task::spawn_blocking(move || read_project(name, plan, store));
        read.await.map_err(|error| error.to_string())?.map(Arc::new)
    }

    async fn read_log(&mut self, client: &mut Client, job: u64, is_over: bool) -> Result<(), Status> {
        let (after, is_read) = self.logs.entry(job).or_default();
        // A job that is retried goes on.
        *is_read &= is_over;
        while !*is_read {
            let page = client.logs(LogsRequest { job, after: *after }).await?.into_inner().lines;
            let Some(last) = page.last() else {
                *is_read = is_over;
                break;
            };
            *after = last.number;
            self.feed.board().log(self.feed.now(), job, &page);
        }
        Ok(())
    }

    fn heard(&mut self, url: &str, store_url: &str) {
        self.silent_since = None;
        let mut board = self.feed.board();
        let coordinator = Some(Coordinator { url: url.to_owned(), reachable: true, silent_millis: 0 });
        let server = Server { coordinator, store_url: Some(store_url.to_owned()), ..board.server.clone() };
        board.set_server(server);
    }

    fn lost(&mut self) {
        let now = self.feed.now();
        let since = *self.silent_since.get_or_insert(now);
        let mut board = self.feed.board();
        let url = board.server.coordinator.as_ref().map_or(String::new(), |coordinator| coordinator.url.clone());
        let silent_millis = now.saturating_sub(since) + 1;
        let coordinator = Some(Coordinator { url, reachable: false, silent_millis });
        let server = Server { coordinator, ..board.server.clone() };
        board.set_server(server);
    }
}

fn read_project(name: String, plan: ArtefactId, store: BlockingStore) -> Result<Project, String> {
    if store.size(plan).map_err(|error| error.to_string())?.is_some_and(|bytes| bytes > PLAN_BYTES_LIMIT) {
        return Err(format!("plan {plan} is too large"));
    }
    let bytes = store.get(plan).map_err(|error| error.to_string())?;
    let plan = Plan::from_frame(&bytes).map_err(|error| format!("plan {plan}: {error}"))?;
    // Without its capture a job is shown without cameras and photos.
    let capture = load_capture(&store, plan.capture).ok();
    Ok(Project::new(name, plan, Results::Store(store.clone()), capture.map(|capture| (capture, Some(store)))))
}

/// Watches one job until its stream ends.
async fn watch(feed: Arc<Feed>, mut client: Client, job: u64) -> u64 {
    let Ok(reply) = client.watch(WatchRequest { job }).await else { return job };
    let mut updates = reply.into_inner();
    while let Ok(Some(event)) = updates.message().await {
        let Some(event) = event.event else { continue };
        feed.board().update(feed.now(), job, &event);
        match &event {
            Update::Changed(changed) if changed.state() == TaskState::Done => {
                add_figures(&feed, job, changed.task, &changed.artefact).await;
            }
            Update::Finished(_) => return job,
            _ => {}
        }
    }
    job
}

/// Reads the figures of an evaluation task that is done.
async fn add_figures(feed: &Arc<Feed>, job: u64, task: u32, artefact: &[u8]) {
    let project = feed.board().jobs.get(&job).map(|job| job.project.clone());
    let evaluates = |project: &Arc<Project>| matches!(project.plan.planned(task), Some(PlannedTask::Evaluate(_)));
    let Some(project) = project.filter(evaluates) else { return };
    let Ok(artefact) = proto::artefact_id(artefact) else { return };
    let reader = project.clone();
    match tokio::task::spawn_blocking(move || reader.figures_of(artefact).map(|figures| reader.add_figures(figures)))
        .await
    {
        Ok(Ok(())) => {
            let [psnr, ssim, perceptual] = project.quality();
            if let Some(job) = feed.board().remeasured(job) {
                (job.psnr, job.ssim, job.perceptual) = (psnr.or(job.psnr), ssim, perceptual);
            }
        }
        Ok(Err(problem)) => tracing::warn!("job {job}: {problem}"),
        Err(error) => tracing::warn!("job {job}: {error}"),
    }
}
