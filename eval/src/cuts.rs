//! Measures cuts of a level-of-detail tree: how much quality a cut loses against the finest model at full resolution and at its
//! viewing distance, and how it compares with the finest model pruned to as many splats.
//!
//! The viewing distance of a cut is the mip of a view at which half of what the view shows is resolved by the cut. There a model is
//! rendered in three ways and judged by the best of them:
//! - classic: the splats as they are;
//! - thinned: classic, after each splat is narrowed by the difference between the mip's screen-space dilation and that of the full
//!   image (a block passes its splats on widened by this, so that they can be rendered at full size);
//! - anti-aliased: with opacity compensated for the dilation.

use std::borrow::Cow;

use blocks::{Cut, Plan};
use dataset::windows::WindowReader;
use model::Tree;
use render::{Frame, Options};
use scene::{Splats, View, column};
use serde::Serialize;
use train::TrainView;
use train::low_pass::from_full_resolution;

use crate::figures::{Comparison, Means, ViewFigures};
use crate::surface::surface_point;
use crate::{EvalError, Renderer};

/// Step between sampled pixels, on both axes.
const SAMPLE_STEP: usize = 4;

/// A cut to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CutRequest {
    /// The blocks of this level, and coarser ones where there are none.
    Level(u8),
}

/// One model at a cut's viewing distance, rendered in three ways.
#[derive(Debug, Clone, Serialize)]
pub struct AwayFigures {
    /// As the splats are.
    pub classic: Means,
    /// Classic, after narrowing.
    pub thinned: Means,
    /// With compensated opacity.
    pub antialiased: Means,
}

impl AwayFigures {
    /// Name and figures of the way with the highest PSNR.
    pub fn best(&self) -> (&'static str, &Means) {
        let ways = [("classic", &self.classic), ("thinned", &self.thinned), ("antialiased", &self.antialiased)];
        let psnr = |means: &Means| means.psnr.unwrap_or(f64::NEG_INFINITY);
        let [first, rest @ ..] = ways;
        rest.into_iter().fold(first, |best, way| if psnr(way.1) > psnr(best.1) { way } else { best })
    }
}

/// Figures of one cut: means over the held-out views. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub struct CutFigures {
    /// The finest level.
    pub level: u8,
    /// Splats rendered.
    pub splats: f64,
    /// At full resolution, rendered as the model says.
    pub full: Means,
    /// dB below the finest model at full resolution.
    pub loss_db: Option<f64>,
    /// The viewing distance as a mip of the full images.
    pub away_mip: f64,
    /// The cut at the viewing distance.
    pub away: AwayFigures,
    /// The finest model there.
    pub away_finest: AwayFigures,
    /// As many of the finest model's most important splats there.
    pub away_pruned: AwayFigures,
    /// dB below the finest model at the viewing distance, each rendered its best way.
    pub away_loss_db: Option<f64>,
    /// dB above the pruned finest model there.
    pub away_gain_db: Option<f64>,
}

/// Measures cuts view by view.
pub(crate) struct CutMeter<'a> {
    tree: &'a Tree,
    finest: &'a Splats,
    /// Rows of `finest`, most important first.
    ranking: Vec<u32>,
    reader: &'a WindowReader,
    requests: &'a [CutRequest],
    sums: Vec<Sums>,
}

impl<'a> CutMeter<'a> {
    pub(crate) fn new(
        tree: &'a Tree,
        finest: &'a Splats,
        requests: &'a [CutRequest],
        reader: &'a WindowReader,
    ) -> Self {
        let ranking = by_importance(finest);
        Self { tree, finest, ranking, reader, requests, sums: vec![Sums::default(); requests.len()] }
    }

    /// Measures all cuts on the view of this index; `finest` are its figures for the finest model, `foreground` its foreground
    /// with depth.
    pub(crate) fn add_view(
        &mut self,
        index: u32,
        finest: &ViewFigures,
        foreground: &Frame,
        renderer: &mut Renderer,
    ) -> Result<(), EvalError> {
        let view = &self.reader.capture().views[index as usize];
        for at in 0..self.requests.len() {
            let CutRequest::Level(level) = self.requests[at];
            let cut = at_level(&self.tree.plan, level);
            let splats = self.tree.merged(&cut);
            let mut most_important = self.ranking[..splats.len().min(self.ranking.len())].to_vec();
            most_important.sort_unstable();
            let pruned = self.finest.select(&most_important);
            let mip = viewing_mip(&self.tree.plan, &cut, view, foreground);
            let full = Way { mip: 0, thinned: false, antialiased: self.tree.antialiased };
            let full = self.measure(&splats, index, full, renderer)?;
            let mut away: [[Vec<ViewFigures>; 3]; 3] = Default::default();
            for (model, away) in [&splats, self.finest, &pruned].into_iter().zip(&mut away) {
                for ((thinned, antialiased), figures) in
                    [(false, false), (true, false), (false, true)].into_iter().zip(away)
                {
                    figures.push(self.measure(model, index, Way { mip, thinned, antialiased }, renderer)?);
                }
            }
            self.sums[at].add(full, finest.clone(), away, mip, splats.len());
        }
        Ok(())
    }

    /// The figures of all requests.
    pub(crate) fn figures(self) -> Vec<CutFigures> {
        self.requests.iter().zip(&self.sums).map(|(&request, sums)| sums.figures(request)).collect()
    }

    fn measure(
        &self,
        splats: &Splats,
        index: u32,
        way: Way,
        renderer: &mut Renderer,
    ) -> Result<ViewFigures, EvalError> {
        let view = &self.reader.capture().views[index as usize];
        let camera = view.camera.mip(way.mip);
        let photo = self.reader.window(index, way.mip, camera.full())?;
        let options = Options { antialiased: way.antialiased, sh_degree: splats.sh_degree(), ..Options::default() };
        let mut splats = Cow::Borrowed(splats);
        if way.thinned && way.mip > 0 {
            let at_mip = TrainView {
                view: index,
                mip: way.mip,
                rect: camera.full(),
                camera: view.camera,
                camera_from_context: None,
            };
            from_full_resolution(splats.to_mut(), &[at_mip]);
        }
        let frame = renderer.render_once(&splats, &camera, &options)?;
        Ok(Comparison::new(&view.name, &frame.colour, &photo).figures(None)?)
    }
}

/// How a model is rendered.
#[derive(Debug, Clone, Copy)]
struct Way {
    mip: u8,
    thinned: bool,
    antialiased: bool,
}

/// The blocks of a level, and coarser ones where there are none.
fn at_level(plan: &Plan, level: u8) -> Cut {
    plan.tasks.iter().map(|task| task.block).filter(|block| block.level <= level).collect()
}

/// Rows by opacity times the area of the splat's two longest axes, largest first.
pub(crate) fn by_importance(splats: &Splats) -> Vec<u32> {
    let importance = |i: usize| {
        let mut scales = [0, 1, 2].map(|axis| splats.col(column::LOG_SCALE + axis)[i]);
        scales.sort_by(f32::total_cmp);
        // log(opacity · scale · scale)
        -(-splats.col(column::OPACITY)[i]).exp().ln_1p() + scales[1] + scales[2]
    };
    let importances: Vec<f32> = (0..splats.len()).map(importance).collect();
    let mut rows: Vec<u32> = (0..splats.len() as u32).collect();
    rows.sort_by(|&a, &b| importances[b as usize].total_cmp(&importances[a as usize]).then(a.cmp(&b)));
    rows
}

/// The mip at which a pixel of the view is as large as one of the cut, for the median pixel of the foreground.
fn viewing_mip(plan: &Plan, cut: &Cut, view: &View, foreground: &Frame) -> u8 {
    let mut steps = Vec::new();
    for y in (0..foreground.height).step_by(SAMPLE_STEP) {
        for x in (0..foreground.width).step_by(SAMPLE_STEP) {
            let Some((point, depth)) = surface_point(foreground, &view.camera, y * foreground.width + x) else {
                continue;
            };
            let owner = cut.owner_of(&plan.ground, point);
            let rho = owner.and_then(|block| plan.rho_metres.get(usize::from(block.level)));
            steps.extend(rho.map(|rho| (rho * view.camera.pinhole.fx / depth).log2()));
        }
    }
    let middle = steps.len() / 2;
    if steps.is_empty() {
        return 0;
    }
    let (_, median, _) = steps.select_nth_unstable_by(middle, f64::total_cmp);
    median.round().clamp(0.0, view.mips.len().saturating_sub(1) as f64) as u8
}

/// Figures of one request so far.
#[derive(Default, Clone)]
struct Sums {
    full: Vec<ViewFigures>,
    finest: Vec<ViewFigures>,
    /// Of the cut, the finest and the pruned model: classic, thinned, anti-aliased.
    away: [[Vec<ViewFigures>; 3]; 3],
    mips: Vec<f64>,
    splats: Vec<f64>,
}

impl Sums {
    fn add(
        &mut self,
        full: ViewFigures,
        finest: ViewFigures,
        away: [[Vec<ViewFigures>; 3]; 3],
        mip: u8,
        splats: usize,
    ) {
        self.full.push(full);
        self.finest.push(finest);
        for (all, of_view) in self.away.as_flattened_mut().iter_mut().zip(away.into_iter().flatten()) {
            all.extend(of_view);
        }
        self.mips.push(f64::from(mip));
        self.splats.push(splats as f64);
    }

    fn figures(&self, request: CutRequest) -> CutFigures {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let away_figures = |of: &[Vec<ViewFigures>; 3]| {
            let [classic, thinned, antialiased] = of.each_ref().map(|figures| Means::of(figures));
            AwayFigures { classic, thinned, antialiased }
        };
        let difference = |a: &Means, b: &Means| Some(a.psnr? - b.psnr?);
        let full = Means::of(&self.full);
        let [away, away_finest, away_pruned] = self.away.each_ref().map(away_figures);
        let CutRequest::Level(level) = request;
        CutFigures {
            level,
            splats: mean(&self.splats),
            loss_db: difference(&Means::of(&self.finest), &full),
            full,
            away_mip: mean(&self.mips),
            away_loss_db: difference(away_finest.best().1, away.best().1),
            away_gain_db: difference(away.best().1, away_pruned.best().1),
            away,
            away_finest,
            away_pruned,
        }
    }
}
