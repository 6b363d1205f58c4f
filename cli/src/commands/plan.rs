//! `plat plan`: shows how a capture would be divided.
//!
//! Photos are not read, so this is fast for any capture. Tasks, budgets and windows are those that `plat train` will use; the plan
//! of `plat train` also names the contents of the photos.

use blocks::Finding;
use model::save_json;
use scene::ArtefactId;
use serde::Serialize;
use store::file::save;
use worker::estimate::Estimate;
use worker::speed::relative_speed;

use crate::args::PlanArgs;
use crate::captures;
use crate::failure::Failure;
use crate::output::Output;
use crate::planning::{check_plan, describe, plan_of};

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
    let source = captures::open_to_plan(&args.capture, &args.plan, output)?;
    let (capture, plan) = plan_of(&source, &args.plan)?;
    if let Some(path) = &args.out {
        save_json(path, &plan)?;
    }
    if let Some(path) = &args.svg {
        save(path, blocks::draw(&plan, &capture).as_bytes())?;
    }
    let findings = blocks::lint(&plan, &capture);
    let planned = Planned {
        command: "plan",
        plan: plan.id(),
        levels: plan.levels,
        tasks: plan.tasks.len(),
        estimate: Estimate::of(&plan, relative_speed()),
        findings: findings.iter().map(Finding::to_string).collect(),
    };
    output.result(&planned, &format!("{}\n{}", describe(&plan), planned.findings.join("\n")))?;
    check_plan(&plan, &capture, &Output::silent())
}
