//! The training loop of one block.
//!
//! A step renders windows of one or more views, compares them with the photos and updates the visible splats. Steps are
//! counted in views. Training starts at coarse mips, densification follows a schedule towards the budget, and learning
//! rates decay to the end. The frozen context covers what lies outside the block, and a pixel is weighted by the share
//! of it that the block's own splats explain.

use std::sync::Arc;

use render::Options;
use render::cpu::Isa;
use scene::{Camera, Exposures, Poses, Rect, Rigid, Splats, Swing};

use crate::checkpoint::State;
use crate::coarse_to_fine::{self, CoarseToFine};
use crate::device::Backend;
use crate::device::step::{MAX_VIEWS_PER_STEP, StatePart, Step, TrainDevice, ViewSample};
use crate::error::TrainError;
use crate::exposure::ExposureTraining;
use crate::growth::{self, DensificationStats, Grown};
use crate::job::{Flow, Job};
use crate::optimiser::{Adam, LearningRates};
use crate::pose::path::PathRates;
use crate::pose::{GivenPoses, PoseRates, PoseTraining, Rates};
use crate::random;
use crate::recipe::Recipe;
use crate::size_limit::SizeLimit;
use crate::source::AHEAD;
use crate::swing::{SwingStep, SwingTraining};
use crate::view::TrainView;

/// Smallest number of periods that the error of a job is measured over, see [`Trainer::period`]. A job of three epochs
/// that waits for the end of one stays coarse for as long as its recipe allows (docs/decisions/0064).
const MIN_PERIODS: u32 = 16;

/// The progress of training. Methods download their values from the device, which takes time and does not change the
/// result. They return `None` where the download fails; training then ends with that error.
pub struct Progress<'a> {
    /// Steps done, counted in views.
    pub step: u32,
    /// Steps in all.
    pub steps: u32,
    /// Views of the last optimiser step.
    pub views: u32,
    state: &'a mut State,
    device: &'a mut dyn TrainDevice,
    failed: &'a mut Option<TrainError>,
}

impl Progress<'_> {
    /// Mean loss over the views of the last step.
    pub fn loss(&mut self) -> Option<f64> {
        self.download(StatePart::Tally).map(|state| state.loss)
    }

    /// Number of steps that were skipped because their loss was not finite.
    pub fn skipped(&mut self) -> Option<u32> {
        self.download(StatePart::Tally).map(|state| state.skipped)
    }

    /// Number of splats.
    pub fn count(&self) -> usize {
        self.state.splats.len()
    }

    /// Current splats.
    pub fn splats(&mut self) -> Option<&Splats> {
        self.download(StatePart::Splats).map(|state| &state.splats)
    }

    /// State from which training can be resumed.
    pub fn state(&mut self) -> Option<&State> {
        self.download(StatePart::All)
    }

    fn download(&mut self, part: StatePart) -> Option<&State> {
        match self.device.download(self.state, part) {
            Ok(()) => Some(self.state),
            Err(error) => {
                self.failed.get_or_insert(error);
                None
            }
        }
    }
}

/// The result of training.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// The splats.
    pub splats: Splats,
    /// The exposures, where they are trained.
    pub exposures: Option<Exposures>,
    /// The refined poses, where they are trained.
    pub poses: Option<Poses>,
    /// Where the path of an object is refined: each time in seconds with the motion of the object then, in its own axes, that
    /// `world_from_object` is followed by. Ascending.
    pub motions: Vec<(f64, Rigid)>,
    /// How the splats swing, where they do.
    pub swing: Option<Swing>,
}

/// Trains a block. Calls `report` after every step.
///
/// # Errors
/// See [`TrainError`].
pub fn train(job: Job, report: &mut dyn FnMut(Progress) -> Flow) -> Result<Splats, TrainError> {
    train_from(job, None, report).map(|trained| trained.splats)
}

/// Trains a block, resuming from a state of the same job where one is given; the result is that of an uninterrupted
/// run.
///
/// # Errors
/// See [`TrainError`].
pub fn train_from(
    job: Job,
    from: Option<State>,
    report: &mut dyn FnMut(Progress) -> Flow,
) -> Result<Trained, TrainError> {
    if job.views.is_empty() {
        return Err(TrainError::NoViews);
    }
    let mut trainer = Trainer::new(job, from)?;
    let steps = trainer.job.steps;
    while trainer.state.step < steps {
        let views = trainer.step()?;
        let mut failed = None;
        let Trainer { state, device, .. } = &mut trainer;
        let step = state.step;
        let flow = report(Progress { step, steps, views, state, device: &mut **device, failed: &mut failed });
        if let Some(error) = failed {
            return Err(error);
        }
        if flow == Flow::Stop {
            break;
        }
    }
    trainer.device.download(&mut trainer.state, StatePart::Splats)?;
    let Trainer { state: State { splats, exposures, poses, swing, .. }, given, .. } = trainer;
    let exposures = exposures.map(|exposures| exposures.exposures());
    let motions = poses.as_ref().map_or(Vec::new(), |poses| poses.motions(&given));
    let walk = given.times.as_ref().and_then(|times| times.walk.as_ref());
    let swing = swing.zip(walk).and_then(|(swing, walk)| swing.swing(walk));
    Ok(Trained { splats, exposures, poses: poses.map(|poses| poses.poses(&given)), motions, swing })
}

/// A job with its state and device.
struct Trainer<'a> {
    /// `initial` has moved into the state.
    job: Job<'a>,
    state: State,
    device: Box<dyn TrainDevice + 'a>,
    given: Arc<GivenPoses>,
    log_scale_bounds: [f32; 2],
    size_limit: SizeLimit,
    /// Detail that each coarse mip lacks, from `first_stage` on.
    missing_detail: Vec<f64>,
    first_stage: u8,
    order: ViewOrder,
    prefetch_order: ViewOrder,
    /// First step whose window was not announced to the source.
    prefetch_step: u32,
}

impl<'a> Trainer<'a> {
    fn new(mut job: Job<'a>, from: Option<State>) -> Result<Self, TrainError> {
        let Job { context, views, counts, steps, recipe, .. } = job;
        let initial = std::mem::replace(&mut job.initial, Splats::new(0));
        if job.path.is_some() && !matches!(job.backend, Backend::Cpu) {
            return Err(TrainError::Device("the path of an object is refined on the CPU only".into()));
        }
        let refines = job.trains_poses || job.sensors.is_some() || job.path.is_some();
        let posed = if refines { views } else { &[] };
        let given = Arc::new(GivenPoses::of(posed, &initial, true, job.sensors, job.path));
        let state = from.unwrap_or_else(|| State {
            step: 0,
            skipped: 0,
            start_count: (0..initial.len()).filter(|&i| counts(initial.mean(i))).count(),
            coarse_to_fine: CoarseToFine::default(),
            adam: Adam::new(Isa::detect(), &initial),
            densification: DensificationStats::default(),
            exposures: job.trains_exposures.then(|| ExposureTraining::new(views)),
            poses: refines.then(|| PoseTraining::new(&given)),
            swing: job.path.and_then(|times| times.walk.as_ref()).map(|walk| SwingTraining::new(walk, initial.len())),
            splats: initial,
            loss: f64::NAN,
        });
        // A finished job needs no upload.
        let backend = if state.step < steps { job.backend } else { &Backend::Cpu };
        let device = backend.open(&state, recipe.lambda, job.picture_loss, context, &given)?;
        let first_stage = state.coarse_to_fine.stage;
        let missing_detail = (first_stage..recipe.coarse.len() as u8)
            .map(|stage| match recipe.detail_factor > 0.0 {
                true => coarse_to_fine::missing_detail(views, job.source, recipe.coarse.len() as u8 - stage),
                false => Ok(0.0),
            })
            .collect::<Result<Vec<f64>, _>>()?;
        let [order, prefetch_order] = [(); 2].map(|()| ViewOrder::new(views.len(), job.seed));
        let (log_scale_bounds, prefetch_step) = (job.size_bounds_metres.map(f32::ln), state.step + 1);
        Ok(Self {
            job,
            state,
            device,
            given,
            log_scale_bounds,
            size_limit: SizeLimit::of(views),
            missing_detail,
            first_stage,
            order,
            prefetch_order,
            prefetch_step,
        })
    }

    /// Computes one optimiser step and what the schedule asks for after it. Returns the number of views of the step.
    fn step(&mut self) -> Result<u32, TrainError> {
        let Job { context, views, steps, recipe, .. } = self.job;
        let step = self.state.step;
        if self.state.splats.is_empty() {
            return Err(TrainError::Empty(step));
        }
        let progress = step as f32 / steps as f32;
        // An epoch draws every view once, and a step does not cross its end or that of a period.
        let left = |every: u32| every - step % every;
        let left = left(views.len() as u32).min(left(self.period())).min(steps - step);
        let count = recipe.views_per_step.clamp(1, MAX_VIEWS_PER_STEP).min(left);
        let coarser = (recipe.coarse.len() as u8).saturating_sub(self.state.coarse_to_fine.stage);
        let samples = self.samples(count, coarser)?;

        let has_depth = samples.iter().any(|sample| sample.photo.depth.is_some());
        let depth_weight = if has_depth { recipe.depth_weight } else { 0.0 };
        let has_silhouette = samples.iter().any(|sample| sample.photo.silhouette.is_some());
        let silhouette_weight = if has_silhouette { recipe.silhouette_weight } else { 0.0 };
        let is_due = progress >= recipe.picture_from
            && (step..step + count).any(|step| step.is_multiple_of(recipe.picture_every.max(1)));
        let sh_degree = recipe.sh_from.iter().filter(|&&from| progress >= from).count() as u8;
        let options = Options {
            antialiased: self.job.antialiased,
            sh_degree: sh_degree.min(self.state.splats.sh_degree()),
            background: [0.0; 3],
            extras: context.is_some() || depth_weight > 0.0 || silhouette_weight > 0.0,
            inverse_depth: depth_weight > 0.0,
        };
        let visits = (steps as f32 / views.len() as f32).max(1.0);
        let [listen, moves] = recipe.swing_from;
        let swing = match progress {
            early if early < listen => None,
            early if early < moves => Some(SwingStep::Listen),
            _ => Some(SwingStep::Train {
                rate: recipe.swing * geometric(recipe.mean, progress) * (count as f32).sqrt(),
                decay: recipe.swing_decay / steps as f32,
                stride_rate: recipe.stride / steps as f32,
                beta2: recipe.beta2,
            }),
        };
        let inputs = Step {
            swing,
            samples,
            options,
            rates: Some(learning_rates(recipe, progress, (count as f32).sqrt(), self.log_scale_bounds)),
            depth_weight,
            silhouette_weight,
            picture_weight: if is_due { recipe.picture_weight } else { 0.0 },
            exposure_rate: geometric(recipe.exposure, progress) / visits,
            pose_rates: (progress >= recipe.pose_from).then(|| PoseRates {
                views: self.job.trains_poses.then(|| Rates {
                    rate: geometric(recipe.pose, progress) / visits,
                    decay: recipe.pose_decay / visits,
                }),
                sensors: self.job.sensors.map(|_| Rates {
                    rate: geometric(recipe.sensor, progress) / visits,
                    decay: recipe.pose_decay / visits,
                }),
                path: self.job.path.map(|_| PathRates {
                    metres: geometric(recipe.path, progress) / visits,
                    decay: recipe.path_decay / visits,
                }),
            }),
        };
        self.device.step(&mut self.state, inputs)?;

        self.state.step = step + count;
        let error = self.end_period()?;
        if coarser > 0 {
            self.advance_mip(error)?;
        }
        self.densify(count, progress, error)?;
        Ok(count)
    }

    /// Reads the windows of the next `count` steps and announces those after them.
    fn samples(&mut self, count: u32, coarser: u8) -> Result<Vec<ViewSample>, TrainError> {
        let Job { views, steps, exposures, source, .. } = self.job;
        let step = self.state.step;
        let window = |view: &TrainView| -> (u8, Rect, Camera) {
            (0..=coarser).rev().find_map(|c| view.at(c)).expect("at(0) is always Some")
        };
        let sample = |view: &TrainView| -> Result<ViewSample, TrainError> {
            let (mip, rect, camera) = window(view);
            let photo = source.window(view.view, mip, rect).map_err(TrainError::Source)?;
            let exposure = exposures.and_then(|exposures| exposures.of(view.view).copied());
            let camera_from_context = view.camera_from_context;
            Ok(ViewSample { view: view.view, mip, rect, photo, camera, camera_from_context, exposure })
        };
        let samples =
            (step..step + count).map(|step| sample(&views[self.order.of(step)])).collect::<Result<Vec<_>, _>>()?;
        // When growth ends early, steps are left out and their windows are never read: announce only a few ahead.
        self.prefetch_step = self.prefetch_step.max(step + count);
        while self.prefetch_step < steps.min(step + count + (AHEAD as u32).max(count)) {
            let next = &views[self.prefetch_order.of(self.prefetch_step)];
            let (mip, rect, _) = window(next);
            source.prefetch(next.view, mip, rect);
            self.prefetch_step += 1;
        }
        Ok(samples)
    }

    /// Number of steps that the error is measured over: an epoch, or part of it where there are few epochs.
    fn period(&self) -> u32 {
        let part = (self.job.steps / MIN_PERIODS).max(MAX_VIEWS_PER_STEP);
        part.min(self.job.views.len() as u32)
    }

    /// At the end of a period: its mean absolute error, unless a step was skipped.
    fn end_period(&mut self) -> Result<Option<f64>, TrainError> {
        let period = self.period();
        if !self.state.step.is_multiple_of(period) {
            return Ok(None);
        }
        self.device.download(&mut self.state, StatePart::Tally)?;
        let error = self.state.coarse_to_fine.end_period(self.state.splats.len(), period);
        self.device.upload(&self.state, StatePart::Tally)?;
        Ok(error)
    }

    /// Goes to the next finer mip when the error is down to the detail that the current mip lacks, or its share of
    /// steps is used.
    fn advance_mip(&mut self, error: Option<f64>) -> Result<(), TrainError> {
        let Job { steps, recipe, .. } = self.job;
        let CoarseToFine { stage, stage_start, .. } = self.state.coarse_to_fine;
        let detail = self.missing_detail[usize::from(stage) - usize::from(self.first_stage)];
        let fits = error.is_some_and(|e| e <= f64::from(recipe.detail_factor) * detail);
        let share = (recipe.coarse[usize::from(stage)] * steps as f32) as u32;
        if fits || self.state.step.saturating_sub(stage_start) >= share {
            self.device.download(&mut self.state, StatePart::Tally)?;
            self.state.coarse_to_fine.advance(self.state.step);
            self.device.upload(&self.state, StatePart::Tally)?;
        }
        Ok(())
    }

    /// Adds and removes splats where that is due after a step of `count` views. Skips the steps up to the end of growth
    /// where it no longer improves the error.
    fn densify(&mut self, count: u32, progress: f32, error: Option<f64>) -> Result<(), TrainError> {
        // The errors of parts of an epoch differ by which views they have.
        let is_epoch = self.period() as usize == self.job.views.len();
        let Job { counts, keeps, free_space, budget, steps, recipe, .. } = self.job;
        let (growth, state) = (&recipe.growth, &mut self.state);
        let until = (growth.until * steps as f32) as u32;
        let worth_db = f64::from(growth.worth_db);
        if worth_db > 0.0
            && error.is_some()
            && is_epoch
            && state.step < until
            && state.coarse_to_fine.growth_gains_less_than(worth_db)
        {
            state.step = until;
        }
        let every = growth.interval(steps);
        if (0..count).any(|n| (state.step - n).is_multiple_of(every))
            && progress >= growth.from
            && state.step <= until + every
            && state.step < steps
        {
            let target = growth.target(state.step, steps, state.start_count, budget);
            self.device.download(state, StatePart::Densification)?;
            let keeps = |place| keeps(place) && free_space.is_none_or(|free| !free.contains(place));
            let Grown { splats: mut grown, parents, rows, .. } =
                growth::refine(&state.splats, &mut state.densification, growth, target, counts, &keeps);
            if let Some(free) = free_space {
                free.clip(&mut grown);
            }
            self.size_limit.clip(&mut grown);
            state.splats = grown;
            if let Some(swing) = &mut state.swing {
                swing.rearrange(&parents, &rows);
            }
            self.device.rearrange(state, &rows)?;
        }
        Ok(())
    }
}

/// The order of views: every view once per epoch, shuffled anew for each epoch.
struct ViewOrder {
    seed: u64,
    views: usize,
    /// Epoch that `order` belongs to.
    epoch: Option<u32>,
    order: Vec<u32>,
}

impl ViewOrder {
    fn new(views: usize, seed: u64) -> Self {
        Self { seed, views, epoch: None, order: Vec::new() }
    }

    /// The view of a step.
    fn of(&mut self, step: u32) -> usize {
        let n = self.views as u32;
        let epoch = step / n;
        if self.epoch != Some(epoch) {
            self.order = random::shuffle(random::bits(self.seed, u64::from(epoch)), self.views);
            self.epoch = Some(epoch);
        }
        self.order[(step % n) as usize] as usize
    }
}

/// Geometric interpolation between the first and the last value.
fn geometric([first, last]: [f32; 2], progress: f32) -> f32 {
    first * (last / first).powf(progress)
}

/// Learning rates at a share of the steps, multiplied by `factor`.
fn learning_rates(recipe: &Recipe, progress: f32, factor: f32, log_scale_bounds: [f32; 2]) -> LearningRates {
    let at = |bounds| factor * geometric(bounds, progress);
    LearningRates {
        mean: at(recipe.mean),
        log_scale: at(recipe.log_scale),
        quat: at(recipe.quat),
        opacity: at(recipe.opacity),
        sh_dc: at(recipe.sh_dc),
        sh_rest: at(recipe.sh_dc) * recipe.sh_rest,
        beta2: recipe.beta2,
        opacity_reg: recipe.opacity_reg,
        needle_reg: recipe.needle_reg,
        log_scale_bounds,
    }
}
