//! `plat bench prune`: prunes a model by each order, to shares and within a tolerance, and measures what is left.

use std::path::{Path, PathBuf};

use ::bench::parts::Prune;
use ::bench::{Judged, PartLine, append_part};
use eval::{Photos, Pruner, Request, load_detector};
use model::Model;
use perceive::Detector;
use scene::{BadInput, Splats};
use train::Backend;
use train::importance::Order;
use train::prune::Pruning;

use crate::args::BenchPruneArgs;
use crate::captures;
use crate::clock::Stopwatch;
use crate::commands::prune::photos;
use crate::failure::{Failure, make_folder, temporary_folder};
use crate::observer::OutputObserver;
use crate::output::Output;
use crate::run_record::{commit, invocation};

/// The file of comparisons.
const LINES: &str = "prune.jsonl";
/// The name of lines of the model itself.
const UNPRUNED: &str = "none";
/// What the name of an order has behind it where pixels of objects count more.
const ZONES: &str = "-zones";
/// What it has behind that where recoveries ask the detector.
const ALIGNED: &str = "-aligned";

/// Figures of splats.
struct Measured {
    held_in_psnr: f64,
    held_out_psnr: f64,
    judged: Vec<Judged>,
}

/// What measures.
struct Judges<'a> {
    model: &'a Model,
    photos: Photos,
    detectors: Vec<Detector>,
    /// For pictures that nobody looks at.
    out: &'a Path,
    output: &'a Output,
}

impl Judges<'_> {
    fn measured(&self, pruner: &Pruner, splats: &Splats) -> Result<Measured, Failure> {
        let none = || BadInput::new("--test-every", "holds out no view", "give a number from 1 to that of the views");
        Ok(Measured {
            held_in_psnr: pruner.held_in_psnr(splats)?,
            held_out_psnr: pruner.held_out_psnr(splats)?.ok_or_else(none)?,
            judged: if self.detectors.is_empty() { Vec::new() } else { self.judged(splats)? },
        })
    }

    fn judged(&self, splats: &Splats) -> Result<Vec<Judged>, Failure> {
        let Model { antialiased, geo_origin, .. } = *self.model;
        let model = Model {
            splats: splats.clone(),
            objects: Vec::new(),
            antialiased,
            geo_origin,
            exposures: None,
            poses: None,
            trained: None,
        };
        let request = Request {
            model: &model,
            details: &eval::Details::default(),
            photos: &self.photos,
            backend: &Backend::Cpu,
            lpips: None,
            fits: eval::Fits::default(),
            depth: None,
            detectors: &self.detectors,
            true_boxes: None,
            out: self.out,
            trained: 0,
        };
        let evaluation = eval::evaluate(&request, &OutputObserver::new(self.output))?;
        Ok(evaluation.detections.into_iter().map(|of| judged(of.detector, &of.groups.held_out.all)).collect())
    }
}

pub(crate) fn run(args: &BenchPruneArgs, output: &Output) -> Result<(), Failure> {
    let model = model::read(&args.model)?;
    let detectors = args.judge.iter().map(|file| load_detector(file)).collect::<Result<_, _>>()?;
    let aligned = args.photos.aligned()?;
    let mut photos = photos(&model, &args.capture, &args.photos, output)?;
    let observer = OutputObserver::new(output);
    let has_zones = photos.zones.is_some();
    let zoned_pruner = Pruner::new(&model, &photos, &observer)?;
    let asking = match &aligned {
        Some((loss, weight)) => Some(Pruner::new(&model, &photos, &observer)?.aligned_by(loss, *weight)),
        None => None,
    };
    photos.zones = None;
    let plain = Pruner::new(&model, &photos, &observer)?;
    let folder = temporary_folder()?;
    let judges = Judges { model: &model, photos, detectors, out: folder.path(), output };
    make_folder(&args.results)?;
    let file: PathBuf = args.results.join(LINES);

    let before = judges.measured(&plain, &model.splats)?;
    let line = Prune {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| captures::name_of(&args.capture)),
        downscale: judges.photos.downscale,
        order: UNPRUNED.to_owned(),
        keep: Some(1.0),
        recovery_steps: None,
        tolerance_db: None,
        splats_before: model.splats.len() as u64,
        splats: model.splats.len() as u64,
        held_in_psnr: [before.held_in_psnr; 2],
        held_out_psnr: [before.held_out_psnr; 2],
        judged: before.judged.clone(),
        cpu_seconds: 0.0,
        command: invocation(),
    };
    let (mut lines, mut text) = (Vec::new(), String::new());
    let mut add = |line: Prune| {
        let row = described(&line);
        output.note(&row);
        text += &(row + "\n");
        let line = PartLine::Prune(line);
        append_part(&file, &line)?;
        lines.push(line);
        Ok::<_, Failure>(())
    };
    add(line.clone())?;
    let orders = if args.order.is_empty() { Order::ALL.to_vec() } else { args.order.clone() };
    let of_orders = orders.into_iter().map(|order| (order, String::new(), &plain));
    let zoned = has_zones.then_some((Order::Energy, ZONES.to_owned(), &zoned_pruner));
    let asking = asking.as_ref().map(|pruner| (Order::Energy, format!("{ZONES}{ALIGNED}"), pruner));
    let tolerance = (args.tolerance_db > 0.0).then_some(None);
    for (order, way, pruner) in of_orders.chain(zoned).chain(asking) {
        let standard = Pruning::within(args.tolerance_db);
        let pruning = Pruning {
            order,
            rounds: args.rounds.unwrap_or(standard.rounds),
            recovery_share: args.healing.unwrap_or(standard.recovery_share),
            drop_db: args.drop_db.unwrap_or(standard.drop_db),
            ..standard
        };
        for keep in args.keep.iter().copied().map(Some).chain(tolerance) {
            let clock = Stopwatch::start();
            let (splats, pruned) = pruner.prune(&pruning, keep, None, &observer)?;
            let cpu_seconds = clock.cpu_seconds();
            let after = judges.measured(pruner, &splats)?;
            add(Prune {
                order: format!("{}{way}", order.name()),
                keep,
                recovery_steps: Some(pruned.steps),
                tolerance_db: keep.is_none().then_some(args.tolerance_db),
                splats: splats.len() as u64,
                held_in_psnr: [before.held_in_psnr, after.held_in_psnr],
                held_out_psnr: [before.held_out_psnr, after.held_out_psnr],
                judged: after.judged,
                cpu_seconds,
                ..line.clone()
            })?;
        }
    }
    output.result(&lines, &format!("{text}appended to {}", file.display()))
}

/// Figures of a detector on held-out views, for a line.
pub(super) fn judged(detector: String, found: &eval::DetectionSummary) -> Judged {
    Judged {
        detector,
        objects: found.counts.all.photos,
        misses: found.misses,
        extra: found.extra,
        map: found.precision.map,
        mean_iou: found.mean_iou,
        zone_psnr: found.zones.zone_psnr,
    }
}

/// A comparison as text.
fn described(line: &Prune) -> String {
    let what = line.keep.map_or("tolerance".to_owned(), |keep| format!("keep {keep}"));
    let [[in_before, held_in], [out_before, held_out]] = [line.held_in_psnr, line.held_out_psnr];
    let mut text = format!(
        "{:<14} {what:<9} {:>8} splats ({:+6.1} %) {held_in:>6.2} dB held in ({:+.2}) {held_out:>6.2} dB held out ({:+.2}) {:>6.1} s",
        line.order,
        line.splats,
        100.0 * (line.splats as f64 / line.splats_before as f64 - 1.0),
        held_in - in_before,
        held_out - out_before,
        line.cpu_seconds,
    );
    for of in &line.judged {
        let or_none =
            |value: Option<f64>, places: usize| value.map_or("-".to_owned(), |value| format!("{value:.places$}"));
        text += &format!(
            "  {}: {} of {} missed, {} extra, mAP {}, {} dB in zones",
            of.detector,
            of.misses,
            of.objects,
            of.extra,
            or_none(of.map, 3),
            or_none(of.zone_psnr, 2),
        );
    }
    text
}
