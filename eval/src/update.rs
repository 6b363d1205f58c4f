//! Trains an area of a finished model on new photos of it (EDeRF, section 3.1: fast local updates of key areas). The model's other splats
//! are drawn, and stay as they are.
//!
//! A model of several levels is updated at each: the cut at that level is trained at the pixels of that level, so that a viewer sees the
//! change from afar too.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use blocks::{Cut, Part};
use dataset::box_masks::covered;
use dataset::windows::WindowReader;
use glam::{DVec3, Vec3};
use model::{Model, Tree, read_tree};
use scene::{BadInput, BlockId, Camera, Pixels, Rect, Rigid, SparsePoints, Splats};
use train::changes::Changes;
use train::importance::{EvaluationViews, OwnershipWeights};
use train::{Backend, Flow, Job, Recipe, TrainView, WindowSource, low_pass, random, visibility};

use crate::pruning::size_bounds;
use crate::{EvalError, Observer, Photos, Seconds};

/// Splats that are trained lie in a ball of this many times the area's radius: beyond it nothing changes.
pub const HALO: f64 = 1.2;
/// Bytes of decoded photos that are kept.
const CACHE_BYTES: usize = 256 << 20;
/// Smallest side of a window, pixels.
const MIN_WINDOW: u32 = 16;
/// Margin around a window, as a share of its size, within which frozen splats are kept in memory.
const CONTEXT_MARGIN: f32 = 0.3;
/// Changed pixels of a photo for each splat that a new surface begins with.
const PIXELS_PER_SPLAT: f64 = 8.0;
/// Splats to end with, of those that a new surface begins with.
const GROWTH: f64 = 1.5;
/// Share of the steps that each coarser level is trained for, of the next finer one's.
const COARSER_STEPS: f64 = 0.5;
/// Smallest number of steps of a level.
const MIN_STEPS: u32 = 40;

/// A box of the world, for figures of what is in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldBox {
    /// Takes the box's axes to the world's.
    pub world_from_box: Rigid,
    /// Its lower corner in its own axes, metres.
    pub low: DVec3,
    /// The upper corner.
    pub high: DVec3,
}

/// What to update.
#[derive(Debug, Clone, Copy)]
pub struct UpdateOptions<'a> {
    /// Middle of the area, world metres.
    pub centre: DVec3,
    /// Its radius, metres.
    pub radius: f64,
    /// Training steps at the finest level, counted in views.
    pub steps: u32,
    /// Key of all random numbers.
    pub seed: u64,
    /// Also measures the pixels that show this box.
    pub measured: Option<WorldBox>,
    /// The device.
    pub backend: &'a Backend,
}

/// PSNR before and after, dB: means over the photos.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Gain {
    /// Of the model as it was.
    pub before: f64,
    /// Of the updated one.
    pub after: f64,
}

/// An updated model.
#[derive(Debug)]
pub struct Updated {
    /// Splats of the finest cut.
    pub splats: Splats,
    /// All splats of each block that has changed, halo included; empty for a model of one file.
    pub blocks: BTreeMap<BlockId, Splats>,
    /// Photos that show the area: trained on, and held out.
    pub photos: [usize; 2],
    /// Splats in the area and its halo, before and after.
    pub area_splats: [usize; 2],
    /// Windows of the photos that were trained on, and of those held out.
    pub windows: [Option<Gain>; 2],
    /// The same within the measured box.
    pub in_box: [Option<Gain>; 2],
    /// Time of training, all levels; and of the finest alone.
    pub training: [Seconds; 2],
}

/// Updates a model. Nothing is written.
///
/// # Errors
/// Photos of which none shows the area, or that cannot be read; training that fails; a model that cannot be read again.
pub fn update(
    model: &Model,
    photos: &Photos,
    options: &UpdateOptions,
    observer: &dyn Observer,
) -> Result<Updated, EvalError> {
    let tree = match &model.trained {
        Some((_, out)) => Some(read_tree(out)?),
        None => None,
    };
    let reader = photos.reader(CACHE_BYTES);
    let [trained, held_out] = [Part::Trained, Part::Test].map(|part| area_windows(photos, part, options));
    if trained.is_empty() {
        let problem = "has no photo that shows the area from a place that is not in it";
        let advice = "check --area, in the axes of the model, or give photos of it";
        return Err(BadInput::new("--photos", problem, advice).into());
    }
    let area = Area { options, reader: &reader, antialiased: model.antialiased };
    let (mut blocks, mut training) = (BTreeMap::new(), [Seconds::default(); 2]);
    let mut splats = model.splats.clone();
    let mut counts = [0; 2];
    let steps_of = |coarser: u8| {
        let steps = f64::from(options.steps) * COARSER_STEPS.powi(coarser.into());
        (steps as u32).max(MIN_STEPS.min(options.steps))
    };
    let levels = levels(tree.as_ref());
    let all_steps: u64 = levels.iter().map(|(coarser, _)| u64::from(steps_of(*coarser))).sum();
    let mut done = 0;
    for (coarser, cut) in levels {
        let steps = steps_of(coarser);
        let whole = match (&tree, &cut) {
            (Some(tree), Some(cut)) => tree.merged(cut),
            _ => model.splats.clone(),
        };
        let windows: Vec<TrainView> = trained.iter().map(|view| coarsened(view, coarser)).collect();
        let began = observer.now();
        let mut report = |step: u32| observer.progress("updating", done + u64::from(step), all_steps, "");
        let inside = area.train(&whole, &windows, steps, &mut report)?;
        done += u64::from(steps);
        let ended = observer.now();
        training[0].add(began, ended);
        let (before, rest) = area.parted(&whole);
        if coarser == 0 {
            training[1].add(began, ended);
            counts = [before.len(), inside.len()];
            splats = rest;
            splats.append(&inside);
        }
        if let (Some(tree), Some(cut)) = (&tree, &cut) {
            area.replace(tree, cut, &inside, &mut blocks);
        }
    }
    let measured = |source: &dyn WindowSource, views: &[TrainView]| -> Result<Option<Gain>, EvalError> {
        if views.is_empty() {
            return Ok(None);
        }
        let psnr = |splats: &Splats| -> Result<f64, EvalError> {
            let (antialiased, context, exposures) = (model.antialiased, None, None);
            let around = EvaluationViews { views, context, antialiased, exposures, source };
            Ok(around.psnr(splats, &OwnershipWeights::default())?[0])
        };
        Ok(Some(Gain { before: psnr(&model.splats)?, after: psnr(&splats)? }))
    };
    let windows = [measured(&reader, &trained)?, measured(&reader, &held_out)?];
    let in_box = match options.measured {
        None => [None, None],
        Some(of) => {
            let source = BoxPixels { photos: &reader, cameras: photos, of };
            let showing = |views: &[TrainView]| -> Vec<TrainView> {
                views.iter().filter(|view| source.shows(view)).copied().collect()
            };
            [measured(&source, &showing(&trained))?, measured(&source, &showing(&held_out))?]
        }
    };
    let photos = [trained.len(), held_out.len()];
    Ok(Updated { splats, blocks, photos, area_splats: counts, windows, in_box, training })
}

/// Of each level that has blocks, coarsest first: how many levels finer the finest is, and its cut, with blocks of the levels above where
/// it has none. A model of one file has one level.
fn levels(tree: Option<&Tree>) -> Vec<(u8, Option<Cut>)> {
    let Some(Tree { plan, .. }) = tree else { return vec![(0, None)] };
    let levels: BTreeSet<u8> = plan.tasks.iter().map(|task| task.block.level).collect();
    let finest = levels.last().copied().unwrap_or(0);
    let cut = |level: u8| match level == finest {
        true => plan.leaves(),
        false => plan.tasks.iter().map(|task| task.block).filter(|block| block.level <= level).collect(),
    };
    levels.iter().map(|&level| (finest - level, Some(cut(level)))).collect()
}

/// The windows of the photos of a part that show the area. A camera in the area is left out: it sees what is to change from inside.
fn area_windows(photos: &Photos, part: Part, options: &UpdateOptions) -> Vec<TrainView> {
    let window = |view: u32| {
        let camera = photos.capture.views[view as usize].camera;
        let rect = ball_window(&camera, options.centre, HALO * options.radius)?;
        let is_outside = camera.centre().distance(options.centre) > options.radius;
        let is_large = rect.width.min(rect.height) >= MIN_WINDOW;
        (is_outside && is_large).then_some(TrainView { view, mip: 0, rect, camera, camera_from_context: None })
    };
    photos.split.views(part).into_iter().filter_map(window).collect()
}

/// The pixels that a ball may cover: those of the cube around it.
fn ball_window(camera: &Camera, centre: DVec3, radius: f64) -> Option<Rect> {
    let (width, height) = (f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
    let cube = corners(centre - radius, centre + radius).map(|corner| camera.camera_from_world.apply(corner));
    let outline = camera.pinhole.outline(&cube);
    let fold =
        |start: f64, pick: fn(f64, f64) -> f64, of: fn(&glam::DVec2) -> f64| outline.iter().map(of).fold(start, pick);
    let [left, top] = [fold(width, f64::min, |p| p.x), fold(height, f64::min, |p| p.y)].map(|low| low.floor().max(0.0));
    let right = fold(0.0, f64::max, |p| p.x).ceil().min(width);
    let bottom = fold(0.0, f64::max, |p| p.y).ceil().min(height);
    let is_seen = !outline.is_empty() && left < right && top < bottom;
    is_seen.then_some(Rect {
        x: left as u32,
        y: top as u32,
        width: (right - left) as u32,
        height: (bottom - top) as u32,
    })
}

/// The corners of a box, numbered by the bits of their sides.
fn corners(low: DVec3, high: DVec3) -> [DVec3; 8] {
    [0, 1, 2, 3, 4, 5, 6, 7].map(|bits: u32| {
        let side = |axis: usize| if bits >> axis & 1 == 1 { high[axis] } else { low[axis] };
        DVec3::new(side(0), side(1), side(2))
    })
}

/// The window so many mips up, or fewer where the photo has no more.
fn coarsened(view: &TrainView, coarser: u8) -> TrainView {
    let at = |mips: u8| view.at(mips).map(|(mip, rect, _)| TrainView { mip, rect, ..*view });
    (0..=coarser).rev().find_map(at).unwrap_or(*view)
}

/// The area that is trained.
struct Area<'a> {
    options: &'a UpdateOptions<'a>,
    reader: &'a WindowReader,
    antialiased: bool,
}

impl Area<'_> {
    fn contains(&self, place: Vec3) -> bool {
        place.as_dvec3().distance(self.options.centre) <= HALO * self.options.radius
    }

    /// The splats in the area with its halo, and the others.
    fn parted(&self, splats: &Splats) -> (Splats, Splats) {
        let inside: Vec<bool> = (0..splats.len()).map(|i| self.contains(splats.mean(i))).collect();
        (splats.filter(|i| inside[i]), splats.filter(|i| !inside[i]))
    }

    /// The splats of the area, trained on these windows.
    fn train(
        &self,
        whole: &Splats,
        views: &[TrainView],
        steps: u32,
        report: &mut dyn FnMut(u32),
    ) -> Result<Splats, EvalError> {
        let (options, antialiased) = (self.options, self.antialiased);
        let (mut initial, rest) = self.parted(whole);
        let visible = visibility::finest_pixels(&rest, views, CONTEXT_MARGIN);
        let mut context = rest.filter(|i| visible[i].is_visible());
        if !antialiased {
            low_pass::from_full_resolution(&mut initial, views);
            low_pass::from_full_resolution(&mut context, views);
        }
        let around =
            EvaluationViews { views, context: Some(&context), antialiased, exposures: None, source: self.reader };
        let changes = Changes::find(&around, &initial)?;
        let wanted = (changes.pixels() / PIXELS_PER_SPLAT).ceil() as usize;
        let surface = changes.surface(&initial, options.centre, options.radius, wanted);
        let points = SparsePoints {
            positions: surface.iter().map(|at| at.place).collect(),
            colours: surface.iter().map(|at| at.colour).collect(),
            ..SparsePoints::default()
        };
        let bounds = size_bounds(whole);
        let recipe = Recipe { coarse: Vec::new(), ..Recipe::refinement(1.0) };
        let new = train::init::from_points(&points, whole.sh_degree(), recipe.initial_opacity, bounds);
        let budget = initial.len() + (GROWTH * new.len() as f64) as usize;
        initial.append(&new.with_attributes(&whole.attribute_names()));
        if initial.is_empty() {
            return Ok(initial);
        }
        let keeps = |place: Vec3| self.contains(place);
        let job = Job {
            initial,
            context: Some(&context),
            views,
            counts: &keeps,
            keeps: &keeps,
            free_space: None,
            budget,
            steps,
            antialiased,
            seed: random::bits(options.seed, u64::from(views[0].mip)),
            size_bounds_metres: bounds,
            exposures: None,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: None,
            recipe: &recipe,
            source: self.reader,
            picture_loss: None,
            backend: options.backend,
        };
        let mut trained = train::train(job, &mut |now| {
            report(now.step);
            Flow::Continue
        })?;
        if !antialiased {
            low_pass::to_full_resolution(&mut trained, views);
        }
        Ok(trained.filter(|i| keeps(trained.mean(i))))
    }

    /// Puts the trained splats into the blocks of a level that own them, in place of what these owned in the area.
    fn replace(&self, tree: &Tree, cut: &Cut, inside: &Splats, blocks: &mut BTreeMap<BlockId, Splats>) {
        let ground = &tree.plan.ground;
        for block in cut.blocks() {
            let Some(splats) = tree.results.get(&block) else { continue };
            // A coarser level may have changed it.
            let splats = blocks.get(&block).unwrap_or(splats);
            let stays = |i: usize| {
                let place = splats.mean(i);
                !self.contains(place) || cut.owner_of(ground, place.as_dvec3()) != Some(block)
            };
            let rest = splats.filter(stays);
            let new = cut.keep(inside, ground, block);
            if rest.len() == splats.len() && new.is_empty() {
                continue;
            }
            let mut now = rest;
            now.append(&new.with_sh_degree(splats.sh_degree()));
            blocks.insert(block, now);
        }
    }
}

/// Photos of which only the pixels count that show a box.
struct BoxPixels<'a> {
    photos: &'a WindowReader,
    cameras: &'a Photos,
    of: WorldBox,
}

impl BoxPixels<'_> {
    /// The pixels of a window that show the box.
    fn mask(&self, camera: &Camera) -> Vec<u8> {
        let WorldBox { world_from_box, low, high } = self.of;
        let corners = corners(low, high).map(|corner| camera.camera_from_world.apply(world_from_box.apply(corner)));
        let k = &camera.pinhole;
        let mut mask = vec![0; k.width as usize * k.height as usize];
        for (row, columns) in covered(&corners, k) {
            let start = row as usize * k.width as usize;
            mask[start + columns.start as usize..start + columns.end as usize].fill(255);
        }
        mask
    }

    fn shows(&self, view: &TrainView) -> bool {
        let window = view.camera.mip(view.mip).window(view.rect);
        self.mask(&window).iter().filter(|mask| **mask > 0).count() >= 64
    }
}

impl WindowSource for BoxPixels<'_> {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let pixels = WindowSource::window(self.photos, view, mip, rect)?;
        let camera = self.cameras.capture.views[view as usize].camera.mip(mip).window(rect);
        let mut mask = self.mask(&camera);
        if let Some(own) = &pixels.mask {
            mask.iter_mut().zip(own).for_each(|(mask, own)| *mask = (*mask).min(*own));
        }
        Ok(Arc::new(Pixels { mask: Some(mask), weights: None, ..(*pixels).clone() }))
    }
}
