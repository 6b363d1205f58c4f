//! The way to the coordinator that leads: at an address, or by the lease that it keeps in the store; lost, and found again.

use std::time::Duration;

use proto::leader::{FOLDER, Leader};
use proto::{Access, Client};
use scene::{ArtefactId, BadInput};
use store::Store;
use tonic::Status;

use crate::{Options, WorkerError};

/// Longest pause between two tries to reach a coordinator that is away.
const BACKOFF_LIMIT: Duration = Duration::from_secs(5);

/// A connection to whoever leads.
pub(crate) struct Link {
    whereabouts: Whereabouts,
    access: Access,
    client: Option<Client>,
    /// The highest epoch that was seen, in a lease or in a grant.
    epoch: u64,
    backoff: Backoff,
}

enum Whereabouts {
    Address(String),
    Lease(Store),
}

impl Link {
    /// Connects when it is first used.
    ///
    /// # Errors
    /// A coordinator that is neither the URL of one nor that of a store, or does not go with the access.
    pub(crate) fn new(options: &Options) -> Result<Self, WorkerError> {
        let url = &options.coordinator_url;
        let whereabouts = if url.starts_with("http://") || url.starts_with("https://") {
            proto::connect(url, &options.access)?;
            Whereabouts::Address(url.clone())
        } else if url.contains("://") {
            Whereabouts::Lease(Store::open(url).map_err(|error| bad(url, &error.to_string()))?)
        } else {
            return Err(bad(url, "is neither the URL of a coordinator nor that of a store"));
        };
        let access = options.access.clone();
        Ok(Self { whereabouts, access, client: None, epoch: 0, backoff: Backoff::new(&options.worker_id) })
    }

    /// The client of whoever leads, as far as is known.
    pub(crate) async fn client(&mut self) -> Result<&mut Client, Status> {
        if self.client.is_none() {
            let url = match &self.whereabouts {
                Whereabouts::Address(url) => url.clone(),
                Whereabouts::Lease(store) => {
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
        }
        self.client.as_mut().ok_or_else(|| Status::internal("no connection"))
    }

    /// A call failed in a way that may pass: before the next one it is looked for again who leads. Returns how long to wait.
    pub(crate) fn lost(&mut self) -> Duration {
        self.client = None;
        self.backoff.next()
    }

    /// A call was answered.
    pub(crate) fn found(&mut self) {
        self.backoff.tries = 0;
    }

    /// The highest epoch that was seen; 0 = none.
    pub(crate) fn epoch(&self) -> u64 {
        self.epoch
    }

    /// A grant says under which epoch it was given.
    pub(crate) fn saw(&mut self, epoch: u64) {
        self.epoch = self.epoch.max(epoch);
    }
}

/// The lease of whoever leads on a store.
///
/// # Errors
/// `Unavailable`, with what is in the way, where nobody leads now.
pub async fn leader_of(store: &Store) -> Result<Leader, Status> {
    let newest = store.newest(FOLDER).await.map_err(|error| Status::unavailable(error.to_string()))?;
    let (epoch, bytes) =
        newest.ok_or_else(|| Status::unavailable(format!("no coordinator has led on {}", store.url())))?;
    let lease = Leader::from_bytes(epoch, &bytes).map_err(Status::unavailable)?;
    if lease.released {
        return Err(Status::unavailable("the coordinator has left, and none has followed yet"));
    }
    Ok(lease)
}

fn bad(url: &str, problem: &str) -> WorkerError {
    let advice = "give the coordinator as http://host:port, or the store that it keeps its lease in";
    BadInput::new("--coordinator", format!("'{url}': {problem}"), advice).into()
}

/// Pauses that double from 0.1 s to [`BACKOFF_LIMIT`], the second half of each by chance, so that workers which lost one
/// coordinator together do not come back together. The chance follows from the worker's name.
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
        let longest = (Duration::from_millis(100) * 2u32.pow(self.tries.min(10))).min(BACKOFF_LIMIT);
        self.tries += 1;
        self.drawn += 1;
        let chance = ArtefactId::of(&[self.seed.to_le_bytes(), self.drawn.to_le_bytes()].concat()).seed();
        longest.mul_f64(0.5 + 0.5 * (chance as f64 / u64::MAX as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_differ_between_workers_and_are_the_same_again() {
        let pauses = |name: &str| {
            let mut backoff = Backoff::new(name);
            (0..12).map(|_| backoff.next()).collect::<Vec<_>>()
        };
        let one = pauses("w1");
        assert_eq!(one, pauses("w1"));
        assert_ne!(one, pauses("w2"));
        for (tries, pause) in one.iter().enumerate() {
            let longest = (Duration::from_millis(100) * 2u32.pow(tries as u32)).min(BACKOFF_LIMIT);
            assert!(longest / 2 <= *pause && *pause <= longest, "{tries}: {pause:?}");
        }
    }

    #[tokio::test]
    async fn the_newest_lease_says_who_leads() {
        let folder = tempfile::tempdir().unwrap();
        let url = url_of(folder.path());
        let store = Store::open(&url).unwrap();
        let options = options(&url);
        let mut link = Link::new(&options).unwrap();
        assert!(link.client().await.unwrap_err().message().starts_with("no coordinator has led on "));
        let lease =
            |epoch: u64, released| Leader { epoch, address: format!("http://127.0.0.1:{epoch}"), beat: 0, released };
        for epoch in [3, 17] {
            store.put_name(&lease(epoch, false).name(), lease(epoch, false).to_bytes().into()).await.unwrap();
        }
        assert!(link.client().await.is_ok() && link.epoch() == 17);
        // A connection that works is kept, whatever the store says.
        store.put_name(&lease(17, true).name(), lease(17, true).to_bytes().into()).await.unwrap();
        assert!(link.client().await.is_ok());
        link.lost();
        assert!(link.client().await.unwrap_err().message().contains("has left"));
        store.remove_name(&lease(17, true).name()).await.unwrap();
        assert!(link.client().await.unwrap_err().message().contains("older than one seen before"));
    }

    #[test]
    fn what_names_no_coordinator_is_refused() {
        for bad in ["", "host:7070", "gs://bucket", "http://a b", "file://relative"] {
            let options = options(bad);
            let line = Link::new(&options).err().map(|error| error.to_string()).unwrap_or_default();
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
