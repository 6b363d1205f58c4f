//! Deletes the objects of a forgotten job from the store: its plan, its tasks' results, and the records by which workers find them. Objects
//! that another job or any other record refers to are kept.
//!
//! Photos are kept, as the record of their ingest refers to them. Objects that a result itself refers to (exposures) are kept as well,
//! because the contents of artefacts are not parsed here.

use std::collections::BTreeSet;

use scene::ArtefactId;
use store::{Store, StoreError};

/// Checkpoints contain their data, and leases name no artefact.
const FOLDERS_WITHOUT_REFERENCES: [&str; 2] = ["checkpoints", proto::leader::FOLDER];

/// The objects of a finished job that may be deleted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Garbage {
    /// Its artefacts, without those of other jobs.
    pub(crate) artefacts: BTreeSet<ArtefactId>,
    /// The key of each task's result and checkpoint records.
    pub(crate) keys: BTreeSet<ArtefactId>,
}

impl Garbage {
    /// Deletes them; returns the number of artefacts that were deleted.
    ///
    /// # Errors
    /// The store fails; the deletion can be repeated.
    pub(crate) async fn delete(mut self, store: &Store) -> Result<u32, StoreError> {
        // The records are removed first, so that no worker finds a result that is about to be deleted.
        for key in &self.keys {
            for folder in ["results", "checkpoints"] {
                store.remove_record(&format!("{folder}/{key}")).await?;
            }
        }
        for name in store.record_names("").await? {
            if FOLDERS_WITHOUT_REFERENCES.iter().any(|folder| name.split('/').next() == Some(folder)) {
                continue;
            }
            // Any 32 bytes of a record that equal an artefact's name count as a reference.
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
    async fn referenced_objects_are_kept() {
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
        let garbage = Garbage { artefacts: ids.iter().copied().collect(), keys: BTreeSet::from([own]) };
        assert_eq!(garbage.clone().delete(&store).await.unwrap(), 3);
        for (id, stays) in [(plan, false), (result, false), (shared, true), (ingested, true), (checkpointed, false)] {
            assert_eq!(store.exists(id).await.unwrap(), stays, "{id}");
        }
        let names = store.record_names("").await.unwrap();
        assert_eq!(names, [format!("checkpoints/{other}"), "ingest/photos".into(), format!("results/{other}")]);
        // A second run deletes nothing more: the rest is still referred to.
        assert_eq!(garbage.delete(&store).await.unwrap(), 3);
        assert!(store.exists(shared).await.unwrap());
    }
}
