//! Plans a capture, checks the plan, and describes it.

use blocks::{Plan, Severity};
use dataset::open::Source;
use scene::{ArtefactId, BadInput, Capture, frame};
use worker::estimate::Estimate;
use worker::speed::relative_speed;

use crate::args::PlanOptions;
use crate::captures;
use crate::failure::Failure;
use crate::output::{Output, beside};

/// Plans an opened capture for the CPU; returns the capture at the size that it was planned for.
pub(crate) fn plan_of(source: &Source, options: &PlanOptions) -> Result<(Capture, Plan), Failure> {
    let capture = captures::shrunk(&source.capture, options.downscale)?;
    let id = ArtefactId::of(&frame::encode(dataset::ingest::CAPTURE, &capture, &[]));
    let settings = options.settings(&capture, source.seeds.len());
    if settings.depth_weight > 0.0 && !source.is_measured() && capture.points.seen_by.is_empty() {
        let problem = "the capture has neither lidar nor depth maps, and does not say which photos observed its sparse \
                       points: there are no target depths";
        return Err(BadInput::new("--depth-weight", problem, "leave it").into());
    }
    let planned = if options.budget.0.is_some() { blocks::plan } else { blocks::plan_at_most };
    let plan = planned(&capture, id, &settings, &train::Backend::Cpu.name())?;
    Ok((capture, plan))
}

/// Notes the linter's warnings. Its first error refuses the plan.
pub(crate) fn check_plan(plan: &Plan, capture: &Capture, output: &Output) -> Result<(), Failure> {
    let findings = blocks::lint(plan, capture);
    for warning in findings.iter().filter(|finding| finding.severity == Severity::Warning) {
        output.note(warning);
    }
    let errors: Vec<_> = findings.iter().filter(|finding| finding.severity == Severity::Error).collect();
    let Some(first) = errors.first() else { return Ok(()) };
    let more = if errors.len() > 1 { format!(" (and {} more)", errors.len() - 1) } else { String::new() };
    Err(Failure::Input(format!("the plan cannot run: {first}{more}; plat plan shows all, other --levels may help")))
}

/// The plan as text, a line per level.
pub(crate) fn describe(plan: &Plan) -> String {
    let estimate = Estimate::of(plan, relative_speed());
    let evaluation = match plan.eval_tasks.len() {
        0 => String::new(),
        count => format!(" and {count} evaluation task{}", if count == 1 { "" } else { "s" }),
    };
    let moving = beside(plan.object_tasks.len());
    let mut text = format!(
        "{:?} plan of {} level{}, {} task{}{evaluation}{moving}, root {:.1} m: about {:.0} ({:.0} to {:.0}) CPU seconds and {} MB a task\n",
        plan.settings.mode,
        plan.levels + 1,
        if plan.levels == 0 { "" } else { "s" },
        plan.tasks.len(),
        if plan.tasks.len() == 1 { "" } else { "s" },
        plan.ground.edge_metres,
        estimate.cpu_seconds,
        estimate.cpu_seconds_range[0],
        estimate.cpu_seconds_range[1],
        estimate.memory_bytes >> 20,
    );
    for level in 0..=plan.levels {
        let tasks: Vec<_> = plan.tasks.iter().filter(|task| task.block.level == level).collect();
        if tasks.is_empty() {
            continue;
        }
        text += &format!(
            "level {level}: {} blocks of {:.1} m at {:.4} m per pixel, {} splats, {} steps, {} to {} views each\n",
            tasks.len(),
            plan.ground.core_edge_metres(level),
            plan.rho_metres[usize::from(level)],
            tasks.iter().map(|task| u64::from(task.budget)).sum::<u64>(),
            tasks.iter().map(|task| u64::from(task.steps)).sum::<u64>(),
            tasks.iter().map(|task| task.views.len()).min().unwrap_or(0),
            tasks.iter().map(|task| task.views.len()).max().unwrap_or(0),
        );
    }
    text
}
