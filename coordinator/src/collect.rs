//! What a job leaves in the store, deleted once the job is not wanted any more: its plan, its tasks' results, and the records by
//! which workers would find them again. What another job or any other record refers to stays.
//!
//! Photos stay, as the record of their ingest refers to them. What a result itself refers to (exposures) stays, too: nothing
//! here knows what the bytes of an artefact mean.

use std::collections::BTreeSet;

use scene::ArtefactId;
use store::{Store, StoreError};

/// Checkpoints hold what they need, and leases name nobody's artefact.
const FOLDERS_WITHOUT_REFERENCES: [&str; 2] = ["checkpoints", proto::leader::FOLDER];

/// What a job that is over leaves, as the coordinator knows it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Leftovers {
    /// Its artefacts, without those of other jobs.
    pub(crate) artefacts: BTreeSet<ArtefactId>,
    /// Of each task the key under which workers remember it.
    pub(crate) keys: BTreeSet<ArtefactId>,
}

impl Leftovers {
    /// Deletes them, and says how many artefacts that were.
    ///
    /// # Errors
    /// The store fails; doing it again goes on.
    pub(crate) async fn delete(mut self, store: &Store) -> Result<u32, StoreError> {
        // First nobody finds them, then they go.
        for key in &self.keys {
            for folder in ["results", "checkpoints"] {
                store.remove_record(&format!("{folder}/{key}")).await?;
            }
        }
        for name in store.record_names("").await? {
            if FOLDERS_WITHOUT_REFERENCES.iter().any(|folder| name.split('/').next() == Some(folder)) {
                continue;
            }
            // Whatever the record means: 32 bytes that are an artefact's name refer to it.
            for part in store.get_record(&name).await?.unwrap_or_default().windows(32) {
                if let Ok(id) = part.try_into() {
                    self.artefacts.remove(&ArtefactId(id));
                }
            }
        }
        for id in &self.artefacts {
            store.remove(*id).await?;
        }
        Ok(self.artefacts.len() as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_others_refer_to_stays() {
        let store = Store::open("memory://").unwrap();
        let mut ids = Vec::new();
        for text in ["plan", "result", "shared result", "ingested", "checkpointed"] {
            ids.push(store.put(text.into()).await.unwrap());
        }
        let [plan, result, shared, ingested, checkpointed] = ids[..] else { panic!("five") };
        let (own, other) = (ArtefactId::of(b"own task"), ArtefactId::of(b"task of another"));
        store.put_record(&format!("results/{own}"), result.0.to_vec().into()).await.unwrap();
        store.put_record(&format!("checkpoints/{own}"), "state".into()).await.unwrap();
        store.put_record(&format!("results/{other}"), shared.0.to_vec().into()).await.unwrap();
        let memo = [b"some bytes before ".as_slice(), &ingested.0, b" and after"].concat();
        store.put_record("ingest/photos", memo.into()).await.unwrap();
        store.put_record(&format!("checkpoints/{other}"), checkpointed.0.to_vec().into()).await.unwrap();
        let left = Leftovers { artefacts: ids.iter().copied().collect(), keys: BTreeSet::from([own]) };
        assert_eq!(left.clone().delete(&store).await.unwrap(), 3);
        for (id, stays) in [(plan, false), (result, false), (shared, true), (ingested, true), (checkpointed, false)] {
            assert_eq!(store.exists(id).await.unwrap(), stays, "{id}");
        }
        let names = store.record_names("").await.unwrap();
        assert_eq!(names, [format!("checkpoints/{other}"), "ingest/photos".into(), format!("results/{other}")]);
        // Once more finds nothing that the first left: those that stay are still referred to.
        assert_eq!(left.delete(&store).await.unwrap(), 3);
        assert!(store.exists(shared).await.unwrap());
    }
}
