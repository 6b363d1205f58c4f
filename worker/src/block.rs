//! A block under training: from what its parent left to what its children, or viewers, get.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use blocks::{Plan, PlanSettings, Task, ViewUse};
use dataset::windows::WindowReader;
use glam::Vec3;
use scene::{BlockId, Capture, Exposures, Splats};
use train::importance::EvaluationViews;
use train::prune::{self, Pruning};
use train::{Backend, Recipe, TrainError, TrainView};

use crate::cap::{Cap, Limit};
use crate::clock::Stopwatch;
use crate::execute::{BlockTrainer, Shared, failed};
use crate::memory::Memory;
use crate::merged::{Judge, is_look};
use crate::refine::{self, Start};
use crate::room::Room;
use crate::{ExecuteError, FULL_RATE, FailureKind, Flow, Report, TaskOrder};

/// Steps between two reports: on a GPU each makes the device wait.
fn report_every(backend: &Backend) -> u32 {
    match backend {
        Backend::Cpu => 10,
        Backend::Gpu(_) => 100,
    }
}

/// What a block comes to.
pub(crate) struct Trained {
    pub(crate) splats: Splats,
    /// Where it is this block that trains them.
    pub(crate) exposures: Option<Exposures>,
    /// How far they are off, where the tree begins with this block.
    pub(crate) residual: Option<f64>,
}

/// A block about to be trained.
pub(crate) struct Block<'a> {
    pub(crate) trainer: &'a BlockTrainer,
    pub(crate) order: &'a TaskOrder,
    pub(crate) plan: &'a Plan,
    pub(crate) task: &'a Task,
    pub(crate) capture: &'a Arc<Capture>,
    pub(crate) reader: &'a WindowReader,
    pub(crate) memory: Option<&'a Memory>,
    pub(crate) exposures_given: Option<&'a Exposures>,
    pub(crate) residual_given: Option<f64>,
}

impl Block<'_> {
    /// Trains it, refines it or leaves it as it is, and prunes it.
    pub(crate) fn train(
        &self,
        results: BTreeMap<BlockId, Splats>,
        stopwatch: &mut Stopwatch,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<Trained, ExecuteError> {
        let Self { plan, task, .. } = *self;
        let Shared { finished, cap, metrics, .. } = &*self.trainer.shared;
        let eval_every = self.trainer.options.eval_every;
        let recipe = recipe_of(&plan.settings, task).at_rate(self.order.rate_permille as f32 / FULL_RATE as f32);
        let wrong = |error| match error {
            TrainError::NoViews | TrainError::Exposures | TrainError::Empty(_) => {
                ExecuteError::of(FailureKind::Input, format!("block {}: {error}", task.block))
            }
            TrainError::Device(_) => failed(format!("block {}: {error}", task.block)),
            TrainError::OutOfMemory(_) => {
                ExecuteError::of(FailureKind::OutOfMemory, format!("block {}: {error}", task.block))
            }
            // The photos' windows carry checksums: what cannot be read is away or damaged.
            TrainError::Source(_) => ExecuteError::of(FailureKind::Infrastructure, error),
        };
        let counts = |p: Vec3| self.owns(task, p.as_dvec3());
        let budget = self.budget(&results);
        let mut judge = Judge::new(plan, self.reader, &self.trainer.store);
        if judge.is_some() {
            finished.learn(self.order.plan, plan, &results);
        }
        let mut views = self.windows(&task.views)?;
        let mut start = self.start(results, &views, &recipe)?;
        let settled = self.is_settled(&start, &views, &counts).map_err(wrong)?;
        if settled {
            let coarser = refine::coarser(&views);
            if !plan.settings.antialiased {
                start = refine::moved(start, &views, &coarser);
            }
            views = coarser;
            self.trainer.shared.settled.fetch_add(1, Ordering::Relaxed);
        }
        let (initial, context) = start;
        let mut measure = |splats: &Splats| {
            let judge = judge.as_mut()?;
            let merged = finished.with(self.order.plan, plan, task.block, &self.handed_on(splats.clone(), &views));
            judge.psnr(&merged).map(|psnr| (psnr, merged.len() as u64))
        };
        let cut = task.context_cut();
        let keeps = |p: Vec3| self.trains(&cut, p.as_dvec3());
        let job_of = |initial, steps| train::Job {
            initial,
            context: context.as_ref(),
            views: &views,
            counts: &counts,
            keeps: &keeps,
            budget,
            steps,
            antialiased: plan.settings.antialiased,
            seed: self.seed(),
            size_bounds_metres: self.size_bounds_metres(&views),
            exposures: self.exposures_given,
            trains_exposures: plan.settings.exposure && task.parent.is_none(),
            recipe: &recipe,
            source: self.reader,
            backend: &self.trainer.backend,
        };
        let pruning = self.pruning();
        let mut job = job_of(initial, task.steps);
        if settled {
            job.steps = 0;
        } else if pruning.is_some() {
            job.steps = prune::steps_before(task.steps);
        }
        let planned = job.steps;
        let limit = cap.as_ref().filter(|_| !settled).map(|cap| {
            let evaluate = |splats: &Splats| stopwatch.paused(|| measure(splats));
            let part = f64::from(planned) / f64::from(task.steps.max(1));
            Limit::of(cap, plan, self.order.task, &mut job, part, eval_every, evaluate)
        });
        let over = || limit.as_ref().is_some_and(Limit::is_over);
        let trained = job.steps;
        // In proportion, where the cap left fewer.
        let whole = match planned {
            0 => task.steps,
            _ => (u64::from(task.steps) * u64::from(trained)).div_ceil(u64::from(planned)) as u32,
        };
        let steps = trained + pruning.map_or(0, |pruning| pruning.steps(whole));
        let (mut cancelled, mut late, mut diverged) = (false, false, false);
        let memory_bytes = self.trainer.options.memory_bytes;
        let mut room = (memory_bytes > 0).then(|| Room::of(memory_bytes)).flatten();
        let mut overrun = None;
        let every = report_every(&self.trainer.backend);
        // Is a step to be reported, and the merged model measured for it?
        let due = |step: u32, views: u32, last: bool| -> Option<bool> {
            let passed = |every: u32| (0..views).any(|n| step.saturating_sub(n).is_multiple_of(every));
            let evaluate = (last && is_look(plan, self.order.task)) || (eval_every > 0 && passed(eval_every));
            (evaluate || last || passed(every)).then_some(evaluate)
        };
        // Reports a step, measured where splats are given; whether to go on.
        let mut tell = |step: u32, loss: f64, count: usize, splats: Option<&Splats>, last: bool| -> bool {
            let (cpu_seconds, wall_seconds) = (stopwatch.cpu_seconds(), stopwatch.wall_seconds());
            metrics.splats.set(count as i64);
            metrics.cache_bytes.set(self.reader.stats().cached_bytes as i64);
            let measured = splats.and_then(|splats| stopwatch.paused(|| measure(splats)));
            let flow = report(Report {
                step: step.into(),
                steps: steps.into(),
                loss,
                splats: count as u64,
                cpu_seconds,
                wall_seconds,
                psnr: measured.map(|(psnr, _)| psnr),
                merged_splats: measured.map(|(_, splats)| splats),
            });
            cancelled |= flow == Flow::Stop && !last;
            overrun = room.as_mut().filter(|_| !last).and_then(Room::overrun);
            !cancelled && overrun.is_none()
        };
        let going = |on: bool| if on { train::Flow::Continue } else { train::Flow::Stop };
        let (mut loss, mut stopped) = (f64::NAN, false);
        let from = self.memory.and_then(|memory| memory.checkpoint(&self.trainer.store));
        if from.is_some() {
            self.trainer.shared.resumed.fetch_add(1, Ordering::Relaxed);
        }
        let clock = Stopwatch::start();
        let mut next_checkpoint = self.trainer.options.checkpoint_seconds;
        let (mut splats, exposures) = train::train_from(job, from, &mut |mut now| {
            metrics.steps.inc();
            let (seconds, last) = (clock.wall_seconds(), now.step == now.steps);
            // The last one is what pruning begins with.
            if let Some(memory) = self.memory
                && (seconds >= next_checkpoint || (last && seconds > 0.5 * next_checkpoint))
                && let Some(state) = now.state()
            {
                self.keep_checkpoint(memory, state);
                next_checkpoint = seconds + self.trainer.options.checkpoint_seconds;
            }
            late = !last && over();
            let (step, last) = (now.step, late || now.step == steps);
            if let Some(evaluate) = due(step, now.views, last) {
                // Where there is no telling, training ends with why.
                loss = now.loss().unwrap_or(f64::NAN);
                diverged = now.skipped().is_some_and(|skipped| has_diverged(skipped, step));
                if diverged {
                    return train::Flow::Stop;
                }
                let count = now.count();
                stopped = !tell(step, loss, count, if evaluate { now.splats() } else { None }, last);
            }
            // Whoever takes it up begins here, be it this worker.
            if stopped
                && let Some(memory) = self.memory
                && let Some(state) = now.state()
            {
                self.keep_checkpoint(memory, state);
            }
            going(!stopped && !late)
        })
        .map_err(wrong)?;
        if diverged {
            let message = format!("block {}: training diverges: too many losses are no numbers", task.block);
            return Err(ExecuteError::of(FailureKind::Numeric, message));
        }
        // Where training's last step is not the last to tell.
        let mut end = (settled && pruning.is_none()).then_some(task.steps);
        if let Some(pruning) = pruning.filter(|_| !stopped && !late) {
            let job = train::Job { exposures: exposures.as_ref().or(self.exposures_given), ..job_of(splats, whole) };
            let (pruned, outcome) = prune::within_tolerance(job, &pruning, &mut |mut now| {
                metrics.steps.inc();
                late = over();
                // Once more at the end, with what pruning chose.
                let (step, recovery) = (trained + now.step.min(now.steps - 1), &mut now.recovery);
                let due = due(step, recovery.views, false);
                if due.is_some() || recovery.step == recovery.steps {
                    loss = recovery.loss().unwrap_or(f64::NAN);
                }
                let told = due.is_none_or(|evaluate| {
                    let count = recovery.count();
                    tell(step, loss, count, if evaluate { recovery.splats() } else { None }, false)
                });
                going(told && !late)
            })
            .map_err(wrong)?;
            tracing::info!(block = %task.block, before = outcome.splats[0], after = outcome.splats[1], "pruned");
            splats = pruned;
            end = Some(steps);
        }
        if let Some(end) = end {
            let evaluate = due(end, 1, true) == Some(true);
            tell(end, loss, splats.len(), evaluate.then_some(&splats), true);
        }
        if let Some(taken) = overrun {
            let [taken, most] = [taken, memory_bytes].map(|bytes| bytes.div_ceil(1 << 20));
            let message = format!("block {}: the worker takes {taken} MiB, --memory gives it {most}", task.block);
            return Err(ExecuteError::of(FailureKind::OutOfMemory, message));
        }
        if cancelled {
            return Err(failed("stopped before its end, as asked"));
        }
        if late {
            cap.iter().for_each(Cap::shorten);
        }
        let exposed = exposures.as_ref().or(self.exposures_given);
        let residual = self.residual(&splats, &views, exposed).map_err(wrong)?;
        let splats = self.handed_on(splats, &views);
        if judge.is_some() {
            finished.insert(self.order.plan, plan, task.block, &splats);
        }
        Ok(Trained { splats, exposures, residual })
    }

    fn keep_checkpoint(&self, memory: &Memory, state: &train::State) {
        if memory.keep_checkpoint(&self.trainer.store, state) {
            self.trainer.shared.metrics.checkpoints.inc();
        }
    }

    /// How far the splats of a root with children are off in what they were trained on.
    fn residual(
        &self,
        splats: &Splats,
        views: &[TrainView],
        exposures: Option<&Exposures>,
    ) -> Result<Option<f64>, TrainError> {
        let settings = &self.plan.settings;
        if self.task.parent.is_some() || settings.residual == 0.0 || self.plan.tasks.len() == 1 {
            return Ok(None);
        }
        let all = EvaluationViews { views, context: None, antialiased: settings.antialiased, exposures, source: self.reader };
        refine::residual(all, splats)
    }

    /// The splats as other blocks, viewers and the merged model draw them: at full resolution. Compensated opacity does not
    /// depend on the resolution.
    pub(crate) fn handed_on(&self, mut splats: Splats, views: &[TrainView]) -> Splats {
        if !self.plan.settings.antialiased {
            train::low_pass::to_full_resolution(&mut splats, views);
        }
        splats
    }

    /// Splats to end with in the core. The plan shares the budget among the children of a block by what is known beforehand;
    /// the parent's growth has since put splats where the error was, so the same sum is shared as they lie, less what the root
    /// has of far splats, which no child replaces.
    fn budget(&self, results: &BTreeMap<BlockId, Splats>) -> usize {
        let (plan, task) = (self.plan, self.task);
        let Some(splats) = task.parent.and_then(|parent| results.get(&parent)) else { return task.budget as usize };
        let siblings: Vec<&Task> = plan.tasks.iter().filter(|t| t.parent == task.parent).collect();
        let total: u64 = siblings.iter().map(|t| u64::from(t.budget)).sum();
        let mut counts = vec![0u64; siblings.len()];
        for i in 0..splats.len() {
            let place = splats.mean(i).as_dvec3();
            if let Some(of) = siblings.iter().position(|t| self.owns(t, place)) {
                counts[of] += 1;
            }
        }
        let own = siblings.iter().position(|t| t.block == task.block).map_or(0, |i| counts[i]);
        let of_level = plan.tasks.iter().filter(|t| t.block.level == task.block.level).map(|t| u64::from(t.budget));
        let of_level = of_level.sum::<u64>().max(1);
        let is_far = |root: &Splats| (0..root.len()).filter(|&i| plan.ground.is_background(root.mean(i).as_dvec3())).count();
        let far = results.get(&BlockId::ROOT).map_or(0, is_far) as u64;
        let total = total * (of_level - far.min(of_level / 2)) / of_level;
        (total * own / counts.iter().sum::<u64>().max(1)).max(1) as usize
    }

    /// Blocks without children are pruned: what lies above them, they replace.
    fn pruning(&self) -> Option<Pruning> {
        let tolerance_db = self.plan.settings.tolerance_db;
        let is_leaf = self.plan.tasks.iter().all(|task| task.parent != Some(self.task.block));
        (is_leaf && tolerance_db > 0.0).then(|| Pruning::within(tolerance_db))
    }

    /// Does the block stay at its parent's resolution?
    fn is_settled(
        &self,
        start: &Start,
        views: &[TrainView],
        counts: &(dyn Fn(Vec3) -> bool + Sync),
    ) -> Result<bool, TrainError> {
        let Self { plan, reader, exposures_given: exposures, .. } = *self;
        let Some(all) = self.residual_given.filter(|_| plan.settings.residual > 0.0) else { return Ok(false) };
        let antialiased = plan.settings.antialiased;
        let around = EvaluationViews { views, context: start.1.as_ref(), antialiased, exposures, source: reader };
        let found = refine::residual_of_core(around, &start.0, counts)?;
        tracing::debug!(block = %self.task.block, found, all, "what its parent lacks, and what the root lacks");
        Ok(found.is_some_and(|found| found <= plan.settings.residual * all))
    }

    pub(crate) fn seed(&self) -> u64 {
        let BlockId { level, x, y } = self.task.block;
        let place = u64::from(level) << 58 | u64::from(x) << 29 | u64::from(y);
        train::random::bits(self.plan.settings.seed, place)
    }

    /// From a twentieth of a pixel of the block's level to three times what the backdrop begins with. One of its splats that is let
    /// grow much farther becomes a haze over every photo that looks its way; what has a parent has none of them.
    pub(crate) fn size_bounds_metres(&self, views: &[TrainView]) -> [f32; 2] {
        let largest = match self.task.parent {
            None => 3.0 * train::init::backdrop_size_metres(self.surroundings(views).1),
            Some(_) => 0.5 * self.plan.ground.edge_metres,
        };
        [self.task.rho_metres as f32 * 0.05, largest as f32]
    }

    pub(crate) fn windows(&self, uses: &[ViewUse]) -> Result<Vec<TrainView>, ExecuteError> {
        let window = |use_: &ViewUse| {
            let view = self.capture.views.get(use_.view as usize);
            let view = view.ok_or_else(|| failed(format!("the capture has no view {}", use_.view)))?;
            Ok(TrainView { view: use_.view, mip: use_.mip, rect: use_.window, camera: view.camera })
        };
        uses.iter().map(window).collect()
    }

    /// Is this place a task's in the end? What is far is the root's.
    pub(crate) fn owns(&self, task: &Task, place: glam::DVec3) -> bool {
        let ground = &self.plan.ground;
        ground.owns(task.block, place) && (task.parent.is_none() || !ground.is_background(place))
    }

    /// Is this place the block's to train: in its halo, not far, and not in the core of a neighbour that is final already?
    pub(crate) fn trains(&self, cut: &blocks::Cut, place: glam::DVec3) -> bool {
        let ground = &self.plan.ground;
        let owner = cut.owner_of(ground, place);
        self.task.parent.is_none()
            || (ground.in_halo(self.task.block, place)
                && !ground.is_background(place)
                && owner.is_none_or(|b| b.level < self.task.block.level))
    }
}

/// Is a loss that is no number the rule rather than the exception? One such step is left out, and harms nothing.
fn has_diverged(skipped: u32, step: u32) -> bool {
    const FEW: u32 = 10;
    skipped > FEW && skipped > step / 20
}

const _: () = assert!(blocks::MAX_VIEWS_PER_STEP == train::MAX_VIEWS_PER_STEP);

/// The recipe of a block's level: a child starts from splats that fit already, one mip coarser.
pub(crate) fn recipe_of(settings: &PlanSettings, task: &Task) -> Recipe {
    let from_points = task.parent.is_none();
    let recipe = if from_points { Recipe::default() } else { Recipe::refinement() };
    let recipe = Recipe { views_per_step: settings.views_per_step, ..recipe };
    if settings.residual > 0.0 { recipe } else { recipe.fixed_schedule(from_points) }
}
