//! Carries out a task: trains a block.
//!
//! ```text
//! plan, capture, results of parent and context ──from the store──▶ initial splats and frozen context
//!   ──train──▶ splats of the block, halo included ──to the store──▶ artefact
//! ```
//! Everything here follows from the plan and its inputs, so an attempt anywhere gives the same bytes.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use blocks::{Plan, Task};
use bytes::Bytes;
use dataset::bounded::Bounded;
use dataset::ingest::IngestError;
use dataset::windows::{Common, WindowReader};
use scene::frame::{self, About};
use scene::{ArtefactId, BlockId, Capture, Exposures, Splats};
use store::BlockingStore;
use train::Backend;

use crate::block::{Block, Trained};
use crate::cap::Cap;
use crate::clock::Stopwatch;
use crate::memory::Memory;
use crate::merged::{Finished, Judge, is_look};
use crate::metrics::Metrics;
use crate::{Execute, ExecuteError, FailureKind, Flow, Report, TaskOrder};

/// What a worker may use, and what it is asked to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainerOptions {
    /// Threads of the compute pool, at least 1.
    pub threads: usize,
    /// Steps between two evaluations of the merged model so far; 0 = only at the end of a task.
    pub eval_every: u32,
    /// Bound on the windows kept in memory.
    pub cache_bytes: usize,
    /// Bound on what the whole process takes: a task that takes more fails, and is another worker's. 0 bounds nothing.
    pub memory_bytes: u64,
    /// Whether to take what an earlier run left in the store, and to leave such (never where there is a cap in time).
    pub resume: bool,
    /// Wall seconds between two checkpoints of a task.
    pub checkpoint_seconds: f64,
}

/// What the workers of one process know of a job together.
#[derive(Debug, Default)]
pub struct Shared {
    /// What is finished.
    pub finished: Finished,
    /// A cap in wall time.
    pub cap: Option<Cap>,
    /// Tasks that an earlier run had finished, or begun and left a checkpoint of.
    pub resumed: AtomicU32,
    /// Blocks that were trained no finer than their parent.
    pub settled: AtomicU32,
    /// What the work comes to, as it goes on.
    pub metrics: Metrics,
}

/// Of the bound on the cache results of tasks take one part of so many where the store is far, and tiles of photos another.
const FAR_PARTS: usize = 4;

/// Trains blocks.
pub struct BlockTrainer {
    pub(crate) store: BlockingStore,
    pub(crate) options: TrainerOptions,
    pub(crate) shared: Arc<Shared>,
    pub(crate) backend: Backend,
    pool: rayon::ThreadPool,
    /// Those of the task before. A city's have megabytes, and the next task is mostly of the same job.
    plan: Mutex<Option<(ArtefactId, Arc<Plan>)>>,
    capture: Mutex<Option<KnownCapture>>,
    /// Results of tasks as they were read, where the store is far: the blocks around one block are mostly those around the next, and
    /// the root is around all.
    kept: Mutex<Bounded<ArtefactId, Bytes>>,
    /// Bytes that results may take, and tiles as many.
    far_bytes: usize,
}

/// A capture, and what its readers have in common.
type KnownCapture = (ArtefactId, Arc<Capture>, Arc<Common>);

impl BlockTrainer {
    /// A trainer over this store.
    ///
    /// # Errors
    /// The operating system refused the threads.
    pub fn new(
        store: BlockingStore,
        options: TrainerOptions,
        shared: Arc<Shared>,
        backend: Backend,
    ) -> Result<Self, String> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(options.threads.max(1))
            .build()
            .map_err(|error| format!("cannot start {} threads: {error}", options.threads))?;
        let near = !store.store().is_far();
        let far_bytes = if near { 0 } else { options.cache_bytes / FAR_PARTS };
        let kept = Mutex::new(Bounded::new(far_bytes));
        let (plan, capture) = (Mutex::default(), Mutex::default());
        Ok(Self { store, options, shared, backend, pool, plan, capture, kept, far_bytes })
    }

    /// Does something on the trainer's threads.
    pub(crate) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.pool.install(work)
    }
}

impl Execute for BlockTrainer {
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        let mut stopwatch = Stopwatch::start();
        let fetching = tracing::info_span!("fetch").entered();
        let plan = self.plan(order.plan)?;
        if plan.backend != self.backend.name() {
            let (planned, own) = (&plan.backend, self.backend.name());
            return Err(failed(format!("the plan is for the backend {planned}, this worker computes on {own}")));
        }
        let task = plan.tasks.get(order.task as usize).ok_or_else(|| failed("the plan has no such task"))?;
        let (capture, common) = self.capture(plan.capture)?;
        let windows = self.options.cache_bytes - 2 * self.far_bytes;
        let reader = WindowReader::sharing(common, capture.clone(), self.store.clone(), windows);
        let (results, given) = self.results(&plan, task, order, report)?;
        let memory = self.options.resume.then(|| Memory::of(order)).filter(|_| self.shared.cap.is_none());
        if let Some((artefact, splats)) = memory.as_ref().and_then(|memory| memory.result(&self.store)) {
            self.shared.resumed.fetch_add(1, Ordering::Relaxed);
            let psnr = Judge::new(&plan, &reader, &self.store).and_then(|mut judge| {
                let finished = &self.shared.finished;
                finished.learn(order.plan, &plan, &results);
                finished.insert(order.plan, &plan, task.block, &splats);
                is_look(&plan, order.task).then_some(())?;
                let merged = finished.with(order.plan, &plan, task.block, &splats);
                judge.psnr(&merged).map(|psnr| (psnr, merged.len() as u64))
            });
            let steps = task.steps.into();
            // Nothing is left to stop.
            let _ = report(Report {
                step: steps,
                steps,
                loss: f64::NAN,
                splats: splats.len() as u64,
                cpu_seconds: stopwatch.cpu_seconds(),
                wall_seconds: stopwatch.wall_seconds(),
                psnr: psnr.map(|(psnr, _)| psnr),
                merged_splats: psnr.map(|(_, count)| count),
            });
            return Ok(artefact);
        }
        let memory = memory.as_ref();
        let exposures = match given.exposures {
            Some(id) => Some(Exposures::from_frame(&self.store.get(id)?).map_err(failed)?),
            None => None,
        };
        drop(fetching);
        let (exposures_given, residual_given) = (exposures.as_ref(), given.residual);
        let block = Block {
            trainer: self,
            order,
            plan: &plan,
            task,
            capture: &capture,
            reader: &reader,
            memory,
            exposures_given,
            residual_given,
        };
        let training = tracing::info_span!("train", block = %task.block);
        let trained = self.pool.install(|| training.in_scope(|| block.train(results, &mut stopwatch, report)));
        drop(training);
        self.shared.metrics.has_read(reader.stats());
        // The next block has splats and a cache of its own.
        self.shared.metrics.splats.set(0);
        self.shared.metrics.cache_bytes.set(0);
        let Trained { splats, exposures, residual } = trained?;
        let _keeping = tracing::info_span!("keep").entered();
        let exposures = match exposures {
            Some(trained) => Some(self.store.put(trained.to_frame())?),
            None => given.exposures,
        };
        let about = About { exposures, residual: residual.or(given.residual) };
        let artefact = self.store.put(frame::encode_result(&splats, about))?;
        self.shared.cap.iter().for_each(|cap| cap.finish(order.task));
        if let Some(memory) = memory {
            memory.keep_result(&self.store, artefact);
        }
        Ok(artefact)
    }
}

impl BlockTrainer {
    fn plan(&self, id: ArtefactId) -> Result<Arc<Plan>, ExecuteError> {
        let mut kept = self.plan.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((of, plan)) = &*kept
            && *of == id
        {
            return Ok(plan.clone());
        }
        // Not both at once.
        *kept = None;
        let plan = Arc::new(Plan::from_frame(&self.store.get(id)?).map_err(failed)?);
        *kept = Some((id, plan.clone()));
        Ok(plan)
    }

    fn capture(&self, id: ArtefactId) -> Result<(Arc<Capture>, Arc<Common>), ExecuteError> {
        let mut kept = self.capture.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((of, capture, common)) = &*kept
            && *of == id
        {
            return Ok((capture.clone(), common.clone()));
        }
        // Not both at once.
        *kept = None;
        let capture = Arc::new(dataset::ingest::load_capture(&self.store, id).map_err(unread)?);
        let common = Arc::new(Common::keeping(self.far_bytes));
        *kept = Some((id, capture.clone(), common.clone()));
        Ok((capture, common))
    }

    fn kept(&self) -> MutexGuard<'_, Bounded<ArtefactId, Bytes>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The splats of the blocks that the task needs, and what else its parent hands down.
    fn results(
        &self,
        plan: &Plan,
        task: &Task,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<Inputs, ExecuteError> {
        /// Fetched side by side: encoded as they are they take a part of what they take as splats.
        const AT_ONCE: usize = 8;
        let (mut results, mut given) = (BTreeMap::new(), About::default());
        let wanted = task.context_cut().blocks().into_iter().map(|block| {
            let index = plan.tasks.iter().position(|t| t.block == block);
            let known = index.and_then(|i| order.inputs.get_key_value(&(i as u32)));
            known
                .map(|(&index, &id)| (block, index, id))
                .ok_or_else(|| failed(format!("the result of block {block} was not handed over")))
        });
        let wanted: Vec<_> = wanted.collect::<Result<_, _>>()?;
        for some in wanted.chunks(AT_ONCE) {
            let mut found: Vec<Option<Bytes>> = some.iter().map(|(.., id)| self.kept().get(id).cloned()).collect();
            let missing: Vec<usize> = (0..some.len()).filter(|&i| found[i].is_none()).collect();
            let ids: Vec<ArtefactId> = missing.iter().map(|&i| some[i].2).collect();
            for (i, bytes) in missing.into_iter().zip(self.store.get_all_or_discard(&ids)?) {
                bytes.iter().for_each(|bytes| self.kept().put(some[i].2, bytes.clone(), bytes.len()));
                found[i] = bytes;
            }
            for (&(block, index, id), found) in some.iter().zip(found) {
                let bytes = match found {
                    Some(bytes) => bytes,
                    None => self.make_again(plan, order, index, id, report)?,
                };
                let (splats, about) = frame::decode_result(&bytes).map_err(failed)?;
                results.insert(block, splats);
                given = if Some(block) == task.parent { about } else { given };
            }
        }
        Ok((results, given))
    }
}

/// What other tasks made: splats by block, and what else the parent hands down.
type Inputs = (BTreeMap<BlockId, Splats>, About);

pub(crate) fn failed(error: impl ToString) -> ExecuteError {
    ExecuteError::of(FailureKind::Work, error)
}

fn unread(error: IngestError) -> ExecuteError {
    match error {
        IngestError::Store(error) => error.into(),
        IngestError::BadInput(error) => failed(error),
    }
}
