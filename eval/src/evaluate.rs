//! Renders the held-out views of a capture and measures them.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use blocks::{Part, view_kinds};
use dataset::ingest::TrueDepth;
use dataset::true_boxes::TrueBoxes;
use model::{Model, Tree};
use perceive::Detector;
use render::{Frame, Options};
use scene::{BadInput, Camera, Splats};
use train::Backend;

use crate::budgets::{BudgetFigures, BudgetMeter};
use crate::composition::Composition;
use crate::cuts::{CutFigures, CutMeter};
use crate::details::Details;
use crate::figures::{Comparison, ViewFigures, clamped};
use crate::fits::{Fits, Fitter};
use crate::images::{colour_image, photo_image, write_png};
use crate::judges::{DepthReport, DetectionReport, Judged, Judges};
use crate::moving::{MovingFigures, MovingMeter};
use crate::seams::{SeamFrames, SeamMeter, SeamReport};
use crate::sheet::{SheetRow, contact_sheet};
use crate::summary::{ByKind, Group};
use crate::surface::without_backdrop;
use crate::{EvalError, Lpips, Observer, Photos, Renderer, Seconds};

/// Rows of a contact sheet at most; of more views an even selection is shown.
const MAX_SHEET_ROWS: usize = 24;
/// Bytes of decoded photos that are kept.
const CACHE_BYTES: usize = 16 << 20;

/// What to evaluate.
pub struct Request<'a> {
    /// The model.
    pub model: &'a Model,
    /// Cuts and seams to measure as well.
    pub details: &'a Details,
    /// The photos.
    pub photos: &'a Photos,
    /// What renders.
    pub backend: &'a Backend,
    /// The network for LPIPS.
    pub lpips: Option<&'a Lpips>,
    /// What is fitted to each photo for further figures.
    pub fits: Fits,
    /// True depths to compare with.
    pub depth: Option<&'a TrueDepth>,
    /// What finds objects on photos and renders.
    pub detectors: &'a [Detector],
    /// The objects that are there, to compare detections with.
    pub true_boxes: Option<&'a TrueBoxes>,
    /// Folder for contact sheets and pictures; created if need be.
    pub out: &'a Path,
    /// How many views that were trained on to measure as well, evenly chosen.
    pub trained: usize,
}

/// Results of an evaluation.
#[derive(Debug)]
pub struct Evaluation {
    /// Name of the renderer's backend.
    pub backend: String,
    /// Time of rendering the model's held-out views.
    pub render_seconds: Seconds,
    /// By held-out view; those in held-out stretches are apart.
    pub views: Vec<ViewFigures>,
    /// Of these.
    pub by_kind: ByKind,
    /// Of the views in held-out stretches.
    pub stretches: Option<Group>,
    /// Of views that were trained on.
    pub trained_on: Option<Group>,
    /// Depth errors.
    pub depth: Option<DepthReport>,
    /// Detections on photos and renders, by detector.
    pub detections: Vec<DetectionReport>,
    /// The contact sheet.
    pub sheet: PathBuf,
    /// Of objects that move, where the capture has some.
    pub moving: Option<MovingFigures>,
    /// In the order of the request.
    pub cuts: Vec<CutFigures>,
    /// In the order of the request.
    pub budgets: Vec<BudgetFigures>,
    /// Figures near the seams.
    pub seams: Option<SeamReport>,
}

/// Renders every held-out view once and measures it, cuts and seams only on views outside held-out stretches; writes the contact sheet `sheet.png` and, with seams, their pictures.
/// Views are rendered without exposures.
///
/// # Errors
/// A capture without held-out views, photos that cannot be read, a renderer that fails, pictures that cannot be written.
pub fn evaluate(request: &Request, observer: &dyn Observer) -> Result<Evaluation, EvalError> {
    let Request { model, details, photos, backend, lpips, fits, out, .. } = *request;
    let [test, stretches, trained] = [Part::Test, Part::Stretch, Part::Trained].map(|part| photos.split.views(part));
    let held_out = [test.as_slice(), &stretches].concat();
    if held_out.is_empty() {
        let advice = "give a number from 1 to that of the views";
        return Err(BadInput::new("--test-every", "holds out no view", advice).into());
    }
    let of_photos = |&index: &u32| &photos.capture.views[index as usize];
    let Request { depth, detectors, true_boxes, .. } = *request;
    let mut judges = Judges::new(depth, detectors, true_boxes, photos.downscale, held_out.iter().map(of_photos))?;
    let extras = judges.need_depth();
    let options = Options { extras, inverse_depth: extras, ..model.options() };
    std::fs::create_dir_all(out).map_err(|error| EvalError::Folder { path: out.to_path_buf(), error })?;
    let reader = photos.reader(CACHE_BYTES);
    let mut renderer = Renderer::new(backend)?;
    let mut fitter = Fitter::new(fits, &model.splats, model.antialiased, &held_out, &reader)?;
    let splats = renderer.upload(&model.splats)?;
    let objects = Composition::new(&renderer, model.objects.iter())?;
    let mut moving = MovingMeter::new(&photos.capture.objects);

    // The finest cut of the model's own tree is the model itself.
    let own = details.own.as_ref().map(|tree| Scene::new(tree, Cow::Borrowed(&model.splats)));
    let other = details.other.as_ref().map(|tree| Scene::new(tree, Cow::Owned(tree.merged(&tree.plan.leaves()))));
    let has_cuts = !details.cuts.is_empty();
    let mut cuts =
        own.as_ref().filter(|_| has_cuts).map(|own| CutMeter::new(own.tree, &own.finest, &details.cuts, &reader));
    let has_budgets = !details.budgets.is_empty();
    let budgets = has_budgets.then(|| BudgetMeter::new(&model.splats, model.antialiased, &details.budgets));
    let mut budgets = budgets.transpose()?;
    let seam_scene = other.as_ref().or(own.as_ref().filter(|_| details.own_seams));
    let mut seams = seam_scene
        .map(|scene| SeamMeter::new(scene.tree, &scene.finest, other.is_some(), details.seam_metres, &photos.capture));

    let shown_every = held_out.len().div_ceil(MAX_SHEET_ROWS);
    let trained = evenly(&trained, request.trained);
    let total = (held_out.len() + trained.len()) as u64;
    let (mut views, mut rows, mut render_seconds) = (Vec::new(), Vec::new(), Seconds::default());
    for (i, &index) in held_out.iter().enumerate() {
        let view = &photos.capture.views[index as usize];
        let photo = reader.window(index, 0, view.camera.full())?;
        let began = observer.now();
        let placed = objects.at(&renderer, view.seconds)?;
        let frame = renderer.compose(&splats, &placed, &view.camera, &options)?;
        render_seconds.add(began, observer.now());
        let part = if i < test.len() { Part::Test } else { Part::Stretch };
        let compared = Comparison::new(&view.name, &frame.colour, &photo);
        let mut figures = compared.figures(lpips)?;
        if let Some(moving) = &mut moving {
            moving.add(view, &photo, &compared);
        }
        judges.add((part, index), view, &photo, frame, (&compared, &figures))?;
        let rendering = (&mut renderer, &splats, &model.options());
        fitter.add(&mut figures, (index, &photo), &compared, rendering, &photos.capture)?;
        if i.is_multiple_of(shown_every) {
            rows.push(SheetRow {
                label: view.name.clone(),
                photo: photo_image(&photo),
                render: colour_image(&compared.render, compared.width, compared.height),
                psnr: figures.psnr,
                ssim: Some(figures.ssim),
                perceptual: figures.perceptual,
            });
        }
        views.push(figures);
        observer.progress("evaluating", i as u64 + 1, total, "");
        if i >= test.len() {
            continue;
        }
        if let Some(budgets) = &mut budgets {
            budgets.add_view(view, &photo, &views[i], &mut renderer)?;
        }
        let own_frame = own.as_ref().map(|own| own.foreground(&mut renderer, &view.camera)).transpose()?;
        if let (Some(cuts), Some(foreground)) = (&mut cuts, &own_frame) {
            cuts.add_view(index, &views[i], foreground, &mut renderer)?;
        }
        if let Some(seams) = &mut seams {
            let other = other.as_ref().map(|other| other.frames(&mut renderer, &view.camera)).transpose()?;
            let frames = match (&other, &own_frame) {
                (Some((colour, foreground)), _) => SeamFrames { colour, control: Some(&compared.render), foreground },
                (None, Some(foreground)) => SeamFrames { colour: &compared.render, control: None, foreground },
                (None, None) => unreachable!("seams are measured on a tree"),
            };
            seams.add_view(view, &photo, &compared.truth, &frames, &mut renderer)?;
        }
    }
    let mut trained_figures = Vec::new();
    for (i, &index) in trained.iter().enumerate() {
        let view = &photos.capture.views[index as usize];
        let photo = reader.window(index, 0, view.camera.full())?;
        let placed = objects.at(&renderer, view.seconds)?;
        let frame = renderer.compose(&splats, &placed, &view.camera, &options)?;
        let compared = Comparison::new(&view.name, &frame.colour, &photo);
        let figures = compared.figures(lpips)?;
        judges.add((Part::Trained, index), view, &photo, frame, (&compared, &figures))?;
        trained_figures.push(figures);
        observer.progress("evaluating", (held_out.len() + i) as u64 + 1, total, "");
    }

    let kinds = view_kinds(&photos.capture);
    let Judged { depth, detections } = judges.finish(&kinds);
    let in_stretches = views.split_off(test.len());
    let sheet = out.join("sheet.png");
    write_png(&sheet, &contact_sheet(&rows))?;
    Ok(Evaluation {
        backend: renderer.name(),
        render_seconds,
        by_kind: ByKind::of(&views, &test, &kinds),
        views,
        stretches: Group::of(in_stretches, &stretches, &kinds),
        trained_on: Group::of(trained_figures, &trained, &kinds),
        depth,
        detections,
        sheet,
        moving: moving.map(MovingMeter::figures),
        cuts: cuts.map_or(Vec::new(), CutMeter::figures),
        budgets: budgets.map_or(Vec::new(), BudgetMeter::figures),
        seams: seams.map(|seams| seams.finish(&photos.capture, out, &mut renderer)).transpose()?,
    })
}

/// At most `count` of the views, evenly chosen.
fn evenly(views: &[u32], count: usize) -> Vec<u32> {
    let count = count.min(views.len());
    (0..count).map(|i| views[(2 * i + 1) * views.len() / (2 * count)]).collect()
}

/// A tree's finest cut, with and without its backdrop.
struct Scene<'a> {
    tree: &'a Tree,
    finest: Cow<'a, Splats>,
    foreground: Splats,
}

impl<'a> Scene<'a> {
    fn new(tree: &'a Tree, finest: Cow<'a, Splats>) -> Self {
        let foreground = without_backdrop(&finest, &tree.plan.ground);
        Self { tree, finest, foreground }
    }

    fn options(&self) -> Options {
        Options { antialiased: self.tree.antialiased, sh_degree: self.finest.sh_degree(), ..Options::default() }
    }

    /// The foreground alone, with depth.
    fn foreground(&self, renderer: &mut Renderer, camera: &Camera) -> Result<Frame, EvalError> {
        let options = Options { extras: true, ..self.options() };
        Ok(renderer.render_once(&self.foreground, camera, &options)?.clone())
    }

    /// Colours of the finest cut, clamped to 0..1, and the foreground with depth.
    fn frames(&self, renderer: &mut Renderer, camera: &Camera) -> Result<(Vec<f32>, Frame), EvalError> {
        let colour = clamped(&renderer.render_once(&self.finest, camera, &self.options())?.colour);
        Ok((colour, self.foreground(renderer, camera)?))
    }
}
