//! Trains a block: initial splats, optimisation, pruning, evaluation of the merged model on the way.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;

use glam::Vec3;
use proto::FailureKind;
use scene::{BlockId, Exposures, Poses, Splats};
use train::importance::EvaluationViews;
use train::prune::{self, Pruning};
use train::{Backend, Job, PictureLoss, Recipe, TrainError, TrainView, Trained};

use crate::aligned::TalliedLoss;
use crate::block::Block;
use crate::clock::Stopwatch;
use crate::initial_splats::InitialSplats;
use crate::memory_budget::{MemoryBudget, memory_budget};
use crate::merged_eval::{MergedEvaluator, evaluates_after};
use crate::recipe::recipe_of;
use crate::refine;
use crate::result_cache::ResultCache;
use crate::task::{ExecuteError, FULL_RATE, Flow, Report};
use crate::time_limit::{TaskTimeLimit, TimeLimit};

/// The result of a block.
pub(crate) struct TrainedBlock {
    pub(crate) splats: Splats,
    /// The exposures if this block trained them.
    pub(crate) exposures: Option<Exposures>,
    /// The poses if this block refined them.
    pub(crate) poses: Option<Poses>,
    /// The splats' error if the block is a root with children, see [`refine`].
    pub(crate) residual: Option<f64>,
}

/// The initial splats and the windows that they are trained on.
struct Start {
    splats: InitialSplats,
    views: Vec<TrainView>,
    /// The block stays at its parent's resolution and is only pruned, see [`refine`].
    is_settled: bool,
}

impl Block<'_> {
    /// Trains the block and prunes it. A settled block is only pruned. `results` are those of the parent and the context blocks.
    pub(crate) fn train(
        &self,
        results: BTreeMap<BlockId, Splats>,
        stopwatch: &mut Stopwatch,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<TrainedBlock, ExecuteError> {
        let (plan, task, options) = (self.plan, self.task, &self.context.options);
        let finished = &self.context.shared.finished;
        let recipe = recipe_of(plan, task).at_rate(self.order.rate_permille as f32 / FULL_RATE as f32);
        let counts = |p: Vec3| self.owns(task, p.as_dvec3());
        let budget = self.budget(&results);
        let evaluator = MergedEvaluator::new(plan, self.reader, &self.context.store);
        let is_evaluated = evaluator.is_some();
        if is_evaluated {
            finished.learn(self.order.plan, plan, &results);
        }
        let Start { splats: InitialSplats { trained: initial, context }, views, is_settled } =
            self.start(results, &recipe, &counts)?;
        let cut = task.context_cut();
        let keeps = |p: Vec3| self.trains(&cut, p.as_dvec3());
        let free_space = self.free_space(&views);
        let size_bounds_metres = self.size_bounds_metres(&views);
        let refines_sensors = plan.settings.refine_sensors && task.parent.is_none();
        let sensors = refines_sensors.then(|| scene::sensors::sensors(&self.capture.views));
        let job_of = |initial, steps, views| Job {
            initial,
            context: context.as_ref(),
            views,
            counts: &counts,
            keeps: &keeps,
            free_space: free_space.as_ref(),
            budget,
            steps,
            antialiased: plan.settings.antialiased,
            seed: self.seed(),
            size_bounds_metres,
            exposures: self.given_exposures,
            trains_exposures: plan.settings.exposure && task.parent.is_none(),
            trains_poses: plan.settings.refine_poses && task.parent.is_none(),
            sensors: sensors.as_ref().map(|sensors| &sensors.of_views[..]),
            path: None,
            recipe: &recipe,
            source: self.reader,
            picture_loss: self.aligned.map(|aligned| aligned as &dyn PictureLoss),
            backend: &self.context.backend,
        };
        let mut progress = Progress::new(self, &views, evaluator, stopwatch, report);
        let pruning = self.pruning();
        let mut job = job_of(initial, task.steps, &views);
        if is_settled {
            job.steps = 0;
        } else if pruning.is_some() {
            job.steps = prune::steps_before(task.steps);
        }
        let planned = job.steps;
        let time_limit = self.context.shared.time_limit.as_ref();
        let limit = time_limit.filter(|_| !is_settled).map(|limit| {
            let evaluate = |splats: &Splats| progress.evaluate(splats);
            let part = f64::from(planned) / f64::from(task.steps.max(1));
            TaskTimeLimit::new(limit, plan, self.order.task, &mut job, part, options.eval_every, evaluate)
        });
        let trained = job.steps;
        // The task's steps, in proportion if the time limit left fewer.
        let all_steps = match planned {
            0 => task.steps,
            _ => (u64::from(task.steps) * u64::from(trained)).div_ceil(u64::from(planned)) as u32,
        };
        progress.begin(trained + pruning.map_or(0, |pruning| pruning.steps(all_steps)));

        let Trained { mut splats, exposures, poses, .. } = self.optimise(job, limit.as_ref(), &mut progress)?;
        let refined: Vec<TrainView> = match &poses {
            Some(poses) => {
                views.iter().map(|view| TrainView { camera: poses.apply(view.view, view.camera), ..*view }).collect()
            }
            None => views.clone(),
        };
        // Set if the last step of training is not the last one to report.
        let mut last_step = (is_settled && pruning.is_none()).then_some(task.steps);
        if let Some(pruning) = pruning.filter(|_| !progress.is_stopped && !progress.is_late) {
            let job =
                Job { exposures: exposures.as_ref().or(self.given_exposures), ..job_of(splats, all_steps, &refined) };
            splats = self.prune(job, &pruning, trained, limit.as_ref(), &mut progress)?;
            last_step = Some(progress.steps);
        }
        progress.finish(last_step, &splats)?;
        if progress.is_late {
            time_limit.into_iter().for_each(TimeLimit::mark_shortened);
        }
        let exposed = exposures.as_ref().or(self.given_exposures);
        let residual = self.root_residual(&splats, &refined, exposed).map_err(|error| self.failure(error))?;
        let splats = self.at_full_resolution(splats, &views);
        let splats = if plan.settings.label_blocks && !is_settled { self.labelled(splats) } else { splats };
        if is_evaluated {
            finished.insert(self.order.plan, plan, task.block, &splats);
        }
        Ok(TrainedBlock { splats, exposures, poses, residual })
    }

    /// Assembles the initial splats and decides whether the block is settled.
    fn start(
        &self,
        results: BTreeMap<BlockId, Splats>,
        recipe: &Recipe,
        counts: &(dyn Fn(Vec3) -> bool + Sync),
    ) -> Result<Start, ExecuteError> {
        let views = self.windows(&self.task.views)?;
        let splats = self.initial_splats(results, &views, recipe)?;
        let is_settled = self.is_settled(&splats, &views, counts).map_err(|error| self.failure(error))?;
        if !is_settled {
            return Ok(Start { splats, views, is_settled });
        }
        let coarser = refine::coarser(&views);
        let splats = if self.plan.settings.antialiased { splats } else { refine::refilter(splats, &views, &coarser) };
        self.context.shared.settled.fetch_add(1, Ordering::Relaxed);
        Ok(Start { splats, views: coarser, is_settled })
    }

    /// Whether the block stays at its parent's resolution.
    fn is_settled(
        &self,
        initial: &InitialSplats,
        views: &[TrainView],
        counts: &(dyn Fn(Vec3) -> bool + Sync),
    ) -> Result<bool, TrainError> {
        let settings = &self.plan.settings;
        let Some(root) = self.given_residual.filter(|_| settings.residual > 0.0) else { return Ok(false) };
        let (context, antialiased) = (initial.context.as_ref(), settings.antialiased);
        let around =
            EvaluationViews { views, context, antialiased, exposures: self.given_exposures, source: self.reader };
        let parent = refine::residual_of_core(around, &initial.trained, counts)?;
        tracing::debug!(block = %self.task.block, parent, root, "error of the parent's splats in this block, and of the root's");
        Ok(parent.is_some_and(|parent| parent <= settings.residual * root))
    }

    /// Trains the job, from a checkpoint if there is one, and writes checkpoints.
    fn optimise(
        &self,
        job: Job,
        limit: Option<&TaskTimeLimit>,
        progress: &mut Progress,
    ) -> Result<Trained, ExecuteError> {
        let (shared, options) = (&self.context.shared, &self.context.options);
        let checkpoint = self.cache.and_then(|cache| cache.checkpoint(&self.context.store));
        if checkpoint.is_some() {
            shared.resumed.fetch_add(1, Ordering::Relaxed);
        }
        let clock = Stopwatch::start();
        let mut next_checkpoint = options.checkpoint_seconds;
        let mut has_diverged = false;
        let trained = train::train_from(job, checkpoint, &mut |mut now| {
            shared.metrics.steps.inc();
            let (seconds, is_last) = (clock.wall_seconds(), now.step == now.steps);
            // Pruning resumes from the checkpoint of the last step.
            if let Some(cache) = self.cache
                && (seconds >= next_checkpoint || (is_last && seconds > 0.5 * next_checkpoint))
                && let Some(state) = now.state()
            {
                self.put_checkpoint(cache, state);
                next_checkpoint = seconds + options.checkpoint_seconds;
            }
            progress.is_late = !is_last && limit.is_some_and(TaskTimeLimit::is_over);
            let (step, is_last) = (now.step, progress.is_late || now.step == progress.steps);
            if let Some(evaluate) = progress.is_due(step, now.views, is_last) {
                // `None` if the device failed: training then ends with its error.
                progress.loss = now.loss().unwrap_or(f64::NAN);
                has_diverged = now.skipped().is_some_and(|skipped| is_divergence(skipped, step));
                if has_diverged {
                    return train::Flow::Stop;
                }
                let count = now.count();
                let splats = if evaluate { now.splats() } else { None };
                progress.is_stopped = !progress.report(step, count, splats, is_last);
            }
            // The next attempt starts from here, on this worker or another one.
            if progress.is_stopped
                && let Some(cache) = self.cache
                && let Some(state) = now.state()
            {
                self.put_checkpoint(cache, state);
            }
            flow(!progress.is_stopped && !progress.is_late)
        });
        let trained = trained.map_err(|error| self.failure(error))?;
        if has_diverged {
            let message = format!("block {}: training diverges: too many losses are not finite", self.task.block);
            return Err(ExecuteError::of(FailureKind::Numeric, message));
        }
        Ok(trained)
    }

    /// Prunes the job's splats after `trained` steps of training.
    fn prune(
        &self,
        job: Job,
        pruning: &Pruning,
        trained: u32,
        limit: Option<&TaskTimeLimit>,
        progress: &mut Progress,
    ) -> Result<Splats, ExecuteError> {
        let pruned = prune::within_tolerance(job, pruning, None, &mut |mut now| {
            self.context.shared.metrics.steps.inc();
            progress.is_late = limit.is_some_and(TaskTimeLimit::is_over);
            // The last step is reported at the end, with the splats that pruning chose.
            let (step, recovery) = (trained + now.step.min(now.steps - 1), &mut now.recovery);
            let due = progress.is_due(step, recovery.views, false);
            if due.is_some() || recovery.step == recovery.steps {
                progress.loss = recovery.loss().unwrap_or(f64::NAN);
            }
            let goes_on = due.is_none_or(|evaluate| {
                let count = recovery.count();
                let splats = if evaluate { recovery.splats() } else { None };
                progress.report(step, count, splats, false)
            });
            flow(goes_on && !progress.is_late)
        });
        let (pruned, outcome) = pruned.map_err(|error| self.failure(error))?;
        tracing::info!(block = %self.task.block, before = outcome.splats[0], after = outcome.splats[1], "pruned");
        Ok(pruned)
    }

    fn put_checkpoint(&self, cache: &ResultCache, state: &train::State) {
        if cache.put_checkpoint(&self.context.store, state) {
            self.context.shared.metrics.checkpoints.inc();
        }
    }

    /// The error of the splats of a root with children on its own training windows.
    fn root_residual(
        &self,
        splats: &Splats,
        views: &[TrainView],
        exposures: Option<&Exposures>,
    ) -> Result<Option<f64>, TrainError> {
        let settings = &self.plan.settings;
        if self.task.parent.is_some() || settings.residual == 0.0 || self.plan.tasks.len() == 1 {
            return Ok(None);
        }
        let all =
            EvaluationViews { views, context: None, antialiased: settings.antialiased, exposures, source: self.reader };
        refine::residual(all, splats)
    }

    /// The failure class of a training error.
    fn failure(&self, error: TrainError) -> ExecuteError {
        let kind = match error {
            TrainError::NoViews | TrainError::Empty(_) | TrainError::PictureLoss(_) | TrainError::Objects(_) => {
                FailureKind::Input
            }
            TrainError::Device(_) => FailureKind::Work,
            TrainError::OutOfMemory(_) => FailureKind::OutOfMemory,
            // Windows carry checksums: an unreadable one is unreachable or damaged, which the input does not explain.
            TrainError::Source(_) => return ExecuteError::of(FailureKind::Infrastructure, error),
        };
        ExecuteError::of(kind, format!("block {}: {error}", self.task.block))
    }
}

/// The progress of a block's training: what was reported, and why training has to end.
struct Progress<'a> {
    block: &'a Block<'a>,
    views: &'a [TrainView],
    evaluator: Option<MergedEvaluator>,
    stopwatch: &'a mut Stopwatch,
    report: &'a mut (dyn FnMut(Report) -> Flow + Send),
    memory: Option<MemoryBudget>,
    /// Steps in all, those of pruning included.
    steps: u32,
    /// The last loss that was read from the device.
    loss: f64,
    /// A report was answered with [`Flow::Stop`].
    is_cancelled: bool,
    /// Resident memory in bytes that exceeded the budget.
    overrun: Option<u64>,
    /// Training stopped because of `is_cancelled` or `overrun`.
    is_stopped: bool,
    /// The time limit has passed.
    is_late: bool,
}

impl<'a> Progress<'a> {
    fn new(
        block: &'a Block<'a>,
        views: &'a [TrainView],
        evaluator: Option<MergedEvaluator>,
        stopwatch: &'a mut Stopwatch,
        report: &'a mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Self {
        Self {
            block,
            views,
            evaluator,
            stopwatch,
            report,
            memory: None,
            steps: 0,
            loss: f64::NAN,
            is_cancelled: false,
            overrun: None,
            is_stopped: false,
            is_late: false,
        }
    }

    /// Sets the number of steps, and starts the memory budget from what is resident now.
    fn begin(&mut self, steps: u32) {
        self.steps = steps;
        self.memory = memory_budget(self.block.context.options.memory_bytes);
    }

    /// Evaluates the merged model with these splats of the block: PSNR in dB and number of splats. Does not count as training time.
    fn evaluate(&mut self, splats: &Splats) -> Option<(f64, u64)> {
        let Self { block, views, evaluator, stopwatch, .. } = self;
        stopwatch.paused(|| {
            let evaluator = evaluator.as_mut()?;
            let (plan, task) = (block.plan, block.task);
            let splats = block.at_full_resolution(splats.clone(), views);
            let merged = block.context.shared.finished.merged_with(block.order.plan, plan, task.block, &splats);
            evaluator.psnr(&merged).map(|psnr| (psnr, merged.len() as u64))
        })
    }

    /// Whether a step (of so many views) is reported, and if so, whether the merged model is evaluated for it.
    fn is_due(&self, step: u32, views: u32, is_last: bool) -> Option<bool> {
        let Block { context, plan, order, .. } = self.block;
        let (eval_every, report_every) = (context.options.eval_every, report_every(&context.backend));
        let passed = |every: u32| (0..views).any(|n| step.saturating_sub(n).is_multiple_of(every));
        let evaluate = (is_last && evaluates_after(plan, order.task)) || (eval_every > 0 && passed(eval_every));
        (evaluate || is_last || passed(report_every)).then_some(evaluate)
    }

    /// Reports a step of `count` splats, evaluated if splats are given; whether to go on.
    fn report(&mut self, step: u32, count: usize, splats: Option<&Splats>, is_last: bool) -> bool {
        let (cpu_seconds, wall_seconds) = (self.stopwatch.cpu_seconds(), self.stopwatch.wall_seconds());
        let metrics = &self.block.context.shared.metrics;
        metrics.splats.set(count as i64);
        metrics.cache_bytes.set(self.block.reader.stats().cached_bytes as i64);
        let evaluated = splats.and_then(|splats| self.evaluate(splats));
        let flow = (self.report)(Report {
            step: step.into(),
            steps: self.steps.into(),
            loss: self.loss,
            splats: count as u64,
            cpu_seconds,
            wall_seconds,
            psnr: evaluated.map(|(psnr, _)| psnr),
            merged_splats: evaluated.map(|(_, splats)| splats),
            aligned: self.block.aligned.and_then(TalliedLoss::report),
        });
        self.is_cancelled |= flow == Flow::Stop && !is_last;
        self.overrun = self.memory.as_mut().filter(|_| !is_last).and_then(MemoryBudget::overrun);
        !self.is_cancelled && self.overrun.is_none()
    }

    /// Reports the last step if training did not, and returns why the block has no result.
    fn finish(&mut self, last_step: Option<u32>, splats: &Splats) -> Result<(), ExecuteError> {
        if let Some(step) = last_step {
            let evaluate = self.is_due(step, 1, true) == Some(true);
            self.report(step, splats.len(), evaluate.then_some(splats), true);
        }
        if let Some(resident) = self.overrun {
            let limit = self.block.context.options.memory_bytes;
            let [resident, limit] = [resident, limit].map(|bytes| bytes.div_ceil(1 << 20));
            let block = self.block.task.block;
            let message = format!("block {block}: the worker takes {resident} MiB, --memory gives it {limit}");
            return Err(ExecuteError::of(FailureKind::OutOfMemory, message));
        }
        if self.is_cancelled { Err(ExecuteError::work("stopped before its end, as requested")) } else { Ok(()) }
    }
}

fn flow(goes_on: bool) -> train::Flow {
    if goes_on { train::Flow::Continue } else { train::Flow::Stop }
}

/// Steps between two reports. On a GPU each report waits for the device.
fn report_every(backend: &Backend) -> u32 {
    match backend {
        Backend::Cpu => 10,
        Backend::Gpu(_) => 100,
    }
}

/// Whether so many skipped steps (with a loss that is not finite) mean divergence. A single one is harmless.
fn is_divergence(skipped: u32, step: u32) -> bool {
    const FEW: u32 = 10;
    skipped > FEW && skipped > step / 20
}
