//! Carries out a task: trains a block.
//!
//! ```text
//! plan, capture, results of parent and context ──from the store──▶ initial splats and frozen context
//!   ──train──▶ splats of the block, halo included ──to the store──▶ artefact
//! ```
//! Everything here follows from the plan and its inputs, so an attempt anywhere gives the same bytes.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use blocks::{Mode, Plan, PlanSettings, Task, ViewUse};
use dataset::windows::WindowReader;
use glam::Vec3;
use rayon::prelude::*;
use render::cpu::Isa;
use scene::frame::{self, About};
use scene::{ArtefactId, BlockId, Capture, Exposures, SparsePoints, Splats};
use store::BlockingStore;
use train::importance::Views;
use train::prune::{self, Pruning};
use train::{Recipe, TrainError, TrainView};

use crate::cap::{Cap, Limit};
use crate::clock::Stopwatch;
use crate::memory::Memory;
use crate::merged::{Finished, Judge};
use crate::refine::{self, Start};
use crate::{Execute, ExecuteError, Flow, Report, TaskOrder};

/// Steps between two reports.
const REPORT_EVERY: u32 = 10;

/// What a worker may use, and what it is asked to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainerOptions {
    /// Threads of the compute pool, at least 1.
    pub threads: usize,
    /// Steps between two evaluations of the merged model so far; 0 = only at the end of a task.
    pub eval_every: u32,
    /// Bound on the windows kept in memory.
    pub cache_bytes: usize,
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
}

/// Trains blocks on the CPU backend.
pub struct BlockTrainer {
    store: BlockingStore,
    options: TrainerOptions,
    shared: Arc<Shared>,
    pool: rayon::ThreadPool,
}

/// The name of the backend that [`BlockTrainer`] runs on, instruction set included.
pub fn backend() -> String {
    format!("cpu-{}", Isa::detect().name())
}

impl BlockTrainer {
    /// A trainer over this store.
    ///
    /// # Errors
    /// The operating system refused the threads.
    pub fn new(store: BlockingStore, options: TrainerOptions, shared: Arc<Shared>) -> Result<Self, String> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(options.threads.max(1))
            .build()
            .map_err(|error| format!("cannot start {} threads: {error}", options.threads))?;
        Ok(Self { store, options, shared, pool })
    }
}

impl Execute for BlockTrainer {
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        let mut stopwatch = Stopwatch::start();
        let plan = self.store.get(order.plan).map_err(failed)?;
        let plan = Plan::from_frame(&plan).map_err(failed)?;
        let task = plan.tasks.get(order.task as usize).ok_or_else(|| failed("the plan has no such task"))?;
        let capture = Arc::new(dataset::ingest::load_capture(&self.store, plan.capture).map_err(failed)?);
        let reader = WindowReader::new(capture.clone(), self.store.clone(), self.options.cache_bytes);
        let (results, given) = self.results(&plan, task, order)?;
        let memory = self.options.resume.then(|| Memory::of(order)).filter(|_| self.shared.cap.is_none());
        if let Some((artefact, splats)) = memory.as_ref().and_then(|memory| memory.result(&self.store)) {
            self.shared.resumed.fetch_add(1, Ordering::Relaxed);
            let psnr = Judge::new(&plan, &capture, &self.store).and_then(|mut judge| {
                let finished = &self.shared.finished;
                finished.learn(order.plan, &plan, &results);
                finished.insert(order.plan, &plan, task.block, &splats);
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
            Some(id) => Some(Exposures::from_frame(&self.store.get(id).map_err(failed)?).map_err(failed)?),
            None => None,
        };
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
        let Trained { splats, exposures, residual } =
            self.pool.install(|| block.train(results, &mut stopwatch, report))?;
        let exposures = match exposures {
            Some(trained) => Some(self.store.put(trained.to_frame()).map_err(failed)?),
            None => given.exposures,
        };
        let about = About { exposures, residual: residual.or(given.residual) };
        let artefact = self.store.put(frame::encode_result(&splats, about)).map_err(failed)?;
        self.shared.cap.iter().for_each(|cap| cap.finish(order.task));
        if let Some(memory) = memory {
            memory.keep_result(&self.store, artefact);
        }
        Ok(artefact)
    }
}

impl BlockTrainer {
    /// The splats of the blocks that the task needs, and what else its parent hands down.
    fn results(&self, plan: &Plan, task: &Task, order: &TaskOrder) -> Result<Inputs, ExecuteError> {
        let (mut results, mut given) = (BTreeMap::new(), About::default());
        for block in task.context_cut().blocks() {
            let index = plan.tasks.iter().position(|t| t.block == block);
            let id = index.and_then(|i| order.inputs.get(&(i as u32)));
            let id = id.ok_or_else(|| failed(format!("the result of block {block} was not handed over")))?;
            let bytes = self.store.get(*id).map_err(failed)?;
            let (splats, about) = frame::decode_result(&bytes).map_err(failed)?;
            results.insert(block, splats);
            given = if Some(block) == task.parent { about } else { given };
        }
        Ok((results, given))
    }
}

/// What other tasks made: splats by block, and what else the parent hands down.
type Inputs = (BTreeMap<BlockId, Splats>, About);

/// What a block comes to.
struct Trained {
    splats: Splats,
    /// Where it is this block that trains them.
    exposures: Option<Exposures>,
    /// How far they are off, where the tree begins with this block.
    residual: Option<f64>,
}

/// A block about to be trained.
struct Block<'a> {
    trainer: &'a BlockTrainer,
    order: &'a TaskOrder,
    plan: &'a Plan,
    task: &'a Task,
    capture: &'a Arc<Capture>,
    reader: &'a WindowReader,
    memory: Option<&'a Memory>,
    exposures_given: Option<&'a Exposures>,
    residual_given: Option<f64>,
}

impl Block<'_> {
    fn train(
        &self,
        results: BTreeMap<BlockId, Splats>,
        stopwatch: &mut Stopwatch,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<Trained, ExecuteError> {
        let Self { plan, task, .. } = *self;
        let Shared { finished, cap, .. } = &*self.trainer.shared;
        let eval_every = self.trainer.options.eval_every;
        let recipe = recipe_of(&plan.settings, task);
        let wrong = |error| match error {
            TrainError::NoViews | TrainError::Empty(_) => {
                ExecuteError { message: format!("block {}: {error}", task.block), is_input: true }
            }
            TrainError::Source(_) => failed(error),
        };
        let counts = |p: Vec3| self.owns(task, p.as_dvec3());
        let budget = self.budget(&results);
        let mut judge = Judge::new(plan, self.capture, &self.trainer.store);
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
            size_bounds_metres: self.size_bounds_metres(),
            exposures: self.exposures_given,
            trains_exposures: plan.settings.exposure && task.parent.is_none(),
            recipe: &recipe,
            source: self.reader,
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
        let (mut cancelled, mut late) = (false, false);
        // Reports a step if one is due; whether to go on.
        let mut tell = |step: u32, loss: f64, splats: &Splats, last: bool| -> bool {
            let evaluate = last || (eval_every > 0 && step.is_multiple_of(eval_every));
            if !evaluate && !step.is_multiple_of(REPORT_EVERY) {
                return true;
            }
            let (cpu_seconds, wall_seconds) = (stopwatch.cpu_seconds(), stopwatch.wall_seconds());
            let measured = if evaluate { stopwatch.paused(|| measure(splats)) } else { None };
            let flow = report(Report {
                step: step.into(),
                steps: steps.into(),
                loss,
                splats: splats.len() as u64,
                cpu_seconds,
                wall_seconds,
                psnr: measured.map(|(psnr, _)| psnr),
                merged_splats: measured.map(|(_, splats)| splats),
            });
            cancelled |= flow == Flow::Stop && !last;
            !cancelled
        };
        let going = |on: bool| if on { train::Flow::Continue } else { train::Flow::Stop };
        let (mut loss, mut stopped) = (f64::NAN, false);
        let from = self.memory.and_then(|memory| memory.checkpoint(&self.trainer.store));
        if from.is_some() {
            self.trainer.shared.resumed.fetch_add(1, Ordering::Relaxed);
        }
        let clock = Stopwatch::start();
        let mut next_checkpoint = self.trainer.options.checkpoint_seconds;
        let (mut splats, exposures) = train::train_on(job, from, &mut |now| {
            let (seconds, last) = (clock.wall_seconds(), now.step == now.steps);
            // The last one is what pruning begins with.
            if let Some(memory) = self.memory
                && (seconds >= next_checkpoint || (last && seconds > 0.5 * next_checkpoint))
            {
                memory.keep_checkpoint(&self.trainer.store, now.state);
                next_checkpoint = seconds + self.trainer.options.checkpoint_seconds;
            }
            late = now.step < now.steps && over();
            loss = now.loss;
            stopped = !tell(now.step, loss, now.splats, late || now.step == steps);
            going(!stopped && !late)
        })
        .map_err(wrong)?;
        if let Some(pruning) = pruning.filter(|_| !stopped && !late) {
            let job = train::Job { exposures: exposures.as_ref().or(self.exposures_given), ..job_of(splats, whole) };
            let (pruned, outcome) = prune::within_tolerance(job, &pruning, &mut |now| {
                late = over();
                loss = now.loss;
                // Once more at the end, with what pruning chose.
                going(tell(trained + now.step.min(now.steps - 1), loss, now.splats, false) && !late)
            })
            .map_err(wrong)?;
            tracing::info!(block = %task.block, before = outcome.splats[0], after = outcome.splats[1], "pruned");
            splats = pruned;
            tell(steps, loss, &splats, true);
        }
        if settled && pruning.is_none() {
            tell(task.steps, loss, &splats, true);
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
        let all = Views { views, context: None, antialiased: settings.antialiased, exposures, source: self.reader };
        refine::residual(all, splats)
    }

    /// The splats as other blocks, viewers and the merged model draw them: at full resolution. Compensated opacity does not
    /// depend on the resolution.
    fn handed_on(&self, mut splats: Splats, views: &[TrainView]) -> Splats {
        if !self.plan.settings.antialiased {
            train::blur::to_full_images(&mut splats, views);
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
        let is_far = |root: &Splats| (0..root.len()).filter(|&i| plan.ground.is_far(root.mean(i).as_dvec3())).count();
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
        let around = Views { views, context: start.1.as_ref(), antialiased, exposures, source: reader };
        let found = refine::residual_of_core(around, &start.0, counts)?;
        tracing::debug!(block = %self.task.block, found, all, "what its parent lacks, and what the root lacks");
        Ok(found.is_some_and(|found| found <= plan.settings.residual * all))
    }

    fn seed(&self) -> u64 {
        let BlockId { level, x, y } = self.task.block;
        let place = u64::from(level) << 58 | u64::from(x) << 29 | u64::from(y);
        train::random::bits(self.plan.settings.seed, place)
    }

    /// From a twentieth of a pixel of the block's level to twice the edge of the scene, which the backdrop needs.
    fn size_bounds_metres(&self) -> [f32; 2] {
        [self.task.rho_metres as f32 * 0.05, 2.0 * self.plan.ground.edge_metres as f32]
    }

    fn windows(&self, uses: &[ViewUse]) -> Result<Vec<TrainView>, ExecuteError> {
        let window = |use_: &ViewUse| {
            let view = self.capture.views.get(use_.view as usize);
            let view = view.ok_or_else(|| failed(format!("the capture has no view {}", use_.view)))?;
            Ok(TrainView { view: use_.view, mip: use_.mip, rect: use_.window, camera: view.camera })
        };
        uses.iter().map(window).collect()
    }

    /// The splats to train, and those to draw around them: from the parent and its neighbours, or from the points.
    fn start(
        &self,
        results: BTreeMap<BlockId, Splats>,
        views: &[TrainView],
        recipe: &Recipe,
    ) -> Result<Start, ExecuteError> {
        let Self { plan, task, capture, .. } = self;
        let sh_degree = plan.settings.sh_degree;
        if results.is_empty() {
            let all = plan.settings.mode != Mode::Flat;
            let keep = |p: glam::DVec3| all || views.iter().any(|view| sees(view, p, 0.0));
            let (centre, radius) = self.surroundings(views);
            let backdrop = train::init::backdrop(views, self.reader, sh_degree, centre, radius).map_err(failed)?;
            let points = &capture.points;
            let rows: Vec<usize> = (0..points.len()).filter(|&i| keep(points.positions[i])).collect();
            let places: Vec<glam::DVec3> = rows.iter().map(|&i| points.positions[i]).collect();
            // There may be more points than splats are wanted.
            let budget = plan.first_splats(task) as usize;
            let most = budget.saturating_sub(backdrop.len()).max(budget / 2).max(1);
            let chosen = train::init::thinned(&places, most);
            let points = SparsePoints {
                positions: chosen.iter().map(|&i| places[i]).collect(),
                colours: chosen.iter().map(|&i| points.colours[rows[i]]).collect(),
                ..SparsePoints::default()
            };
            let sizes = self.size_bounds_metres();
            let mut initial = train::init::from_points(&points, sh_degree, recipe.initial_opacity, sizes);
            initial.append(&backdrop);
            return Ok((initial, None));
        }
        let cut = task.context_cut();
        let mut initial = Splats::new(sh_degree);
        let mut context = Splats::new(sh_degree);
        for (block, mut splats) in results {
            if !plan.settings.antialiased {
                train::blur::from_full_images(&mut splats, views);
            }
            let splats = cut.keep(&splats, &plan.ground, block);
            let inside = |i: usize| self.trains(&cut, splats.mean(i).as_dvec3());
            initial.append(&splats.filter(inside));
            // Only what a window can show is worth keeping in memory.
            let shown: Vec<bool> = (0..splats.len())
                .into_par_iter()
                .map(|i| !inside(i) && views.iter().any(|view| sees(view, splats.mean(i).as_dvec3(), 0.2)))
                .collect();
            context.append(&splats.filter(|i| shown[i]));
        }
        let context = (!context.is_empty()).then_some(context);
        Ok((initial, context))
    }

    /// Is this place a task's in the end? What is far is the root's.
    fn owns(&self, task: &Task, place: glam::DVec3) -> bool {
        let ground = &self.plan.ground;
        ground.owns(task.block, place) && (task.parent.is_none() || !ground.is_far(place))
    }

    /// Is this place the block's to train: in its halo, not far, and not in the core of a neighbour that is final already?
    fn trains(&self, cut: &blocks::Cut, place: glam::DVec3) -> bool {
        let ground = &self.plan.ground;
        let owner = cut.owner_of(ground, place);
        self.task.parent.is_none()
            || (ground.in_halo(self.task.block, place)
                && !ground.is_far(place)
                && owner.is_none_or(|b| b.level < self.task.block.level))
    }

    /// Where the backdrop stands: around the cameras, five times as far as all but the farthest points.
    fn surroundings(&self, views: &[TrainView]) -> (glam::DVec3, f64) {
        let cameras = views.iter().map(|view| view.camera.centre());
        let centre = cameras.clone().sum::<glam::DVec3>() / views.len().max(1) as f64;
        let points = self.capture.points.positions.iter().copied();
        let mut distances: Vec<f64> =
            points.chain(cameras).map(|p| p.distance(centre)).filter(|d| d.is_finite()).collect();
        distances.sort_by(f64::total_cmp);
        let far = distances.get(distances.len() * 98 / 100).copied().unwrap_or(1.0);
        (centre, 5.0 * far.max(self.plan.ground.edge_metres * 0.5))
    }
}

/// The recipe of a block's level: a child starts from splats that fit already, one mip coarser.
pub(crate) fn recipe_of(settings: &PlanSettings, task: &Task) -> Recipe {
    let from_points = task.parent.is_none();
    let recipe = if from_points { Recipe::default() } else { Recipe::refinement() };
    if settings.residual > 0.0 { recipe } else { recipe.unmeasured(from_points) }
}

/// Does a point project into the window, grown by `margin` of its size on every side?
fn sees(view: &TrainView, point: glam::DVec3, margin: f64) -> bool {
    let camera = view.camera.mip(view.mip).window(view.rect);
    let (pixel, depth) = camera.project(point);
    let (width, height) = (f64::from(view.rect.width), f64::from(view.rect.height));
    let inside = |v: f64, size: f64| v >= -margin * size && v < size * (1.0 + margin);
    depth > 0.0 && inside(pixel.x, width) && inside(pixel.y, height)
}

fn failed(error: impl ToString) -> ExecuteError {
    ExecuteError { message: error.to_string(), is_input: false }
}
