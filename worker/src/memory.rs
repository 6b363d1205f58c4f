//! What earlier runs left of a task: its result, or a checkpoint on the way.
//!
//! A task's result is a function of its plan, which names the backend, and of its inputs. So their hash is its name, and whoever
//! finds the name need not train. Both are records that appear whole or not at all; one that is damaged, or cannot be written, is as none.

use std::sync::atomic::{AtomicBool, Ordering};

use scene::{ArtefactId, Splats, frame};
use store::BlockingStore;
use train::State;

use crate::{FULL_RATE, TaskOrder};

/// Names of what is remembered of a task.
#[derive(Debug)]
pub(crate) struct Memory {
    result: String,
    checkpoint: String,
    /// There is no checkpoint, as was seen: nothing to take back, and no way to the store to look.
    bare: AtomicBool,
}

impl Memory {
    pub(crate) fn of(order: &TaskOrder) -> Self {
        let key = proto::memory_key(order.plan, order.task, &order.inputs);
        // At a lower rate training begins anew: from a checkpoint, the result would hang on when that was made.
        let slower = if order.rate_permille < FULL_RATE { "-slower" } else { "" };
        Self { result: format!("results/{key}"), checkpoint: format!("checkpoints/{key}{slower}"), bare: false.into() }
    }

    pub(crate) fn result(&self, store: &BlockingStore) -> Option<(ArtefactId, Splats)> {
        let id = ArtefactId(store.get_name(&self.result).ok()??.as_ref().try_into().ok()?);
        let splats = frame::decode_splats(&store.get_or_discard(id).ok()??).ok()?;
        Some((id, splats))
    }

    pub(crate) fn keep_result(&self, store: &BlockingStore, id: ArtefactId) {
        kept(store.put_name(&self.result, id.0.to_vec()));
        // Its room is worth more than it is.
        let looks = !self.bare.load(Ordering::Relaxed);
        if looks && store.get_name(&self.checkpoint).is_ok_and(|found| found.is_some_and(|bytes| !bytes.is_empty())) {
            kept(store.put_name(&self.checkpoint, Vec::new()));
        }
    }

    pub(crate) fn checkpoint(&self, store: &BlockingStore) -> Option<State> {
        let found = store.get_name(&self.checkpoint).ok()?;
        self.bare.store(found.is_none(), Ordering::Relaxed);
        State::from_frame(&found?).ok()
    }

    /// Whether it is there now.
    pub(crate) fn keep_checkpoint(&self, store: &BlockingStore, state: &State) -> bool {
        self.bare.store(false, Ordering::Relaxed);
        tracing::info_span!("checkpoint").in_scope(|| kept(store.put_name(&self.checkpoint, state.to_frame())))
    }
}

fn kept(outcome: Result<(), store::StoreError>) -> bool {
    if let Err(error) = &outcome {
        tracing::warn!("what was reached is not kept: {error}");
    }
    outcome.is_ok()
}
