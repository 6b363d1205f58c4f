//! Assembles the splats that a block's training starts from, and the frozen context around them.
//!
//! A block with a parent starts from the parent's splats, and from a donor neighbour's along the faces that it shares with one. A block
//! without one starts from the sparse points and a backdrop.

use std::collections::BTreeMap;

use blocks::Mode;
use glam::Vec3;
use scene::{BlockId, SparsePoints, Splats};
use train::{Recipe, TrainView};

use crate::block::Block;
use crate::task::ExecuteError;

/// Margin around a window, as a share of its size, within which frozen splats are kept in memory.
const CONTEXT_MARGIN: f32 = 0.2;

/// The splats to train, and those that are rendered with them but frozen.
pub(crate) struct InitialSplats {
    pub(crate) trained: Splats,
    /// `None` if there are none.
    pub(crate) context: Option<Splats>,
}

impl Block<'_> {
    /// The initial splats, filtered for the pixels of `views`. `results` are those of the parent and the context blocks.
    pub(crate) fn initial_splats(
        &self,
        results: BTreeMap<BlockId, Splats>,
        views: &[TrainView],
        recipe: &Recipe,
    ) -> Result<InitialSplats, ExecuteError> {
        if results.is_empty() {
            return Ok(InitialSplats { trained: self.splats_from_points(views, recipe)?, context: None });
        }
        let (plan, task) = (self.plan, self.task);
        let sh_degree = plan.settings.sh_degree;
        let cut = task.context_cut();
        let mut trained = Splats::new(sh_degree);
        let mut context = Splats::new(sh_degree);
        let donor = |place: Vec3| task.donor(&plan.ground, place.as_dvec3());
        let filtered = |mut splats: Splats| {
            if !plan.settings.antialiased {
                train::low_pass::from_full_resolution(&mut splats, views);
            }
            splats
        };
        for (block, splats) in results {
            trained.append(&filtered(splats.filter(|i| donor(splats.mean(i)) == Some(block))));
            let splats = cut.keep(&splats, &plan.ground, block);
            let inside = |i: usize| self.trains(&cut, splats.mean(i).as_dvec3());
            trained.append(&filtered(splats.filter(|i| inside(i) && donor(splats.mean(i)).is_none())));
            let frozen = splats.filter(|i| !inside(i));
            let visible = train::visibility::finest_pixels(&frozen, views, CONTEXT_MARGIN);
            context.append(&filtered(frozen.filter(|i| visible[i].is_visible())));
        }
        let context = (!context.is_empty()).then_some(context);
        Ok(InitialSplats { trained, context })
    }

    /// Splats at the capture's points, and a backdrop around them if the plan has one.
    fn splats_from_points(&self, views: &[TrainView], recipe: &Recipe) -> Result<Splats, ExecuteError> {
        let (plan, task) = (self.plan, self.task);
        let sh_degree = plan.settings.sh_degree;
        let all = plan.settings.mode != Mode::Flat;
        let keep = |p: glam::DVec3| all || views.iter().any(|view| projects_into(view, p));
        let (centre, radius) = self.backdrop_sphere(views);
        let backdrop = if plan.settings.backdrop {
            let made = train::init::backdrop(views, self.reader, sh_degree, centre, radius);
            made.map_err(ExecuteError::work)?
        } else {
            Splats::new(sh_degree)
        };
        let points = &self.capture.points;
        let rows: Vec<usize> = (0..points.len()).filter(|&i| keep(points.positions[i])).collect();
        // A capture may have more points than the budget has splats.
        let budget = blocks::initial_splats(plan, task) as usize;
        let max = budget.saturating_sub(backdrop.len()).max(budget / 2).max(1);
        let chosen = chosen(points, &rows, max);
        let points = SparsePoints {
            positions: chosen.iter().map(|&i| points.positions[i]).collect(),
            colours: chosen.iter().map(|&i| points.colours[i]).collect(),
            ..SparsePoints::default()
        };
        let sizes = self.size_bounds_metres(views);
        let mut splats = train::init::from_points(&points, sh_degree, recipe.initial_opacity, sizes);
        splats.append(&backdrop);
        Ok(splats)
    }
}

/// At most `max` of the points `rows`. Triangulated ones lie where photos have detail, so those of lidar get the splats that they leave.
fn chosen(points: &SparsePoints, rows: &[usize], max: usize) -> Vec<usize> {
    let (triangulated, measured) = rows.split_at(rows.partition_point(|&i| i < points.triangulated()));
    let thinned = |rows: &[usize], max: usize| -> Vec<usize> {
        let places: Vec<glam::DVec3> = rows.iter().map(|&i| points.positions[i]).collect();
        train::init::subsample(&places, max).into_iter().map(|k| rows[k]).collect()
    };
    let mut chosen = thinned(triangulated, max);
    chosen.extend(thinned(measured, max - chosen.len()));
    chosen
}

/// Whether a point projects into the window.
fn projects_into(view: &TrainView, point: glam::DVec3) -> bool {
    let camera = view.camera.mip(view.mip).window(view.rect);
    let (pixel, depth) = camera.project(point);
    let (width, height) = (f64::from(view.rect.width), f64::from(view.rect.height));
    let inside = |v: f64, size: f64| v >= 0.0 && v < size;
    depth > 0.0 && inside(pixel.x, width) && inside(pixel.y, height)
}
