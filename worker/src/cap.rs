//! A cap in wall time on a job. What is left is shared out over the tasks that are left by their planned work, and a task
//! that does not fit its share takes fewer steps, so that its schedules of rates and growth still come to their end.
//! The tasks at the end of a job get their part like those at its beginning, and every task takes one step at least.
//!
//! How many steps fit is found by a rehearsal: a few steps at each mip of the schedule, whose outcome is thrown away.
//! A task that is slower than rehearsed is stopped and keeps what it has.
//!
//! A job that was shortened depends on the speed of the machine: its bytes are not those of the plan.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use blocks::Plan;
use scene::{BlockId, Splats};
use train::{Flow, Job, Recipe, TrainView};

use crate::clock::Stopwatch;
use crate::estimate::{cpu_seconds, parents};

/// Cost of a pixel in a training step, and of a splat of the block, whatever the windows show of it: only the ratio counts.
const PIXEL_COST: f64 = 0.2;
const SPLAT_COST: f64 = 0.35;
/// Part of its share that a task plans to use.
const AIM: f64 = 0.95;
/// Part of its share, over one, at which a task that turns out slow is stopped.
const PATIENCE: f64 = 1.2;
/// Part of its share that a rehearsal may take.
const REHEARSAL: f64 = 0.1;
/// Windows that are rehearsed with, twice each: the first time they are read.
const REHEARSED: usize = 3;

/// A cap that the workers of one process share for one job.
#[derive(Debug)]
pub struct Cap {
    clock: Stopwatch,
    seconds: f64,
    workers: u32,
    done: Mutex<BTreeSet<u32>>,
    shortened: AtomicBool,
}

impl Cap {
    /// All tasks are to be done when `clock` shows this many wall seconds.
    pub fn new(clock: Stopwatch, seconds: f64, workers: u32) -> Self {
        Self { clock, seconds, workers, done: Mutex::default(), shortened: AtomicBool::new(false) }
    }

    /// Whether any task took fewer steps than planned.
    pub fn shortened(&self) -> bool {
        self.shortened.load(Ordering::Relaxed)
    }

    /// A task took fewer steps than planned.
    pub(crate) fn shorten(&self) {
        self.shortened.store(true, Ordering::Relaxed);
    }

    /// Wall seconds since the start of the job.
    pub(crate) fn now(&self) -> f64 {
        self.clock.wall_seconds()
    }

    /// This task of the plan is done.
    pub(crate) fn finish(&self, task: u32) {
        self.done.lock().unwrap_or_else(PoisonError::into_inner).insert(task);
    }

    /// Wall seconds that this task of the plan may take from now, at least 0.
    pub(crate) fn share(&self, plan: &Plan, task: u32) -> f64 {
        let done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        share(plan, task, &done, self.workers) * (self.seconds - self.now()).max(0.0)
    }
}

/// The share of a task in the time that the tasks that are not done will take together. Tasks of one depth of the
/// dependencies may run side by side, those of different depths not.
fn share(plan: &Plan, task: u32, done: &BTreeSet<u32>, workers: u32) -> f64 {
    let mut depths: BTreeMap<BlockId, usize> = BTreeMap::new();
    let mut work: BTreeMap<usize, (f64, u32)> = BTreeMap::new();
    let mut own = 1.0;
    let parents = parents(plan);
    for (i, of) in (0..).zip(&plan.tasks) {
        let needed = of.parent.iter().chain(&of.context).filter_map(|block| depths.get(block));
        let depth = needed.max().map_or(0, |depth| depth + 1);
        depths.insert(of.block, depth);
        let seconds = cpu_seconds(plan, of, !parents.contains(&of.block)).max(f64::MIN_POSITIVE);
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

/// What a task may take.
pub(crate) struct Limit<'a> {
    cap: &'a Cap,
    /// Wall seconds on the cap's clock.
    until: f64,
    /// Wall seconds that the evaluation at its end takes.
    evaluation: f64,
}

impl<'a> Limit<'a> {
    /// Gives this task of the plan its share, and its job no more steps than fit into that part of it. There is an evaluation (`evaluate`) at
    /// the end and one every `eval_every` steps (0 = none).
    pub(crate) fn of<T>(
        cap: &'a Cap,
        plan: &Plan,
        task: u32,
        job: &mut Job,
        part: f64,
        eval_every: u32,
        mut evaluate: impl FnMut(&Splats) -> T,
    ) -> Self {
        let start = cap.now();
        let share = cap.share(plan, task);
        let mut limit = Self { cap, until: (start + PATIENCE * share).min(cap.seconds), evaluation: 0.0 };
        let mut steps = 1;
        if share > 0.0 {
            evaluate(&job.initial);
            limit.evaluation = cap.now() - start;
            let Pace { step, window } = rehearse(job, cap, cap.now() + REHEARSAL * share);
            let on_the_way = if eval_every > 0 { limit.evaluation / f64::from(eval_every) } else { 0.0 };
            let available = part * (AIM * share - (cap.now() - start) - limit.evaluation);
            steps = fitting_steps(available, step * growth(job) + on_the_way, window, job.views.len());
        }
        if steps < job.steps {
            job.steps = steps;
            cap.shorten();
        }
        limit
    }

    /// Is it time to stop?
    pub(crate) fn is_over(&self) -> bool {
        self.cap.now() + self.evaluation >= self.until
    }
}

/// How many steps fit into `available` seconds, at least one. Every window is read once, at the first step that shows it.
fn fitting_steps(available: f64, step: f64, window: f64, windows: usize) -> u32 {
    let windows = windows as f64;
    let steps = match (available - windows * window) / step {
        steps if steps >= windows => steps,
        _ => available / (step + window),
    };
    // `as` saturates, and makes 0 of what is no number.
    (steps as u32).max(1)
}

/// Wall seconds.
struct Pace {
    /// Of a step with the first splats, averaged over the mips of the schedule.
    step: f64,
    /// Of reading a window.
    window: f64,
}

/// Times a few steps at each mip of the schedule, the finest first, until `until` on the cap's clock.
fn rehearse(job: &Job, cap: &Cap, until: f64) -> Pace {
    let count = job.views.len().min(REHEARSED);
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
        let mut recipe = Recipe { coarse, detail_factor: 0.0, views_per_step: 1, sh_from: [0.0; 3], ..job.recipe.clone() };
        // Never begins.
        recipe.growth.from = 2.0;
        let steps = 2 * count as u32;
        let trial = Job { initial: job.initial.clone(), views: &few, steps, recipe: &recipe, ..*job };
        let mut times = vec![cap.now()];
        // What fails here fails again in earnest, and is said then.
        let _ = train::train(trial, &mut |mut now| {
            // Which waits for the step.
            let _ = now.loss();
            times.push(cap.now());
            if cap.now() < until { Flow::Continue } else { Flow::Stop }
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
        if cap.now() >= until {
            break;
        }
    }
    pace.step /= weights.max(f64::MIN_POSITIVE);
    pace
}

/// How much more a step costs over the whole schedule, as splats are added, than with the first ones.
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
    use blocks::{Ground, PlanSettings, Task};
    use glam::{DQuat, DVec2};
    use scene::ArtefactId;

    use super::*;

    /// The root, two children side by side and one that waits for them; `steps` says their work.
    fn plan(steps: [u32; 4]) -> Plan {
        let block = |level, x, y| BlockId { level, x, y };
        let blocks = [block(0, 0, 0), block(1, 0, 0), block(1, 1, 0), block(1, 0, 1)];
        let task = |i: usize| Task {
            block: blocks[i],
            parent: blocks[i].parent(),
            context: if i == 3 { blocks[1..3].to_vec() } else { Vec::new() },
            views: Vec::new(),
            test_views: Vec::new(),
            points: 0,
            budget: 1000,
            steps: steps[i],
            rho_metres: 1.0,
            visible_splats: 1000,
            visible_context_splats: 0,
            memory_bytes: 0,
        };
        Plan {
            version: blocks::plan::VERSION,
            capture: ArtefactId([1; 32]),
            settings: PlanSettings::default(),
            backend: "none".into(),
            ground: Ground {
                ground_from_world: DQuat::IDENTITY,
                min: DVec2::ZERO,
                edge_metres: 8.0,
                height_metres: 0.0,
                near_metres: 1e300,
            },
            levels: 1,
            rho_metres: vec![2.0, 1.0],
            tasks: (0..4).map(task).collect(),
        }
    }

    #[test]
    fn what_is_left_is_shared_by_the_work_that_is_left() {
        let plan = plan([10, 20, 20, 50]);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
        let done = |tasks: &[u32]| tasks.iter().copied().collect::<BTreeSet<u32>>();
        let leaves = [false, true, true, true];
        let work = [0, 1, 2, 3].map(|i| cpu_seconds(&plan, &plan.tasks[i], leaves[i]));
        assert!((work[3] / work[1] - 2.5).abs() < 1e-9, "children cost as much as their steps");
        near(share(&plan, 0, &done(&[]), 1), work[0] / work.iter().sum::<f64>());
        near(share(&plan, 1, &done(&[0]), 1), 20.0 / 90.0);
        near(share(&plan, 3, &done(&[0, 1, 2]), 1), 1.0);
        // An attempt after one that was done all the same.
        near(share(&plan, 3, &done(&[0, 1, 2, 3]), 1), 1.0);
        // Two workers do the two in the middle at once, and nothing else.
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
