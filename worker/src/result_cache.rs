//! Finds what earlier attempts left of a task in the store: its result, or a checkpoint.
//!
//! A result is a function of the plan, which names the backend, and of the task's inputs. So both records are named by the hash of
//! those. A record appears whole or not at all; a damaged one counts as absent, and a failed write is only logged.

use std::sync::atomic::{AtomicBool, Ordering};

use scene::ArtefactId;
use store::BlockingStore;
use train::State;

use crate::task::{FULL_RATE, TaskOrder};

/// The records of one task.
#[derive(Debug)]
pub(crate) struct ResultCache {
    result: String,
    checkpoint: String,
    /// No checkpoint was found or written, so that none has to be removed; spares a request to the store.
    has_no_checkpoint: AtomicBool,
}

impl ResultCache {
    pub(crate) fn of(order: &TaskOrder) -> Self {
        let key = proto::result_key(order.plan, order.task, &order.inputs);
        // A retry at a lower rate must not start from the first run's checkpoint: the result would depend on when that was written.
        let slower = if order.rate_permille < FULL_RATE { "-slower" } else { "" };
        Self {
            result: format!("results/{key}"),
            checkpoint: format!("checkpoints/{key}{slower}"),
            has_no_checkpoint: false.into(),
        }
    }

    /// The result and its id, if it is there and `decode` accepts it.
    pub(crate) fn result<T>(
        &self,
        store: &BlockingStore,
        decode: impl FnOnce(&[u8]) -> Option<T>,
    ) -> Option<(ArtefactId, T)> {
        let id = ArtefactId(store.get_record(&self.result).ok()??.as_ref().try_into().ok()?);
        Some((id, decode(&store.get_or_discard(id).ok()??)?))
    }

    /// Records the result and empties the checkpoint, which is large and no longer needed.
    pub(crate) fn put_result(&self, store: &BlockingStore, id: ArtefactId) {
        log_error(store.put_record(&self.result, id.0.to_vec()));
        let may_exist = !self.has_no_checkpoint.load(Ordering::Relaxed);
        if may_exist
            && store.get_record(&self.checkpoint).is_ok_and(|found| found.is_some_and(|bytes| !bytes.is_empty()))
        {
            log_error(store.put_record(&self.checkpoint, Vec::new()));
        }
    }

    pub(crate) fn checkpoint(&self, store: &BlockingStore) -> Option<State> {
        let found = store.get_record(&self.checkpoint).ok()?;
        self.has_no_checkpoint.store(found.is_none(), Ordering::Relaxed);
        State::from_frame(&found?).ok()
    }

    /// Writes a checkpoint; false if that failed.
    pub(crate) fn put_checkpoint(&self, store: &BlockingStore, state: &State) -> bool {
        self.has_no_checkpoint.store(false, Ordering::Relaxed);
        tracing::info_span!("checkpoint").in_scope(|| log_error(store.put_record(&self.checkpoint, state.to_frame())))
    }
}

/// Whether the write succeeded.
fn log_error(outcome: Result<(), store::StoreError>) -> bool {
    if let Err(error) = &outcome {
        tracing::warn!("a result or checkpoint could not be recorded: {error}");
    }
    outcome.is_ok()
}
