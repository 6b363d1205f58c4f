//! The durable state: what a coordinator that starts anew goes on from, in a slatedb below `state/` of the job's own store.
//!
//! ```text
//! epoch            u64, of whoever opened it last
//! next_job         u64, numbers of jobs are used once
//! job/<16 hex>     header of a job, its plan and the span that it is traced under
//! task/<16 hex>/<8 hex>   a task's record
//! worker/<8 hex>   the name of a worker, so that its number means the same again
//! ```
//! Each value is a `scene::frame` with its kind, version and checksum. Opening fences whoever had it open: its next write fails,
//! however late it comes, which rests on objects being created atomically and on nothing else. Writes are one batch each, all
//! or nothing, and have returned only once they lie in the store.
//!
//! On `file://` this outlives the death of any process; a loss of power only as far as the file system keeps what was renamed.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};

use cluster::{Changes, JobHeader, JobId, JobSnapshot, Snapshot, TaskRecord};
use scene::frame::{self, Kind};
use scene::{ArtefactId, CodecError};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use slatedb::bytes::Bytes;
use slatedb::config::{FlushOptions, FlushType, Settings};
use slatedb::{CloseReason, Db, ErrorKind, WriteBatch};
use store::Store;
use telemetry::TraceParent;

/// Where the database lies below the store's URL.
const FOLDER: &str = "state";
/// A log of many files makes taking over slow. slatedb merges it after 4,096 and takes no smaller number, so it is told to after
/// so many writes.
const WRITES_PER_MERGE: u32 = 128;

const NUMBER: Kind = Kind(*b"numb", 1);
const JOB: Kind = Kind(*b"job ", 2);
/// Of before jobs were traced.
const UNTRACED_JOB: Kind = Kind(*b"job ", 1);
const TASK: Kind = Kind(*b"task", 1);
const NAME: Kind = Kind(*b"name", 1);

/// Why the durable state cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StateError {
    /// Another coordinator has taken over.
    #[error("another coordinator has taken over: this one no longer leads")]
    Fenced,
    /// The store does not do what is asked.
    #[error(
        "the durable state in {store} cannot be {action}: {reason}; plat doctor --store {store} says whether it is fit"
    )]
    Failed {
        /// The store's URL.
        store: String,
        /// opened, read, written
        action: &'static str,
        /// What the database said.
        reason: String,
    },
    /// It is not what a coordinator wrote.
    #[error("the durable state in {store} is damaged: {what}; move its folder '{FOLDER}' away to begin with no jobs")]
    Damaged {
        /// The store's URL.
        store: String,
        /// What is wrong.
        what: String,
    },
}

/// What one write makes durable.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    pub(crate) changes: Changes,
    /// Where the jobs came from whose header is written.
    pub(crate) origins: BTreeMap<JobId, Origin>,
    /// Workers that were not there before, by number.
    pub(crate) workers: BTreeMap<u32, String>,
    pub(crate) next_job: Option<u64>,
}

impl Batch {
    pub(crate) fn is_empty(&self) -> bool {
        self.changes.is_empty() && self.workers.is_empty() && self.next_job.is_none()
    }
}

/// What was durable.
#[derive(Debug, Default)]
pub(crate) struct Restored {
    pub(crate) snapshot: Snapshot,
    pub(crate) origins: BTreeMap<JobId, Origin>,
    /// Names of workers, by number.
    pub(crate) workers: Vec<String>,
    pub(crate) next_job: u64,
}

/// What a job came with, and keeps.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Origin {
    pub(crate) plan: ArtefactId,
    /// The span that its tasks are part of.
    pub(crate) traced: Option<TraceParent>,
}

#[derive(Serialize, Deserialize)]
struct JobRow {
    header: JobHeader,
    origin: Origin,
}

#[derive(Serialize, Deserialize)]
struct UntracedJobRow {
    header: JobHeader,
    plan: ArtefactId,
}

/// The durable state, open for writing under an epoch of its own.
pub(crate) struct State {
    db: Db,
    store_url: String,
    epoch: u64,
    writes: AtomicU32,
}

impl State {
    /// Opens the state of this store, fences whoever had it open, and takes the next epoch, above `seen` as well.
    pub(crate) async fn take_over(store: &Store, seen: u64) -> Result<(Self, Restored), StateError> {
        let store_url = store.url().to_owned();
        // Writes are pushed out one by one: what comes while one is under way shares the next, so nothing need wait to be joined.
        let settings = Settings { flush_interval: None, ..Settings::default() };
        // All of it fits into memory, where the scheduler has it anyway: what is read once need not be cached.
        let builder = Db::builder(FOLDER, store.objects()).with_settings(settings).with_db_cache_disabled();
        let db = builder.build().await.map_err(|error| match is_outrun(&error) {
            true => StateError::Fenced,
            false => failed(&store_url, "opened")(error),
        })?;
        let mut state = Self { db, store_url, epoch: 0, writes: AtomicU32::new(0) };
        match state.begin(seen).await {
            Ok(restored) => Ok((state, restored)),
            Err(error) => {
                state.close().await;
                Err(error)
            }
        }
    }

    async fn begin(&mut self, seen: u64) -> Result<Restored, StateError> {
        let restored = self.read_all().await?;
        let seen = seen.max(restored.snapshot.epoch);
        self.epoch = seen.checked_add(1).ok_or_else(|| self.damaged("its epoch is the last there is"))?;
        // Only once this is durable is the epoch ours: of two that open at once, the first fails here.
        let mut batch = WriteBatch::new();
        batch.put(b"epoch", number(self.epoch));
        self.put(batch).await?;
        Ok(restored)
    }

    pub(crate) fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Makes a batch durable, all of it or nothing.
    pub(crate) async fn write(&self, batch: Batch) -> Result<(), StateError> {
        let mut rows = WriteBatch::new();
        for (job, header) in batch.changes.headers {
            match (header, batch.origins.get(&job)) {
                (Some(header), Some(origin)) => {
                    let origin = origin.clone();
                    rows.put(job_key(job), frame::encode(JOB, &JobRow { header, origin }, &[]))
                }
                (Some(_), None) => return Err(self.damaged(&format!("job {} has no plan", job.0))),
                (None, _) => {
                    rows.delete(job_key(job));
                    for (key, _) in self.read(&format!("task/{:016x}/", job.0)).await? {
                        rows.delete(key);
                    }
                }
            }
        }
        for ((job, task), record) in &batch.changes.records {
            rows.put(task_key(*job, task.0), frame::encode(TASK, record, &[]));
        }
        for (worker, name) in &batch.workers {
            rows.put(format!("worker/{worker:08x}"), frame::encode(NAME, name, &[]));
        }
        if let Some(next_job) = batch.next_job {
            rows.put(b"next_job", number(next_job));
        }
        self.put(rows).await?;
        if self.writes.fetch_add(1, Ordering::Relaxed) + 1 >= WRITES_PER_MERGE {
            self.writes.store(0, Ordering::Relaxed);
            let merge = FlushOptions { flush_type: FlushType::MemTable };
            self.db.flush_with_options(merge).await.map_err(failed(&self.store_url, "written"))?;
        }
        Ok(())
    }

    /// Lets go of it. What was written is durable already.
    pub(crate) async fn close(&self) {
        if let Err(error) = self.db.close().await {
            tracing::warn!("the durable state is not closed well: {error}");
        }
    }

    async fn put(&self, rows: WriteBatch) -> Result<(), StateError> {
        let written = self.db.write(rows).await.map_err(failed(&self.store_url, "written"))?;
        let log = FlushOptions { flush_type: FlushType::Wal };
        self.db.flush_with_options(log).await.map_err(failed(&self.store_url, "written"))?;
        written.await_durable().await.map_err(failed(&self.store_url, "written"))
    }

    async fn read_all(&self) -> Result<Restored, StateError> {
        let one = async |key: &str| match self.read(key).await?.first() {
            Some((_, value)) => self.decode::<u64>(NUMBER, key, value).map(Some),
            None => Ok(None),
        };
        let snapshot = Snapshot { epoch: one("epoch").await?.unwrap_or(0), jobs: Vec::new() };
        let mut restored = Restored { snapshot, next_job: one("next_job").await?.unwrap_or(1), ..Restored::default() };
        for (key, value) in self.read("worker/").await? {
            let name: String = self.decode(NAME, &key, &value)?;
            if key != format!("worker/{:08x}", restored.workers.len()) {
                return Err(self.damaged(&format!("'{key}' does not follow the worker before it")));
            }
            restored.workers.push(name);
        }
        for (key, value) in self.read("job/").await? {
            let JobRow { header, origin } = self.job_row(&key, &value)?;
            let id = header.id;
            if key != job_key(id) || id.0 >= restored.next_job {
                return Err(self.damaged(&format!("'{key}' is of job {}", id.0)));
            }
            let mut tasks = Vec::new();
            for (key, value) in self.read(&format!("task/{:016x}/", id.0)).await? {
                let record: TaskRecord = self.decode(TASK, &key, &value)?;
                if key != task_key(id, tasks.len() as u32) {
                    return Err(self.damaged(&format!("'{key}' does not follow the task before it")));
                }
                tasks.push(record);
            }
            restored.origins.insert(id, origin);
            restored.snapshot.jobs.push(JobSnapshot { header, tasks });
        }
        Ok(restored)
    }

    /// All rows whose key begins so, in the order of their keys.
    async fn read(&self, prefix: &str) -> Result<Vec<(String, Bytes)>, StateError> {
        let failed = |error| failed(&self.store_url, "read")(error);
        // No key has a byte above '~'.
        let mut rows =
            self.db.scan(prefix.as_bytes().to_vec()..[prefix.as_bytes(), b"~"].concat()).await.map_err(failed)?;
        let mut found = Vec::new();
        while let Some(row) = rows.next().await.map_err(failed)? {
            let key = String::from_utf8(row.key.to_vec()).map_err(|_| self.damaged("a key is not text"))?;
            found.push((key, row.value));
        }
        Ok(found)
    }

    fn job_row(&self, key: &str, value: &[u8]) -> Result<JobRow, StateError> {
        match frame::decode(UNTRACED_JOB, value) {
            Ok((UntracedJobRow { header, plan }, _)) => Ok(JobRow { header, origin: Origin { plan, traced: None } }),
            Err(_) => self.decode(JOB, key, value),
        }
    }

    fn decode<T: DeserializeOwned>(&self, kind: Kind, key: &str, value: &[u8]) -> Result<T, StateError> {
        let wrong = |error: CodecError| self.damaged(&format!("'{key}': {error}"));
        frame::decode(kind, value).map(|(value, _)| value).map_err(wrong)
    }

    pub(crate) fn damaged(&self, what: &str) -> StateError {
        StateError::Damaged { store: self.store_url.clone(), what: what.into() }
    }
}

fn number(value: u64) -> Vec<u8> {
    frame::encode(NUMBER, &value, &[])
}

fn job_key(job: JobId) -> String {
    format!("job/{:016x}", job.0)
}

fn task_key(job: JobId, task: u32) -> String {
    format!("task/{:016x}/{task:08x}", job.0)
}

/// Did somebody else open it at the same moment, and was faster? The database has no kind of its own for that.
fn is_outrun(error: &slatedb::Error) -> bool {
    error.kind() == ErrorKind::Data && error.to_string().contains("version already exists")
}

fn failed(store: &str, action: &'static str) -> impl Fn(slatedb::Error) -> StateError {
    let store = store.to_owned();
    move |error| match error.kind() {
        ErrorKind::Closed(CloseReason::Fenced) => StateError::Fenced,
        _ => StateError::Failed { store: store.clone(), action, reason: error.to_string().replace('\n', " ") },
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use cluster::{Action, Event, JobSpec, Offer, Scheduler, TaskIndex, TaskNode, TaskState, WorkerId};

    use super::*;

    async fn open(store: &Store) -> (State, Restored) {
        State::take_over(store, 0).await.unwrap()
    }

    /// Every second job is traced.
    fn origin(job: JobId) -> Origin {
        let parent = TraceParent::parse(&format!("00-{:032x}-{:016x}-01", job.0, job.0));
        Origin { plan: ArtefactId([7; 32]), traced: parent.filter(|_| job.0.is_multiple_of(2)) }
    }

    /// Steps a scheduler and makes durable what a coordinator would.
    async fn step(scheduler: &mut Scheduler, state: &State, event: Event) -> Vec<Action> {
        let actions = scheduler.step(1, event.clone());
        let changes = Changes::of(scheduler, &event, &actions);
        let origins = changes.headers.keys().map(|job| (*job, origin(*job))).collect();
        let next_job = changes.headers.keys().map(|job| job.0 + 1).max();
        let batch = Batch { changes, origins, next_job, ..Batch::default() };
        if !batch.is_empty() {
            state.write(batch).await.unwrap();
        }
        actions
    }

    fn spec(tasks: u32) -> JobSpec {
        let node = |task: u32| TaskNode {
            dependencies: if task > 0 { vec![TaskIndex(0)] } else { vec![] },
            ..TaskNode::default()
        };
        JobSpec { backend: "b".into(), priority: 1, weight: 2, tasks: (0..tasks).map(node).collect() }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn what_a_scheduler_makes_durable_is_its_snapshot() {
        let store = Store::open("memory://").unwrap();
        let (state, restored) = open(&store).await;
        assert_eq!((state.epoch(), restored.snapshot, restored.next_job), (1, Snapshot::default(), 1));
        let mut scheduler = Scheduler::new(cluster::Settings::default(), 1);
        for job in [1, 2, 300] {
            step(&mut scheduler, &state, Event::Submitted { job: JobId(job), spec: spec(20) }).await;
        }
        let worker = WorkerId(0);
        let offer = Offer { backend: "b".into(), ..Offer::default() };
        step(&mut scheduler, &state, Event::Joined { worker, offer }).await;
        let names = BTreeMap::from([(0, "w1".to_owned())]);
        state.write(Batch { workers: names, ..Batch::default() }).await.unwrap();
        for result in 0..5 {
            let granted = step(&mut scheduler, &state, Event::LeaseRequested { worker }).await;
            let attempt = granted.iter().find_map(|action| match action {
                Action::Grant { attempt, .. } => Some(*attempt),
                _ => None,
            });
            let done =
                Event::Completed { attempt: attempt.unwrap(), artefact: ArtefactId([result; 32]), follow_ups: vec![] };
            step(&mut scheduler, &state, done).await;
        }
        step(&mut scheduler, &state, Event::CancelRequested { job: JobId(2) }).await;
        step(&mut scheduler, &state, Event::ForgetRequested { job: JobId(2) }).await;
        step(&mut scheduler, &state, Event::PauseRequested { job: JobId(300) }).await;

        // Dropped, not closed.
        drop(state);
        let (state, restored) = open(&store).await;
        assert_eq!((state.epoch(), restored.next_job), (2, 301));
        assert_eq!(restored.workers, ["w1"]);
        assert_eq!(restored.origins, [1, 300].map(|job| (JobId(job), origin(JobId(job)))).into());
        assert!(restored.origins[&JobId(300)].traced.is_some());
        // What a job had of its share may be stale, and what a task waits for follows from the others.
        let durable = |snapshot: &Snapshot| {
            let mut snapshot = snapshot.clone();
            for job in &mut snapshot.jobs {
                job.header.served = 0;
                let waiting =
                    job.tasks.iter_mut().filter(|task| !task.state.is_final() && task.state.leases().is_empty());
                waiting.for_each(|task| task.state = TaskState::Waiting { missing: 0 });
            }
            (snapshot.epoch, snapshot.jobs)
        };
        assert_eq!(durable(&restored.snapshot), durable(&scheduler.snapshot()));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn the_older_of_two_writers_is_fenced_and_epochs_are_used_once() {
        let store = Store::open("memory://").unwrap();
        let mut open_ones = Vec::new();
        for epoch in 1..=3 {
            let (state, _) = open(&store).await;
            assert_eq!(state.epoch(), epoch);
            open_ones.push(state);
        }
        let name = |name: &str| Batch { workers: BTreeMap::from([(0, name.to_owned())]), ..Batch::default() };
        assert_eq!(open_ones[0].write(name("first")).await, Err(StateError::Fenced));
        open_ones[2].write(name("third")).await.unwrap();
        assert_eq!(open_ones[1].write(name("second")).await, Err(StateError::Fenced));
        let (state, restored) = State::take_over(&store, 17).await.unwrap();
        assert_eq!((state.epoch(), restored.workers), (18, vec!["third".to_owned()]));
    }

    /// In a few rounds: one that is outrun late has fenced the one before it, and then nobody can.
    #[tokio::test(flavor = "multi_thread")]
    async fn of_many_that_take_over_at_once_one_can_write() {
        let store = Store::open("memory://").unwrap();
        let mut seen = 0;
        for _ in 0..20 {
            let opening = (0..6).map(|_| {
                let store = store.clone();
                tokio::spawn(async move { State::take_over(&store, seen).await })
            });
            let opening: Vec<_> = opening.collect();
            let mut opened = Vec::new();
            for one in opening {
                match one.await.unwrap() {
                    Ok((state, _)) => opened.push(Arc::new(state)),
                    Err(error) => assert_eq!(error, StateError::Fenced),
                }
            }
            let epochs: std::collections::BTreeSet<u64> = opened.iter().map(|state| state.epoch()).collect();
            assert_eq!(epochs.len(), opened.len(), "each has an epoch of its own");
            assert!(epochs.iter().all(|epoch| *epoch > seen));
            let mut wrote = 0;
            for state in &opened {
                let batch = Batch { next_job: Some(state.epoch()), ..Batch::default() };
                match state.write(batch).await {
                    Ok(()) => wrote += 1,
                    Err(error) => assert_eq!(error, StateError::Fenced),
                }
            }
            assert!(wrote <= 1);
            if wrote == 1 {
                return;
            }
            seen = epochs.last().copied().unwrap_or(seen);
        }
        panic!("in twenty rounds nobody could write");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn jobs_of_before_they_were_traced_are_read() {
        let store = Store::open("memory://").unwrap();
        let (state, _) = open(&store).await;
        let mut scheduler = Scheduler::new(cluster::Settings::default(), 1);
        step(&mut scheduler, &state, Event::Submitted { job: JobId(2), spec: spec(3) }).await;
        let (header, plan) = (scheduler.header(JobId(2)).unwrap(), ArtefactId([9; 32]));
        let mut rows = WriteBatch::new();
        rows.put(job_key(JobId(2)), frame::encode(UNTRACED_JOB, &UntracedJobRow { header, plan }, &[]));
        state.put(rows).await.unwrap();
        drop(state);
        let (_, restored) = open(&store).await;
        assert_eq!(restored.origins, BTreeMap::from([(JobId(2), Origin { plan, traced: None })]));
        assert_eq!(restored.snapshot.jobs[0].header, scheduler.header(JobId(2)).unwrap());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn rows_that_no_coordinator_wrote_are_named() {
        let store = Store::open("memory://").unwrap();
        for (key, value, words) in [
            ("worker/00000001", frame::encode(NAME, &"w", &[]), "does not follow the worker"),
            ("worker/00000000", b"nonsense".to_vec(), "not a plat 'name' frame"),
            ("next_job", frame::encode(NAME, &"w", &[]), "'next_job'"),
            ("job/0000000000000001", frame::encode(JOB, &"w", &[]), "'job/0000000000000001'"),
        ] {
            let (state, _) = open(&store).await;
            let mut rows = WriteBatch::new();
            rows.put(key, value);
            state.put(rows).await.unwrap();
            let line = State::take_over(&store, 0).await.err().unwrap().to_string();
            assert!(line.contains(words) && line.contains("memory://"), "{line}");
            // Mended by hand: who was refused took no epoch, and fenced the one before.
            let db = Db::builder(FOLDER, store.objects()).build().await.unwrap();
            db.delete(key).await.unwrap();
            db.close().await.unwrap();
        }
    }
}
