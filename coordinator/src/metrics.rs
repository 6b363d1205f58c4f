//! The coordinator's Prometheus metrics, which `docs/src/metrics.md` lists. The actor updates them once a second. A scrape reads atomics, so
//! neither waits for the other.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use cluster::{Counts, Outcome, Scheduler, Tally};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

/// Backends with a label of their own; workers of further ones count as `other`.
const BACKENDS_LIMIT: usize = 16;
/// Characters of a label whose text comes from a worker.
const LABEL_LIMIT: usize = 64;
/// Histogram buckets of the duration of a durable write, seconds.
const WRITE_SECONDS: [f64; 12] = [0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0];
/// Values of the label `state` of jobs.
const JOB_STATES: [&str; 5] = ["running", "paused", "done", "incomplete", "cancelled"];
/// States of a task, with the metrics' help texts.
const TASK_STATES: [(&str, &str); 7] = [
    ("waiting", "Tasks whose parent or context is not done"),
    ("ready", "Tasks that wait for a worker"),
    ("delayed", "Tasks that wait before their next attempt"),
    ("leased", "Tasks that a worker executes"),
    ("done", "Tasks with a result"),
    ("failed", "Tasks with wrong input"),
    ("quarantined", "Tasks that reached their limit of attempts"),
];

type Label<V> = [(&'static str, V); 1];

/// A coordinator's metrics. Those of jobs, tasks and workers are 0 while it stands by.
#[derive(Debug)]
pub struct Metrics {
    leader: Gauge,
    epoch: Gauge,
    jobs: Family<Label<&'static str>, Gauge>,
    /// In the order of [`TASK_STATES`].
    tasks: [Gauge; 7],
    workers: Family<Label<String>, Gauge>,
    /// All labels of `workers` so far.
    backends: Mutex<BTreeSet<String>>,
    steps: Counter,
    grants: Counter,
    duplicates: Counter,
    completions: Counter,
    refusals: Counter,
    failures: Family<Label<&'static str>, Counter>,
    durable_writes: Histogram,
}

impl Default for Metrics {
    fn default() -> Self {
        let metrics = Self {
            leader: Gauge::default(),
            epoch: Gauge::default(),
            jobs: Family::default(),
            tasks: Default::default(),
            workers: Family::default(),
            backends: Mutex::default(),
            steps: Counter::default(),
            grants: Counter::default(),
            duplicates: Counter::default(),
            completions: Counter::default(),
            refusals: Counter::default(),
            failures: Family::default(),
            durable_writes: Histogram::new(WRITE_SECONDS),
        };
        // All series are present from the start as 0: a rate over one that appears later misses its first increment.
        for state in JOB_STATES {
            metrics.jobs.get_or_create(&[("state", state)]).set(0);
        }
        for kind in Tally::ENDS {
            metrics.failures.get_or_create(&[("kind", kind)]).inc_by(0);
        }
        metrics
    }
}

impl Metrics {
    /// Registers them under `plat_`.
    pub fn register(&self, registry: &mut Registry) {
        let plat = registry.sub_registry_with_prefix("plat");
        plat.register("leader", "1 while this coordinator leads, 0 while it stands by", self.leader.clone());
        plat.register("epoch", "Epoch under which this coordinator leads or last led", self.epoch.clone());
        plat.register("jobs", "Known jobs by state", self.jobs.clone());
        for ((state, help), tasks) in TASK_STATES.into_iter().zip(&self.tasks) {
            plat.register(format!("tasks_{state}"), help, tasks.clone());
        }
        plat.register("workers", "Connected workers by backend", self.workers.clone());
        plat.register("scheduler_steps", "Events that the scheduler processed", self.steps.clone());
        plat.register("grants", "Attempts granted to workers", self.grants.clone());
        plat.register("duplicates", "Speculative second attempts at late tasks", self.duplicates.clone());
        plat.register("completions", "Results accepted", self.completions.clone());
        plat.register("refusals", "Refused calls of attempts that no longer held their lease", self.refusals.clone());
        plat.register("failures", "Attempts that ended without a result, by failure kind", self.failures.clone());
        let help = "Duration of making a batch of changes durable";
        plat.register("durable_write_seconds", help, self.durable_writes.clone());
    }

    /// Marks the coordinator as leader until the returned value is dropped.
    pub(crate) fn start_leading(&self, epoch: u64) -> LeaderMetrics<'_> {
        self.epoch.set(as_gauge(epoch));
        self.leader.set(1);
        LeaderMetrics { metrics: self, seen: Tally::default() }
    }

    /// Records the duration of a durable write.
    pub(crate) fn observe_write(&self, duration: Duration) {
        self.durable_writes.observe(duration.as_secs_f64());
    }

    fn count_jobs(&self, scheduler: &Scheduler) {
        let (mut jobs, mut tasks) = ([0; JOB_STATES.len()], [0; TASK_STATES.len()]);
        for job in scheduler.jobs() {
            let state = match scheduler.finished(job) {
                None => usize::from(scheduler.is_paused(job)),
                Some(Outcome::Done) => 2,
                Some(Outcome::Incomplete) => 3,
                Some(Outcome::Cancelled) => 4,
            };
            jobs[state] += 1;
            let Counts { waiting, ready, delayed, leased, done, failed, quarantined } = scheduler.counts(job);
            let counts = [waiting, ready, delayed, leased, done, failed, quarantined];
            tasks.iter_mut().zip(counts).for_each(|(sum, count)| *sum += u64::from(count));
        }
        self.set_jobs(jobs, tasks);
    }

    fn set_jobs(&self, jobs: [u64; JOB_STATES.len()], tasks: [u64; TASK_STATES.len()]) {
        for (state, count) in JOB_STATES.into_iter().zip(jobs) {
            self.jobs.get_or_create(&[("state", state)]).set(as_gauge(count));
        }
        for (gauge, count) in self.tasks.iter().zip(tasks) {
            gauge.set(as_gauge(count));
        }
    }

    fn count_workers<'a>(&self, backends: impl Iterator<Item = (&'a str, usize)>) {
        let mut known = self.backends.lock().unwrap_or_else(PoisonError::into_inner);
        // A backend whose workers have all left is exported as 0.
        let mut counts: BTreeMap<String, u64> = known.iter().map(|backend| (backend.clone(), 0)).collect();
        for (backend, workers) in backends {
            let mut label = label_of(backend);
            if !known.contains(&label) && known.len() >= BACKENDS_LIMIT {
                label = "other".into();
            }
            known.insert(label.clone());
            *counts.entry(label).or_default() += workers as u64;
        }
        for (backend, count) in counts {
            self.workers.get_or_create(&[("backend", backend)]).set(as_gauge(count));
        }
    }
}

/// The metrics of a coordinator while it leads.
pub(crate) struct LeaderMetrics<'a> {
    metrics: &'a Metrics,
    /// The scheduler's counters at the last update.
    seen: Tally,
}

impl<'a> LeaderMetrics<'a> {
    /// The coordinator's metrics.
    pub(crate) fn metrics(&self) -> &'a Metrics {
        self.metrics
    }

    /// Updates the metrics from the scheduler. Takes time proportional to the number of jobs and backends.
    pub(crate) fn update(&mut self, scheduler: &Scheduler) {
        let (now, seen, metrics) = (scheduler.tally(), self.seen, self.metrics);
        metrics.steps.inc_by(now.steps - seen.steps);
        metrics.grants.inc_by(now.grants - seen.grants);
        metrics.duplicates.inc_by(now.speculative_attempts - seen.speculative_attempts);
        metrics.completions.inc_by(now.completions - seen.completions);
        metrics.refusals.inc_by(now.refusals - seen.refusals);
        for (place, kind) in Tally::ENDS.into_iter().enumerate() {
            metrics.failures.get_or_create(&[("kind", kind)]).inc_by(now.ends[place] - seen.ends[place]);
        }
        self.seen = now;
        metrics.count_jobs(scheduler);
        metrics.count_workers(scheduler.backends());
    }
}

impl Drop for LeaderMetrics<'_> {
    fn drop(&mut self) {
        self.metrics.leader.set(0);
        self.metrics.set_jobs(Default::default(), Default::default());
        self.metrics.count_workers(std::iter::empty());
    }
}

fn as_gauge(count: u64) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

/// A worker's text as a label: truncated, with characters that need escaping replaced.
fn label_of(text: &str) -> String {
    let plain = |character: char| {
        let fine = character.is_ascii_alphanumeric() || ".-_+:/()".contains(character);
        if fine { character } else { '_' }
    };
    text.chars().take(LABEL_LIMIT).map(plain).collect()
}

#[cfg(test)]
mod tests {
    use cluster::{Event, JobId, JobSpec, Offer, Settings, TaskNode, WorkerId};

    use super::*;

    #[test]
    fn labels_from_workers_are_bounded() {
        let metrics = Metrics::default();
        let names: Vec<String> = (0..100).map(|i| format!("gpu\"{i}\\{}", "x".repeat(100))).collect();
        metrics.count_workers(names.iter().map(|name| (name.as_str(), 3)));
        let mut registry = Registry::default();
        metrics.register(&mut registry);
        let text = telemetry::metrics::text(&registry).unwrap();
        let lines: Vec<&str> = text.lines().filter(|line| line.starts_with("plat_workers{")).collect();
        assert_eq!(lines.len(), BACKENDS_LIMIT + 1, "{lines:?}");
        assert!(lines.contains(&"plat_workers{backend=\"other\"} 252"), "{lines:?}");
        assert!(lines.iter().all(|line| line.len() < LABEL_LIMIT + 40 && !line.contains('\\')), "{lines:?}");
    }

    #[test]
    fn a_former_leader_keeps_only_its_counters() {
        let metrics = Metrics::default();
        let mut registry = Registry::default();
        metrics.register(&mut registry);
        let has = |line: &str| telemetry::metrics::text(&registry).unwrap().lines().any(|other| other == line);
        for epoch in [3, 5] {
            let mut scheduler = Scheduler::new(Settings::default(), epoch);
            let mut leading = metrics.start_leading(epoch);
            let spec = JobSpec { backend: "b".into(), tasks: vec![TaskNode::default(); 4], ..JobSpec::default() };
            scheduler.step(1, Event::Submitted { job: JobId(1), spec });
            let offer = Offer { backend: "b".into(), ..Offer::default() };
            scheduler.step(1, Event::Joined { worker: WorkerId(0), offer });
            leading.update(&scheduler);
            // The second request reveals that the first grant was lost.
            scheduler.step(2, Event::LeaseRequested { worker: WorkerId(0) });
            scheduler.step(2, Event::LeaseRequested { worker: WorkerId(0) });
            leading.update(&scheduler);
            assert!(has("plat_leader 1") && has(&format!("plat_epoch {epoch}")));
            assert!(has("plat_tasks_ready 3") && has("plat_tasks_leased 1") && has("plat_workers{backend=\"b\"} 1"));
            assert!(has("plat_jobs{state=\"running\"} 1") && has("plat_jobs{state=\"paused\"} 0"));
        }
        assert!(has("plat_leader 0") && has("plat_epoch 5"));
        assert!(has("plat_tasks_ready 0") && has("plat_workers{backend=\"b\"} 0"));
        assert!(has("plat_grants_total 4") && has("plat_scheduler_steps_total 8"));
        assert!(has("plat_failures_total{kind=\"lost\"} 2") && has("plat_failures_total{kind=\"input\"} 0"));
    }
}
