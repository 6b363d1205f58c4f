//! The connection to the leading coordinator, at a fixed address or by the lease that it keeps in the store.

use std::time::Duration;

use proto::leader::{FOLDER, Leader};
use proto::{Access, Client};
use scene::{ArtefactId, BadInput};
use store::Store;
use tonic::{Code, Status};

use crate::options::{Options, WorkerError};

/// Longest pause between two tries to reach a coordinator.
const MAX_BACKOFF: Duration = Duration::from_secs(5);

/// A connection to the leader, re-established after errors.
pub(crate) struct CoordinatorLink {
    discovery: Discovery,
    access: Access,
    client: Option<Client>,
    /// The address of the last connection.
    address: Option<String>,
    /// The highest epoch seen in a lease or in a grant.
    epoch: u64,
    backoff: Backoff,
}

/// How the leader's address is found.
enum Discovery {
    Address(String),
    Lease(Store),
}

impl CoordinatorLink {
    /// Connects when it is first used.
    ///
    /// # Errors
    /// A URL that names neither a coordinator nor a store, or that does not fit the credentials.
    pub(crate) fn new(options: &Options) -> Result<Self, WorkerError> {
        let url = &options.coordinator_url;
        let discovery = if url.starts_with("http://") || url.starts_with("https://") {
            proto::connect(url, &options.access)?;
            Discovery::Address(url.clone())
        } else if url.contains("://") {
            Discovery::Lease(Store::open(url).map_err(|error| bad_url(url, &error.to_string()))?)
        } else {
            return Err(bad_url(url, "is neither the URL of a coordinator nor that of a store"));
        };
        let (access, backoff) = (options.access.clone(), Backoff::new(&options.worker_id));
        Ok(Self { discovery, access, client: None, address: None, epoch: 0, backoff })
    }

    /// The client of the leader. Connects if there is no connection.
    pub(crate) async fn client(&mut self) -> Result<&mut Client, Status> {
        if self.client.is_none() {
            let url = match &self.discovery {
                Discovery::Address(url) => url.clone(),
                Discovery::Lease(store) => {
                    let lease = leader_of(store).await?;
                    if lease.epoch < self.epoch {
                        return Err(Status::unavailable("the store shows a lease that is older than one seen before"));
                    }
                    self.epoch = lease.epoch;
                    lease.address
                }
            };
            let client = proto::connect(&url, &self.access);
            self.client = Some(client.map_err(|error| Status::failed_precondition(error.to_string()))?);
            self.address = Some(url);
        }
        self.client.as_mut().ok_or_else(|| Status::internal("no connection"))
    }

    /// Why the last connection can never be made with these certificates; `None` if the error may be transient. Opens a connection of
    /// its own, because gRPC does not report the TLS alert reliably.
    pub(crate) async fn rejected_certificate(&self) -> Option<BadInput> {
        proto::rejected_certificate(self.address.as_deref()?, &self.access).await
    }

    /// Drops the connection after a transient error; the next call finds the leader anew. Returns the pause before it.
    pub(crate) fn disconnect(&mut self) -> Duration {
        self.client = None;
        self.backoff.next()
    }

    /// A call was answered.
    pub(crate) fn reset_backoff(&mut self) {
        self.backoff.tries = 0;
    }

    /// Records the epoch of a grant.
    pub(crate) fn observe_epoch(&mut self, epoch: u64) {
        self.epoch = self.epoch.max(epoch);
    }

    /// The request for a task.
    pub(crate) fn lease_request(&self, options: &Options) -> proto::LeaseRequest {
        let Options { worker_id: worker, backend, memory_bytes, .. } = options.clone();
        proto::LeaseRequest { worker, backend, memory_bytes, epoch: self.epoch, ..Default::default() }
    }
}

/// Whether the same call may succeed later.
pub(crate) fn is_transient(status: &Status) -> bool {
    matches!(
        status.code(),
        Code::Unavailable
            | Code::DeadlineExceeded
            | Code::Cancelled
            | Code::Unknown
            | Code::Internal
            | Code::ResourceExhausted
    )
}

/// The current leader's lease on a store.
///
/// # Errors
/// `Unavailable` with the reason, if there is no leader or its lease cannot be read.
pub async fn leader_of(store: &Store) -> Result<Leader, Status> {
    let newest = store.newest_record(FOLDER).await.map_err(|error| Status::unavailable(error.to_string()))?;
    let (epoch, bytes) =
        newest.ok_or_else(|| Status::unavailable(format!("no coordinator has led on {}", store.url())))?;
    let lease = Leader::from_bytes(epoch, &bytes).map_err(Status::unavailable)?;
    if lease.released {
        return Err(Status::unavailable("the coordinator has left, and none has followed yet"));
    }
    Ok(lease)
}

fn bad_url(url: &str, problem: &str) -> WorkerError {
    let advice = "give the coordinator as http://host:port, or the store that it keeps its lease in";
    BadInput::new("--coordinator", format!("'{url}': {problem}"), advice).into()
}

/// Exponential backoff from 0.1 s to [`MAX_BACKOFF`] with jitter over the second half of each pause, so that workers which lost the
/// same coordinator do not reconnect at the same time. The jitter is a function of the worker's name.
#[derive(Debug)]
struct Backoff {
    seed: u64,
    drawn: u64,
    tries: u32,
}

impl Backoff {
    fn new(name: &str) -> Self {
        Self { seed: ArtefactId::of(name.as_bytes()).seed(), drawn: 0, tries: 0 }
    }

    fn next(&mut self) -> Duration {
        let longest = (Duration::from_millis(100) * 2u32.pow(self.tries.min(10))).min(MAX_BACKOFF);
        self.tries += 1;
        self.drawn += 1;
        let jitter = ArtefactId::of(&[self.seed.to_le_bytes(), self.drawn.to_le_bytes()].concat()).seed();
        longest.mul_f64(0.5 + 0.5 * (jitter as f64 / u64::MAX as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backoff_grows_differs_between_workers_and_is_deterministic() {
        let pauses = |name: &str| {
            let mut backoff = Backoff::new(name);
            (0..12).map(|_| backoff.next()).collect::<Vec<_>>()
        };
        let one = pauses("w1");
        assert_eq!(one, pauses("w1"));
        assert_ne!(one, pauses("w2"));
        for (tries, pause) in one.iter().enumerate() {
            let longest = (Duration::from_millis(100) * 2u32.pow(tries as u32)).min(MAX_BACKOFF);
            assert!(longest / 2 <= *pause && *pause <= longest, "{tries}: {pause:?}");
        }
    }

    #[tokio::test]
    async fn the_newest_lease_names_the_leader() {
        let folder = tempfile::tempdir().unwrap();
        let url = url_of(folder.path());
        let store = Store::open(&url).unwrap();
        let options = options(&url);
        let mut link = CoordinatorLink::new(&options).unwrap();
        assert!(link.client().await.unwrap_err().message().starts_with("no coordinator has led on "));
        let lease =
            |epoch: u64, released| Leader { epoch, address: format!("http://127.0.0.1:{epoch}"), beat: 0, released };
        for epoch in [3, 17] {
            store.put_record(&lease(epoch, false).name(), lease(epoch, false).to_bytes().into()).await.unwrap();
        }
        assert!(link.client().await.is_ok() && link.epoch == 17);
        // An open connection is kept, whatever the lease says.
        store.put_record(&lease(17, true).name(), lease(17, true).to_bytes().into()).await.unwrap();
        assert!(link.client().await.is_ok());
        link.disconnect();
        assert!(link.client().await.unwrap_err().message().contains("has left"));
        store.remove_record(&lease(17, true).name()).await.unwrap();
        assert!(link.client().await.unwrap_err().message().contains("older than one seen before"));
    }

    #[test]
    fn a_url_of_neither_coordinator_nor_store_is_refused() {
        for bad in ["", "host:7070", "gs://bucket", "http://a b", "file://relative"] {
            let options = options(bad);
            let line = CoordinatorLink::new(&options).err().map(|error| error.to_string()).unwrap_or_default();
            assert!(line.starts_with("--coordinator") && line.contains("http://host:port"), "{bad}: {line}");
        }
    }

    fn options(url: &str) -> Options {
        let access = Access::default();
        Options { coordinator_url: url.into(), access, worker_id: "w".into(), backend: "b".into(), memory_bytes: 0 }
    }

    fn url_of(folder: &std::path::Path) -> String {
        format!("file://{}", folder.display())
    }
}
