//! `plat prune` removes splats within a tolerance or down to a share.

use std::path::Path;
use std::sync::Arc;

use eval::{PhotoOptions, Photos, Pruner, load_detector};
use model::{Model, check_out, rewrite};
use scene::{BadInput, Splats};
use serde::Serialize;
use train::Backend;
use train::importance::{Order, surfaces};
use train::prune::{self, Pruned, Pruning};

use crate::args::{PruneArgs, PruneCapture};
use crate::captures;
use crate::clock::{self, Stopwatch};
use crate::failure::Failure;
use crate::observer::OutputObserver;
use crate::output::Output;
use crate::run_record::Record;

/// Default tolerance where no share is given, dB.
const TOLERANCE_DB: f64 = 0.1;

#[derive(Debug, Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    record: Record,
    order: &'static str,
    keep: Option<f64>,
    tolerance_db: Option<f64>,
    tolerance_detections: Option<f64>,
    /// Objects that a detector finds on the renders of the views that judge, of those on their photos: before, and how many of
    /// these after.
    objects: Option<[usize; 2]>,
    splats_before: usize,
    /// On the views that it was pruned by: before and after, dB.
    held_in_psnr: Option<[f64; 2]>,
    /// On the held-out views: before and after, dB.
    held_out_psnr: Option<[f64; 2]>,
    out: &'a Path,
}

pub(crate) fn run(args: &PruneArgs, output: &Output) -> Result<(), Failure> {
    let clock = Stopwatch::start();
    let tolerance_db = if args.keep.is_none() { Some(args.tolerance_db.unwrap_or(TOLERANCE_DB)) } else { None };
    let Some(capture) = &args.capture else {
        if args.photos.zones.finder.is_given() {
            let advice = "name the capture with --capture";
            return Err(BadInput::new("--detector and --zones", "need photos to look at", advice).into());
        }
        let Some(share) = args.keep else {
            let advice = "name the capture with --capture, or give the share to keep with --keep";
            return Err(BadInput::new("--tolerance-db", "needs photos to be measured on", advice).into());
        };
        let model = model::read(&args.model)?;
        check_out(&args.model, &args.out)?;
        let splats = prune::keep(&model.splats, &surfaces(&model.splats), share, &|_| true);
        return finish(args, model, splats, Order::Surface, None, Record::new("prune"), &clock, output);
    };
    let model = model::read(&args.model)?;
    check_out(&args.model, &args.out)?;
    let aligned = args.photos.aligned()?;
    let photos = photos(&model, capture, &args.photos, output)?;
    let observer = OutputObserver::new(output);
    let mut pruner = Pruner::new(&model, &photos, &observer)?;
    if let Some((loss, weight)) = &aligned {
        pruner = pruner.aligned_by(loss, *weight);
    }
    let pruning = Pruning::within(tolerance_db.unwrap_or(TOLERANCE_DB));
    let detector = match (&args.tolerance_detections, &args.photos.zones.finder.zone_detector) {
        (Some(share), Some(path)) => Some((load_detector(path)?, *share)),
        _ => None,
    };
    let detections = detector.as_ref().map(|(detector, share)| (detector, *share));
    let (splats, pruned) = pruner.prune(&pruning, args.keep, detections, &observer)?;
    let held_out = pruner.held_out_psnr(&model.splats)?.zip(pruner.held_out_psnr(&splats)?);
    let held_out = held_out.map(|(before, after)| [before, after]);
    let record = Record {
        scene: captures::name_of(capture),
        downscale: photos.downscale,
        backend: Backend::Cpu.name(),
        threads: rayon::current_num_threads() as u32,
        psnr: held_out.map(|[_, after]| after),
        ..Record::new("prune")
    };
    drop((pruner, observer));
    finish(args, model, splats, pruning.order, Some((pruned, held_out)), record, &clock, output)
}

pub(super) fn photos(
    model: &Model,
    capture: &Path,
    options: &PruneCapture,
    output: &Output,
) -> Result<Photos, Failure> {
    let source = captures::open(capture, output)?;
    let PruneCapture { test_every, downscale, store, zones, .. } = options;
    let from = captures::zone_source(&zones.finder, capture, &source)?;
    let options =
        PhotoOptions { store: store.as_deref(), downscale: *downscale, test_every: *test_every, ..Default::default() };
    let mut photos = captures::photos_of(model, &source, &options, output)?;
    if let Some(from) = from {
        let (found, _) = captures::find_zones(&photos.capture, &from, &photos.store, output)?;
        photos.zones = Some((Arc::new(found), zones.weight() as f32));
    }
    Ok(photos)
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
    let bytes = rewrite(&args.model, &args.out, model, splats)?;
    let report = Report {
        record: Record {
            wall_seconds: Some(clock.wall_seconds()),
            cpu_seconds: Some(clock.cpu_seconds()),
            splats: after as u64,
            bytes: Some(bytes),
            peak_memory_bytes: clock::peak_memory_bytes(),
            ..record
        },
        order: order.name(),
        keep: args.keep,
        tolerance_db: args.keep.is_none().then(|| args.tolerance_db.unwrap_or(TOLERANCE_DB)),
        tolerance_detections: args.tolerance_detections,
        objects: measured.and_then(|(pruned, _)| pruned.objects),
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
    if let Some([before, after]) = report.objects {
        text += &format!("{after} of the {before} objects found on renders of the views that judge are still found\n");
    }
    output.result(&report, &(text + &args.out.display().to_string()))
}
