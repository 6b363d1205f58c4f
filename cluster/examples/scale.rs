//! Benchmark of the scheduler: a job of many tasks on many workers, in simulated time, without faults.
//!
//! ```text
//! cargo run --release -p cluster --example scale -- --tasks 100000 --workers 10000 [--json]
//! ```
//! The job is a quadtree like those of plans: a block depends on its parent and on up to three neighbours of the
//! parent. Tasks take about 30 seconds. Half of the workers are twice as fast as the others. Every worker sends four
//! heartbeats per lease. All figures except simulated times are measured on this machine with one thread.

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
/// Mean duration of a task on a worker of unit speed, milliseconds.
const TASK_MILLIS: u64 = 30_000;
/// Reference task duration for the share of scheduling time, seconds.
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
            eprintln!("'{arg}' is unknown or has no number; usage: scale [--tasks N] [--workers N] [--json]");
            return ExitCode::from(2);
        }
    }
    match measure(tasks, workers) {
        Ok(figures) if as_json => println!("{figures}"),
        Ok(figures) => {
            for (name, figure) in figures.as_object().into_iter().flatten() {
                println!("{name:>28}  {figure}");
            }
        }
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(1);
        }
    }
    ExitCode::SUCCESS
}

/// The next action of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Due {
    Request,
    Heartbeat { attempt: AttemptId, began: u64, ends: u64 },
    Completion { attempt: AttemptId },
}

/// Time spent in the scheduler and number of events.
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

/// Costs by kind of event, and the totals of a run.
#[derive(Default)]
struct Run {
    submitting: Cost,
    requesting: Cost,
    heartbeats: Cost,
    completing: Cost,
    granted: u64,
    speculative: u64,
    /// Simulated time of the end of the job, milliseconds.
    end_millis: u64,
}

/// Simulates the job and measures the scheduler.
fn measure(tasks: u32, workers: u32) -> Result<serde_json::Value, String> {
    let mut random = Random::new(1);
    let settings = Settings::default();
    let mut scheduler = Scheduler::new(settings, 1);
    let spec = quadtree(tasks, &mut random);
    let nodes = spec.tasks.clone();
    let mut run = Run::default();
    run.submitting.step(&mut scheduler, 0, Event::Submitted { job: JOB, spec });

    let speed = |worker: u32| if worker.is_multiple_of(2) { 2 } else { 1 };
    let mut due = BinaryHeap::new();
    for worker in 0..workers {
        let offer = Offer { backend: "cpu".into(), memory_bytes: 16 << 30, cached: Vec::new() };
        scheduler.step(0, Event::Joined { worker: WorkerId(worker), offer });
        due.push(Reverse((random.between(0, 1000), worker, Due::Request)));
    }
    // The current attempt of each worker. Timers of stopped attempts are ignored.
    let mut current: Vec<Option<AttemptId>> = vec![None; workers as usize];
    while let Some(Reverse((now, worker, next))) = due.pop() {
        let place = worker as usize;
        match next {
            Due::Request => {
                for action in
                    run.requesting.step(&mut scheduler, now, Event::LeaseRequested { worker: WorkerId(worker) })
                {
                    match action {
                        Action::Grant { attempt, .. } => {
                            run.granted += 1;
                            let record = scheduler.record(JOB, attempt.task).ok_or("a grant of an unknown task")?;
                            run.speculative += u64::from(record.state.leases().len() > 1);
                            let work = nodes[attempt.task.0 as usize].work;
                            let takes = work * random.between(900, 1100) / 1000 / speed(worker) + 1;
                            let (began, ends) = (now, now + takes);
                            current[place] = Some(attempt);
                            due.push(Reverse((ends, worker, Due::Completion { attempt })));
                            let beat = now + settings.lease_millis / 4;
                            due.push(Reverse((beat, worker, Due::Heartbeat { attempt, began, ends })));
                        }
                        Action::NothingYet { wait_millis, .. } if !scheduler.is_drained() => {
                            due.push(Reverse((now + wait_millis, worker, Due::Request)));
                        }
                        _ => {}
                    }
                }
            }
            Due::Heartbeat { attempt, began, ends } if current[place] == Some(attempt) && now < ends => {
                let done_permille = Some(((now - began) * 1000 / (ends - began)) as u16);
                let actions = run.heartbeats.step(&mut scheduler, now, Event::Progressed { attempt, done_permille });
                let [Action::Accepted { .. }] = &actions[..] else { return Err(format!("{actions:?}")) };
                let beat = now + settings.lease_millis / 4;
                due.push(Reverse((beat, worker, Due::Heartbeat { attempt, began, ends })));
            }
            Due::Completion { attempt } if current[place] == Some(attempt) => {
                let artefact = ArtefactId::of(&attempt.task.0.to_le_bytes());
                let event = Event::Completed { attempt, artefact, follow_ups: Vec::new() };
                for action in run.completing.step(&mut scheduler, now, event) {
                    match action {
                        Action::Stop { worker, .. } => {
                            current[worker.0 as usize] = None;
                            due.push(Reverse((now, worker.0, Due::Request)));
                        }
                        Action::JobFinished { outcome, .. } => {
                            run.end_millis = now;
                            if outcome != Outcome::Done {
                                return Err(format!("the job ended {outcome:?}"));
                            }
                        }
                        _ => {}
                    }
                }
                current[place] = None;
                due.push(Reverse((now, worker, Due::Request)));
            }
            _ => {}
        }
    }

    Ok(figures(&run, &nodes, (0..workers).map(speed).sum(), workers))
}

/// The figures of a run. `speeds` is the sum of all workers' speeds.
fn figures(run: &Run, nodes: &[TaskNode], speeds: u64, workers: u32) -> serde_json::Value {
    let tasks = nodes.len() as u32;
    let ideal = critical_path_work(nodes) / 2;
    let ideal = ideal.max(nodes.iter().map(|node| node.work).sum::<u64>() / speeds);
    let steps = [&run.submitting, &run.requesting, &run.heartbeats, &run.completing];
    let seconds: f64 = steps.iter().map(|cost| cost.spent.as_secs_f64()).sum();
    let share = seconds / f64::from(tasks) / TASK_SECONDS;
    json!({
        "tasks": tasks,
        "workers": workers,
        "scheduler_seconds": seconds,
        "submit_seconds": run.submitting.spent.as_secs_f64(),
        "decisions": run.requesting.events,
        "decisions_per_second": run.requesting.per_second(),
        "grants": run.granted,
        "second_attempts": run.speculative,
        "heartbeats": run.heartbeats.events,
        "heartbeats_per_second": run.heartbeats.per_second(),
        "results_per_second": run.completing.per_second(),
        "drain_seconds": run.end_millis as f64 / 1e3,
        "ideal_seconds": ideal as f64 / 1e3,
        "drain_over_ideal": run.end_millis as f64 / ideal as f64,
        "share_of_30_s_tasks": share,
        "peak_memory_bytes": peak_memory(),
    })
}

/// A quadtree in level order. The work of tasks is between 0.5 and 1.5 of the mean.
fn quadtree(count: u32, random: &mut Random) -> JobSpec {
    let mut tasks = Vec::with_capacity(count as usize);
    for task in 0..count {
        let mut dependencies = Vec::new();
        if task > 0 {
            let parent = (task - 1) / 4;
            dependencies.push(TaskIndex(parent));
            // Approximately the neighbours of the parent on its level, which provide the context.
            dependencies.extend((1..=3).map(|n| TaskIndex(parent.saturating_sub(n))));
        }
        let work = random.between(TASK_MILLIS / 2, TASK_MILLIS * 3 / 2);
        tasks.push(TaskNode { dependencies, work, memory_bytes: random.between(1 << 30, 8 << 30) });
    }
    JobSpec { backend: "cpu".into(), priority: 0, weight: 1, tasks }
}

/// The work on the critical path. Tasks are in topological order.
fn critical_path_work(nodes: &[TaskNode]) -> u64 {
    let mut ends: Vec<u64> = Vec::with_capacity(nodes.len());
    for node in nodes {
        let begins = node.dependencies.iter().map(|task| ends[task.0 as usize]).max().unwrap_or(0);
        ends.push(begins + node.work);
    }
    ends.into_iter().max().unwrap_or(0)
}

/// Peak memory of this process, bytes, if the system reports it.
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
}
