//! The training loop of one block.
//!
//! A step draws one window of a view, compares it with the photo, and moves the splats that were seen; or it does so with a few views
//! at once, which fill a large device. Steps are counted in windows. Coarse mips come
//! first, growth follows a schedule towards the budget, step sizes decay to the end. What lies outside the block is drawn from
//! a frozen context, and a pixel counts by the share of it that the block's own splats explain.

use glam::Vec3;
use render::Options;
use render::cpu::Isa;
use scene::{Camera, Exposures, Rect, Splats};
use serde::{Deserialize, Serialize};

use crate::exposure::ExposureTraining;
use crate::growth::{self, Evidence, Growth};
use crate::need::{self, Need};
use crate::optimiser::{Adam, Rates};
use crate::side::{Backend, Look, MOST_VIEWS_PER_STEP, Part, Side, Step};
use crate::source::AHEAD;
use crate::{State, WindowSource, random};

/// How a block is trained. Shares are of the number of steps; rates are per step of Adam on one window.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// Weight of 1 - SSIM in the loss.
    pub lambda: f32,
    /// Step of means, in units of each splat's size: at first, at the end.
    pub mean: [f32; 2],
    /// Step of ln(scale): at first, at the end.
    pub log_scale: [f32; 2],
    /// Step of quaternions: at first, at the end.
    pub quat: [f32; 2],
    /// Step of opacity logits: at first, at the end.
    pub opacity: [f32; 2],
    /// Step of the constant colour coefficient: at first, at the end.
    pub sh_dc: [f32; 2],
    /// The other coefficients' step relative to that.
    pub sh_rest: f32,
    /// How far the steps of a view's exposure may take it in all, at the first rate and at the last, where exposures are trained:
    /// a view is drawn 7 times by a tree's root or 60 times by a job of one block, and has to get as far.
    pub exposure: [f32; 2],
    /// Decay of Adam's second moment. A splat that few of many views see gets few steps, while the correction of its moments' start
    /// counts all: at 0.999 its steps came out up to seven times the rate, and the root of a city of 1.2 km² lost 26,000 of its 27,700
    /// splats.
    pub beta2: f32,
    /// Pull on opacities and needles, see [`Rates`].
    pub opacity_pull: f32,
    /// See `opacity_pull`.
    pub needle_pull: f32,
    /// Each entry is the share of the steps after which the next SH degree joins.
    pub sh_from: [f32; 3],
    /// Each entry is the largest share of the steps that is trained at one mip coarser than the next, coarsest first.
    pub coarse: Vec<f32>,
    /// Finer pixels are looked at once the error is this many times what coarse photos lack (see [`crate::need`]); with 0 only
    /// after those shares.
    pub closer_at: f32,
    /// Windows that are drawn before splats move, at most [`MOST_VIEWS_PER_STEP`]: on n of them their steps are √n times as long,
    /// as the noise of a sum is √n times smaller beside it (so gsplat; Granziol et al. 2022). What it saves is a device's idling,
    /// where one window has too few tiles for it; arithmetic it saves none, so that a CPU has nothing from it.
    pub views_per_step: u32,
    /// Opacity of the first splats.
    pub initial_opacity: f32,
    /// When and how splats are added and removed.
    pub growth: Growth,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            lambda: 0.2,
            mean: [0.05, 0.005],
            log_scale: [0.017, 0.0085],
            quat: [0.0034, 0.0017],
            opacity: [0.06, 0.025],
            sh_dc: [0.017, 0.004],
            sh_rest: 0.05,
            exposure: [0.2, 0.02],
            beta2: 0.99,
            opacity_pull: 0.0,
            needle_pull: 0.01,
            sh_from: [0.1, 0.2, 0.3],
            coarse: vec![0.2, 0.5],
            closer_at: 2.0,
            views_per_step: 1,
            initial_opacity: 0.1,
            growth: Growth::default(),
        }
    }
}

impl Recipe {
    /// For splats that already fit one mip coarser: full SH degree at once, and longer first steps, as there are fewer of
    /// them. Those that do not fit it yet are trained there first.
    pub fn refinement() -> Self {
        let recipe = Self::default();
        let longer = |[first, last]: [f32; 2]| [1.5 * first, last];
        Self {
            mean: longer(recipe.mean),
            log_scale: longer(recipe.log_scale),
            quat: longer(recipe.quat),
            opacity: longer(recipe.opacity),
            sh_dc: longer(recipe.sh_dc),
            sh_from: [0.0; 3],
            coarse: vec![0.7],
            ..recipe
        }
    }

    /// The same in steps of this share of the size.
    #[must_use]
    pub fn at_rate(self, share: f32) -> Self {
        let scaled = |rate: [f32; 2]| rate.map(|rate| share * rate);
        Self {
            mean: scaled(self.mean),
            log_scale: scaled(self.log_scale),
            quat: scaled(self.quat),
            opacity: scaled(self.opacity),
            sh_dc: scaled(self.sh_dc),
            exposure: scaled(self.exposure),
            ..self
        }
    }

    /// The same by the clock alone, whatever training says: the baseline that following the need is measured against.
    /// Blocks that start from points begin at coarse mips, others do not.
    #[must_use]
    pub fn unmeasured(self, from_points: bool) -> Self {
        let coarse = if from_points { vec![0.15, 0.3] } else { Vec::new() };
        Self { coarse, closer_at: 0.0, growth: Growth { worth_db: 0.0, ..self.growth }, ..self }
    }
}

/// A window of a view that a block trains on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainView {
    /// Index in the capture.
    pub view: u32,
    /// Mip of the image at which the block is trained at the end.
    pub mip: u8,
    /// Window in pixels of that mip.
    pub rect: Rect,
    /// Camera of the whole image at mip 0.
    pub camera: Camera,
}

impl TrainView {
    /// The window `coarser` mips up: its mip, rectangle and camera; `None` when it would be under 8 pixels, or the image
    /// under 16, which is where mips end.
    pub fn at(&self, coarser: u8) -> Option<(u8, Rect, Camera)> {
        let mip = self.mip + coarser;
        let (x, y) = (self.rect.x >> coarser, self.rect.y >> coarser);
        let image = self.camera.mip(mip);
        let width = ((self.rect.x + self.rect.width) >> coarser).min(image.pinhole.width).saturating_sub(x);
        let height = ((self.rect.y + self.rect.height) >> coarser).min(image.pinhole.height).saturating_sub(y);
        let rect = Rect { x, y, width, height };
        let image_side = image.pinhole.width.min(image.pinhole.height);
        (coarser == 0 || (width.min(height) >= 8 && image_side >= 16)).then(|| (mip, rect, image.window(rect)))
    }
}

/// What to train, and on what.
pub struct Job<'a> {
    /// The first splats.
    pub initial: Splats,
    /// What lies outside, drawn but not moved.
    pub context: Option<&'a Splats>,
    /// The windows, in the capture's order.
    pub views: &'a [TrainView],
    /// Is a splat here counted against the budget?
    pub counts: &'a (dyn Fn(Vec3) -> bool + Sync),
    /// May a splat be here? Those that wander off are removed when splats are added: their place is drawn by the context.
    pub keeps: &'a (dyn Fn(Vec3) -> bool + Sync),
    /// Number of counted splats wanted at the end.
    pub budget: usize,
    /// Number of steps, in windows.
    pub steps: u32,
    /// Opacity compensated for the pixel's blur.
    pub antialiased: bool,
    /// Key of all random choices.
    pub seed: u64,
    /// Smallest and largest standard deviation, metres.
    pub size_bounds_metres: [f32; 2],
    /// Exposures of the views, not moved; views without one are drawn as they are.
    pub exposures: Option<&'a Exposures>,
    /// Whether exposures are trained instead, from the identity on.
    pub trains_exposures: bool,
    /// How.
    pub recipe: &'a Recipe,
    /// Pixels.
    pub source: &'a dyn WindowSource,
    /// What computes the steps.
    pub backend: &'a Backend,
}

/// Where training stands. What its methods say is brought from where the training happens when they are asked, which changes
/// nothing in its course. They say nothing where that fails, and then training ends with the error.
pub struct Progress<'a> {
    /// Steps done, in windows.
    pub step: u32,
    /// Steps in all.
    pub steps: u32,
    /// Windows of the last step.
    pub views: u32,
    now: &'a mut State,
    side: &'a mut dyn Side,
    failed: &'a mut Option<TrainError>,
}

impl Progress<'_> {
    /// Mean loss of the last step's windows.
    pub fn loss(&mut self) -> Option<f64> {
        self.fetched(Part::Tally).map(|now| now.loss)
    }

    /// Steps whose loss was not finite; such a step is left out.
    pub fn skipped(&mut self) -> Option<u32> {
        self.fetched(Part::Tally).map(|now| now.skipped)
    }

    /// The number of splats now.
    pub fn count(&self) -> usize {
        self.now.splats.len()
    }

    /// The splats now.
    pub fn splats(&mut self) -> Option<&Splats> {
        self.fetched(Part::Splats).map(|now| &now.splats)
    }

    /// From which training can go on.
    pub fn state(&mut self) -> Option<&State> {
        self.fetched(Part::All)
    }

    fn fetched(&mut self, part: Part) -> Option<&State> {
        match self.side.fetch(self.now, part) {
            Ok(()) => Some(self.now),
            Err(error) => {
                self.failed.get_or_insert(error);
                None
            }
        }
    }
}

/// Should training go on?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// Yes.
    Continue,
    /// No: the splats so far are the result.
    Stop,
}

/// Why a block could not be trained.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrainError {
    /// No window to train on.
    #[error("no view sees this block")]
    NoViews,
    /// A window could not be read.
    #[error("{0}")]
    Source(String),
    /// The device failed.
    #[error("{0}")]
    Device(String),
    /// The device has too little memory for the block: on a larger one it may be trained.
    #[error("{0}")]
    OutOfMemory(String),
    /// Exposures are the CPU's alone.
    #[error("exposures are not trained on a GPU: use --backend cpu, or leave --exposure")]
    Exposures,
    /// All splats were removed.
    #[error("every splat was removed after {0} steps: the views and the points do not agree, or poses are wrong")]
    Empty(u32),
}

/// Trains a block; `report` is called after every step.
///
/// # Errors
/// See [`TrainError`].
pub fn train(job: Job, report: &mut dyn FnMut(Progress) -> Flow) -> Result<Splats, TrainError> {
    train_on(job, None, report).map(|(splats, _)| splats)
}

/// Trains a block on from where an earlier run of the same job stood: the result is what that would have come to. With the
/// splats come the exposures, where those are trained.
///
/// # Errors
/// See [`TrainError`].
pub fn train_on(
    mut job: Job,
    from: Option<State>,
    report: &mut dyn FnMut(Progress) -> Flow,
) -> Result<(Splats, Option<Exposures>), TrainError> {
    let Job { context, views, counts, keeps, budget, steps, recipe, .. } = job;
    if views.is_empty() {
        return Err(TrainError::NoViews);
    }
    if job.backend.is_gpu() && (job.trains_exposures || job.exposures.is_some()) {
        return Err(TrainError::Exposures);
    }
    let initial = std::mem::replace(&mut job.initial, Splats::new(0));
    let mut now = from.unwrap_or_else(|| State {
        step: 0,
        skipped: 0,
        start_count: (0..initial.len()).filter(|&i| counts(initial.mean(i))).count(),
        need: Need::default(),
        adam: Adam::new(Isa::detect(), &initial),
        evidence: Evidence::default(),
        exposures: job.trains_exposures.then(|| ExposureTraining::new(views)),
        splats: initial,
        loss: f64::NAN,
    });
    // Nothing is to be moved to where nothing is to be done.
    let backend = if now.step < steps { job.backend } else { &Backend::Cpu };
    let mut side = backend.side(&now, recipe.lambda, context)?;
    let log_scale_bounds = job.size_bounds_metres.map(f32::ln);
    let lacks = (now.need.stage..recipe.coarse.len() as u8)
        .map(|stage| match recipe.closer_at > 0.0 {
            true => need::detail(views, job.source, recipe.coarse.len() as u8 - stage),
            false => Ok(0.0),
        })
        .collect::<Result<Vec<f64>, _>>()?;
    let first_stage = now.need.stage;
    let until = (recipe.growth.until * steps as f32) as u32;
    let [mut turns, mut turns_ahead] = [(); 2].map(|()| Turns::new(views.len(), job.seed));
    // The first step whose window the source has not been told of.
    let mut told = now.step + 1;

    while now.step < steps {
        let step = now.step;
        if now.splats.is_empty() {
            return Err(TrainError::Empty(step));
        }
        let progress = step as f32 / steps as f32;
        // Every view once per epoch: a step ends with it.
        let left = (views.len() as u32 - step % views.len() as u32).min(steps - step);
        let count = recipe.views_per_step.clamp(1, MOST_VIEWS_PER_STEP).min(left);
        let coarser = (recipe.coarse.len() as u8).saturating_sub(now.need.stage);
        let window = |view: &TrainView| (0..=coarser).rev().find_map(|c| view.at(c)).expect("at(0) always is");
        let look = |view: &TrainView| -> Result<Look, TrainError> {
            let (mip, rect, camera) = window(view);
            let photo = job.source.window(view.view, mip, rect).map_err(TrainError::Source)?;
            let exposure = job.exposures.and_then(|exposures| exposures.of(view.view).copied());
            Ok(Look { view: view.view, photo, camera, exposure })
        };
        let looks = (step..step + count).map(|step| look(&views[turns.of(step)])).collect::<Result<Vec<_>, _>>()?;
        // Growth that ends early skips steps, whose windows nobody asks for.
        told = told.max(step + count);
        while told < steps.min(step + count + (AHEAD as u32).max(count)) {
            let next = &views[turns_ahead.of(told)];
            let (mip, rect, _) = window(next);
            job.source.expect(next.view, mip, rect);
            told += 1;
        }

        let sh_degree = recipe.sh_from.iter().filter(|&&from| progress >= from).count() as u8;
        let options = Options {
            antialiased: job.antialiased,
            sh_degree: sh_degree.min(now.splats.sh_degree()),
            background: [0.0; 3],
            extras: context.is_some(),
        };
        let visits = (steps as f32 / views.len() as f32).max(1.0);
        let drawn = Step {
            looks,
            options,
            rates: rates(recipe, progress, (count as f32).sqrt(), log_scale_bounds),
            exposure_rate: between(recipe.exposure, progress) / visits,
        };
        side.step(&mut now, drawn)?;

        let growth = &recipe.growth;
        now.step = step + count;
        let epoch = views.len() as u32;
        let mut error = None;
        if now.step.is_multiple_of(epoch) {
            side.fetch(&mut now, Part::Tally)?;
            error = now.need.end_epoch(now.splats.len(), epoch);
            side.give(&now, Part::Tally)?;
        }
        if coarser > 0 {
            let stage = usize::from(now.need.stage);
            let fits =
                error.is_some_and(|e| e <= f64::from(recipe.closer_at) * lacks[stage - usize::from(first_stage)]);
            if fits || now.step.saturating_sub(now.need.since) >= (recipe.coarse[stage] * steps as f32) as u32 {
                side.fetch(&mut now, Part::Tally)?;
                now.need.look_closer(now.step);
                side.give(&now, Part::Tally)?;
            }
        }
        let worth_db = f64::from(growth.worth_db);
        if worth_db > 0.0 && error.is_some() && now.step < until && now.need.gains_less_than(worth_db) {
            now.step = until;
        }
        let every = growth.interval(steps);
        if (0..count).any(|n| (now.step - n).is_multiple_of(every))
            && progress >= growth.from
            && now.step <= until + every
            && now.step < steps
        {
            let target = growth.target(now.step, steps, now.start_count, budget);
            side.fetch(&mut now, Part::All)?;
            let (grown, rows, _) = growth::refine(&now.splats, &mut now.evidence, growth, target, counts, keeps);
            now.splats = grown;
            now.adam.rearrange(&rows);
            side.give(&now, Part::All)?;
        }
        let mut failed = None;
        let (step, now, side) = (now.step, &mut now, &mut *side);
        let flow = report(Progress { step, steps, views: count, now, side, failed: &mut failed });
        if let Some(error) = failed {
            return Err(error);
        }
        if flow == Flow::Stop {
            break;
        }
    }
    side.fetch(&mut now, Part::Splats)?;
    let exposures = now.exposures.map(|exposures| exposures.exposures());
    Ok((now.splats, exposures))
}

/// Every view once per epoch, each epoch in another order.
struct Turns {
    seed: u64,
    views: usize,
    /// The epoch whose order is at hand.
    epoch: Option<u32>,
    order: Vec<u32>,
}

impl Turns {
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

/// A step size at a share of the way: geometric between first and last.
fn between([first, last]: [f32; 2], progress: f32) -> f32 {
    first * (last / first).powf(progress)
}

/// Step sizes at a share of the way, so many times as long.
fn rates(recipe: &Recipe, progress: f32, longer: f32, log_scale_bounds: [f32; 2]) -> Rates {
    let at = |bounds| longer * between(bounds, progress);
    Rates {
        mean: at(recipe.mean),
        log_scale: at(recipe.log_scale),
        quat: at(recipe.quat),
        opacity: at(recipe.opacity),
        sh_dc: at(recipe.sh_dc),
        sh_rest: at(recipe.sh_dc) * recipe.sh_rest,
        beta2: recipe.beta2,
        opacity_pull: recipe.opacity_pull,
        needle_pull: recipe.needle_pull,
        log_scale_bounds,
    }
}
