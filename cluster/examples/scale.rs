//! How much scheduling costs: a job of many tasks on many workers, in simulated time, without faults.
//!
//! ```text
//! cargo run --release -p cluster --example scale -- --tasks 100000 --workers 10000 [--json]
//! ```
//! The job is a quadtree as plans make them: a block waits for its parent and for up to three neighbours of the parent. Tasks
//! take about 30 seconds, half of the workers are twice as fast as the others, and every worker gives a sign of life four
//! times a lease. All figures but the simulated times are of this machine, one thread.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use cluster::sim::Random;
use cluster::{
    Action, AttemptId, Event, JobId, JobSpec, Offer, Outcome, Scheduler, Settings, TaskIndex, TaskNode, WorkerId,
};
use scene::ArtefactId;
use serde_json::json;

const JOB: JobId = JobId(1);
/// Milliseconds of a mean task on a worker of unit speed.
const TASK_MILLIS: u64 = 30_000;
/// A task that is asked about, for the share of scheduling in it: seconds.
const TASK_SECONDS: f64 = 30.0;

fn main() -> ExitCode {
    let (mut tasks, mut workers, mut as_json) = (100_000u32, 10_000u32, false);
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut number = || args.next().and_then(|value| value.parse::<u32>().ok()).filter(|number| *number > 0);
        let known = match arg.as_str() {
            "--tasks" => number().map(|number| tasks = number),
            "--workers" => number().map(|number| workers = number),
            "--json" => {
                as_json = true;
                Some(())
            }
            _ => None,
        };
        if known.is_none() {
            eprintln!("'{arg}' is not known or lacks a number; usage: scale [--tasks N] [--workers N] [--json]");
            return ExitCode::from(2);
        }
    }
    match measure(tasks, workers) {
        Ok(figures) if as_json => println!("{figures}"),
        Ok(figures) => {
            for (what, figure) in figures.as_object().into_iter().flatten() {
                println!("{what:>28}  {figure}");
            }
        }
        Err(what) => {
            eprintln!("{what}");
            return ExitCode::from(1);
        }
    }
    ExitCode::SUCCESS
}

/// What a worker does next, by when.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Due {
    Asks,
    Beats { attempt: AttemptId, began: u64, ends: u64 },
    Ends { attempt: AttemptId },
}

/// Time that the scheduler took, and for how many events.
#[derive(Default)]
struct Cost {
    spent: Duration,
    events: u64,
}

impl Cost {
    fn step(&mut self, scheduler: &mut Scheduler, now: u64, event: Event) -> Vec<Action> {
        let began = Instant::now();
        let actions = scheduler.step(now, event);
        self.spent += began.elapsed();
        self.events += 1;
        actions
    }

    fn per_second(&self) -> f64 {
        self.events as f64 / self.spent.as_secs_f64().max(1e-9)
    }
}

fn measure(tasks: u32, workers: u32) -> Result<serde_json::Value, String> {
    let mut random = Random::new(1);
    let settings = Settings::default();
    let mut scheduler = Scheduler::new(settings, 1);
    let spec = quadtree(tasks, &mut random);
    let nodes = spec.tasks.clone();
    let (mut submitting, mut asking, mut beating, mut ending) =
        (Cost::default(), Cost::default(), Cost::default(), Cost::default());
    submitting.step(&mut scheduler, 0, Event::Submitted { job: JOB, spec });

    let speed = |worker: u32| if worker.is_multiple_of(2) { 2 } else { 1 };
    let mut due = BinaryHeap::new();
    for worker in 0..workers {
        let offer = Offer { backend: "cpu".into(), memory_bytes: 16 << 30, cached: Vec::new() };
        scheduler.step(0, Event::Joined { worker: WorkerId(worker), offer });
        due.push(Reverse((random.between(0, 1000), worker, Due::Asks)));
    }
    let (mut granted, mut second, mut last) = (0u64, 0u64, 0u64);
    // Of each worker, what it is at: alarms of attempts that were stopped are dropped.
    let mut current: Vec<Option<AttemptId>> = vec![None; workers as usize];
    while let Some(Reverse((now, worker, what))) = due.pop() {
        let place = worker as usize;
        match what {
            Due::Asks => {
                for action in asking.step(&mut scheduler, now, Event::LeaseRequested { worker: WorkerId(worker) }) {
                    match action {
                        Action::Grant { attempt, .. } => {
                            granted += 1;
                            let record = scheduler.record(JOB, attempt.task).ok_or("a grant of no task")?;
                            second += u64::from(record.state.leases().len() > 1);
                            let work = nodes[attempt.task.0 as usize].work;
                            let takes = work * random.between(900, 1100) / 1000 / speed(worker) + 1;
                            let (began, ends) = (now, now + takes);
                            current[place] = Some(attempt);
                            due.push(Reverse((ends, worker, Due::Ends { attempt })));
                            let beat = now + settings.lease_millis / 4;
                            due.push(Reverse((beat, worker, Due::Beats { attempt, began, ends })));
                        }
                        Action::NothingYet { wait_millis, .. } if !scheduler.is_drained() => {
                            due.push(Reverse((now + wait_millis, worker, Due::Asks)));
                        }
                        _ => {}
                    }
                }
            }
            Due::Beats { attempt, began, ends } if current[place] == Some(attempt) && now < ends => {
                let done_permille = Some(((now - began) * 1000 / (ends - began)) as u16);
                let actions = beating.step(&mut scheduler, now, Event::Progressed { attempt, done_permille });
                let [Action::Accepted { .. }] = &actions[..] else { return Err(format!("{actions:?}")) };
                let beat = now + settings.lease_millis / 4;
                due.push(Reverse((beat, worker, Due::Beats { attempt, began, ends })));
            }
            Due::Ends { attempt } if current[place] == Some(attempt) => {
                let artefact = ArtefactId::of(&attempt.task.0.to_le_bytes());
                let event = Event::Completed { attempt, artefact, followers: Vec::new() };
                for action in ending.step(&mut scheduler, now, event) {
                    match action {
                        Action::Stop { worker, .. } => {
                            current[worker.0 as usize] = None;
                            due.push(Reverse((now, worker.0, Due::Asks)));
                        }
                        Action::JobFinished { outcome, .. } => {
                            last = now;
                            if outcome != Outcome::Done {
                                return Err(format!("the job ended {outcome:?}"));
                            }
                        }
                        _ => {}
                    }
                }
                current[place] = None;
                due.push(Reverse((now, worker, Due::Asks)));
            }
            _ => {}
        }
    }

    let speeds: u64 = (0..workers).map(speed).sum();
    let ideal = longest_chain(&nodes) / 2;
    let ideal = ideal.max(nodes.iter().map(|node| node.work).sum::<u64>() / speeds);
    let steps = [&submitting, &asking, &beating, &ending];
    let seconds: f64 = steps.iter().map(|cost| cost.spent.as_secs_f64()).sum();
    let share = seconds / f64::from(tasks) / TASK_SECONDS;
    Ok(json!({
        "tasks": tasks,
        "workers": workers,
        "scheduler_seconds": seconds,
        "submit_seconds": submitting.spent.as_secs_f64(),
        "decisions": asking.events,
        "decisions_per_second": asking.per_second(),
        "grants": granted,
        "second_attempts": second,
        "heartbeats": beating.events,
        "heartbeats_per_second": beating.per_second(),
        "results_per_second": ending.per_second(),
        "drain_seconds": last as f64 / 1e3,
        "ideal_seconds": ideal as f64 / 1e3,
        "drain_over_ideal": last as f64 / ideal as f64,
        "share_of_30_s_tasks": share,
        "peak_memory_bytes": peak_memory(),
    }))
}

/// A quadtree in the order of its levels, its work between half and one and a half of the mean.
fn quadtree(count: u32, random: &mut Random) -> JobSpec {
    let mut tasks = Vec::with_capacity(count as usize);
    for task in 0..count {
        let mut dependencies = Vec::new();
        if task > 0 {
            let parent = (task - 1) / 4;
            dependencies.push(TaskIndex(parent));
            // Neighbours of the parent of its own level, roughly: what the context is cut from.
            dependencies.extend((1..=3).map(|n| TaskIndex(parent.saturating_sub(n))));
        }
        let work = random.between(TASK_MILLIS / 2, TASK_MILLIS * 3 / 2);
        tasks.push(TaskNode { dependencies, work, memory_bytes: random.between(1 << 30, 8 << 30) });
    }
    JobSpec { backend: "cpu".into(), priority: 0, weight: 1, tasks }
}

/// The work on the longest chain; tasks come after those that they depend on.
fn longest_chain(nodes: &[TaskNode]) -> u64 {
    let mut ends: Vec<u64> = Vec::with_capacity(nodes.len());
    for node in nodes {
        let begins = node.dependencies.iter().map(|task| ends[task.0 as usize]).max().unwrap_or(0);
        ends.push(begins + node.work);
    }
    ends.into_iter().max().unwrap_or(0)
}

/// Of this process, bytes, where the system tells.
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
}
