//! Levels of detail, measured: what a cut of the tree loses against the finest model, at full size and from where it is
//! meant to be seen, and how it stands against the finest model thinned out to as many splats.
//!
//! A cut's viewing distance is where its pixels are as large as the picture's: of a view, the mip at which half of what it
//! shows is resolved by the cut. There, splats are drawn in three ways, and each model is judged by its best:
//! - classic, as they are;
//! - thinned: classic, after taking out of each splat what a pixel of that mip blurs more than one of the full image
//!   ([`train::low_pass`]: a block hands its splats on thickened by this, so that they can be drawn at full size);
//! - anti-aliased: with opacity compensated for the pixel's blur.

use std::borrow::Cow;

use blocks::{Cut, Ground, Plan, ViewTree};
use dataset::windows::WindowReader;
use glam::DVec3;
use render::cpu::Renderer;
use render::{Frame, Options};
use scene::{BadInput, BlockId, Camera, Splats, column};
use serde::Serialize;
use train::TrainView;
use train::low_pass::from_full_resolution;

use crate::args::{EvalArgs, Level};
use crate::commands::eval::{self, Figures};
use crate::failure::Failure;
use crate::model::Tree;
use crate::output::Output;

/// Pixels covered less than this by the scene itself show none of it.
const COVERED: f32 = 0.2;
/// Every how many pixels, on both axes, one is asked for what it shows.
const SAMPLED: usize = 4;

/// A cut to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Ask {
    /// The blocks of this level, and coarser ones where there are none.
    Level(u8),
    /// For each view the sharpest with this many splats.
    Budget(u32),
}

/// Means over the held-out views.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Means {
    /// dB.
    pub(crate) psnr: Option<f64>,
    pub(crate) ssim: Option<f64>,
    /// SSIMULACRA2.
    pub(crate) perceptual: Option<f64>,
}

/// One model at a cut's viewing distance, drawn in three ways.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Drawn {
    pub(crate) classic: Means,
    pub(crate) thinned: Means,
    pub(crate) antialiased: Means,
}

impl Drawn {
    /// The way with the highest PSNR, and its name.
    pub(crate) fn best(&self) -> (&'static str, &Means) {
        let ways = [("classic", &self.classic), ("thinned", &self.thinned), ("antialiased", &self.antialiased)];
        let psnr = |means: &Means| means.psnr.unwrap_or(f64::NEG_INFINITY);
        let [first, rest @ ..] = ways;
        rest.into_iter().fold(first, |best, way| if psnr(way.1) > psnr(best.1) { way } else { best })
    }
}

/// A cut's figures.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct CutFigures {
    pub(crate) level: Option<u8>,
    pub(crate) budget: Option<u32>,
    /// Splats shown, mean over the views.
    pub(crate) splats: f64,
    /// At full size, drawn as the model says.
    pub(crate) full: Means,
    /// dB below the finest at full size.
    pub(crate) loss_db: Option<f64>,
    /// The viewing distance as a mip of the full images, mean over the views.
    pub(crate) away_mip: f64,
    /// At the viewing distance: the cut, the finest model, and the finest model's most important splats, as many.
    pub(crate) away: Drawn,
    pub(crate) away_finest: Drawn,
    pub(crate) away_pruned: Drawn,
    /// dB below the finest at the viewing distance, each drawn its best way.
    pub(crate) away_loss_db: Option<f64>,
    /// dB above the thinned-out finest model there.
    pub(crate) away_gain_db: Option<f64>,
}

/// What the command line asks for.
///
/// # Errors
/// A level that the tree does not have.
pub(crate) fn asked(args: &EvalArgs, plan: &Plan) -> Result<Vec<Ask>, BadInput> {
    let mut asks = match args.level {
        None => Vec::new(),
        Some(Level::All) => (0..=plan.levels).map(Ask::Level).collect(),
        Some(Level::Only(level)) if level <= plan.levels => vec![Ask::Level(level)],
        Some(Level::Only(level)) => {
            let problem = format!("{level} is not in the model, whose finest level is {}", plan.levels);
            return Err(BadInput::new("--level", problem, "give a level that it has, or all"));
        }
    };
    asks.extend(args.budget.map(Ask::Budget));
    if !asks.is_empty() && plan.tasks.iter().all(|task| task.block.level > 0) {
        let advice = "train with --blocks tree";
        return Err(BadInput::new("--level or --budget", "needs a tree: the model has no coarser blocks", advice));
    }
    Ok(asks)
}

/// Measures cuts over views, by index into the reader's capture.
pub(crate) fn measure(
    tree: &Tree,
    asks: &[Ask],
    reader: &WindowReader,
    held_out: &[u32],
    output: &Output,
) -> Result<Vec<CutFigures>, Failure> {
    let finest = tree.sewn(&tree.plan.leaves());
    let scene = without_backdrop(&finest, &tree.plan.ground);
    let ranked = by_importance(&finest);
    let viewer = ViewTree::new(&tree.plan, tree.results.iter().map(|(&block, splats)| (block, splats)));
    let mut bench = Bench { tree, reader, renderer: Renderer::default() };
    let progress = output.progress("measuring cuts", (asks.len() * held_out.len()) as u64);
    let mut measured = Vec::new();
    for &ask in asks {
        let mut sums = Sums::default();
        for &view in held_out {
            let camera = &reader.capture().views[view as usize].camera;
            let cut = match ask {
                Ask::Level(level) => at_level(&tree.plan, level),
                Ask::Budget(budget) => viewer.cut(camera, budget as usize).unwrap_or_default(),
            };
            let splats = tree.sewn(&cut);
            let mut most_important = ranked[..splats.len().min(ranked.len())].to_vec();
            most_important.sort_unstable();
            let pruned = finest.select(&most_important);
            let mip = bench.viewing_mip(&cut, &scene, view);
            let own = Way { mip: 0, thinned: false, antialiased: tree.antialiased };
            sums.full.push(bench.figures(&splats, view, own)?);
            sums.finest.push(bench.figures(&finest, view, own)?);
            for (sum, model) in [&splats, &finest, &pruned].into_iter().enumerate() {
                for (way, (thinned, antialiased)) in
                    [(false, false), (true, false), (false, true)].into_iter().enumerate()
                {
                    sums.away[sum][way].push(bench.figures(model, view, Way { mip, thinned, antialiased })?);
                }
            }
            sums.mips.push(f64::from(mip));
            sums.splats.push(splats.len() as f64);
            progress.at((measured.len() * held_out.len() + sums.mips.len()) as u64, "");
        }
        measured.push(sums.figures(ask));
    }
    Ok(measured)
}

/// The table for people.
pub(crate) fn text(cuts: &[CutFigures]) -> String {
    let mut text = String::from(
        "                    at full size          at its viewing distance\n\
         cut         splats    PSNR    loss    mip    PSNR    loss  against as many of the finest   drawn\n",
    );
    let figure = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
    for cut in cuts {
        let name = match (cut.level, cut.budget) {
            (Some(level), _) => format!("level {level}"),
            (_, Some(budget)) => format!("≤{budget}"),
            (None, None) => String::new(),
        };
        let (way, best) = cut.away.best();
        text += &format!(
            "{name:<10} {:>7.0} {:>7} {:>7} {:>6.1} {:>7} {:>7} {:>30}   {way}\n",
            cut.splats,
            figure(cut.full.psnr),
            figure(cut.loss_db),
            cut.away_mip,
            figure(best.psnr),
            figure(cut.away_loss_db),
            cut.away_gain_db.map_or("-".into(), |db| format!("{db:+.2}")),
        );
    }
    text
}

/// The blocks of a level, and coarser ones where there are none.
fn at_level(plan: &Plan, level: u8) -> Cut {
    plan.tasks.iter().map(|task| task.block).filter(|block| block.level <= level).collect()
}

/// Rows by opacity times the area of the splat's two longest axes, most first.
fn by_importance(splats: &Splats) -> Vec<u32> {
    let importance = |i: usize| {
        let mut scales = [0, 1, 2].map(|axis| splats.col(column::LOG_SCALE + axis)[i]);
        scales.sort_by(f32::total_cmp);
        // The logarithm of o · s · s.
        -(-splats.col(column::OPACITY)[i]).exp().ln_1p() + scales[1] + scales[2]
    };
    let importances: Vec<f32> = (0..splats.len()).map(importance).collect();
    let mut rows: Vec<u32> = (0..splats.len() as u32).collect();
    rows.sort_by(|&a, &b| importances[b as usize].total_cmp(&importances[a as usize]).then(a.cmp(&b)));
    rows
}

/// How a model is drawn.
#[derive(Debug, Clone, Copy)]
struct Way {
    mip: u8,
    thinned: bool,
    antialiased: bool,
}

struct Bench<'a> {
    tree: &'a Tree,
    reader: &'a WindowReader,
    renderer: Renderer,
}

impl Bench<'_> {
    fn figures(&mut self, splats: &Splats, view: u32, way: Way) -> Result<Figures, Failure> {
        let view_of = &self.reader.capture().views[view as usize];
        let camera = view_of.camera.mip(way.mip);
        let photo = self.reader.window(view, way.mip, camera.full()).map_err(|e| Failure::Work(e.to_string()))?;
        let options = Options { antialiased: way.antialiased, sh_degree: splats.sh_degree(), ..Options::default() };
        let mut splats = Cow::Borrowed(splats);
        if way.thinned && way.mip > 0 {
            let at_mip = TrainView { view, mip: way.mip, rect: camera.full(), camera: view_of.camera };
            from_full_resolution(splats.to_mut(), &[at_mip]);
        }
        let frame = self.renderer.forward(&splats, None, &camera, &options);
        eval::measure(&view_of.name, &frame.colour, &photo, None)
    }

    /// The mip at which a pixel of the view is as large as one of the cut, over half of what the view shows of the scene.
    fn viewing_mip(&mut self, cut: &Cut, scene: &Splats, view: u32) -> u8 {
        let view = &self.reader.capture().views[view as usize];
        let plan = &self.tree.plan;
        let options = Options { antialiased: self.tree.antialiased, extras: true, ..Options::default() };
        let frame = self.renderer.forward(scene, None, &view.camera, &options);
        let mut steps = Vec::new();
        for y in (0..frame.height).step_by(SAMPLED) {
            for x in (0..frame.width).step_by(SAMPLED) {
                let Some((place, depth)) = shown_at(frame, &view.camera, y * frame.width + x) else { continue };
                let owner = cut.owner_of(&plan.ground, place);
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
}

/// Tells what belongs to the scene itself: what is in the root square, and no farther above or below the middle of that
/// than it is wide. The backdrop, which stands for the sky and all that is far, does not; it would draw depths away.
pub(crate) fn scene_of(splats: &Splats, ground: &Ground) -> impl Fn(DVec3) -> bool + use<> {
    let (ground, root) = (*ground, ground.core(BlockId::ROOT));
    let places = (0..splats.len()).map(|i| ground.from_world(splats.mean(i).as_dvec3()));
    let mut heights: Vec<f64> = places.filter(|at| root.contains(at.truncate())).map(|at| at.z).collect();
    heights.sort_by(f64::total_cmp);
    let middle = heights.get(heights.len() / 2).copied().unwrap_or_default();
    move |place| {
        let at = ground.from_world(place);
        root.contains(at.truncate()) && (at.z - middle).abs() <= ground.edge_metres
    }
}

/// The splats of the scene itself.
pub(crate) fn without_backdrop(splats: &Splats, ground: &Ground) -> Splats {
    let is_scene = scene_of(splats, ground);
    splats.filter(|i| is_scene(splats.mean(i).as_dvec3()))
}

/// The place in the world that a pixel shows, and its depth, metres. `None` where it shows nothing.
pub(crate) fn shown_at(frame: &Frame, camera: &Camera, pixel: usize) -> Option<(DVec3, f64)> {
    let covered = 1.0 - frame.transmittance[pixel];
    let depth = f64::from(frame.depth[pixel] / covered);
    if covered < COVERED || !depth.is_finite() || depth <= 0.0 {
        return None;
    }
    let k = &camera.pinhole;
    let (x, y) = ((pixel % frame.width) as f64 + 0.5, (pixel / frame.width) as f64 + 0.5);
    let ray = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
    Some((camera.camera_from_world.inverse().apply(ray * depth), depth))
}

/// Figures of the views so far.
#[derive(Default)]
struct Sums {
    full: Vec<Figures>,
    finest: Vec<Figures>,
    /// Of the cut, the finest and the pruned model: classic, thinned, anti-aliased.
    away: [[Vec<Figures>; 3]; 3],
    mips: Vec<f64>,
    splats: Vec<f64>,
}

impl Sums {
    fn figures(&self, ask: Ask) -> CutFigures {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let drawn = |of: &[Vec<Figures>; 3]| {
            let [classic, thinned, antialiased] = of.each_ref().map(|figures| means(figures));
            Drawn { classic, thinned, antialiased }
        };
        let less = |a: &Means, b: &Means| Some(a.psnr? - b.psnr?);
        let full = means(&self.full);
        let [away, away_finest, away_pruned] = self.away.each_ref().map(drawn);
        let (level, budget) = match ask {
            Ask::Level(level) => (Some(level), None),
            Ask::Budget(budget) => (None, Some(budget)),
        };
        CutFigures {
            level,
            budget,
            splats: mean(&self.splats),
            loss_db: less(&means(&self.finest), &full),
            full,
            away_mip: mean(&self.mips),
            away_loss_db: less(away_finest.best().1, away.best().1),
            away_gain_db: less(away.best().1, away_pruned.best().1),
            away,
            away_finest,
            away_pruned,
        }
    }
}

fn means(figures: &[Figures]) -> Means {
    Means {
        psnr: eval::mean(figures.iter().map(|f| f.psnr)),
        ssim: eval::mean(figures.iter().map(|f| Some(f.ssim))),
        perceptual: eval::mean(figures.iter().map(|f| f.perceptual)),
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use scene::{Pinhole, Rigid};

    use super::*;

    #[test]
    fn a_pixel_shows_the_place_in_front_of_it() {
        let pinhole = Pinhole { width: 4, height: 2, fx: 2.0, fy: 2.0, cx: 2.0, cy: 1.0 };
        let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, 5.0) };
        let camera = Camera { pinhole, camera_from_world };
        let mut frame =
            Frame { width: 4, height: 2, transmittance: vec![0.5; 8], depth: vec![4.0; 8], ..Frame::default() };
        frame.transmittance[3] = 0.9;
        let (place, depth) = shown_at(&frame, &camera, 5).unwrap();
        assert_eq!((place, depth), (DVec3::new(-2.0, 2.0, 3.0), 8.0));
        assert_eq!(camera.project(place).0, glam::DVec2::new(1.5, 1.5));
        assert!(shown_at(&frame, &camera, 3).is_none());
    }
}
