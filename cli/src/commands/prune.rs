//! `plat prune`: a model with fewer splats, as many as a tolerance or a share allows; and `plat bench prune`, which compares the
//! orders to prune by.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ::bench::parts::Prune;
use ::bench::{PartLine, append_part};
use dataset::windows::WindowReader;
use glam::Vec3;
use scene::{BadInput, Capture, Exposures, Splats, column};
use serde::Serialize;
use store::BlockingStore;
use tempfile::TempDir;
use train::importance::{self, Order, OwnershipWeights, EvaluationViews};
use train::prune::{self, PruneProgress, Pruned, Pruning};
use train::{Backend, Flow, Job, Recipe, TrainError, TrainView};

use crate::args::{BenchPruneArgs, PruneArgs, PruneCapture};
use crate::cameras;
use crate::clock::Stopwatch;
use crate::commands::bench::invoked;
use crate::commands::train::{ingest_photos, make_folder};
use crate::failure::Failure;
use crate::model::{self, Model, rewrite};
use crate::output::Output;
use crate::record::{Record, commit};

/// Tolerance where neither that nor a share is given, dB.
const TOLERANCE_DB: f64 = 0.1;
/// Photos kept decoded.
const CACHE_BYTES: usize = 256 << 20;
/// Steps that a model of unknown origin is taken to be trained with.
const STEPS: u32 = 3000;

/// What was done.
#[derive(Debug, Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    record: Record,
    order: &'static str,
    keep: Option<f64>,
    tolerance_db: Option<f64>,
    splats_before: usize,
    /// On the views that it was pruned by: before and after, dB.
    held_in_psnr: Option<[f64; 2]>,
    /// On the held-out views.
    held_out_psnr: Option<[f64; 2]>,
    out: &'a Path,
}

pub(crate) fn run(args: &PruneArgs, output: &Output) -> Result<(), Failure> {
    let clock = Stopwatch::start();
    let tolerance_db = if args.keep.is_none() { Some(args.tolerance_db.unwrap_or(TOLERANCE_DB)) } else { None };
    let Some(capture) = &args.capture else {
        let Some(share) = args.keep else {
            let advice = "name the capture with --capture, or say with --keep which share to keep";
            return Err(BadInput::new("--tolerance-db", "needs photos to be measured on", advice).into());
        };
        let model = model::read(&args.model)?;
        rewrite::check_out(&args.model, &args.out)?;
        let splats = prune::keep(&model.splats, &importance::surfaces(&model.splats), share, &|_| true);
        return finish(args, model, splats, Order::Surface, None, Record::new("prune"), &clock, output);
    };
    let model = model::read(&args.model)?;
    rewrite::check_out(&args.model, &args.out)?;
    let photos = Photos::open(&model, capture, &args.photos, output)?;
    let pruning = Pruning::within(tolerance_db.unwrap_or(TOLERANCE_DB));
    let (splats, pruned) = photos.prune(&model, &pruning, args.keep, output)?;
    let held_out = photos.held_out();
    let held_out = if held_out.is_empty() {
        None
    } else {
        Some([photos.psnr(&model, &model.splats, &held_out)?, photos.psnr(&model, &splats, &held_out)?])
    };
    let record = Record {
        scene: cameras::name_of(capture),
        downscale: photos.downscale,
        backend: Backend::Cpu.name(),
        threads: rayon::current_num_threads() as u32,
        psnr: held_out.map(|[_, after]| after),
        ..Record::new("prune")
    };
    finish(args, model, splats, pruning.order, Some((pruned, held_out)), record, &clock, output)
}

fn finish(
    args: &PruneArgs,
    model: Model,
    splats: Splats,
    order: Order,
    measured: Option<(Pruned, Option<[f64; 2]>)>,
    record: Record,
    clock: &Stopwatch,
    output: &Output,
) -> Result<(), Failure> {
    if splats.is_empty() {
        return Err(BadInput::new("--keep", "leaves no splat", "keep more").into());
    }
    let before = model.splats.len();
    let after = splats.len();
    let bytes = rewrite::rewrite(&args.model, &args.out, model, splats)?;
    let report = Report {
        record: Record {
            wall_seconds: Some(clock.wall_seconds()),
            cpu_seconds: Some(clock.cpu_seconds()),
            splats: after as u64,
            bytes: Some(bytes),
            peak_memory_bytes: crate::clock::peak_memory_bytes(),
            ..record
        },
        order: order.name(),
        keep: args.keep,
        tolerance_db: args.keep.is_none().then(|| args.tolerance_db.unwrap_or(TOLERANCE_DB)),
        splats_before: before,
        held_in_psnr: measured.map(|(pruned, _)| pruned.psnr),
        held_out_psnr: measured.and_then(|(_, held_out)| held_out),
        out: &args.out,
    };
    let share = 100.0 * (1.0 - after as f64 / before.max(1) as f64);
    let mut text = format!("{after} of {before} splats, {share:.1} % fewer\n");
    for (name, psnr) in [("views pruned by", report.held_in_psnr), ("held-out views", report.held_out_psnr)] {
        if let Some([before, after]) = psnr {
            text += &format!("{after:.2} dB on {name}, {:+.2} dB\n", after - before);
        }
    }
    output.result(&report, &(text + &args.out.display().to_string()))
}

/// A capture's photos at the size that a model was trained with.
struct Photos {
    reader: WindowReader,
    /// Whether the model's exposures are of these photos.
    are_trained_on: bool,
    test_every: u32,
    downscale: u32,
    /// Gone with the command.
    _temporary: TempDir,
}

impl Photos {
    fn open(model: &Model, capture: &Path, options: &PruneCapture, output: &Output) -> Result<Self, Failure> {
        let source = cameras::open(capture, output)?;
        let (every, downscale) = model.photos_used();
        let (store, temporary) = model.photo_store(options.store.as_deref())?;
        let store: BlockingStore = store.blocking();
        let (downscale, test_every) = (options.downscale.unwrap_or(downscale), options.test_every.unwrap_or(every));
        let ingested = ingest_photos(&source, &store, downscale, output)?;
        let are_trained_on = match (&model.exposures, &model.trained) {
            (Some(_), Some((_, out))) => model::read_tree(out)?.plan.capture == ingested.id,
            _ => false,
        };
        if model.exposures.is_some() && !are_trained_on {
            output.note("these are not the photos that the model was trained on: its exposures are left out");
        }
        let reader = WindowReader::new(Arc::new(ingested.capture), store, CACHE_BYTES);
        Ok(Self { reader, are_trained_on, test_every, downscale, _temporary: temporary })
    }

    fn views(&self, test: bool) -> Vec<TrainView> {
        let views = self.reader.capture().views.iter().enumerate();
        let views = views.filter(|(i, _)| Capture::is_test(*i, self.test_every) == test);
        let window =
            |camera: scene::Camera, i: usize| TrainView { view: i as u32, mip: 0, rect: camera.full(), camera };
        views.map(|(i, view)| window(view.camera, i)).collect()
    }

    fn held_out(&self) -> Vec<TrainView> {
        self.views(true)
    }

    /// Mean PSNR over views, as `plat eval` measures it: held-out views have no exposure.
    fn psnr(&self, model: &Model, splats: &Splats, views: &[TrainView]) -> Result<f64, Failure> {
        self.judged(model, views).psnr(splats, &OwnershipWeights::default()).map_err(failed)
    }

    fn judged<'a>(&'a self, model: &'a Model, views: &'a [TrainView]) -> EvaluationViews<'a> {
        let (antialiased, exposures) = (model.antialiased, self.exposures(model));
        EvaluationViews { views, context: None, antialiased, exposures, source: &self.reader }
    }

    fn exposures<'a>(&self, model: &'a Model) -> Option<&'a Exposures> {
        model.exposures.as_ref().filter(|_| self.are_trained_on)
    }

    /// Prunes to a share, or within the tolerance, by the views that are not held out.
    fn prune(
        &self,
        model: &Model,
        pruning: &Pruning,
        share: Option<f64>,
        output: &Output,
    ) -> Result<(Splats, Pruned), Failure> {
        let views = self.views(false);
        let settings = match &model.trained {
            Some((_, out)) => Some(model::read_tree(out)?.plan.settings),
            None => None,
        };
        let recipe = Recipe::refinement();
        let all: &(dyn Fn(Vec3) -> bool + Sync) = &|_| true;
        let job = Job {
            initial: model.splats.clone(),
            context: None,
            views: &views,
            counts: all,
            keeps: all,
            budget: model.splats.len(),
            steps: settings.as_ref().map_or(STEPS, |settings| settings.steps),
            antialiased: model.antialiased,
            seed: settings.as_ref().map_or(0, |settings| settings.seed),
            size_bounds_metres: sizes_metres(&model.splats),
            exposures: self.exposures(model),
            trains_exposures: false,
            recipe: &recipe,
            source: &self.reader,
            backend: &Backend::Cpu,
        };
        let progress = output.progress("pruning", 1000);
        let mut report = |now: PruneProgress| {
            progress.at(1000 * u64::from(now.step) / u64::from(now.steps), format!("{} splats", now.recovery.count()));
            Flow::Continue
        };
        let pruned = match share {
            Some(share) => prune::to_share(job, pruning, share, &mut report),
            None => prune::within_tolerance(job, pruning, &mut report),
        };
        pruned.map_err(failed)
    }
}

/// Smallest and largest standard deviation there is, metres.
fn sizes_metres(splats: &Splats) -> [f32; 2] {
    let sizes = (0..3).flat_map(|axis| splats.col(column::LOG_SCALE + axis)).filter(|size| size.is_finite());
    let (low, high) = sizes.fold((f32::MAX, f32::MIN), |(low, high), &size| (low.min(size), high.max(size)));
    if low <= high { [low.exp(), high.exp()] } else { [1e-6, 1e6] }
}

fn failed(error: TrainError) -> Failure {
    match error {
        TrainError::NoViews => {
            BadInput::new("--capture", "has no view that is not held out", "hold out fewer with --test-every").into()
        }
        other => Failure::Work(other.to_string()),
    }
}

/// The file of comparisons.
const LINES: &str = "prune.jsonl";

/// Compares the orders: cut to equal shares without healing, and pruned within the tolerance.
pub(crate) fn bench(args: &BenchPruneArgs, output: &Output) -> Result<(), Failure> {
    let model = model::read(&args.model)?;
    let photos = Photos::open(&model, &args.capture, &args.photos, output)?;
    let (held_in, held_out) = (photos.views(false), photos.held_out());
    let before = [photos.psnr(&model, &model.splats, &held_in)?, photos.psnr(&model, &model.splats, &held_out)?];
    make_folder(&args.results)?;
    let file: PathBuf = args.results.join(LINES);
    let mut text =
        format!("{} splats: {:.2} dB held in, {:.2} dB held out\n", model.splats.len(), before[0], before[1]);
    let mut lines = Vec::new();
    let orders = if args.order.is_empty() { Order::ALL.to_vec() } else { args.order.clone() };
    for order in orders {
        let mut line = |keep: Option<f64>, splats: &Splats, pruning: Option<&Pruning>, clock: &Stopwatch| {
            let cpu_seconds = clock.cpu_seconds();
            let after = [photos.psnr(&model, splats, &held_in)?, photos.psnr(&model, splats, &held_out)?];
            let line = Prune {
                commit: commit().to_owned(),
                machine: ::bench::machine(),
                scene: args.scene.clone().unwrap_or_else(|| cameras::name_of(&args.capture)),
                downscale: photos.downscale,
                order: order.name().to_owned(),
                keep,
                tolerance_db: pruning.map(|pruning| pruning.tolerance_db),
                splats_before: model.splats.len() as u64,
                splats: splats.len() as u64,
                held_in_psnr: [before[0], after[0]],
                held_out_psnr: [before[1], after[1]],
                cpu_seconds,
                command: invoked(),
            };
            let what = keep.map_or("tolerance".to_owned(), |keep| format!("keep {keep}"));
            text += &format!(
                "{:<8} {what:<9} {:>8} splats ({:+6.1} %) {:>6.2} dB held in ({:+.2}) {:>6.2} dB held out ({:+.2}) {cpu_seconds:>6.1} s\n",
                order.name(),
                splats.len(),
                100.0 * (splats.len() as f64 / model.splats.len() as f64 - 1.0),
                after[0],
                after[0] - before[0],
                after[1],
                after[1] - before[1],
            );
            output.note(text.lines().last().unwrap_or_default());
            let line = PartLine::Prune(line);
            append_part(&file, &line)?;
            lines.push(line);
            Ok::<_, Failure>(())
        };
        let clock = Stopwatch::start();
        let importance = photos.judged(&model, &held_in).importance(order, &model.splats).map_err(failed)?;
        for keep in [0.8, 0.6, 0.4] {
            line(Some(keep), &prune::keep(&model.splats, &importance, keep, &|_| true), None, &clock)?;
        }
        let clock = Stopwatch::start();
        let standard = Pruning::within(args.tolerance_db);
        let pruning = Pruning {
            order,
            rounds: args.rounds.unwrap_or(standard.rounds),
            recovery_share: args.healing.unwrap_or(standard.recovery_share),
            drop_db: args.drop_db.unwrap_or(standard.drop_db),
            ..standard
        };
        let (splats, _) = photos.prune(&model, &pruning, None, output)?;
        line(None, &splats, Some(&pruning), &clock)?;
    }
    output.result(&lines, &format!("{text}appended to {}", file.display()))
}
