//! `plat eval`: a model against the held-out photos of a capture.
//!
//! Renders are compared as floats clamped to 0..1, not rounded to 8 bits; PSNR counts unmasked pixels only, and where
//! a mask leaves pixels out the other measures see the photo there. Views are drawn without an exposure; cc-PSNR says what is left
//! when the photo's own is forgiven. The contact sheet shows 8-bit pictures.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ::render::cpu::Renderer;
use bench::{SheetRow, contact_sheet, write_png};
use dataset::windows::WindowReader;
use image::RgbImage;
use scene::{BadInput, Capture, Pixels};
use serde::Serialize;
use store::BlockingStore;
use train::metrics;

use crate::args::EvalArgs;
use crate::cameras;
use crate::clock::{self, Stopwatch};
use crate::commands::render::to_image;
use crate::commands::train::{ingest_photos, make_folder};
use crate::cuts::{self, CutFigures};
use crate::failure::Failure;
use crate::lpips::Lpips;
use crate::model::{self, Model, Tree, save_json};
use crate::output::Output;
use crate::record::Record;
use crate::seams::{self, SeamReport};

/// Rows of a contact sheet at most; of more views, evenly many are shown.
const SHEET_ROWS: usize = 24;
/// Photos kept decoded.
const CACHE_BYTES: usize = 16 << 20;

/// `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Evaluated {
    #[serde(flatten)]
    pub(crate) record: Record,
    pub(crate) sheet: PathBuf,
    pub(crate) views: Vec<Figures>,
    /// With `--level` or `--budget`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) cuts: Vec<CutFigures>,
    /// With `--seams` or `--seams-of`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seams: Option<SeamReport>,
}

/// One held-out view.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Figures {
    pub(crate) view: String,
    /// dB; null where a mask leaves nothing.
    pub(crate) psnr: Option<f64>,
    /// dB, after the affine transform of colours that comes nearest.
    pub(crate) cc_psnr: Option<f64>,
    pub(crate) ssim: f64,
    /// SSIMULACRA2; null below 8 pixels a side.
    pub(crate) perceptual: Option<f64>,
    /// Null without weights.
    pub(crate) lpips: Option<f64>,
}

pub(crate) fn run(args: &EvalArgs, output: &Output) -> Result<(), Failure> {
    let evaluated = look(args, output)?;
    output.result(&evaluated, &text(&evaluated))
}

/// Measures all that is asked for.
pub(crate) fn look(args: &EvalArgs, output: &Output) -> Result<Evaluated, Failure> {
    let lpips = args.lpips.as_deref().map(Lpips::load).transpose()?;
    let model = model::read(&args.model)?;
    let parts = Parts::read(args)?;
    let source = cameras::open(&args.capture, output)?;
    let (default_every, default_downscale) = model.photos_used();
    let (store, _temporary) = model.photo_store(args.store.as_deref())?;
    let downscale = args.downscale.unwrap_or(default_downscale);
    let ingested = ingest_photos(&source, &store.blocking(), downscale, output)?;
    let out = args.out.clone().unwrap_or_else(|| model.folder(&args.model, "eval"));
    let test_every = args.test_every.unwrap_or(default_every);
    let capture = ingested.capture;
    let mut evaluated = evaluate(&model, capture.clone(), store.blocking(), test_every, lpips.as_ref(), &out, output)?;
    let held_out = held_out(&capture, test_every);
    let reader = WindowReader::new(Arc::new(capture), store.blocking(), CACHE_BYTES);
    if let Some(tree) = &parts.own {
        evaluated.cuts = cuts::measure(tree, &parts.cuts, &reader, &held_out, output)?;
    }
    if let Some(tree) = parts.faces_of() {
        let control = parts.other.as_ref().map(|_| (&model.splats, model.antialiased));
        let ask = seams::Ask { tree, control, seam_metres: args.seam_metres, out: &out };
        evaluated.seams = Some(seams::measure(&ask, &reader, &held_out, output)?);
    }
    evaluated.record.scene = cameras::name_of(&args.capture);
    evaluated.record.downscale = downscale;
    save_json(&out.join("report.json"), &evaluated)?;
    Ok(evaluated)
}

/// What of models is looked at block by block.
struct Parts {
    /// MODEL, where it is.
    own: Option<Tree>,
    cuts: Vec<cuts::Ask>,
    /// Whether its faces are looked at.
    seams: bool,
    /// The model of `--seams-of`.
    other: Option<Tree>,
}

impl Parts {
    fn read(args: &EvalArgs) -> Result<Self, BadInput> {
        let other = args.seams_of.as_deref().map(model::read_tree).transpose()?;
        let seams = args.seams || (args.seam_metres.is_some() && other.is_none());
        let own = (seams || args.level.is_some() || args.budget.is_some()).then(|| model::read_tree(&args.model));
        let own = own.transpose()?;
        let cuts = own.as_ref().map_or(Ok(Vec::new()), |tree| cuts::asked(args, &tree.plan))?;
        let parts = Self { own, cuts, seams, other };
        if parts.faces_of().is_some_and(|tree| tree.plan.leaves().blocks().len() < 2) {
            let path = args.seams_of.as_ref().unwrap_or(&args.model).display().to_string();
            return Err(BadInput::new(
                path,
                "is one block and has no seams",
                "give it with --seams-of a model that has",
            ));
        }
        Ok(parts)
    }

    fn faces_of(&self) -> Option<&Tree> {
        self.other.as_ref().or(self.own.as_ref().filter(|_| self.seams))
    }
}

/// The figures as text, a line a view.
pub(crate) fn text(evaluated: &Evaluated) -> String {
    let record = &evaluated.record;
    let line = |name: &str, [psnr, cc_psnr, ssim, perceptual, lpips]: [Option<f64>; 5]| {
        let figure = |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
        let lpips = record.lpips.map_or(String::new(), |_| format!(" {:>8}", figure(lpips, 4)));
        let [psnr, cc_psnr] = [psnr, cc_psnr].map(|value| figure(value, 2));
        format!("{psnr:>8} {cc_psnr:>8} {:>8} {:>11}{lpips}  {name}\n", figure(ssim, 4), figure(perceptual, 2))
    };
    let lpips = if record.lpips.is_some() { "    LPIPS" } else { "" };
    let mut text = format!("{:>8} {:>8} {:>8} {:>11}{lpips}\n", "PSNR", "cc-PSNR", "SSIM", "SSIMULACRA2");
    for view in &evaluated.views {
        text += &line(&view.view, [view.psnr, view.cc_psnr, Some(view.ssim), view.perceptual, view.lpips]);
    }
    text += &line("mean", [record.psnr, record.cc_psnr, record.ssim, record.perceptual, record.lpips]);
    if !evaluated.cuts.is_empty() {
        text += &format!("\n{}\n", cuts::text(&evaluated.cuts));
    }
    if let Some(report) = &evaluated.seams {
        text += &format!("\n{}\n\n", seams::text(report));
    }
    text + &evaluated.sheet.display().to_string()
}

/// Indices of the views that are held out.
fn held_out(capture: &Capture, test_every: u32) -> Vec<u32> {
    (0..capture.views.len()).filter(|&i| Capture::is_test(i, test_every)).map(|i| i as u32).collect()
}

/// Draws every held-out view of an ingested capture and measures it; leaves the contact sheet under `out`.
pub(crate) fn evaluate(
    model: &Model,
    capture: Capture,
    store: BlockingStore,
    test_every: u32,
    lpips: Option<&Lpips>,
    out: &Path,
    output: &Output,
) -> Result<Evaluated, Failure> {
    let held_out = held_out(&capture, test_every);
    if held_out.is_empty() {
        return Err(BadInput::new("--test-every", "holds out no view", "give a number from 1 to that of views").into());
    }
    make_folder(out)?;
    let reader = WindowReader::new(Arc::new(capture), store, CACHE_BYTES);
    let mut renderer = Renderer::default();
    let progress = output.progress("evaluating", held_out.len() as u64);
    let shown_every = held_out.len().div_ceil(SHEET_ROWS);
    let (mut views, mut rows) = (Vec::new(), Vec::new());
    let mut drawing = Drawing::default();
    for (i, &index) in held_out.iter().enumerate() {
        let view = &reader.capture().views[index as usize];
        let photo = reader.window(index, 0, view.camera.full()).map_err(|e| Failure::Work(e.to_string()))?;
        let clock = Stopwatch::start();
        let frame = renderer.forward(&model.splats, None, &view.camera, &model.options());
        drawing.add(&clock);
        let figures = measure(&view.name, &frame.colour, &photo, lpips)?;
        if i.is_multiple_of(shown_every) {
            rows.push(SheetRow {
                label: view.name.clone(),
                photo: photo_image(&photo),
                render: to_image(frame),
                psnr: figures.psnr,
                ssim: Some(figures.ssim),
                perceptual: figures.perceptual,
            });
        }
        views.push(figures);
        progress.at(i as u64 + 1, "");
    }
    drop(progress);
    let sheet = out.join("sheet.png");
    write_png(&sheet, &contact_sheet(&rows))?;
    let record = Record {
        backend: renderer.name(),
        workers: 1,
        threads: rayon::current_num_threads() as u32,
        wall_seconds: Some(drawing.wall_seconds),
        cpu_seconds: Some(drawing.cpu_seconds),
        psnr: mean(views.iter().map(|view| view.psnr)),
        cc_psnr: mean(views.iter().map(|view| view.cc_psnr)),
        ssim: mean(views.iter().map(|view| Some(view.ssim))),
        perceptual: mean(views.iter().map(|view| view.perceptual)),
        lpips: mean(views.iter().map(|view| view.lpips)),
        splats: model.splats.len() as u64,
        fps: Some(views.len() as f64 / drawing.wall_seconds.max(1e-9)),
        peak_memory_bytes: clock::peak_memory_bytes(),
        ..Record::new("eval")
    };
    Ok(Evaluated { record, sheet, views, cuts: Vec::new(), seams: None })
}

/// Time that drawing took.
#[derive(Debug, Default)]
struct Drawing {
    cpu_seconds: f64,
    wall_seconds: f64,
}

impl Drawing {
    fn add(&mut self, clock: &Stopwatch) {
        self.cpu_seconds += clock.cpu_seconds();
        self.wall_seconds += clock.wall_seconds();
    }
}

pub(crate) fn measure(name: &str, colour: &[f32], photo: &Pixels, lpips: Option<&Lpips>) -> Result<Figures, Failure> {
    let truth: Vec<f32> = photo.rgb.iter().map(|&value| f32::from(value) / 255.0).collect();
    let mut render: Vec<f32> = colour.iter().map(|value| value.clamp(0.0, 1.0)).collect();
    let psnr = metrics::psnr(&render, &truth, photo.mask.as_deref());
    let cc_psnr = metrics::colour_corrected_psnr(&render, &truth, photo.mask.as_deref());
    if let Some(mask) = &photo.mask {
        for (i, value) in render.iter_mut().enumerate() {
            if mask[i % mask.len()] < 128 {
                *value = truth[i];
            }
        }
    }
    let (width, height) = (photo.width as usize, photo.height as usize);
    Ok(Figures {
        view: name.to_owned(),
        psnr,
        cc_psnr,
        ssim: metrics::ssim(&render, &truth, width, height),
        perceptual: metrics::ssimulacra2(&truth, &render, width, height),
        lpips: lpips.map(|lpips| lpips.distance(&render, &truth, width, height)).transpose()?,
    })
}

/// Mean of what there is.
pub(crate) fn mean(values: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let (sum, count) = values.flatten().fold((0.0, 0u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

pub(crate) fn photo_image(photo: &Pixels) -> RgbImage {
    let area = photo.area();
    RgbImage::from_fn(photo.width, photo.height, |x, y| {
        let at = y as usize * photo.width as usize + x as usize;
        image::Rgb([photo.rgb[at], photo.rgb[area + at], photo.rgb[2 * area + at]])
    })
}
