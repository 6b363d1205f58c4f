//! What a block's training uses beyond its task: the store, the backend, the options, and the state that a process's workers share.

use std::sync::Arc;
use std::sync::atomic::AtomicU32;

use store::BlockingStore;
use train::Backend;

use crate::merged_eval::FinishedBlocks;
use crate::metrics::Metrics;
use crate::time_limit::TimeLimit;

/// Resources of a trainer, and what it evaluates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainerOptions {
    /// Threads of the compute pool, at least 1.
    pub threads: usize,
    /// Steps between two evaluations of the merged model so far; 0 = only at the end of a task.
    pub eval_every: u32,
    /// Size of the cache of decoded windows, bytes.
    pub cache_bytes: usize,
    /// Memory budget of the whole process, bytes: a task that exceeds it fails, and goes to another worker. 0 = no limit.
    pub memory_bytes: u64,
    /// Whether to read and write results and checkpoints of earlier runs in the store (never under a time limit).
    pub resume: bool,
    /// Wall seconds between two checkpoints of a task.
    pub checkpoint_seconds: f64,
}

/// State that the workers of one process share for a job.
#[derive(Debug, Default)]
pub struct Shared {
    /// Finished blocks.
    pub finished: FinishedBlocks,
    /// The job's limit in wall time, if there is one.
    pub time_limit: Option<TimeLimit>,
    /// Tasks whose result, or a checkpoint of which, an earlier run left.
    pub resumed: AtomicU32,
    /// Blocks that were kept at their parent's resolution.
    pub settled: AtomicU32,
    /// The worker's metrics.
    pub metrics: Metrics,
}

/// What a block's training uses beyond its task.
pub(crate) struct TrainerContext {
    pub(crate) store: BlockingStore,
    pub(crate) options: TrainerOptions,
    pub(crate) shared: Arc<Shared>,
    pub(crate) backend: Backend,
}
