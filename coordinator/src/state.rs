//! The durable state of a coordinator: a slatedb below `state/` of the job's store.
//!
//! ```text
//! epoch                   u64, of the coordinator that opened it last
//! next_job                u64; job numbers are never reused
//! job/<16 hex>            header of a job, its plan and its parent span
//! task/<16 hex>/<8 hex>   a task's record
//! worker/<8 hex>          the name of a worker by its number
//! log/<16 hex>/<16 hex>   a line of a job's log by its number
//! ```
//! Each value is a `scene::frame` with kind, version and checksum. Opening the state fences the previous writer: its next write fails,
//! however late it comes. This only requires that the store creates objects atomically. Each write is one atomic batch, and returns once
//! it is durable in the store.
//!
//! On `file://` the state survives the crash of any process. After a power loss it depends on the file system's handling of renames.

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

use crate::log::{Line, LogChanges};

/// The database's folder below the store's URL.
const FOLDER: &str = "state";
/// Writes after which the write-ahead log is flushed to a table, because replaying many log files makes a takeover slow. slatedb itself
/// does so after 4,096 at the earliest.
const WRITES_PER_FLUSH: u32 = 128;

const NUMBER: Kind = Kind(*b"numb", 1);
const JOB: Kind = Kind(*b"job ", 2);
/// The version without a parent span.
const UNTRACED_JOB: Kind = Kind(*b"job ", 1);
const TASK: Kind = Kind(*b"task", 1);
const NAME: Kind = Kind(*b"name", 1);
const LINE: Kind = Kind(*b"line", 1);

/// Why the durable state cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StateError {
    /// Another coordinator has taken over.
    #[error("another coordinator has taken over: this one no longer leads")]
    Fenced,
    /// The store fails.
    #[error("the durable state in {store} cannot be {action}: {reason}; plat doctor --store {store} checks the store")]
    Failed {
        /// The store's URL.
        store: String,
        /// opened, read, written
        action: &'static str,
        /// The database's error.
        reason: String,
    },
    /// The state was not written by a coordinator.
    #[error(
        "the durable state in {store} is damaged: {problem}; move its folder '{FOLDER}' away to start without jobs"
    )]
    Damaged {
        /// The store's URL.
        store: String,
        /// What is wrong.
        problem: String,
    },
}

/// The changes of one write.
#[derive(Debug, Default)]
pub(crate) struct Batch {
    pub(crate) changes: Changes,
    /// The origins of the jobs whose headers are written.
    pub(crate) origins: BTreeMap<JobId, Origin>,
    /// New workers by number.
    pub(crate) workers: BTreeMap<u32, String>,
    pub(crate) next_job: Option<u64>,
    pub(crate) log: LogChanges,
}

impl Batch {
    pub(crate) fn is_empty(&self) -> bool {
        self.changes.is_empty() && self.workers.is_empty() && self.next_job.is_none() && self.log.is_empty()
    }
}

/// The content of the state.
#[derive(Debug, Default)]
pub(crate) struct Restored {
    pub(crate) snapshot: Snapshot,
    pub(crate) origins: BTreeMap<JobId, Origin>,
    /// Names of workers by number.
    pub(crate) workers: Vec<String>,
    pub(crate) next_job: u64,
    /// Lines of the jobs' logs, in any order.
    pub(crate) lines: Vec<Line>,
}

/// The constant part of a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Origin {
    pub(crate) plan: ArtefactId,
    /// The parent span of its tasks.
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
    /// Opens the state of a store, fences the previous writer, and takes the next epoch, which is above `seen` as well.
    pub(crate) async fn take_over(store: &Store, seen: u64) -> Result<(Self, Restored), StateError> {
        let store_url = store.url().to_owned();
        // The actor groups writes itself and flushes each, so a flush timer would only delay them.
        let settings = Settings { flush_interval: None, ..Settings::default() };
        // Each row is read once, at the start, so a cache has no use.
        let builder = Db::builder(FOLDER, store.objects()).with_settings(settings).with_db_cache_disabled();
        let db = builder.build().await.map_err(|error| match is_lost_race(&error) {
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
        self.epoch = seen.checked_add(1).ok_or_else(|| self.damaged("its epoch is the largest possible"))?;
        // The epoch is taken once this is durable. If two coordinators open the state at once, the first one fails here.
        let mut batch = WriteBatch::new();
        batch.put(b"epoch", number(self.epoch));
        self.put(batch).await?;
        Ok(restored)
    }

    pub(crate) fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Makes a batch durable atomically.
    pub(crate) async fn write(&self, batch: Batch) -> Result<(), StateError> {
        let mut rows = WriteBatch::new();
        let is_forgotten = |job: &JobId| matches!(batch.changes.headers.get(job), Some(None));
        for line in batch.log.added.iter().filter(|line| !is_forgotten(&line.job)) {
            rows.put(line_key(line.job, line.number), frame::encode(LINE, line, &[]));
        }
        for (job, number) in batch.log.dropped {
            rows.delete(line_key(job, number));
        }
        for (job, header) in batch.changes.headers {
            match (header, batch.origins.get(&job)) {
                (Some(header), Some(origin)) => {
                    let origin = origin.clone();
                    rows.put(job_key(job), frame::encode(JOB, &JobRow { header, origin }, &[]))
                }
                (Some(_), None) => return Err(self.damaged(&format!("job {} has no plan", job.0))),
                (None, _) => {
                    rows.delete(job_key(job));
                    for of_job in ["task", "log"] {
                        for (key, _) in self.read(&format!("{of_job}/{:016x}/", job.0)).await? {
                            rows.delete(key);
                        }
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
        if self.writes.fetch_add(1, Ordering::Relaxed) + 1 >= WRITES_PER_FLUSH {
            self.writes.store(0, Ordering::Relaxed);
            let table = FlushOptions { flush_type: FlushType::MemTable };
            self.db.flush_with_options(table).await.map_err(failed(&self.store_url, "written"))?;
        }
        Ok(())
    }

    /// Closes the database. All writes are durable already.
    pub(crate) async fn close(&self) {
        if let Err(error) = self.db.close().await {
            tracing::warn!("closing the durable state failed: {error}");
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
        for (key, value) in self.read("log/").await? {
            let line: Line = self.decode(LINE, &key, &value)?;
            if key != line_key(line.job, line.number) {
                return Err(self.damaged(&format!("'{key}' is line {} of job {}", line.number, line.job.0)));
            }
            restored.lines.push(line);
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

    /// All rows with this key prefix, ordered by key.
    async fn read(&self, prefix: &str) -> Result<Vec<(String, Bytes)>, StateError> {
        let failed = |error| failed(&self.store_url, "read")(error);
        // Keys have no byte above '~'.
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

    pub(crate) fn damaged(&self, problem: &str) -> StateError {
        StateError::Damaged { store: self.store_url.clone(), problem: problem.into() }
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

fn line_key(job: JobId, number: u64) -> String {
    format!("log/{:016x}/{number:016x}", job.0)
}

/// Whether another coordinator opened the state at the same moment and won. slatedb 0.18 reports this as [`ErrorKind::Data`] without a
/// source, so only the text tells it from damaged data. The test `one_of_many_concurrent_openers_can_write` fails if the text changes.
fn is_lost_race(error: &slatedb::Error) -> bool {
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
mod tests;
