//! Prunes a model by the photos of a capture, and measures it before and after.

use blocks::Part;
use dataset::windows::WindowReader;
use glam::Vec3;
use model::{Model, read_tree};
use perceive::Detector;
use scene::{BadInput, Exposures, Splats, column};
use train::importance::{EvaluationViews, Order, OwnershipWeights};
use train::prune::{self, ObjectTolerance, PruneProgress, Pruned, Pruning};
use train::{Backend, Flow, Job, PictureLoss, Recipe, TrainError, TrainView};

use crate::shown_objects::ShownObjects;
use crate::{AlignedLoss, EvalError, Observer, Photos};

/// Bytes of decoded photos that are kept.
const CACHE_BYTES: usize = 256 << 20;
/// Training steps assumed for a model whose training is unknown.
const DEFAULT_STEPS: u32 = 3000;
/// Parts that progress is reported in.
const PROGRESS_PARTS: u64 = 1000;

/// A model and the photos that it is pruned by: the views that are not held out.
pub struct Pruner<'a> {
    model: &'a Model,
    /// Without weights, to measure.
    reader: WindowReader,
    /// With the weights of zones, to prune by.
    weighted: WindowReader,
    held_in: Vec<TrainView>,
    held_out: Vec<TrainView>,
    /// Of the model, if these are the photos that it was trained on.
    exposures: Option<&'a Exposures>,
    /// A loss beside the photometric one in recoveries, and its weight.
    aligned: Option<(&'a AlignedLoss, f32)>,
}

impl<'a> Pruner<'a> {
    /// Reads nothing yet but the plan of a trained model, whose exposures and poses count only if it was trained on these photos.
    ///
    /// # Errors
    /// A trained model whose plan cannot be read.
    pub fn new(model: &'a Model, photos: &Photos, observer: &dyn Observer) -> Result<Self, EvalError> {
        let knows_its_photos = model.exposures.is_some() || model.poses.is_some();
        let has_own_photos = knows_its_photos && photos.are_of(model)?;
        if knows_its_photos && !has_own_photos {
            observer.note("the model was trained on other photos: its exposures are left out, and its refined poses");
        }
        let poses = model.poses.as_ref().filter(|_| has_own_photos);
        let corrected = poses.map(|poses| poses.corrected(&photos.capture.views));
        let views = |part: Part| {
            let window = |i: u32| {
                let given = photos.capture.views[i as usize].camera;
                let camera = corrected.as_ref().map_or(given, |cameras| cameras[i as usize]);
                TrainView { view: i, mip: 0, rect: camera.full(), camera, camera_from_context: None }
            };
            photos.split.views(part).into_iter().map(window).collect()
        };
        let (held_in, held_out) = (views(Part::Trained), views(Part::Test));
        let exposures = model.exposures.as_ref().filter(|_| has_own_photos);
        let (reader, weighted) = (photos.reader(CACHE_BYTES), photos.weighted_reader(CACHE_BYTES));
        Ok(Self { model, reader, weighted, held_in, held_out, exposures, aligned: None })
    }

    /// Recoveries also ask a detector, with this weight.
    #[must_use]
    pub fn aligned_by(self, loss: &'a AlignedLoss, weight: f32) -> Self {
        Self { aligned: Some((loss, weight)), ..self }
    }

    /// Mean PSNR of these splats over the views that are not held out, dB.
    ///
    /// # Errors
    /// Without such views, or with photos that cannot be read.
    pub fn held_in_psnr(&self, splats: &Splats) -> Result<f64, EvalError> {
        let psnr = self.measured(&self.held_in).psnr(splats, &OwnershipWeights::default());
        psnr.map(|[all, _]| all).map_err(no_views)
    }

    /// Mean PSNR of these splats over the held-out views, as `plat eval` measures it, dB. `None` if there are none.
    ///
    /// # Errors
    /// Photos that cannot be read.
    pub fn held_out_psnr(&self, splats: &Splats) -> Result<Option<f64>, EvalError> {
        if self.held_out.is_empty() {
            return Ok(None);
        }
        let psnr = self.measured(&self.held_out).psnr(splats, &OwnershipWeights::default());
        psnr.map(|[all, _]| Some(all)).map_err(no_views)
    }

    /// Importance of each of the model's splats by this order.
    ///
    /// # Errors
    /// As [`held_in_psnr`](Self::held_in_psnr).
    pub fn importance(&self, order: Order) -> Result<Vec<f64>, EvalError> {
        let views = EvaluationViews { source: &self.weighted, ..self.measured(&self.held_in) };
        views.importance(order, &self.model.splats).map_err(no_views)
    }

    fn measured<'v>(&'v self, views: &'v [TrainView]) -> EvaluationViews<'v> {
        let (antialiased, exposures) = (self.model.antialiased, self.exposures);
        EvaluationViews { views, context: None, antialiased, exposures, source: &self.reader }
    }

    /// Prunes to a share of the splats, or without one within the tolerance, and that on what a detector finds: the share of the
    /// objects that the model shows which may be lost.
    ///
    /// # Errors
    /// As [`held_in_psnr`](Self::held_in_psnr).
    pub fn prune(
        &self,
        pruning: &Pruning,
        share: Option<f64>,
        detections: Option<(&Detector, f64)>,
        observer: &dyn Observer,
    ) -> Result<(Splats, Pruned), EvalError> {
        let model = self.model;
        let settings = match &model.trained {
            Some((_, out)) => Some(read_tree(out)?.plan.settings),
            None => None,
        };
        let picture_weight = self.aligned.map_or(0.0, |(_, weight)| weight);
        let recipe = Recipe { picture_weight, ..Recipe::refinement(1.0) };
        let all: &(dyn Fn(Vec3) -> bool + Sync) = &|_| true;
        let job = Job {
            initial: model.splats.clone(),
            context: None,
            views: &self.held_in,
            counts: all,
            keeps: all,
            free_space: None,
            budget: model.splats.len(),
            steps: settings.as_ref().map_or(DEFAULT_STEPS, |settings| settings.steps),
            antialiased: model.antialiased,
            seed: settings.as_ref().map_or(0, |settings| settings.seed),
            size_bounds_metres: size_bounds(&model.splats),
            exposures: self.exposures,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: None,
            recipe: &recipe,
            source: &self.weighted,
            picture_loss: self.aligned.map(|(loss, _)| loss as &dyn PictureLoss),
            backend: &Backend::Cpu,
        };
        let mut report = |now: PruneProgress| {
            let done = PROGRESS_PARTS * u64::from(now.step) / u64::from(now.steps);
            observer.progress("pruning", done, PROGRESS_PARTS, &format!("{} splats", now.recovery.count()));
            Flow::Continue
        };
        let pruned = match share {
            Some(share) => prune::to_share(job, pruning, share, &mut report),
            None => {
                let judge = detections.map(|(detector, share)| (ShownObjects::new(detector), share));
                let objects = judge.as_ref().map(|(judge, share)| ObjectTolerance { judge, share: *share });
                prune::within_tolerance(job, pruning, objects.as_ref(), &mut report)
            }
        };
        pruned.map_err(no_views)
    }
}

/// Smallest and largest standard deviation of the splats, metres.
pub(crate) fn size_bounds(splats: &Splats) -> [f32; 2] {
    let sizes = (0..3).flat_map(|axis| splats.col(column::LOG_SCALE + axis)).filter(|size| size.is_finite());
    let (low, high) = sizes.fold((f32::MAX, f32::MIN), |(low, high), &size| (low.min(size), high.max(size)));
    if low <= high { [low.exp(), high.exp()] } else { [1e-6, 1e6] }
}

fn no_views(error: TrainError) -> EvalError {
    match error {
        TrainError::NoViews => {
            BadInput::new("--capture", "has no view that is not held out", "hold out fewer with --test-every").into()
        }
        other => other.into(),
    }
}
