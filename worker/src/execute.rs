//! Carries out a task of a plan: looks for objects on photos, trains a block or an object that moves, or measures the merged model.
//!
//! ```text
//! detect:   plan, capture, detector ──from the store──▶ network
//!             ──run on some photos──▶ objects on each ──to the store──▶ artefact
//! train:    plan, capture, results of parent and context, objects ──from the store──▶ initial splats and frozen context
//!             ──train──▶ splats of the block, halo included ──to the store──▶ artefact
//! evaluate: plan, capture, results of all blocks ──from the store──▶ merged model
//!             ──render held-out views──▶ figures of each view ──to the store──▶ artefact
//! ```
//! The result is a function of the plan and its inputs, so an attempt on any worker gives the same bytes.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use blocks::{DetectTask, EvalTask, ObjectTask, Plan, PlannedTask, Task};
use dataset::ingest::IngestError;
use dataset::windows::{SharedTileCache, WindowReader};
use perceive::Detector;
use scene::frame::{self, TrainingInfo};
use scene::objects;
use scene::{ArtefactId, BlockId, Capture, Exposures, Poses, Splats};
use store::BlockingStore;
use train::Backend;

use crate::aligned::TalliedLoss;
use crate::block::Block;
use crate::clock::Stopwatch;
use crate::detect::{Detection, detect, of_network};
use crate::evaluate::{Evaluation, evaluate};
use crate::inputs::{Inputs, KeptResults};
use crate::latest::Latest;
use crate::memory_budget::memory_budget;
use crate::merged_eval::{MergedEvaluator, evaluates_after};
use crate::object::ObjectTraining;
use crate::result_cache::ResultCache;
use crate::task::{Execute, ExecuteError, Flow, Report, Reporter, TaskOrder};
use crate::train_block::TrainedBlock;
use crate::trainer_context::{Shared, TrainerContext, TrainerOptions};

/// With a remote store, task results and photo tiles each take this fraction of the cache: 1/4.
const REMOTE_CACHE_FRACTION: usize = 4;

/// Carries out the tasks of plans on one backend.
pub struct PlanExecutor {
    pub(crate) context: TrainerContext,
    pool: rayon::ThreadPool,
    plan: Latest<Arc<Plan>>,
    /// The capture, and the tiles that its readers share.
    capture: Latest<(Arc<Capture>, Arc<SharedTileCache>)>,
    detector: Latest<Arc<Detector>>,
    /// Keeps results with a remote store only: consecutive blocks share most neighbours, and all share the root.
    results: KeptResults,
    /// Capacity for results, and as much again for tiles: bytes.
    remote_bytes: usize,
}

impl PlanExecutor {
    /// An executor over this store.
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
        let is_local = !store.store().is_remote();
        let remote_bytes = if is_local { 0 } else { options.cache_bytes / REMOTE_CACHE_FRACTION };
        let results = KeptResults::new(remote_bytes);
        let (plan, capture, detector) = (Latest::default(), Latest::default(), Latest::default());
        let context = TrainerContext { store, options, shared, backend };
        Ok(Self { context, pool, plan, capture, detector, results, remote_bytes })
    }

    /// Runs `work` on the executor's threads.
    pub(crate) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.pool.install(work)
    }
}

impl Execute for PlanExecutor {
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        let mut stopwatch = Stopwatch::start();
        let TrainerContext { options, shared, backend, .. } = &self.context;
        let fetch_span = tracing::info_span!("fetch");
        let fetching = fetch_span.enter();
        let plan = self.plan(order.plan)?;
        if plan.backend != backend.name() {
            let (planned, own) = (&plan.backend, backend.name());
            let message = format!("the plan is for the backend {planned}, this worker computes on {own}");
            return Err(ExecuteError::work(message));
        }
        let task = plan.planned(order.task).ok_or_else(|| ExecuteError::work("the plan has no such task"))?;
        let (capture, tiles) = self.capture(plan.capture)?;
        let cache = options.resume.then(|| ResultCache::of(order)).filter(|_| shared.time_limit.is_none());
        drop(fetching);
        let job = Assignment { order, plan: &plan, capture: &capture, tiles, cache: cache.as_ref(), fetch_span };
        match task {
            PlannedTask::Train(task) => self.train(&job, task, &mut stopwatch, report),
            PlannedTask::Evaluate(task) => self.evaluate(&job, task, &stopwatch, report),
            PlannedTask::Detect(task) => self.detect(&job, task, &stopwatch, report),
            PlannedTask::Object(task) => self.object(&job, task, &stopwatch, report),
        }
    }
}

/// What carrying out a task of any kind needs.
struct Assignment<'a> {
    order: &'a TaskOrder,
    plan: &'a Plan,
    capture: &'a Arc<Capture>,
    tiles: Arc<SharedTileCache>,
    /// `None` if nothing is resumed.
    cache: Option<&'a ResultCache>,
    /// Entered again while the inputs are fetched.
    fetch_span: tracing::Span,
}

impl Assignment<'_> {
    /// A reader of the capture's windows that keeps this many bytes of them.
    fn reader(&self, store: &BlockingStore, cache_bytes: usize) -> WindowReader {
        self.reader_of(self.capture.clone(), store, cache_bytes)
    }

    /// As [`reader`](Self::reader), with other cameras.
    fn reader_of(&self, capture: Arc<Capture>, store: &BlockingStore, cache_bytes: usize) -> WindowReader {
        WindowReader::with_shared_tiles(self.tiles.clone(), capture, store.clone(), cache_bytes)
    }
}

impl PlanExecutor {
    /// Trains a block; the artefact is its splats.
    fn train(
        &self,
        job: &Assignment,
        task: &Task,
        stopwatch: &mut Stopwatch,
        report: &mut Reporter,
    ) -> Result<ArtefactId, ExecuteError> {
        let &Assignment { order, plan, capture, cache, .. } = job;
        let TrainerContext { store, shared, options, .. } = &self.context;
        let fetching = job.fetch_span.enter();
        let reader = job.reader(store, options.cache_bytes - 2 * self.remote_bytes);
        let reader = match self.inputs(job).zones(task, capture, report)? {
            Some(zones) => reader.with_zones(zones, plan.settings.zone_weight as f32),
            None => reader,
        };
        let reader = if plan.settings.depth_weight > 0.0 { reader.with_depth() } else { reader };
        let (mut results, mut given) = (BTreeMap::new(), TrainingInfo::default());
        self.inputs(job).blocks(PlannedTask::Train(task), report, |block, splats, training| {
            results.insert(block, splats);
            given = if Some(block) == task.parent { training } else { given };
        })?;
        let decode = |bytes: &[u8]| frame::decode_splats(bytes).ok();
        if let Some((artefact, splats)) = cache.and_then(|cache| cache.result(store, decode)) {
            shared.resumed.fetch_add(1, Ordering::Relaxed);
            self.report_cached(order, plan, &reader, (&results, &splats), stopwatch, report);
            return Ok(artefact);
        }
        let (exposures, poses) = self.of_views(given)?;
        let aligned = TalliedLoss::of(plan, store)?;
        drop(fetching);
        let (given_exposures, given_poses, given_residual) = (exposures.as_ref(), poses.as_ref(), given.residual);
        let block = Block {
            context: &self.context,
            order,
            plan,
            task,
            capture,
            reader: &reader,
            aligned: aligned.as_ref(),
            cache,
            given_exposures,
            given_poses,
            given_residual,
        };
        let train_span = tracing::info_span!("train", block = %task.block);
        let trained = self.pool.install(|| train_span.in_scope(|| block.train(results, stopwatch, report)));
        drop(train_span);
        shared.metrics.count_reads(reader.stats());
        // The next block has splats and a cache of its own.
        shared.metrics.splats.set(0);
        shared.metrics.cache_bytes.set(0);
        let trained = trained?;
        let _keep_span = tracing::info_span!("keep").entered();
        let artefact = self.put_result(trained, given)?;
        shared.time_limit.iter().for_each(|limit| limit.finish(order.task));
        if let Some(cache) = cache {
            cache.put_result(store, artefact);
        }
        Ok(artefact)
    }

    /// Looks for objects on some photos; the artefact is what was found.
    fn detect(
        &self,
        job: &Assignment,
        task: &DetectTask,
        stopwatch: &Stopwatch,
        report: &mut Reporter,
    ) -> Result<ArtefactId, ExecuteError> {
        let TrainerContext { store, shared, options, .. } = &self.context;
        let is_sound = |bytes: &[u8]| dataset::zones::objects_from_frame(bytes).is_ok();
        self.kept_or(job, is_sound, || {
            let id = job.plan.detector.ok_or_else(|| ExecuteError::work("the plan names no detector"))?;
            let detector = job.fetch_span.in_scope(|| self.detector(id))?;
            // Each photo is read once.
            let reader = job.reader(store, 0);
            let detection = Detection { task, detector: &detector, id, reader: &reader, store };
            let span = tracing::info_span!("detect", views = task.count);
            let found = span.in_scope(|| detect(&detection, memory_budget(options.memory_bytes), stopwatch, report));
            shared.metrics.count_reads(reader.stats());
            Ok(dataset::zones::objects_to_frame(&found?))
        })
    }

    /// Trains an object that moves; the artefact is its path and its splats, in its own axes.
    fn object(
        &self,
        job: &Assignment,
        task: &ObjectTask,
        stopwatch: &Stopwatch,
        report: &mut Reporter,
    ) -> Result<ArtefactId, ExecuteError> {
        let &Assignment { order, plan, capture, .. } = job;
        let TrainerContext { store, shared, options, .. } = &self.context;
        let about = capture.objects.get(task.object as usize);
        let about = about.ok_or_else(|| ExecuteError::work(format!("the capture has no object {}", task.object)))?;
        let is_sound = |bytes: &[u8]| objects::from_frame(bytes, about).is_ok();
        self.kept_or(job, is_sound, || {
            let reader = job.reader(store, options.cache_bytes - 2 * self.remote_bytes);
            let (mut results, mut given) = (BTreeMap::new(), TrainingInfo::default());
            job.fetch_span.in_scope(|| {
                self.inputs(job).blocks(PlannedTask::Object(task), report, |block, splats, training| {
                    results.insert(block, splats);
                    // Those of the root, which all blocks pass on.
                    given = training;
                })
            })?;
            let (exposures, poses) = self.of_views(given)?;
            let (exposures, poses) = (exposures.as_ref(), poses.as_ref());
            let training =
                ObjectTraining { plan, task, object: about, order, capture, reader: &reader, exposures, poses };
            let memory = memory_budget(options.memory_bytes);
            let span = tracing::info_span!("train", object = task.object);
            let trained = self.pool.install(|| span.in_scope(|| training.train(results, memory, stopwatch, report)));
            shared.metrics.count_reads(reader.stats());
            let (path, splats, swing) = trained?;
            Ok(objects::to_frame(&path, &splats, swing.as_ref()))
        })
    }

    /// Measures the merged model on some held-out views; the artefact is their figures.
    fn evaluate(
        &self,
        job: &Assignment,
        task: &EvalTask,
        stopwatch: &Stopwatch,
        report: &mut Reporter,
    ) -> Result<ArtefactId, ExecuteError> {
        let plan = job.plan;
        let TrainerContext { store, shared, backend, options } = &self.context;
        let is_sound = |bytes: &[u8]| eval::figures_from_frame(bytes).is_ok();
        self.kept_or(job, is_sound, || {
            let (mut parts, mut given, leaves) = (Vec::new(), TrainingInfo::default(), plan.leaves());
            job.fetch_span.in_scope(|| {
                self.inputs(job).blocks(PlannedTask::Evaluate(task), report, |block, splats, training| {
                    parts.push((block, leaves.keep(&splats, &plan.ground, block)));
                    given = training;
                })
            })?;
            let corrected = |poses: Poses| Arc::new(poses.in_capture(job.capture));
            let capture = self.of_views(given)?.1.map_or_else(|| job.capture.clone(), corrected);
            // Each photo is read once.
            let reader = job.reader_of(capture, store, 0);
            let objects = self.inputs(job).objects(PlannedTask::Evaluate(task), job.capture, report)?;
            let span = tracing::info_span!("evaluate", views = task.views.len());
            let figures = self.pool.install(|| {
                span.in_scope(|| {
                    let model = blocks::merge(parts);
                    let (model, objects) = (&model, &objects[..]);
                    let evaluation = Evaluation { plan, task, model, objects, reader: &reader, backend };
                    evaluate(&evaluation, memory_budget(options.memory_bytes), stopwatch, report)
                })
            });
            shared.metrics.count_reads(reader.stats());
            Ok(eval::figures_to_frame(&figures?))
        })
    }

    /// The exposures and poses of the photos that the root trained, if it did.
    fn of_views(&self, given: TrainingInfo) -> Result<(Option<Exposures>, Option<Poses>), ExecuteError> {
        let store = &self.context.store;
        let exposures = given.exposures.map(|id| Exposures::from_frame(&store.get(id)?).map_err(ExecuteError::work));
        let poses = given.poses.map(|id| Poses::from_frame(&store.get(id)?).map_err(ExecuteError::work));
        Ok((exposures.transpose()?, poses.transpose()?))
    }

    /// The results of other tasks.
    fn inputs<'a>(&'a self, job: &Assignment<'a>) -> Inputs<'a> {
        let &Assignment { order, plan, .. } = job;
        Inputs { executor: self, store: &self.context.store, kept: &self.results, plan, order }
    }

    /// The result that an earlier attempt left, if it is sound; else the computed one, which is kept.
    fn kept_or(
        &self,
        job: &Assignment,
        is_sound: impl FnOnce(&[u8]) -> bool,
        compute: impl FnOnce() -> Result<Vec<u8>, ExecuteError>,
    ) -> Result<ArtefactId, ExecuteError> {
        let TrainerContext { store, shared, .. } = &self.context;
        let decode = |bytes: &[u8]| is_sound(bytes).then_some(());
        if let Some((artefact, ())) = job.cache.and_then(|cache| cache.result(store, decode)) {
            shared.resumed.fetch_add(1, Ordering::Relaxed);
            return Ok(artefact);
        }
        let result = compute()?;
        let _keep_span = tracing::info_span!("keep").entered();
        let artefact = store.put(result)?;
        if let Some(cache) = job.cache {
            cache.put_result(store, artefact);
        }
        Ok(artefact)
    }

    /// Reports a task whose result an earlier run left, evaluated as if it had been trained now.
    fn report_cached(
        &self,
        order: &TaskOrder,
        plan: &Plan,
        reader: &WindowReader,
        (inputs, splats): (&BTreeMap<BlockId, Splats>, &Splats),
        stopwatch: &Stopwatch,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) {
        let Some(task) = plan.tasks.get(order.task as usize) else { return };
        let evaluated = MergedEvaluator::new(plan, reader, &self.context.store).and_then(|mut evaluator| {
            let finished = &self.context.shared.finished;
            finished.learn(order.plan, plan, inputs);
            finished.insert(order.plan, plan, task.block, splats);
            evaluates_after(plan, order.task).then_some(())?;
            let merged = finished.merged_with(order.plan, plan, task.block, splats);
            evaluator.psnr(&merged).map(|psnr| (psnr, merged.len() as u64))
        });
        let steps = task.steps.into();
        // The task is finished, so `Flow::Stop` changes nothing.
        let _ = report(Report {
            step: steps,
            steps,
            loss: f64::NAN,
            splats: splats.len() as u64,
            cpu_seconds: stopwatch.cpu_seconds(),
            wall_seconds: stopwatch.wall_seconds(),
            psnr: evaluated.map(|(psnr, _)| psnr),
            merged_splats: evaluated.map(|(_, count)| count),
            aligned: None,
        });
    }

    /// Puts a block's result into the store. Exposures, poses and residual are passed down from the parent unless the block has its own.
    fn put_result(&self, trained: TrainedBlock, given: TrainingInfo) -> Result<ArtefactId, ExecuteError> {
        let TrainedBlock { splats, exposures, poses, residual } = trained;
        let store = &self.context.store;
        let exposures = match exposures {
            Some(trained) => Some(store.put(trained.to_frame())?),
            None => given.exposures,
        };
        let poses = match poses {
            Some(refined) => Some(store.put(refined.to_frame())?),
            None => given.poses,
        };
        let training = TrainingInfo { exposures, residual: residual.or(given.residual), poses };
        Ok(store.put(frame::encode_result(&splats, training))?)
    }

    fn plan(&self, id: ArtefactId) -> Result<Arc<Plan>, ExecuteError> {
        let load = || Plan::from_frame(&self.context.store.get(id)?).map_err(ExecuteError::work);
        self.plan.get(id, || load().map(Arc::new))
    }

    fn capture(&self, id: ArtefactId) -> Result<(Arc<Capture>, Arc<SharedTileCache>), ExecuteError> {
        self.capture.get(id, || {
            let capture = dataset::ingest::load_capture(&self.context.store, id)?;
            Ok((Arc::new(capture), Arc::new(SharedTileCache::new(self.remote_bytes))))
        })
    }

    fn detector(&self, id: ArtefactId) -> Result<Arc<Detector>, ExecuteError> {
        self.detector.get(id, || {
            let loaded = dataset::networks::load_detector(&self.context.store, id);
            let detector = loaded.map_err(|error| match error {
                IngestError::BadInput(error) => of_network(error),
                error @ IngestError::Store(_) => error.into(),
            })?;
            Ok(Arc::new(detector.on_threads(self.context.options.threads.max(1))))
        })
    }
}
