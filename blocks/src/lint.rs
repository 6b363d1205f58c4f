//! The linter: checks a plan against its capture before training starts.

use std::collections::BTreeSet;
use std::fmt;

use scene::{BlockId, Capture};

use crate::layout::MIN_VIEWS;
use crate::lod::training_order;
use crate::plan::{Mode, Plan};
use crate::split::Split;
use crate::task::{EvalTask, Task, ViewUse};
use crate::visibility::max_mip;

/// Finest blocks that draw each of their windows less often than this gain little on their parents: a street had 26.56 dB with
/// leaves of 0.2 visits, and 27.39 with its root alone (docs/decisions/0064).
const FEW_VISITS: f64 = 0.5;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// The plan can run, but may not be what the user wants.
    Warning,
    /// The plan must not run.
    Error,
}

/// A finding of the linter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// The block; `None` for the plan as a whole.
    pub block: Option<BlockId>,
    /// The problem.
    pub message: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = if self.severity == Severity::Error { "error" } else { "warning" };
        match self.block {
            Some(block) => write!(f, "{word}: block {block}: {}", self.message),
            None => write!(f, "{word}: {}", self.message),
        }
    }
}

/// All findings about a plan for this capture, errors first. Empty for a good plan.
pub fn lint(plan: &Plan, capture: &Capture) -> Vec<Finding> {
    let mut findings = Findings(Vec::new());
    if let Err(error) = plan.check() {
        findings.error(None, error.to_string());
        return findings.0;
    }
    if let Some(asked) = plan.settings.levels.filter(|&asked| asked != plan.levels && plan.settings.mode == Mode::Tree)
    {
        let message = format!("{} of {asked} levels: views and points do not support more", plan.levels);
        findings.warning(None, message);
    }
    let visits = plan.leaf_visits();
    if plan.levels > 0 && visits < FEW_VISITS {
        let message = format!(
            "the finest blocks draw each photo {visits:.1} times; give more --steps, fewer --levels or a lower --budget"
        );
        findings.warning(None, message);
    }
    check_ownership(plan, capture, &mut findings);
    let split = Split::of(plan, capture);
    let mut earlier: BTreeSet<BlockId> = BTreeSet::new();
    for task in &plan.tasks {
        check_order(plan, task, &earlier, &mut findings);
        check_views(task, capture, &split, &mut findings);
        check_budgets(plan, task, &mut findings);
        earlier.insert(task.block);
    }
    plan.eval_tasks.iter().for_each(|task| check_evaluation(task, capture, &split, &mut findings));
    if let Some(end) = plan.detect_tasks.last().map(|task| task.views().end as usize)
        && end != capture.views.len()
    {
        findings.error(None, format!("looks for objects on {end} views, the capture has {}", capture.views.len()));
    }
    let evaluating = ("evaluating the merged model", "lower --budget, or leave --evaluate and use plat eval");
    check_memory(plan, plan.eval_tasks.iter().map(|task| task.memory_bytes), evaluating, &mut findings);
    let detecting = ("looking for objects", "give a smaller --detector");
    if plan.settings.objects && plan.object_tasks.is_empty() {
        let message = "no object that moves is shown by three photos with 12 pixels a side".to_owned();
        findings.warning(None, message);
    }
    let objects = ("training an object that moves", "leave --objects");
    check_memory(plan, plan.object_tasks.iter().map(|task| task.memory_bytes), objects, &mut findings);
    if let Some(task) = plan.object_tasks.last().filter(|task| task.object as usize >= capture.objects.len()) {
        findings.error(None, format!("trains object {}, which the capture does not have", task.object));
    }
    let views = plan.object_tasks.iter().flat_map(|task| &task.views);
    if let Some(used) =
        views.into_iter().find(|used| used.view as usize >= capture.views.len() || split.is_held_out(used.view))
    {
        findings.error(None, format!("trains an object on view {}, which is not there or held out", used.view));
    }
    check_memory(plan, plan.detect_tasks.iter().map(|task| task.memory_bytes), detecting, &mut findings);
    let finest: u64 = plan.leaves().blocks().iter().filter_map(|&b| plan.task(b)).map(|t| u64::from(t.budget)).sum();
    let deepest: u64 = plan.tasks.iter().filter(|t| t.block.level == plan.levels).map(|t| u64::from(t.budget)).sum();
    let (budget, parts) = (u64::from(plan.settings.budget), plan.tasks.len() as u64);
    if deepest > budget + parts || finest < budget.saturating_sub(parts) {
        let message = format!(
            "the finest level's {deepest} splats (merged model: {finest}) do not add up to the budget of {budget}"
        );
        findings.error(None, message);
    }
    findings.0.sort_by_key(|f| std::cmp::Reverse(f.severity));
    findings.0
}

struct Findings(Vec<Finding>);

impl Findings {
    fn error(&mut self, block: impl Into<Option<BlockId>>, message: String) {
        self.0.push(Finding { severity: Severity::Error, block: block.into(), message });
    }

    fn warning(&mut self, block: impl Into<Option<BlockId>>, message: String) {
        self.0.push(Finding { severity: Severity::Warning, block: block.into(), message });
    }
}

/// Checks that every sparse point has an owner, and that most lie in their owner's halo and at the finest resolution.
fn check_ownership(plan: &Plan, capture: &Capture, findings: &mut Findings) {
    let (leaves, tasks) = (plan.leaves(), plan.tasks.iter().map(|t| t.block).collect::<BTreeSet<_>>());
    let (mut finite, mut coarse, mut outside) = (0usize, 0usize, 0usize);
    let finest_metres = plan.rho_metres.iter().copied().fold(f64::INFINITY, f64::min);
    for &point in capture.points.positions.iter().filter(|p| p.is_finite()) {
        finite += 1;
        match leaves.owner_of(&plan.ground, point) {
            Some(owner) if tasks.contains(&owner) => {
                coarse += usize::from(plan.task(owner).is_some_and(|task| task.rho_metres > 1.5 * finest_metres));
                outside += usize::from(!plan.ground.in_halo(owner, point));
            }
            _ => {
                findings.error(None, format!("sparse point {point} has no owner"));
                return;
            }
        }
    }
    let percent = |n: usize| 100 * n / finite.max(1);
    if finite < capture.points.len() {
        findings.warning(None, format!("{} sparse points are not finite", capture.points.len() - finite));
    }
    if percent(coarse) >= 5 {
        let message =
            format!("{} % of the sparse points stay at a coarser level: too few views or points", percent(coarse));
        findings.warning(None, message);
    }
    if percent(outside) >= 1 {
        findings.warning(None, format!("{} % of the sparse points lie outside their owner's halo", percent(outside)));
    }
}

/// Checks that parent and context exist and precede the task, and that a tree's block has its parent.
fn check_order(plan: &Plan, task: &Task, earlier: &BTreeSet<BlockId>, findings: &mut Findings) {
    for dependency in task.context.iter().chain(&task.parent) {
        if !earlier.contains(dependency) {
            findings.error(task.block, format!("depends on block {dependency}, which does not precede it"));
        }
        if training_order(*dependency) >= training_order(task.block) {
            findings.error(task.block, format!("depends on block {dependency}, which is trained later"));
        }
    }
    if plan.settings.mode == Mode::Tree && task.parent != task.block.parent() {
        findings.error(task.block, "is not initialised from its parent".into());
    }
}

/// Checks that training and held-out views are disjoint and exist, and that mips and windows are inside them.
fn check_views(task: &Task, capture: &Capture, split: &Split, findings: &mut Findings) {
    let is_test = |v: &ViewUse| split.is_held_out(v.view);
    if let Some(v) = task.views.iter().find(|v| is_test(v)) {
        findings.error(task.block, format!("trains on held-out view {}", v.view));
    }
    if let Some(v) = task.test_views.iter().find(|v| !is_test(v)) {
        findings.error(task.block, format!("is tested on training view {}", v.view));
    }
    for used in [&task.views, &task.test_views] {
        if !used.is_sorted_by(|a, b| a.view < b.view) {
            findings.error(task.block, "lists a view twice or out of order".into());
        }
    }
    for v in task.views.iter().chain(&task.test_views) {
        let Some(view) = capture.views.get(v.view as usize) else {
            findings.error(task.block, format!("uses view {}, the capture has {}", v.view, capture.views.len()));
            continue;
        };
        let (full, window) = (view.camera.full(), v.window);
        if v.mip > max_mip(full.width, full.height) {
            findings.error(task.block, format!("uses mip {} of '{}', which does not exist", v.mip, view.name));
            continue;
        }
        let image = view.camera.mip(v.mip).full();
        let ends = |from: u32, length: u32, size: u32| u64::from(from) + u64::from(length) <= u64::from(size);
        if !ends(window.x, window.width, image.width) || !ends(window.y, window.height, image.height) {
            findings.error(task.block, format!("uses a window outside mip {} of '{}'", v.mip, view.name));
        }
    }
    match task.views.len() {
        0 => findings.error(task.block, "has no training view".into()),
        n if n < MIN_VIEWS => findings.warning(task.block, format!("has {n} training views, fewer than {MIN_VIEWS}")),
        _ => {}
    }
}

/// Checks splat budget, steps and memory.
fn check_budgets(plan: &Plan, task: &Task, findings: &mut Findings) {
    if task.budget == 0 || task.steps == 0 {
        findings.error(task.block, format!("has a budget of {} splats and {} steps", task.budget, task.steps));
    }
    if task.points == 0 {
        findings.error(task.block, "has no sparse point".into());
    }
    let (bytes, limit) = (task.memory_bytes, plan.settings.memory_limit_bytes);
    if bytes > limit {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        findings.error(
            task.block,
            format!("needs {} MiB, the limit is {} MiB; lower --budget or raise --levels", mib(bytes), mib(limit)),
        );
    }
}

/// Checks that the largest of some tasks that train no block fits the memory limit.
fn check_memory(plan: &Plan, bytes: impl Iterator<Item = u64>, (what, advice): (&str, &str), findings: &mut Findings) {
    let limit = plan.settings.memory_limit_bytes;
    if let Some(bytes) = bytes.max().filter(|bytes| *bytes > limit) {
        let [bytes, limit] = [bytes, limit].map(|bytes| bytes.div_ceil(1 << 20));
        findings.error(None, format!("{what} needs {bytes} MiB, the limit is {limit} MiB; {advice}"));
    }
}

/// Checks that the views of an evaluation exist and are held out.
fn check_evaluation(task: &EvalTask, capture: &Capture, split: &Split, findings: &mut Findings) {
    for &view in &task.views {
        if view as usize >= capture.views.len() {
            findings.error(None, format!("evaluates view {view}, the capture has {}", capture.views.len()));
        } else if !split.is_held_out(view) {
            findings.error(None, format!("evaluates training view {view}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use scene::ArtefactId;

    use super::*;
    use crate::plan::PlanSettings;
    use crate::task::DetectTask;
    use crate::testing::aerial;

    /// Each damage is found at the damaged block.
    #[test]
    fn damage_is_found() {
        let capture = aerial(6, 200.0, 4000);
        let settings = PlanSettings { levels: Some(1), ..PlanSettings::default() };
        let good = crate::plan(&capture, ArtefactId::of(b""), &settings, "cpu").unwrap();
        assert!(lint(&good, &capture).is_empty());
        type Damage = fn(&mut Plan);
        let damages: [(&str, Damage); 10] = [
            ("trains on held-out view 0", |p| p.tasks[2].views[0].view = 0),
            ("is tested on training view", |p| p.tasks[2].test_views[0].view = 1),
            ("window outside", |p| p.tasks[2].views[0].window.x = u32::MAX),
            ("which does not exist", |p| p.tasks[2].views[0].mip = 9),
            ("lists a view twice", |p| p.tasks[2].views[1] = p.tasks[2].views[0]),
            ("has no training view", |p| p.tasks[2].views.clear()),
            ("not initialised from its parent", |p| p.tasks[2].parent = None),
            ("is trained later", |p| p.tasks[2].context = vec![BlockId { level: 1, x: 1, y: 1 }]),
            ("MiB, the limit is", |p| p.tasks[2].memory_bytes = u64::MAX),
            ("has a budget of 0 splats", |p| p.tasks[2].budget = 0),
        ];
        for (expected, damage) in damages {
            let mut plan = good.clone();
            damage(&mut plan);
            let findings = lint(&plan, &capture);
            let found = findings.iter().find(|f| f.message.contains(expected));
            assert_eq!(
                found.map(|f| (f.severity, f.block)),
                Some((Severity::Error, Some(good.tasks[2].block))),
                "{expected}: {findings:?}"
            );
            assert!(findings.is_sorted_by_key(|f| std::cmp::Reverse(f.severity)));
        }
        let mut lost = good.clone();
        lost.tasks.remove(0);
        assert!(lint(&lost, &capture).iter().any(|f| f.message.contains("does not precede it")));
        let mut poor = good.clone();
        poor.tasks[1].budget += 90_000;
        assert!(lint(&poor, &capture).iter().any(|f| f.message.contains("do not add up")));
        // Views 0 and 8 are held out.
        let evaluates = |views: &[u32], memory_bytes: u64| {
            let task = EvalTask { views: views.to_vec(), pixels: 1, memory_bytes };
            lint(&Plan { eval_tasks: vec![task], ..good.clone() }, &capture)
        };
        assert!(evaluates(&[0, 8], 1).is_empty());
        for (views, bytes, expected) in [
            (&[0, 9][..], 1, "evaluates training view 9"),
            (&[4000], 1, "the capture has 36"),
            (&[8, 0], 1, "twice or out of order"),
            (&[0, 0], 1, "twice or out of order"),
            (&[], 1, "without views"),
            (&[0], u64::MAX, "leave --evaluate"),
        ] {
            let findings = evaluates(views, bytes);
            let found = findings.iter().any(|f| f.severity == Severity::Error && f.message.contains(expected));
            assert!(found, "{expected}: {findings:?}");
        }
        let detects = |ranges: &[(u32, u32)], memory_bytes: u64| {
            let task = |&(first, count): &(u32, u32)| DetectTask { first, count, work_millis: 1, memory_bytes };
            let detector = Some(ArtefactId::of(b"network"));
            lint(&Plan { detector, detect_tasks: ranges.iter().map(task).collect(), ..good.clone() }, &capture)
        };
        assert!(detects(&[(0, 36)], 1).is_empty() && detects(&[(0, 1), (1, 35)], 1).is_empty());
        for (ranges, bytes, expected) in [
            (&[(0, 35)][..], 1, "on 35 views, the capture has 36"),
            (&[(1, 35)], 1, "do not follow each other"),
            (&[(0, 2), (1, 34)], 1, "do not follow each other"),
            (&[(0, 0), (0, 36)], 1, "do not follow each other"),
            (&[(0, u32::MAX), (u32::MAX, 1)], 1, "do not follow each other"),
            (&[(0, 36)], u64::MAX, "give a smaller --detector"),
        ] {
            let findings = detects(ranges, bytes);
            let found = findings.iter().any(|f| f.severity == Severity::Error && f.message.contains(expected));
            assert!(found, "{expected}: {findings:?}");
        }
        let task = DetectTask { first: 0, count: 36, work_millis: 1, memory_bytes: 1 };
        let blind = Plan { detect_tasks: vec![task], ..good.clone() };
        assert!(lint(&blind, &capture)[0].message.contains("no detector"));
        let mut fewer = capture.clone();
        fewer.views.truncate(20);
        assert!(lint(&good, &fewer).iter().any(|f| f.message.contains("the capture has 20")));
    }
}
