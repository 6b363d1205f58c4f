//! The planner: turns a capture and settings into a plan.

use scene::{ArtefactId, Capture};

use crate::budgets::{self, BLOCK_SPLATS, DetailShares};
use crate::evaluation::eval_tasks;
use crate::ground::{Ground, quantile};
use crate::layout::{Layout, level_rho_metres};
use crate::moving::object_tasks;
use crate::plan::{MAX_EVALUATED_BLOCKS, MAX_LEVELS, MAX_VIEWS_PER_STEP, Mode, Plan, PlanSettings, VERSION};
use crate::plan_error::PlanError;
use crate::split::{Part, Split};
use crate::visibility::{Observations, is_usable};

/// The finest resolution is this quantile of depth / focal length over all observations. With the median, half of the
/// views of a street would use mip 1.
const FINE_QUANTILE: f64 = 0.25;

/// Plans as [`plan`] does, with `settings.budget` as the most splats that the model may have. Where levels are automatic and
/// the steps are too few to draw each window of the finest blocks once, the plan has a level less and the splats that its blocks
/// hold: more would cost time and memory, and hardly be trained (docs/decisions/0065).
///
/// # Errors
/// As [`plan`].
pub fn plan_at_most(
    capture: &Capture,
    capture_id: ArtefactId,
    settings: &PlanSettings,
    backend: &str,
) -> Result<Plan, PlanError> {
    let mut best = plan(capture, capture_id, settings, backend)?;
    while settings.levels.is_none() && best.leaf_visits() < 1.0 && best.levels > 0 {
        let above = best.tasks.iter().filter(|task| task.block.level + 1 == best.levels).count();
        let held = BLOCK_SPLATS.saturating_mul(u32::try_from(above).unwrap_or(u32::MAX));
        let fewer = PlanSettings { budget: best.settings.budget.min(held), ..settings.clone() };
        let coarser = plan(capture, capture_id, &fewer, backend)?;
        if coarser.levels >= best.levels {
            break;
        }
        best = coarser;
    }
    Ok(best)
}

/// Plans the training of a capture on a backend. Held-out views ([`Split`]) are never trained on. Zones, detector and
/// detection tasks are for the caller to add. Equal inputs give equal plans. Where levels are automatic, there are as many as it takes
/// for each block to keep to the memory limit, if the capture supports them.
///
/// # Errors
/// [`PlanError`]: a setting out of range, or a capture that cannot be trained on.
pub fn plan(
    capture: &Capture,
    capture_id: ArtefactId,
    settings: &PlanSettings,
    backend: &str,
) -> Result<Plan, PlanError> {
    let mut best = divided(capture, capture_id, settings, backend, settings.levels)?;
    let is_too_large = |plan: &Plan| plan.tasks.iter().any(|task| task.memory_bytes > settings.memory_limit_bytes);
    while (settings.mode, settings.levels) == (Mode::Tree, None) && is_too_large(&best) && best.levels < MAX_LEVELS {
        let deeper = divided(capture, capture_id, settings, backend, Some(best.levels + 1))?;
        if deeper.levels <= best.levels {
            break;
        }
        best = deeper;
    }
    Ok(best)
}

/// The plan with these levels.
fn divided(
    capture: &Capture,
    capture_id: ArtefactId,
    settings: &PlanSettings,
    backend: &str,
    levels: Option<u8>,
) -> Result<Plan, PlanError> {
    check(settings)?;
    if settings.objects {
        check_objects(capture)?;
    }
    let finite = capture.points.positions.iter().filter(|p| p.is_finite()).count();
    let ground = Ground::of(capture);
    let split = Split::new(capture, &ground, settings.test_every, settings.test_stretches);
    let test = |view: usize| split.is_held_out(view as u32);
    if settings.test_stretches > 0.0 && split.views(Part::Stretch).is_empty() {
        let problem = format!("there are not two stretches of {} m with street views", settings.test_stretches);
        return Err(PlanError::Setting {
            setting: "--test-stretches",
            problem,
            advice: "give fewer metres, or leave it",
        });
    }
    let (views, all_test) = (capture.views.len(), (0..capture.views.len()).filter(|&v| test(v)).count());
    let usable_views: Vec<usize> = (0..views).filter(|&v| is_usable(&capture.views[v].camera)).collect();
    if usable_views.iter().all(|&v| test(v)) {
        return Err(PlanError::NoTrainViews { views, usable: usable_views.len(), test: all_test });
    }
    if finite == 0 {
        return Err(PlanError::NoPoints);
    }
    let observations = Observations::of(capture);
    let mut footprints: Vec<f64> =
        (observations.all.iter()).filter(|s| !test(s.view as usize)).map(|s| s.footprint_metres(capture)).collect();
    let finest_metres = quantile(&mut footprints, FINE_QUANTILE);
    if !(finest_metres.is_finite() && finest_metres > 0.0) {
        return Err(PlanError::NoObservations { points: finite });
    }

    let layout = Layout { capture, observations: &observations, ground: &ground, split: &split };
    let automatic = levels.is_none();
    let levels = match (settings.mode, levels) {
        (Mode::Whole, _) => 0,
        (_, Some(levels)) => levels,
        (_, None) => layout.choose_levels(finest_metres, settings.budget),
    };
    let (base, mut tasks) = layout.lay_out(settings.mode, levels, finest_metres)?;
    if settings.mode == Mode::Tree && automatic {
        layout.split_crowded(base, finest_metres, &mut tasks);
    }
    let levels = tasks.iter().map(|task| task.block.level).max().unwrap_or(base);

    let shares = DetailShares::of(capture, &observations, &ground, levels, finest_metres);
    let whole = layout.lay_out(Mode::Whole, 0, finest_metres)?.1.remove(0);
    budgets::set_all(&mut tasks, whole, &shares, capture, &ground, settings);
    if settings.evaluate && tasks.len() > MAX_EVALUATED_BLOCKS {
        let problem = format!("{} blocks are too many to evaluate in the job", tasks.len());
        return Err(PlanError::Setting { setting: "--evaluate", problem, advice: "leave it, and use plat eval" });
    }
    let eval_tasks = if settings.evaluate { eval_tasks(capture, &tasks, &split, settings) } else { Vec::new() };
    let object_tasks =
        if settings.objects { object_tasks(capture, &tasks, &ground, &split, settings) } else { Vec::new() };
    Ok(Plan {
        version: VERSION,
        capture: capture_id,
        zones: None,
        detector: None,
        settings: settings.clone(),
        backend: backend.to_owned(),
        ground,
        levels,
        rho_metres: (0..=levels).map(|level| level_rho_metres(finest_metres, base, level)).collect(),
        tasks,
        eval_tasks,
        detect_tasks: Vec::new(),
        object_tasks,
    })
}

/// What training objects that move needs of a capture.
fn check_objects(capture: &Capture) -> Result<(), PlanError> {
    let bad = |problem: &str, advice| Err(PlanError::Setting { setting: "--objects", problem: problem.into(), advice });
    if capture.objects.is_empty() {
        return bad(
            "the capture knows no objects with boxes and paths",
            "omit it, or put a tracks.json beside the photos",
        );
    }
    if capture.views.iter().all(|view| view.seconds.is_none()) {
        return bad("it is not known when photos were taken", "omit it, or add \"seconds\" to tracks.json");
    }
    // A mask says which pixels of a box are the object's.
    if !capture.views.iter().any(|view| view.masked) {
        return bad(
            "no photo has a mask, which shows what moves",
            "omit it, or add mask files that leave out what moves",
        );
    }
    Ok(())
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
        return bad(
            "--tolerance-db",
            format!("{} is out of range", settings.tolerance_db),
            "give a number of decibels from 0",
        );
    }
    if !(0.0..1.0).contains(&settings.residual) {
        return bad("--residual", format!("{} is out of range", settings.residual), "give 0 to 1, such as 0.4");
    }
    if !(settings.test_stretches >= 0.0 && settings.test_stretches.is_finite()) {
        let problem = format!("{} is out of range", settings.test_stretches);
        return bad("--test-stretches", problem, "give metres from 0");
    }
    if settings.evaluate && settings.test_every == 0 && settings.test_stretches == 0.0 {
        let problem = "no view is held out to measure the model on";
        return bad("--evaluate", problem.into(), "omit it, or give --test-every a number from 1");
    }
    if settings.exposure && settings.mode == Mode::Flat {
        let problem = "flat blocks have no root that trains the exposures";
        return bad("--exposure", problem.into(), "omit it, or use --blocks tree or whole");
    }
    if settings.refine_poses && settings.mode == Mode::Flat {
        let problem = "flat blocks have no root that refines the poses";
        return bad("--refine-poses", problem.into(), "omit it, or use --blocks tree or whole");
    }
    if settings.refine_sensors && settings.mode == Mode::Flat {
        let problem = "flat blocks have no root that refines the sensors";
        return bad("--refine-sensors", problem.into(), "omit it, or use --blocks tree or whole");
    }
    if settings.objects && settings.mode == Mode::Flat {
        let problem = "flat blocks are no scene that objects could be trained in";
        return bad("--objects", problem.into(), "omit it, or use --blocks tree or whole");
    }
    if settings.sh_degree > 3 {
        return bad("sh_degree", format!("{} is not supported", settings.sh_degree), "give 0 to 3");
    }
    if !(1..=MAX_VIEWS_PER_STEP).contains(&settings.views_per_step) {
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

#[cfg(test)]
mod tests;
