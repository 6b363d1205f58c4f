//! Limits a job's wall time (`--minutes`). The remaining time is divided among the remaining tasks in proportion to their planned work.
//! A task that does not fit its share takes fewer steps, so that its schedules of learning rates and densification still run to their
//! end. Every task takes at least one step.
//!
//! A trial run of a few steps at each mip of the schedule, whose splats are discarded, measures how many steps fit. A task that turns
//! out slower than its trial run is stopped and keeps its current splats.
//!
//! A shortened job depends on the speed of the machine: its bytes are not those of the plan.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use blocks::Plan;
use scene::{BlockId, Splats};
use train::{Flow, Job, Recipe, TrainView};

use crate::clock::Stopwatch;
use crate::estimate::cpu_seconds;

/// Cost of a pixel in a training step, and of a splat of the block, visible or not: only their ratio counts.
const PIXEL_COST: f64 = 0.2;
const SPLAT_COST: f64 = 0.35;
/// Fraction of its share that a task plans to use.
const TARGET_FRACTION: f64 = 0.95;
/// Multiple of its share at which a slow task is stopped.
const STOP_FRACTION: f64 = 1.2;
/// Fraction of its share that the trial run may take.
const TRIAL_FRACTION: f64 = 0.1;
/// Windows of the trial run. Each is used twice: the first time it is also read.
const TRIAL_WINDOWS: usize = 3;

/// A job's limit in wall time, shared by the workers of one process.
#[derive(Debug)]
pub struct TimeLimit {
    clock: Stopwatch,
    seconds: f64,
    workers: u32,
    done: Mutex<BTreeSet<u32>>,
    is_shortened: AtomicBool,
}

impl TimeLimit {
    /// All tasks are to be done when `clock` shows this many wall seconds.
    pub fn new(clock: Stopwatch, seconds: f64, workers: u32) -> Self {
        Self { clock, seconds, workers, done: Mutex::default(), is_shortened: AtomicBool::new(false) }
    }

    /// Whether any task took fewer steps than planned.
    pub fn is_shortened(&self) -> bool {
        self.is_shortened.load(Ordering::Relaxed)
    }

    /// Records that a task took fewer steps than planned.
    pub(crate) fn mark_shortened(&self) {
        self.is_shortened.store(true, Ordering::Relaxed);
    }

    /// Wall seconds since the start of the job.
    pub(crate) fn now(&self) -> f64 {
        self.clock.wall_seconds()
    }

    /// Records that this task of the plan is done.
    pub(crate) fn finish(&self, task: u32) {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).insert(task);
    }

    /// Wall seconds that this task of the plan may take from now, at least 0.
    pub(crate) fn share(&self, plan: &Plan, task: u32) -> f64 {
        let done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        share(plan, task, &done, self.workers) * (self.seconds - self.now()).max(0.0)
    }
}

/// A task's share of the time that all remaining tasks take. Tasks of the same dependency depth may run in parallel, those of different
/// depths may not.
fn share(plan: &Plan, task: u32, done: &BTreeSet<u32>, workers: u32) -> f64 {
    let mut depths: BTreeMap<BlockId, usize> = BTreeMap::new();
    let mut work: BTreeMap<usize, (f64, u32)> = BTreeMap::new();
    let mut own = 1.0;
    for (i, of) in (0..).zip(&plan.tasks) {
        let dependencies = of.parent.iter().chain(&of.context).filter_map(|block| depths.get(block));
        let depth = dependencies.max().map_or(0, |depth| depth + 1);
        depths.insert(of.block, depth);
        let seconds = cpu_seconds(plan, of).max(f64::MIN_POSITIVE);
        if i == task {
            own = seconds;
        }
        if i == task || !done.contains(&i) {
            let (sum, count) = work.entry(depth).or_default();
            *sum += seconds;
            *count += 1;
        }
    }
    let all: f64 = work.values().map(|(sum, count)| sum / f64::from((*count).min(workers).max(1))).sum();
    (own / all).min(1.0)
}

/// The time limit of one task.
pub(crate) struct TaskTimeLimit<'a> {
    limit: &'a TimeLimit,
    /// Wall seconds on the job's clock.
    until: f64,
    /// Wall seconds of one evaluation.
    evaluation: f64,
}

impl<'a> TaskTimeLimit<'a> {
    /// Limits this task of the plan to its share, and its job to the steps that fit into `part` of that. `evaluate` runs at the end and
    /// every `eval_every` steps (0 = never).
    pub(crate) fn new<T>(
        limit: &'a TimeLimit,
        plan: &Plan,
        task: u32,
        job: &mut Job,
        part: f64,
        eval_every: u32,
        mut evaluate: impl FnMut(&Splats) -> T,
    ) -> Self {
        let start = limit.now();
        let share = limit.share(plan, task);
        let mut task_limit = Self { limit, until: (start + STOP_FRACTION * share).min(limit.seconds), evaluation: 0.0 };
        let mut steps = 1;
        if share > 0.0 {
            evaluate(&job.initial);
            task_limit.evaluation = limit.now() - start;
            let Pace { step, window } = trial_run(job, limit, limit.now() + TRIAL_FRACTION * share);
            let per_step = if eval_every > 0 { task_limit.evaluation / f64::from(eval_every) } else { 0.0 };
            let available = part * (TARGET_FRACTION * share - (limit.now() - start) - task_limit.evaluation);
            steps = fitting_steps(available, step * growth(job) + per_step, window, job.views.len());
        }
        if steps < job.steps {
            job.steps = steps;
            limit.mark_shortened();
        }
        task_limit
    }

    /// Whether the task has to stop now.
    pub(crate) fn is_over(&self) -> bool {
        self.limit.now() + self.evaluation >= self.until
    }
}

/// Number of steps that fit into `available` seconds, at least one. `step` is the time of a step, `window` that of reading a window,
/// which happens at the first step that uses it.
fn fitting_steps(available: f64, step: f64, window: f64, windows: usize) -> u32 {
    let windows = windows as f64;
    let steps = match (available - windows * window) / step {
        steps if steps >= windows => steps,
        _ => available / (step + window),
    };
    // `as` saturates, and converts NaN to 0.
    (steps as u32).max(1)
}

/// Measured wall seconds.
struct Pace {
    /// A step with the initial splats, averaged over the mips of the schedule.
    step: f64,
    /// Reading a window.
    window: f64,
}

/// Times a few steps at each mip of the schedule, the finest first, until `until` on the job's clock.
fn trial_run(job: &Job, limit: &TimeLimit, until: f64) -> Pace {
    let count = job.views.len().min(TRIAL_WINDOWS);
    let few: Vec<TrainView> = (0..count).map(|i| job.views[i * job.views.len() / count]).collect();
    let coarse = &job.recipe.coarse;
    let mut pace = Pace { step: 0.0, window: 0.0 };
    let mut weights = 0.0;
    for coarser in 0..=coarse.len() {
        let weight = match coarse.len() - coarser {
            at if coarser > 0 => coarse[at],
            _ => 1.0 - coarse.iter().sum::<f32>(),
        };
        let coarse = vec![1.0; coarser];
        let mut recipe =
            Recipe { coarse, detail_factor: 0.0, views_per_step: 1, sh_from: [0.0; 3], ..job.recipe.clone() };
        // Densification never starts.
        recipe.growth.from = 2.0;
        let steps = 2 * count as u32;
        let trial = Job { initial: job.initial.clone(), views: &few, steps, recipe: &recipe, ..*job };
        let mut times = vec![limit.now()];
        // An error occurs again in training, and is reported there.
        let _ = train::train(trial, &mut |mut now| {
            // Waits for the device to finish the step.
            let _ = now.loss();
            times.push(limit.now());
            if limit.now() < until { Flow::Continue } else { Flow::Stop }
        });
        let seconds = |from: usize, to: usize| (times[to] - times[from]) / (to - from) as f64;
        let step = match times.len() - 1 {
            0 => continue,
            taken if taken <= count => seconds(0, taken),
            taken => seconds(count, taken),
        };
        if coarser == 0 && times.len() > count {
            pace.window = (seconds(0, count) - step).max(0.0);
        }
        pace.step += f64::from(weight) * step;
        weights += f64::from(weight);
        if limit.now() >= until {
            break;
        }
    }
    pace.step /= weights.max(f64::MIN_POSITIVE);
    pace
}

/// Mean cost of a step over the whole schedule, as splats are added, relative to one with the initial splats.
fn growth(job: &Job) -> f64 {
    let first = job.initial.len() as f64;
    let last = first.max(job.budget as f64);
    let until = f64::from(job.recipe.growth.until.clamp(0.0, 1.0));
    let mean = until * 0.5 * (first + last) + (1.0 - until) * last;
    let pixels = job.views.iter().map(|view| view.rect.area() as f64).sum::<f64>() / job.views.len().max(1) as f64;
    let cost = |splats: f64| PIXEL_COST * pixels + SPLAT_COST * splats;
    cost(mean) / cost(first)
}

#[cfg(test)]
mod tests {
    use blocks::{Mode, Task};

    use super::*;
    use crate::testing::{plan_of, task};

    /// The root, two children that may run in parallel, and one that depends on them; `steps` is their work.
    fn plan(steps: [u32; 4]) -> Plan {
        let block = |level, x, y| BlockId { level, x, y };
        let blocks = [block(0, 0, 0), block(1, 0, 0), block(1, 1, 0), block(1, 0, 1)];
        let task = |i: usize| {
            let context = if i == 3 { blocks[1..3].to_vec() } else { Vec::new() };
            Task { context, ..task(blocks[i], steps[i]) }
        };
        plan_of(Mode::Tree, (0..4).map(task).collect())
    }

    #[test]
    fn remaining_time_is_divided_by_remaining_work() {
        let plan = plan([10, 20, 20, 50]);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
        let done = |tasks: &[u32]| tasks.iter().copied().collect::<BTreeSet<u32>>();
        let work = [0, 1, 2, 3].map(|i| cpu_seconds(&plan, &plan.tasks[i]));
        assert!((work[3] / work[1] - 2.5).abs() < 1e-9, "children cost as much as their steps");
        near(share(&plan, 0, &done(&[]), 1), work[0] / work.iter().sum::<f64>());
        near(share(&plan, 1, &done(&[0]), 1), 20.0 / 90.0);
        near(share(&plan, 3, &done(&[0, 1, 2]), 1), 1.0);
        // A second attempt at a task that is done already.
        near(share(&plan, 3, &done(&[0, 1, 2, 3]), 1), 1.0);
        // Two workers run the two in the middle in parallel, and nothing else.
        near(share(&plan, 0, &done(&[]), 2), work[0] / (work[0] + work[1] + work[3]));
        near(share(&plan, 1, &done(&[0]), 2), 20.0 / 70.0);
        near(share(&plan, 2, &done(&[0, 1]), 2), 20.0 / 70.0);
        near(share(&plan, 3, &done(&[0, 1, 2]), 8), 1.0);
    }

    #[test]
    fn windows_are_read_once() {
        assert_eq!(fitting_steps(10.0, 0.1, 0.0, 5), 100);
        assert_eq!(fitting_steps(10.0, 0.1, 1.0, 5), 50);
        assert_eq!(fitting_steps(10.0, 0.1, 0.9, 50), 10);
        for nonsense in [fitting_steps(-1.0, 0.1, 0.1, 5), fitting_steps(1.0, f64::NAN, 0.0, 5)] {
            assert_eq!(nonsense, 1);
        }
    }
}
