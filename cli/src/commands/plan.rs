//! `plat plan`: how a capture would be divided. Photos are not read, so this is quick for any capture; tasks, budgets and
//! windows are those that `plat train` will use, whose plan also names the photos' contents.

use blocks::{Finding, Plan};
use scene::{ArtefactId, Capture, frame};
use serde::Serialize;
use store::file::save;
use worker::estimate::Estimate;

use crate::args::{PlanArgs, PlanOptions};
use crate::cameras;
use crate::commands::train::check_plan;
use crate::failure::Failure;
use crate::model::save_json;
use crate::output::Output;

#[derive(Serialize)]
struct Planned {
    command: &'static str,
    plan: ArtefactId,
    levels: u8,
    tasks: usize,
    #[serde(flatten)]
    estimate: Estimate,
    findings: Vec<String>,
}

pub(crate) fn run(args: &PlanArgs, output: &Output) -> Result<(), Failure> {
    let source = cameras::open(&args.capture, output)?;
    let (capture, plan) = plan_of(&source.capture, &args.plan)?;
    if let Some(path) = &args.out {
        save_json(path, &plan)?;
    }
    if let Some(path) = &args.svg {
        save(path, blocks::draw(&plan, &capture).as_bytes())?;
    }
    let estimate = Estimate::of(&plan);
    let findings = blocks::lint(&plan, &capture);
    let planned = Planned {
        command: "plan",
        plan: plan.id(),
        levels: plan.levels,
        tasks: plan.tasks.len(),
        estimate,
        findings: findings.iter().map(Finding::to_string).collect(),
    };
    output.result(&planned, &format!("{}\n{}", describe(&plan), planned.findings.join("\n")))?;
    check_plan(&plan, &capture, &Output::new(false, true, false))
}

/// Plans an opened capture for the CPU; returns it as it was planned for.
pub(crate) fn plan_of(capture: &Capture, options: &PlanOptions) -> Result<(Capture, Plan), Failure> {
    let capture = cameras::shrunk(capture, options.downscale)?;
    let id = ArtefactId::of(&frame::encode(dataset::ingest::CAPTURE, &capture, &[]));
    let settings = options.settings(&capture);
    let plan = blocks::plan(&capture, id, &settings, &train::Backend::Cpu.name())?;
    Ok((capture, plan))
}

/// The plan for a person, a line a level.
pub(crate) fn describe(plan: &Plan) -> String {
    let estimate = Estimate::of(plan);
    let mut text = format!(
        "{:?} plan of {} level{}, {} task{}, root {:.1} m: about {:.0} CPU seconds and {} MB a task\n",
        plan.settings.mode,
        plan.levels + 1,
        if plan.levels == 0 { "" } else { "s" },
        plan.tasks.len(),
        if plan.tasks.len() == 1 { "" } else { "s" },
        plan.ground.edge_metres,
        estimate.cpu_seconds,
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
