//! Makes the plan: how deep, which blocks, on which views and against which context.

use std::collections::{BTreeMap, BTreeSet};

use scene::{ArtefactId, BlockId, Capture};

use crate::allot::{BLOCK_SPLATS, Needs, set_means};
use crate::ground::{Ground, quantile};
use crate::lod::{context_of, finished_neighbours, training_order};
use crate::plan::{MAX_LEVELS, MOST_VIEWS_PER_STEP, Mode, Plan, PlanError, PlanSettings, Task, VERSION};
use crate::select::{Selection, Sightings, full_views, select_level, usable};
use crate::shown::Shown;

/// The finest resolution: this quantile of depth / focal over all sightings. The median would send half of the views
/// of a street to their second mip.
const FINE_QUANTILE: f64 = 0.25;
/// Leaves chosen by `levels: None` have a core of at least this many finest pixels a side.
const LEAF_EDGE_PIXELS: f64 = 768.0;
/// They are trained on this many views, on average ...
const MEAN_VIEWS: usize = 24;
/// ... hold this many sparse points, on average ...
const MEAN_POINTS: usize = 500;
/// ... and together this share of all of them.
const MIN_COVERED: f64 = 0.9;
/// Leaves that could do with fewer levels are not for less than this share of pixels that nobody saw before: where every view
/// looks at all of them, as along a road, they cost several times what they are worth ...
const MIN_FIRST_SEEN: f64 = 1.0 / 3.0;
/// ... unless there is too much for one block, of splats ([`BLOCK_SPLATS`]) or of pixels.
const BLOCK_PIXELS: u64 = 500_000_000;
/// A leaf is split once more where it holds this many times the points of the median leaf ...
const CROWDED: f64 = 4.0;
/// ... at most so often.
const MAX_SPLITS: u8 = 3;
/// A block that fewer views see finer than its parent could use has no task (unless it is the root) ...
pub const MIN_VIEWS: usize = 6;
/// ... nor has one with fewer sparse points in its core.
pub const MIN_POINTS: u32 = 10;

/// Plans the training of a capture on a backend. Test views ([`Capture::is_test`]) never train.
///
/// # Errors
/// Settings out of range, or a capture that has nothing to train on: see [`PlanError`].
pub fn plan(
    capture: &Capture,
    capture_id: ArtefactId,
    settings: &PlanSettings,
    backend: &str,
) -> Result<Plan, PlanError> {
    check(settings)?;
    let finite = capture.points.positions.iter().filter(|p| p.is_finite()).count();
    let test = |view: usize| Capture::is_test(view, settings.test_every);
    let (views, all_test) = (capture.views.len(), (0..capture.views.len()).filter(|&v| test(v)).count());
    let usable_views: Vec<usize> = (0..views).filter(|&v| usable(&capture.views[v].camera)).collect();
    if usable_views.iter().all(|&v| test(v)) {
        return Err(PlanError::NoTrainViews { views, usable: usable_views.len(), test: all_test });
    }
    if finite == 0 {
        return Err(PlanError::NoPoints);
    }
    let sightings = Sightings::of(capture);
    let mut footprints: Vec<f64> =
        (sightings.all.iter()).filter(|s| !test(s.view as usize)).map(|s| s.footprint_metres(capture)).collect();
    let finest_metres = quantile(&mut footprints, FINE_QUANTILE);
    if !(finest_metres.is_finite() && finest_metres > 0.0) {
        return Err(PlanError::NothingSeen { points: finite });
    }

    let ground = Ground::of(capture);
    let survey = Survey { capture, sightings: &sightings, ground: &ground, test_every: settings.test_every };
    let levels = match (settings.mode, settings.levels) {
        (Mode::Whole, _) => 0,
        (_, Some(levels)) => levels,
        (_, None) => survey.choose_levels(finest_metres, settings.budget),
    };
    let (base, mut tasks) = survey.lay_out(settings.mode, levels, finest_metres)?;
    if settings.mode == Mode::Tree && settings.levels.is_none() {
        survey.split_crowded(base, finest_metres, &mut tasks);
    }
    let levels = tasks.iter().map(|task| task.block.level).max().unwrap_or(base);

    let needs = Needs::of(capture, &sightings, &ground, levels, finest_metres);
    let whole = survey.lay_out(Mode::Whole, 0, finest_metres)?.1.remove(0);
    set_means(&mut tasks, whole, &needs, capture, &ground, settings);
    Ok(Plan {
        version: VERSION,
        capture: capture_id,
        settings: settings.clone(),
        backend: backend.to_owned(),
        ground,
        levels,
        rho_metres: (0..=levels).map(|level| rho_of(finest_metres, base, level)).collect(),
        tasks,
    })
}

/// Metres per pixel of a level: the finest at `base` and below, twice as much with every level up.
fn rho_of(finest_metres: f64, base: u8, level: u8) -> f64 {
    finest_metres * f64::from(1u32 << base.saturating_sub(level))
}

fn check(settings: &PlanSettings) -> Result<(), PlanError> {
    let bad = |setting, problem: String, advice| Err(PlanError::Setting { setting, problem, advice });
    if settings.steps == 0 {
        return bad("--steps", "no steps".into(), "give at least 1");
    }
    if settings.budget == 0 {
        return bad("--budget", "no splats".into(), "give at least 1");
    }
    if !(settings.tolerance_db >= 0.0 && settings.tolerance_db.is_finite()) {
        return bad("--tolerance-db", format!("{} is no loss", settings.tolerance_db), "give decibels from 0");
    }
    if !(0.0..1.0).contains(&settings.residual) {
        return bad("--residual", format!("{} is out of range", settings.residual), "give 0 to 1, such as 0.4");
    }
    if settings.exposure && settings.mode == Mode::Flat {
        let problem = "flat blocks have no root to share exposures from";
        return bad("--exposure", problem.into(), "leave it off, or use --blocks tree or whole");
    }
    if settings.sh_degree > 3 {
        return bad("sh_degree", format!("{} is not supported", settings.sh_degree), "give 0 to 3");
    }
    if !(1..=MOST_VIEWS_PER_STEP).contains(&settings.views_per_step) {
        let problem = format!("{} is out of range", settings.views_per_step);
        return bad("--views-per-step", problem, "give 1 to 16");
    }
    match settings.levels {
        Some(levels) if levels > MAX_LEVELS => {
            bad("--levels", format!("{levels} are too many"), "give 0 to 16, or auto")
        }
        _ => Ok(()),
    }
}

/// The capture, and what its views see.
struct Survey<'a> {
    capture: &'a Capture,
    sightings: &'a Sightings,
    ground: &'a Ground,
    test_every: u32,
}

impl Survey<'_> {
    /// The blocks of a level that can be trained.
    fn tasks_of(&self, level: u8, rho_metres: f64) -> BTreeMap<BlockId, Selection> {
        let mut selections =
            select_level(self.capture, self.sightings, self.ground, level, rho_metres, self.test_every);
        selections.retain(|_, s| level == 0 || s.finer_views >= MIN_VIEWS && s.core_points >= MIN_POINTS);
        selections
    }

    /// Gives the most crowded leaves children that share their work, at the same resolution: those with several times
    /// the points of the others, and views enough for all.
    fn split_crowded(&self, base: u8, finest_metres: f64, tasks: &mut Vec<Task>) {
        let of_base = tasks.iter().filter(|task| task.block.level == base);
        let mut points: Vec<f64> = of_base.map(|task| f64::from(task.points)).collect();
        let usual = quantile(&mut points, 0.5).max(MEAN_POINTS as f64);
        for level in base + 1..=(base + MAX_SPLITS).min(MAX_LEVELS) {
            let crowded: BTreeSet<BlockId> = (tasks.iter())
                .filter(|task| task.block.level == level - 1)
                .filter(|task| f64::from(task.points) > CROWDED * usual)
                .filter(|task| task.views.len() >= 2 * MEAN_VIEWS)
                .map(|task| task.block)
                .collect();
            let mut selections = self.tasks_of(level, finest_metres);
            selections.retain(|block, _| block.parent().is_some_and(|parent| crowded.contains(&parent)));
            if selections.is_empty() {
                return;
            }
            let existing: BTreeSet<BlockId> = tasks.iter().map(|task| task.block).collect();
            tasks.append(&mut self.tasks_from(Mode::Tree, selections, &existing, finest_metres));
        }
    }

    /// The deepest level that resolution allows, whose blocks have enough views and points, and that is worth its work.
    fn choose_levels(&self, finest_metres: f64, budget: u32) -> u8 {
        let points = self.capture.points.len();
        let by_resolution = (self.ground.edge_metres / (LEAF_EDGE_PIXELS * finest_metres)).log2().floor();
        let deepest = (by_resolution.max(0.0) as u8).min(MAX_LEVELS);
        (1..=deepest)
            .rev()
            .find(|&level| {
                let tasks = self.tasks_of(level, finest_metres);
                let views: usize = tasks.values().map(|s| s.views.len()).sum();
                let covered: usize = tasks.values().map(|s| s.core_points as usize).sum();
                covered as f64 >= MIN_COVERED * points as f64
                    && views >= MEAN_VIEWS * tasks.len()
                    && covered >= MEAN_POINTS * tasks.len()
                    && self.is_worth_it(level, &tasks, finest_metres, budget)
            })
            .unwrap_or(0)
    }

    /// Do these leaves see enough that their parents would not, or is it too much for the parents alone?
    fn is_worth_it(&self, level: u8, leaves: &BTreeMap<BlockId, Selection>, finest_metres: f64, budget: u32) -> bool {
        let parents = self.tasks_of(level - 1, 2.0 * finest_metres);
        let [shown, before] = [leaves, &parents].map(|selections| {
            let mut shown = Shown::default();
            selections.values().for_each(|s| shown.add(&s.views, self.capture));
            shown
        });
        let blocks = parents.len().max(1) as u64;
        let pixels: u64 = self.capture.views.iter().map(|view| view.camera.full().area()).sum();
        shown.first(&before, 0.0) >= MIN_FIRST_SEEN * shown.in_windows() as f64
            || u64::from(budget) > u64::from(BLOCK_SPLATS) * blocks
            || pixels > BLOCK_PIXELS * blocks
    }

    /// The tasks, without budgets and steps, and the depth they really reach: a tree that asks for more levels than
    /// views and points can fill is laid out anew with fewer.
    fn lay_out(&self, mode: Mode, levels: u8, finest_metres: f64) -> Result<(u8, Vec<Task>), PlanError> {
        let tree = mode == Mode::Tree;
        let first = if tree { 0 } else { levels };
        let mut tasks: Vec<Task> = Vec::new();
        let mut existing: BTreeSet<BlockId> = BTreeSet::new();
        for level in first..=levels {
            let rho_metres = rho_of(finest_metres, levels, level);
            let mut selections = self.tasks_of(level, rho_metres);
            selections.retain(|block, _| !tree || block.parent().is_none_or(|p| existing.contains(&p)));
            if let (Mode::Whole, Some(root)) = (mode, selections.get_mut(&BlockId::ROOT)) {
                // Mip 0 for all: no pixel is finer than this.
                (root.test_views, root.views) = full_views(self.capture, self.sightings, 0.0)
                    .into_iter()
                    .partition(|u| Capture::is_test(u.view as usize, self.test_every));
            }
            let mut of_level = self.tasks_from(mode, selections, &existing, rho_metres);
            existing.extend(of_level.iter().map(|task| task.block));
            tasks.append(&mut of_level);
        }
        match tasks.last().map(|t| t.block.level) {
            None => Err(PlanError::NoBlocks { levels, needed: MIN_VIEWS }),
            Some(reached) if reached < levels => self.lay_out(mode, reached, finest_metres),
            Some(_) => Ok((levels, tasks)),
        }
    }

    /// The tasks of one level, in training order.
    fn tasks_from(
        &self,
        mode: Mode,
        selections: BTreeMap<BlockId, Selection>,
        existing: &BTreeSet<BlockId>,
        rho_metres: f64,
    ) -> Vec<Task> {
        let tree = mode == Mode::Tree;
        let of_level: BTreeSet<BlockId> = selections.keys().copied().collect();
        let context = |block| -> Vec<BlockId> {
            if !tree {
                return Vec::new();
            }
            let coarser = context_of(self.ground, block, existing);
            coarser.into_iter().chain(finished_neighbours(block, &of_level)).collect()
        };
        let mut tasks: Vec<Task> = (selections.into_iter())
            .map(|(block, selection)| Task {
                block,
                parent: block.parent().filter(|_| tree),
                context: context(block),
                views: selection.views,
                test_views: selection.test_views,
                points: selection.halo_points,
                budget: 0,
                steps: 0,
                rho_metres,
                drawn: 0,
                context_drawn: 0,
                memory_bytes: 0,
            })
            .collect();
        tasks.sort_by_key(|t| training_order(t.block));
        tasks
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use scene::Camera;

    use super::*;
    use crate::allot::cost_of_visits;
    use crate::lint::{Severity, lint};
    use crate::testing::{aerial, capture, look, noise, street};

    fn settings(mode: Mode, levels: Option<u8>) -> PlanSettings {
        PlanSettings { mode, levels, steps: 4000, budget: 50_000, ..PlanSettings::default() }
    }

    fn plan_of(capture: &Capture, mode: Mode, levels: Option<u8>) -> Plan {
        let plan = plan(capture, ArtefactId::of(b"capture"), &settings(mode, levels), "cpu").unwrap();
        let errors: Vec<String> =
            (lint(&plan, capture).iter()).filter(|f| f.severity == Severity::Error).map(ToString::to_string).collect();
        assert!(errors.is_empty(), "{errors:?}");
        plan
    }

    #[test]
    fn a_tree_is_complete_and_ordered() {
        let capture = aerial(8, 300.0, 8000);
        let plan = plan_of(&capture, Mode::Tree, Some(2));
        assert_eq!((plan.levels, plan.tasks.len()), (2, 1 + 4 + 16));
        assert_eq!(plan.tasks[0].block, BlockId::ROOT);
        assert!(plan.tasks[0].parent.is_none() && plan.tasks[0].context.is_empty());
        for (coarse, fine) in plan.rho_metres.iter().zip(&plan.rho_metres[1..]) {
            assert!((coarse / fine - 2.0).abs() < 1e-12);
        }
        for task in &plan.tasks[1..] {
            assert_eq!(task.parent, task.block.parent());
            assert!(task.views.iter().all(|v| !Capture::is_test(v.view as usize, 8)));
            assert_eq!(plan.task(task.block), Some(task));
        }
        let mips: Vec<u8> = [0, 1, 5].map(|i: usize| plan.tasks[i].views[0].mip).to_vec();
        assert_eq!(mips, [2, 1, 0]);
        assert!(lint(&plan, &capture).is_empty(), "{:?}", lint(&plan, &capture));
    }

    #[test]
    fn levels_fit_resolution_views_and_points() {
        // 300 m at 0.12 m a pixel are 2,500 pixels: room for 768 a leaf once halved.
        assert_eq!(plan_of(&aerial(12, 300.0, 20_000), Mode::Tree, None).levels, 1);
        assert_eq!(plan_of(&aerial(12, 300.0, 1000), Mode::Tree, None).levels, 0, "too few points");
        assert_eq!(plan_of(&aerial(4, 300.0, 20_000), Mode::Tree, None).levels, 0, "too few views");
        assert_eq!(plan_of(&aerial(8, 60.0, 20_000), Mode::Tree, None).levels, 0, "too small");
    }

    #[test]
    fn levels_are_worth_their_work_or_needed() {
        // Views along a street look at all of what lies ahead.
        let capture = street(120, 20_000);
        let levels = |budget: u32| {
            let settings = PlanSettings { budget, ..settings(Mode::Tree, None) };
            plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap().levels
        };
        assert_eq!([50_000, 2_000_000].map(levels), [0, 1]);
    }

    /// From the air, photos are looked at about as often at every height as one block would look at them.
    #[test]
    fn heights_get_work_for_what_they_are_the_first_to_see() {
        let capture = aerial(12, 300.0, 20_000);
        let plan = plan_of(&capture, Mode::Tree, Some(2));
        let visits = |level: u8| {
            let of_level = plan.tasks.iter().filter(|t| t.block.level == level);
            let (steps, views) = of_level.fold((0, 0), |(s, v), t| (s + t.steps, v + t.views.len()));
            f64::from(steps) / views as f64
        };
        let whole = 4000.0 / plan.tasks[0].views.len() as f64;
        let ratios = [0, 1, 2].map(|level| visits(level) / whole);
        assert!(ratios[0] > 0.5 && ratios[1] > ratios[2] && ratios[2] > 0.2, "{ratios:?}");
    }

    #[test]
    fn budgets_add_up_to_the_merged_model() {
        for (levels, mode) in [(0, Mode::Whole), (0, Mode::Tree), (1, Mode::Tree), (2, Mode::Tree), (2, Mode::Flat)] {
            let plan = plan_of(&aerial(8, 300.0, 8000), mode, Some(levels));
            let finest: u64 =
                plan.tasks.iter().filter(|t| t.block.level == plan.levels).map(|t| u64::from(t.budget)).sum();
            assert_eq!(plan.tasks.iter().filter(|t| t.block.level == levels).count(), 1 << (2 * levels));
            assert_eq!(finest, 50_000, "{mode:?} {levels}");
            assert!(plan.tasks.iter().all(|t| t.budget > 0 && t.steps > 0 && t.memory_bytes > 0));
        }
    }

    #[test]
    fn all_modes_cost_about_the_same() {
        let capture = aerial(8, 300.0, 8000);
        let work = |plan: &Plan| -> f64 {
            let visits = |t: &Task| f64::from(t.steps) / t.views.len() as f64;
            plan.tasks.iter().map(|t| visits(t) * cost_of_visits(t)).sum()
        };
        let whole = plan_of(&capture, Mode::Whole, None);
        assert_eq!(whole.tasks[0].steps, 4000);
        for (mode, levels) in [(Mode::Tree, 0), (Mode::Tree, 1), (Mode::Tree, 2), (Mode::Flat, 1), (Mode::Flat, 2)] {
            let plan = plan_of(&capture, mode, Some(levels));
            let ratio = work(&plan) / work(&whole);
            assert!((0.95..1.10).contains(&ratio), "{mode:?} {levels}: {ratio}");
        }
    }

    #[test]
    fn finished_neighbours_lend_what_lies_along_their_faces() {
        let plan = plan_of(&aerial(8, 300.0, 8000), Mode::Tree, Some(1));
        let ground = &plan.ground;
        let block = |x, y| BlockId { level: 1, x, y };
        let lender = |of: BlockId, x: f64, y: f64| {
            // From the middle of the root, in edges of its children.
            let at = ground.core(BlockId::ROOT).centre() + glam::DVec2::new(x, y) * ground.core_edge_metres(1);
            plan.task(of).unwrap().lender(ground, ground.to_world(at.extend(0.0)))
        };
        // The second sweep stands on two finished neighbours here, the first on none.
        let last = block(1, 0);
        assert_eq!(lender(last, 0.05, -0.5), Some(block(0, 0)));
        assert_eq!(lender(last, 0.5, -0.05), Some(block(1, 1)));
        assert_eq!(lender(last, 0.05, -0.08), Some(block(0, 0)), "the nearer one");
        for (x, y) in [(0.11, -0.5), (0.5, -0.11), (0.9, -0.9), (-0.05, -0.5), (0.5, 0.05), (f64::NAN, -0.5)] {
            assert_eq!(lender(last, x, y), None, "{x} {y}");
        }
        assert_eq!(lender(block(1, 1), 0.05, 0.5), None);
        assert_eq!(lender(block(0, 0), -0.05, -0.5), None);
        assert_eq!(lender(BlockId::ROOT, 0.05, 0.5), None);
    }

    #[test]
    fn splats_beyond_a_blocks_worth_do_not_raise_the_work() {
        // Small photos, as splats are to be most of the price.
        let mut capture = aerial(8, 300.0, 8000);
        capture.views.iter_mut().for_each(|view| view.camera = view.camera.mip(2));
        let visits = |budget: u32| -> f64 {
            let settings = PlanSettings { budget, ..settings(Mode::Tree, Some(2)) };
            let plan = plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
            plan.tasks.iter().map(|t| f64::from(t.steps) / t.views.len() as f64 * cost_of_visits(t)).sum()
        };
        let [few, many, more] = [BLOCK_SPLATS / 16, BLOCK_SPLATS, 4 * BLOCK_SPLATS].map(visits);
        assert!(many > 1.5 * few && (0.95..1.05).contains(&(more / many)), "{few} {many} {more}");
    }

    #[test]
    fn whole_and_flat_are_what_they_say() {
        let capture = street(40, 4000);
        let whole = plan_of(&capture, Mode::Whole, Some(3));
        assert_eq!((whole.levels, whole.tasks.len()), (0, 1));
        let root = &whole.tasks[0];
        assert_eq!((root.views.len(), root.test_views.len()), (35, 5));
        assert!(root.views.iter().all(|v| v.mip == 0 && (v.window.width, v.window.height) == (640, 480)));
        let flat = plan_of(&capture, Mode::Flat, Some(2));
        assert!(flat.tasks.iter().all(|t| t.block.level == 2 && t.parent.is_none() && t.context.is_empty()));
        // A street crosses only some of the leaves; the others' ground still has an owner.
        assert!(flat.tasks.len() < 16);
        assert!(flat.leaves().owner_of(&flat.ground, DVec3::new(-1e6, 1e6, 0.0)).is_some());
    }

    #[test]
    fn areas_without_a_task_stay_with_their_ancestor() {
        let capture = street(40, 4000);
        let plan = plan_of(&capture, Mode::Tree, Some(3));
        let (leaves, tasks) = (plan.leaves(), plan.tasks.iter().map(|t| t.block).collect::<BTreeSet<_>>());
        for i in 0..2000 {
            let at = DVec3::new(noise(2 * i) * 300.0 - 100.0, noise(2 * i + 1) * 300.0 - 150.0, 0.0);
            let cell = plan.ground.block_at(plan.levels, at);
            let deepest = (0..=plan.levels).rev().map(|l| cell.ancestor(l)).find(|b| tasks.contains(b));
            let deepest = if plan.ground.is_far(at) { Some(BlockId::ROOT) } else { deepest };
            assert_eq!(leaves.owner_of(&plan.ground, at), deepest);
        }
        let owned: u64 = leaves.blocks().iter().filter_map(|&b| plan.task(b)).map(|t| u64::from(t.budget)).sum();
        assert!(owned >= 50_000);
    }

    #[test]
    fn a_tree_too_deep_for_its_capture_is_cut_short() {
        let capture = aerial(4, 100.0, 600);
        let plan = plan_of(&capture, Mode::Tree, Some(9));
        assert!(plan.levels < 5);
        assert!(
            lint(&plan, &capture).iter().any(|f| f.severity == Severity::Warning && f.what.contains("of 9 levels"))
        );
    }

    #[test]
    fn plans_are_pure_and_round_trip() {
        let capture = aerial(5, 150.0, 3000);
        let plan = plan_of(&capture, Mode::Tree, Some(1));
        assert_eq!(plan, plan_of(&capture, Mode::Tree, Some(1)));
        assert_eq!(Plan::from_frame(&plan.to_frame()).unwrap(), plan);
        let json = serde_json::to_string(&plan).unwrap();
        let back: Plan = serde_json::from_str(&json).unwrap();
        assert_eq!(back.id(), plan.id());
        assert!(Plan::from_frame(&plan.to_frame()[..99]).is_err());
        let mut other = plan.clone();
        other.settings.seed = 1;
        assert_ne!(other.id(), plan.id());
        let mut broken = plan.clone();
        broken.tasks.swap(0, 1);
        assert!(Plan::from_frame(&broken.to_frame()).is_err());
        for side in [0, u32::MAX] {
            broken = plan.clone();
            broken.tasks[0].views[0].window.width = side;
            assert!(Plan::from_frame(&broken.to_frame()).is_err());
        }
        broken = plan;
        broken.ground.edge_metres = f64::NAN;
        assert!(Plan::from_frame(&broken.to_frame()).is_err());
    }

    /// Every capture gives a plan without errors or a reason, for every mode and depth.
    #[test]
    fn strange_captures_give_a_plan_or_a_reason() {
        let grid = |n: usize| (0..n).map(move |i| DVec3::new((i % 30) as f64, (i / 30) as f64, noise(i as u64)));
        let above = |x: f64, y: f64| {
            let eye = DVec3::new(x, y, 20.0);
            look(eye, eye - DVec3::Z, DVec3::Y)
        };
        let line: Vec<Camera> = (0..30).map(|i| above(f64::from(i), 15.0)).collect();
        let corner: Vec<Camera> = (0..30).map(|_| above(0.0, 0.0)).collect();
        let islands: Vec<Camera> = (0..40).map(|i| above(f64::from(i % 2) * 5e4 + f64::from(i), 0.0)).collect();
        let island_points = (0..2000)
            .map(|i| DVec3::new(f64::from(i % 2) * 5e4 + noise(i as u64) * 40.0, noise(i as u64 + 9) * 20.0, 0.0));
        // Nothing in the middle: a ring of cameras, and of points.
        let ring = |radius: f64, i: usize| {
            let (sin, cos) = (f64::from(i as u32) * 0.618).sin_cos();
            DVec3::new(radius * cos, radius * sin, noise(i as u64))
        };
        let around: Vec<Camera> = (0..60).map(|i| above(ring(200.0, i).x, ring(200.0, i).y)).collect();
        let rim = |n: usize| (0..n).map(move |i| ring(190.0 + 20.0 * noise(3 * i as u64), i));
        let strange = [
            ("line", capture(&line, grid(900).collect(), true)),
            ("corner", capture(&corner, grid(900).collect(), true)),
            ("islands", capture(&islands, island_points.collect(), true)),
            ("hole", capture(&around, rim(900).collect(), true)),
            ("one view", capture(&line[..1], grid(900).collect(), true)),
            ("two views", capture(&line[..2], grid(900).collect(), true)),
            ("one spot", capture(&line, vec![DVec3::new(3.0, 15.0, 1.0); 500], true)),
            ("one point", capture(&line, vec![DVec3::new(3.0, 15.0, 1.0)], true)),
            ("no tracks", capture(&line, grid(900).collect(), false)),
            ("no points", capture(&line, Vec::new(), false)),
            ("nothing finite", capture(&line, vec![DVec3::NAN; 9], false)),
            ("nothing seen", capture(&line, vec![DVec3::Z * 500.0; 9], false)),
            ("huge", capture(&line, grid(900).map(|p| p * 1e300).collect(), false)),
            ("nothing", Capture::default()),
        ];
        for (name, capture) in &strange {
            for mode in [Mode::Tree, Mode::Flat, Mode::Whole] {
                for levels in [None, Some(0), Some(1), Some(3), Some(MAX_LEVELS)] {
                    let id = ArtefactId::of(b"capture");
                    match plan(capture, id, &settings(mode, levels), "cpu") {
                        Ok(plan) => {
                            let findings = lint(&plan, capture);
                            let error = findings.iter().find(|f| f.severity == Severity::Error);
                            assert!(error.is_none(), "{name} {mode:?} {levels:?}: {}", findings[0]);
                            let sane = |t: &Task| !t.views.is_empty() && t.steps < 1_000_000;
                            let strange = plan.tasks.iter().find(|t| !sane(t));
                            assert!(strange.is_none(), "{name} {mode:?} {levels:?}: {strange:?}");
                            let svg = crate::draw(&plan, capture);
                            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}: {svg}");
                        }
                        Err(error) => assert!(
                            ["one view", "no points", "nothing finite", "nothing seen", "huge", "nothing"]
                                .contains(name)
                                || mode == Mode::Flat,
                            "{name} {mode:?} {levels:?}: {error}"
                        ),
                    }
                }
            }
        }
    }

    #[test]
    fn crowded_leaves_are_split() {
        let even = aerial(14, 300.0, 8000);
        // A quarter of a quarter holds as much again as the other leaves together, and more.
        let mut crowd = even.points.positions.clone();
        let at = |i: u64, k: u64| noise(1_000_000 + 3 * i + k);
        crowd.extend(
            (0..24_000).map(|i| DVec3::new(-140.0 + 60.0 * at(i, 0), -140.0 + 60.0 * at(i, 1), 4.0 * at(i, 2))),
        );
        let cameras: Vec<Camera> = even.views.iter().map(|view| view.camera).collect();
        let [even, crowded] = [even.points.positions, crowd].map(|points| {
            let capture = capture(&cameras, points, true);
            (plan_of(&capture, Mode::Tree, None), capture)
        });
        assert_eq!(even.0.levels, 1);
        let (plan, capture) = crowded;
        assert!(plan.levels > 1, "{}", plan.levels);
        let split: BTreeSet<BlockId> =
            plan.tasks.iter().filter(|t| t.block.level == 2).filter_map(|t| t.parent).collect();
        assert_eq!(split, BTreeSet::from([plan.ground.block_at(1, DVec3::new(-110.0, -110.0, 0.0))]));
        // At the same resolution: only the work is divided.
        assert_eq!(plan.rho_metres[1], plan.rho_metres[2]);
        assert!(!lint(&plan, &capture).iter().any(|f| f.what.contains("coarser")), "{:?}", lint(&plan, &capture));
        let [low, high] = visits_of_leaves(&plan);
        assert!(high < 1.1 * low, "{low} {high}");
    }

    #[test]
    fn what_no_view_sees_finer_stays_with_its_parent() {
        // Near the path pixels are small; the far side is seen by as many views, from eight times as far.
        let cameras: Vec<Camera> = (0..60)
            .map(|i| {
                let eye = DVec3::new(f64::from(i) * 5.0 - 150.0, -150.0, 30.0);
                look(eye, eye + DVec3::new(0.0, 100.0, -20.0), DVec3::Z)
            })
            .collect();
        let at = |i: u64, k: u64| noise(3 * i + k) - 0.5;
        let points: Vec<DVec3> =
            (0..20_000).map(|i| DVec3::new(300.0 * at(i, 0), 300.0 * at(i, 1), 4.0 * at(i, 2))).collect();
        let plan = plan_of(&capture(&cameras, points, true), Mode::Tree, Some(3));
        let rows = |level: u8| -> BTreeSet<u32> {
            plan.tasks.iter().filter(|t| t.block.level == level).map(|t| t.block.y).collect()
        };
        assert!(rows(1).len() == 2 && rows(3).contains(&1), "{:?} {:?}", rows(1), rows(3));
        assert!(!rows(3).contains(&7), "{:?}", rows(3));
        // They were not starved of views or points: of level 2, twice as coarse, there are blocks farther out.
        assert!(rows(2).last() > rows(3).last().map(|row| row / 2).as_ref(), "{:?} {:?}", rows(2), rows(3));
        // Leaves of any level are worked on alike.
        let [low, high] = visits_of_leaves(&plan);
        assert!(high < 1.1 * low, "{low} {high}");
    }

    /// Fewest and most steps for each view, of tasks without children.
    fn visits_of_leaves(plan: &Plan) -> [f64; 2] {
        let parents: BTreeSet<_> = plan.tasks.iter().filter_map(|t| t.parent).collect();
        let leaves = plan.tasks.iter().filter(|t| !parents.contains(&t.block));
        leaves
            .map(|t| f64::from(t.steps) / t.views.len() as f64)
            .fold([f64::MAX, 0.0], |[low, high], v| [low.min(v), high.max(v)])
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let capture = aerial(3, 60.0, 300);
        for bad in [
            PlanSettings { steps: 0, ..PlanSettings::default() },
            PlanSettings { budget: 0, ..PlanSettings::default() },
            PlanSettings { sh_degree: 4, ..PlanSettings::default() },
            PlanSettings { levels: Some(17), ..PlanSettings::default() },
        ] {
            let error = plan(&capture, ArtefactId::of(b""), &bad, "cpu").unwrap_err();
            assert!(matches!(error, PlanError::Setting { .. }), "{error}");
        }
        let all_test = PlanSettings { test_every: 1, ..PlanSettings::default() };
        let error = plan(&capture, ArtefactId::of(b""), &all_test, "cpu").unwrap_err();
        assert_eq!(error, PlanError::NoTrainViews { views: 9, usable: 9, test: 9 });
    }
}
