//! What a block's training starts from: its parent's splats and, along the faces, its neighbours'; or points and a backdrop.

use std::collections::BTreeMap;

use blocks::Mode;
use glam::Vec3;
use scene::{BlockId, SparsePoints, Splats};
use train::{Recipe, TrainView};

use crate::ExecuteError;
use crate::block::Block;
use crate::execute::failed;
use crate::refine::Start;

impl Block<'_> {
    /// The splats to train, and those to draw around them: from the parent and its neighbours, or from the points.
    pub(crate) fn start(
        &self,
        results: BTreeMap<BlockId, Splats>,
        views: &[TrainView],
        recipe: &Recipe,
    ) -> Result<Start, ExecuteError> {
        let Self { plan, task, capture, .. } = self;
        let sh_degree = plan.settings.sh_degree;
        if results.is_empty() {
            let all = plan.settings.mode != Mode::Flat;
            let keep = |p: glam::DVec3| all || views.iter().any(|view| sees(view, p, 0.0));
            let (centre, radius) = self.surroundings(views);
            let backdrop = train::init::backdrop(views, self.reader, sh_degree, centre, radius).map_err(failed)?;
            let points = &capture.points;
            let rows: Vec<usize> = (0..points.len()).filter(|&i| keep(points.positions[i])).collect();
            let places: Vec<glam::DVec3> = rows.iter().map(|&i| points.positions[i]).collect();
            // There may be more points than splats are wanted.
            let budget = blocks::initial_splats(plan, task) as usize;
            let most = budget.saturating_sub(backdrop.len()).max(budget / 2).max(1);
            let chosen = train::init::subsample(&places, most);
            let points = SparsePoints {
                positions: chosen.iter().map(|&i| places[i]).collect(),
                colours: chosen.iter().map(|&i| points.colours[rows[i]]).collect(),
                ..SparsePoints::default()
            };
            let sizes = self.size_bounds_metres(views);
            let mut initial = train::init::from_points(&points, sh_degree, recipe.initial_opacity, sizes);
            initial.append(&backdrop);
            return Ok((initial, None));
        }
        let cut = task.context_cut();
        let mut initial = Splats::new(sh_degree);
        let mut context = Splats::new(sh_degree);
        let lender = |place: Vec3| task.donor(&plan.ground, place.as_dvec3());
        let for_mips = |mut splats: Splats| {
            if !plan.settings.antialiased {
                train::low_pass::from_full_resolution(&mut splats, views);
            }
            splats
        };
        for (block, splats) in results {
            initial.append(&for_mips(splats.filter(|i| lender(splats.mean(i)) == Some(block))));
            let splats = cut.keep(&splats, &plan.ground, block);
            let inside = |i: usize| self.trains(&cut, splats.mean(i).as_dvec3());
            initial.append(&for_mips(splats.filter(|i| inside(i) && lender(splats.mean(i)).is_none())));
            // Only what a window can show is worth keeping in memory.
            let frozen = splats.filter(|i| !inside(i));
            let seen = train::visibility::finest_pixels(&frozen, views, 0.2);
            context.append(&for_mips(frozen.filter(|i| seen[i].is_visible())));
        }
        let context = (!context.is_empty()).then_some(context);
        Ok((initial, context))
    }

    /// Where the backdrop stands: around the cameras, five times as far as all but the farthest points.
    pub(crate) fn surroundings(&self, views: &[TrainView]) -> (glam::DVec3, f64) {
        let cameras = views.iter().map(|view| view.camera.centre());
        let centre = cameras.clone().sum::<glam::DVec3>() / views.len().max(1) as f64;
        let points = self.capture.points.positions.iter().copied();
        let mut distances: Vec<f64> =
            points.chain(cameras).map(|p| p.distance(centre)).filter(|d| d.is_finite()).collect();
        distances.sort_by(f64::total_cmp);
        let far = distances.get(distances.len() * 98 / 100).copied().unwrap_or(1.0);
        (centre, 5.0 * far.max(self.plan.ground.edge_metres * 0.5))
    }
}

/// Does a point project into the window, grown by `margin` of its size on every side?
fn sees(view: &TrainView, point: glam::DVec3, margin: f64) -> bool {
    let camera = view.camera.mip(view.mip).window(view.rect);
    let (pixel, depth) = camera.project(point);
    let (width, height) = (f64::from(view.rect.width), f64::from(view.rect.height));
    let inside = |v: f64, size: f64| v >= -margin * size && v < size * (1.0 + margin);
    depth > 0.0 && inside(pixel.x, width) && inside(pixel.y, height)
}
