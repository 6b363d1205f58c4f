//! `plat eval`: measures a model against the held-out photos of a capture.
//!
//! Views are rendered without exposures; cc-PSNR forgives the photo's own. The contact sheet shows 8-bit pictures.

use std::path::Path;

use dataset::ingest::TrueDepth;
use dataset::true_boxes::TrueBoxes;
use eval::{DetailOptions, Details, Evaluation, Fits, Lpips, PhotoOptions, Photos, Request, load_detector};
use model::{Model, save_json};
use perceive::Detector;
use scene::BadInput;

use crate::args::EvalArgs;
use crate::eval_report::{Evaluated, text};
use crate::failure::Failure;
use crate::observer::OutputObserver;
use crate::output::Output;
use crate::run_record::Record;
use crate::{backend, captures, clock};

pub(crate) fn run(args: &EvalArgs, output: &Output) -> Result<(), Failure> {
    let evaluated = measure(args, output)?;
    output.result(&evaluated, &text(&evaluated))
}

/// Measures everything that the options ask for and writes `report.json`.
pub(crate) fn measure(args: &EvalArgs, output: &Output) -> Result<Evaluated, Failure> {
    let backend = backend::open(args.backend)?;
    let lpips = args.lpips.as_deref().map(Lpips::load).transpose()?;
    let detectors: Vec<Detector> = args.detector.iter().map(|file| load_detector(file)).collect::<Result<_, _>>()?;
    let model = model::read(&args.model)?;
    if args.objects_later.is_some() && model.objects.is_empty() {
        return Err(BadInput::new("--objects-later", "finds no objects in the model", "train it with --objects").into());
    }
    let options = DetailOptions {
        levels: args.level,
        budgets: args.budget.clone(),
        seams: args.seams,
        seams_of: args.seams_of.clone(),
        seam_metres: args.seam_metres,
    };
    let details = Details::read(&args.model, &options)?;
    let source = captures::open(&args.capture, output)?;
    let photos = PhotoOptions {
        store: args.store.as_deref(),
        downscale: args.downscale,
        test_every: args.test_every,
        test_stretches: args.test_stretches,
        ..PhotoOptions::default()
    };
    let depth = args.depth.then(|| TrueDepth::open(&args.capture)).transpose()?;
    let true_boxes = true_boxes(&detectors, &args.capture)?;
    let photos = captures::photos_of(&model, &source, &photos, output)?;
    let photos = photos.with_cameras_of(&model, &OutputObserver::new(output))?;
    let out = args.out.clone().unwrap_or_else(|| model.report_folder(&args.model, "eval"));
    let request = Request {
        model: &model,
        details: &details,
        photos: &photos,
        backend: &backend,
        lpips: lpips.as_ref(),
        fits: Fits {
            pose: args.refine_poses || model.poses.is_some(),
            exposure: args.fit_exposure || model.exposures.is_some(),
        },
        depth: depth.as_ref(),
        detectors: &detectors,
        true_boxes: true_boxes.as_ref(),
        out: &out,
        trained: args.trained as usize,
    };
    let mut evaluated = evaluated(&request, output)?;
    if let Some(seconds) = args.objects_later {
        let observer = OutputObserver::new(output);
        evaluated.objects_moved = Some(eval::moved(&model, &photos, &backend, &detectors, seconds, &observer)?);
    }
    evaluated.record.scene = captures::name_of(&args.capture);
    evaluated.record.downscale = photos.downscale;
    save_json(&out.join("report.json"), &evaluated)?;
    Ok(evaluated)
}

/// What a trained model is measured by beside its photos.
#[derive(Default)]
pub(crate) struct Further<'a> {
    pub(crate) lpips: Option<&'a Lpips>,
    pub(crate) depth: Option<&'a TrueDepth>,
    pub(crate) detectors: &'a [Detector],
    pub(crate) true_boxes: Option<&'a TrueBoxes>,
}

/// The true boxes of a capture, if there are detectors to compare with them and the capture has some.
pub(crate) fn true_boxes(detectors: &[Detector], capture: &Path) -> Result<Option<TrueBoxes>, Failure> {
    Ok(if detectors.is_empty() { None } else { TrueBoxes::open(capture)? })
}

/// Measures a model that was just trained on these photos, on the CPU or a GPU, and writes `report.json`. Renders on the CPU.
pub(crate) fn measure_trained(
    model: &Model,
    photos: Photos,
    further: &Further,
    out: &Path,
    output: &Output,
) -> Result<Evaluated, Failure> {
    let (details, backend) = (Details::default(), train::Backend::Cpu);
    let fits = Fits { pose: model.poses.is_some(), exposure: model.exposures.is_some() };
    let Further { lpips, depth, detectors, true_boxes } = *further;
    let photos = &match &model.poses {
        Some(poses) => photos.corrected_by(poses),
        None => photos,
    };
    let (details, backend) = (&details, &backend);
    let request =
        Request { model, details, photos, backend, lpips, fits, depth, detectors, true_boxes, out, trained: 0 };
    let evaluated = evaluated(&request, output)?;
    save_json(&out.join("report.json"), &evaluated)?;
    Ok(evaluated)
}

fn evaluated(request: &Request, output: &Output) -> Result<Evaluated, Failure> {
    let evaluation = eval::evaluate(request, &OutputObserver::new(output))?;
    let seconds = evaluation.render_seconds;
    let rendered = evaluation.views.len() + evaluation.stretches.as_ref().map_or(0, |group| group.all.views);
    let mut record = Record {
        backend: evaluation.backend.clone(),
        workers: 1,
        threads: rayon::current_num_threads() as u32,
        wall_seconds: Some(seconds.wall),
        cpu_seconds: Some(seconds.cpu),
        splats: request.model.splats.len() as u64,
        fps: Some(rendered as f64 / seconds.wall.max(1e-9)),
        peak_memory_bytes: clock::peak_memory_bytes(),
        ..Record::new("eval")
    };
    record.set_figures(&evaluation.views);
    if let Some(found) = evaluation.detections.first().map(|found| &found.groups.held_out.all) {
        (record.detections_kept, record.zone_psnr) = (found.share_kept, found.zones.zone_psnr);
    }
    let Evaluation {
        views,
        by_kind,
        stretches,
        trained_on,
        depth,
        detections,
        sheet,
        moving,
        cuts,
        budgets,
        seams,
        ..
    } = evaluation;
    let evaluated = Evaluated::new(record, views);
    Ok(Evaluated {
        by_kind,
        stretches,
        trained_on,
        depth,
        detections,
        sheet: Some(sheet),
        moving,
        cuts,
        budgets,
        seams,
        ..evaluated
    })
}
