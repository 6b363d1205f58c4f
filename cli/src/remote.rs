//! A client of a cluster's coordinator for the commands that query and control it.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use coordinator::{LocalError, Results, of_status};
use proto::watch_event::Event;
use proto::{Access, Client, KeyPair, Outcome, Token};
use scene::{BadInput, BlockId};
use store::Store;
use tokio::runtime::Runtime;
use tonic::{Code, Response, Status};

use crate::args::Connection;
use crate::failure::Failure;
use crate::live_status::TaskNames;
use crate::output::Output;

/// Largest certificate or token file, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Longest pause between two attempts to reconnect.
const MAX_PAUSE: Duration = Duration::from_secs(5);

/// A connection to a coordinator.
pub(crate) struct Remote {
    runtime: Runtime,
    client: Client,
    access: Access,
    /// As given by the user.
    url: String,
    /// Of the coordinator that `client` calls.
    address: String,
    /// The store whose leases name the leader, if no coordinator was named.
    leases: Option<Store>,
}

impl Remote {
    pub(crate) fn open(connection: &Connection) -> Result<Self, Failure> {
        let access = access(connection)?;
        let runtime = runtime()?;
        let url = connection.coordinator.clone();
        let leases = if is_address(&url) { None } else { Some(Store::open(&url)?) };
        let (client, address) = runtime.block_on(find(&url, leases.as_ref(), &access))?;
        Ok(Self { runtime, client, access, url, address, leases })
    }

    /// Makes one call.
    pub(crate) fn call<T>(
        &mut self,
        request: impl AsyncFnOnce(&mut Client) -> Result<Response<T>, Status>,
    ) -> Result<T, Failure> {
        let reply = self.runtime.block_on(request(&mut self.client));
        reply.map(Response::into_inner).map_err(|status| self.failure(status))
    }

    /// The coordinator's store.
    pub(crate) fn store(&self, about: &proto::AboutReply) -> Result<Store, Failure> {
        self.runtime.block_on(shared_store(&about.store_url))
    }

    /// What a job's tasks are called.
    pub(crate) fn names(&mut self, job: u64) -> Result<TaskNames, Failure> {
        let reply = self.call(async |client: &mut Client| client.blocks(proto::BlocksRequest { job }).await)?;
        let columns = reply.level.into_iter().zip(reply.x).zip(reply.y);
        let blocks = columns.map(|((level, x), y)| format!("{level}/{x}/{y}").parse::<BlockId>());
        let blocks = blocks.collect::<Result<_, _>>();
        let blocks = blocks.map_err(|error| Failure::Work(format!("the coordinator's answer: {error}")))?;
        Ok(TaskNames { blocks, first_detection: reply.first_detection, first_object: reply.first_object })
    }

    /// Follows a job of this many tasks to its end and passes on each update. If the coordinator is lost, it reconnects and receives the
    /// state again. Returns `None` after Ctrl-C; the job goes on.
    pub(crate) fn follow(
        &mut self,
        job: u64,
        tasks: u32,
        output: &Output,
        mut on_update: impl FnMut(&Results, &Event),
    ) -> Result<Option<(Outcome, Results)>, Failure> {
        let mut results = Results::new(tasks);
        let mut pause = Duration::from_millis(100);
        loop {
            let client = &mut self.client;
            let ended = self.runtime.block_on(async {
                tokio::select! {
                    _ = tokio::signal::ctrl_c() => Ok(None),
                    outcome = watch(client, job, &mut results, &mut on_update, &mut pause) => outcome.map(Some),
                }
            });
            match ended {
                Ok(Some(outcome)) => return Ok(Some((outcome, results))),
                Ok(None) => return Ok(None),
                Err(Lost::Job(error)) => return Err(error.into()),
                Err(Lost::Connection(status)) if is_transient(&status) => {
                    output.note(format!("waiting for the coordinator {}: {}", self.url, proto::explain(&status)));
                    // The timer must be created inside the runtime.
                    self.runtime.block_on(async { tokio::time::sleep(pause).await });
                    // The leader may have changed.
                    let found = self.runtime.block_on(find(&self.url, self.leases.as_ref(), &self.access));
                    if let Ok((client, address)) = found {
                        (self.client, self.address) = (client, address);
                    }
                    pause = MAX_PAUSE.min(2 * pause);
                }
                Err(Lost::Connection(status)) => return Err(self.failure(status)),
            }
        }
    }

    /// Maps a status to bad input or failed work. A coordinator that rejects the certificates looks like one that is not there.
    fn failure(&self, status: Status) -> Failure {
        let is_transient = is_transient(&status);
        if is_transient
            && let Some(rejected) = self.runtime.block_on(proto::rejected_certificate(&self.address, &self.access))
        {
            return rejected.into();
        }
        match of_status(status) {
            LocalError::Failed(line) if is_transient => {
                Failure::Work(format!("the coordinator {} does not answer: {line}; check that it is running", self.url))
            }
            other => other.into(),
        }
    }
}

/// A client of the named coordinator, or of the leader, and that coordinator's URL.
async fn find(url: &str, leases: Option<&Store>, access: &Access) -> Result<(Client, String), Failure> {
    let address = match leases {
        None => url.to_owned(),
        Some(store) => worker::leader_of(store).await.map_err(|status| Failure::Work(status.message().into()))?.address,
    };
    Ok((proto::connect(&address, access)?, address))
}

/// Finds a coordinator for the dashboard as [`Remote::open`] does.
///
/// # Errors
/// A store that cannot be opened, a URL that does not fit the credentials.
pub(crate) fn finder(url: &str, access: Access) -> Result<serve::Find, Failure> {
    if !is_address(url) {
        return Ok(finder_in(Store::open(url)?, access));
    }
    let client = proto::connect(url, &access)?;
    let url = url.to_owned();
    Ok(Arc::new(move || {
        let found = Ok((client.clone(), url.clone()));
        Box::pin(async { found })
    }))
}

/// Finds the leader of the coordinators on a store.
pub(crate) fn finder_in(store: Store, access: Access) -> serve::Find {
    let leases = Arc::new((store, access));
    Arc::new(move || {
        let leases = leases.clone();
        Box::pin(async move {
            let (store, access) = &*leases;
            find(store.url(), Some(store), access).await.map_err(|failure| failure.to_string())
        })
    })
}

/// Whether a URL names a coordinator, and not the store whose leases name one.
fn is_address(url: &str) -> bool {
    ["http://", "https://"].iter().any(|scheme| url.starts_with(scheme)) || !url.contains("://")
}

/// Why watching ended before the job did.
enum Lost {
    Connection(Status),
    Job(LocalError),
}

/// Watches a job until it is over or the stream ends.
async fn watch(
    client: &mut Client,
    job: u64,
    results: &mut Results,
    on_update: &mut impl FnMut(&Results, &Event),
    pause: &mut Duration,
) -> Result<Outcome, Lost> {
    let mut updates = client.watch(proto::WatchRequest { job }).await.map_err(Lost::Connection)?.into_inner();
    while let Some(event) = updates.message().await.map_err(Lost::Connection)? {
        // Updates of kinds that newer coordinators send are ignored.
        let Some(event) = event.event else { continue };
        *pause = Duration::from_millis(100);
        if let Event::Changed(changed) = &event {
            results.update(changed.clone()).map_err(Lost::Job)?;
        }
        on_update(results, &event);
        if let Event::Finished(finished) = event {
            return Ok(finished.outcome());
        }
    }
    Err(Lost::Connection(Status::unavailable("the stream of updates ended")))
}

fn is_transient(status: &Status) -> bool {
    matches!(
        status.code(),
        Code::Unavailable | Code::DeadlineExceeded | Code::Cancelled | Code::Unknown | Code::Internal
    )
}

/// The result of a job that has ended.
pub(crate) fn result_of(job: u64, outcome: Outcome, results: &Results) -> Result<(), Failure> {
    match outcome {
        Outcome::Done => Ok(()),
        Outcome::Incomplete => Err(results.failure().into()),
        Outcome::Cancelled => Err(Failure::Work(format!("job {job} was cancelled"))),
    }
}

/// The runtime for network calls.
pub(crate) fn runtime() -> Result<Runtime, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    runtime.map_err(|error| Failure::Work(format!("cannot start threads: {error}")))
}

/// The store of a coordinator, if its URL names the same store on this machine.
pub(crate) async fn shared_store(url: &str) -> Result<Store, Failure> {
    let store = Store::open(url)?;
    match store.newest_record(proto::leader::FOLDER).await? {
        Some(_) => Ok(store),
        None => {
            let advice =
                "mount it here under the same path, or start the coordinator with a --store that all machines reach";
            Err(BadInput::new(url, "names the coordinator's store, but another one on this machine", advice).into())
        }
    }
}

/// Reads the connection's certificates and token.
pub(crate) fn access(connection: &Connection) -> Result<Access, Failure> {
    let authority = connection.tls_ca.as_deref().map(|path| pem("--tls-ca", path, "CERTIFICATE")).transpose()?;
    let identity = key_pair(&connection.tls_cert, &connection.tls_key)?;
    Ok(Access { authority, identity, token: token(&connection.token_file)? })
}

/// Reads a certificate and its key, if both are given.
pub(crate) fn key_pair(certificate: &Option<PathBuf>, key: &Option<PathBuf>) -> Result<Option<KeyPair>, Failure> {
    let (Some(certificate), Some(key)) = (certificate, key) else { return Ok(None) };
    let (certificate, key) = (pem("--tls-cert", certificate, "CERTIFICATE")?, pem("--tls-key", key, "PRIVATE KEY")?);
    Ok(Some(KeyPair { certificate, key }))
}

/// Reads a token file.
pub(crate) fn token(path: &Option<PathBuf>) -> Result<Option<Token>, Failure> {
    let Some(path) = path else { return Ok(None) };
    let text = String::from_utf8(small_file("--token-file", path)?).unwrap_or_default();
    let token = Token::new(&text).map_err(|problem| {
        BadInput::new(path.display().to_string(), problem, "write one there, for example by `openssl rand -hex 32`")
    });
    Ok(Some(token?))
}

/// Reads a PEM file that has a part of this kind.
pub(crate) fn pem(flag: &str, path: &Path, part: &str) -> Result<Vec<u8>, Failure> {
    let bytes = small_file(flag, path)?;
    let text = String::from_utf8_lossy(&bytes);
    if text.lines().any(|line| line.starts_with("-----BEGIN ") && line.trim_end().ends_with(&format!("{part}-----"))) {
        return Ok(bytes);
    }
    let problem = format!("holds no {}", part.to_lowercase());
    Err(BadInput::new(path.display().to_string(), problem, format!("give {flag} a PEM file with one")).into())
}

fn small_file(flag: &str, path: &Path) -> Result<Vec<u8>, Failure> {
    let bad = |problem: String| BadInput::new(path.display().to_string(), problem, format!("give {flag} a file"));
    let unreadable = |error: std::io::Error| bad(format!("cannot be read ({error})"));
    let length = fs::metadata(path).map_err(unreadable)?.len();
    if length > MAX_FILE_BYTES {
        return Err(bad(format!("has {length} bytes, which is too large")).into());
    }
    Ok(fs::read(path).map_err(unreadable)?)
}
