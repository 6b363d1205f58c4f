//! What a worker tells Prometheus: `docs/src/metrics.md` lists it.

use std::any::Any;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, OnceLock};

use dataset::windows::WindowStats;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;
use scene::ArtefactId;
use store::Store;

use crate::clock::cpu_seconds;
use crate::{Execute, ExecuteError, FailureKind, Flow, Report, TaskOrder};

/// Why a task had no result.
const FAILURES: [&str; 6] = ["input", "work", "infrastructure", "out_of_memory", "numeric", "panic"];

/// A worker's metrics. Clones share them.
#[derive(Debug, Clone)]
pub struct Metrics {
    tasks_done: Counter,
    tasks_stopped: Counter,
    tasks_failed: Family<[(&'static str, &'static str); 1], Counter>,
    pub(crate) steps: Counter,
    pub(crate) splats: Gauge,
    pub(crate) cache_bytes: Gauge,
    window_read_bytes: Counter,
    window_used_bytes: Counter,
    pub(crate) checkpoints: Counter,
    store: Arc<OnceLock<Store>>,
}

impl Default for Metrics {
    fn default() -> Self {
        let metrics = Self {
            tasks_done: Counter::default(),
            tasks_stopped: Counter::default(),
            tasks_failed: Family::default(),
            steps: Counter::default(),
            splats: Gauge::default(),
            cache_bytes: Gauge::default(),
            window_read_bytes: Counter::default(),
            window_used_bytes: Counter::default(),
            checkpoints: Counter::default(),
            store: Arc::default(),
        };
        // A rate over what appears later misses its first.
        for kind in FAILURES {
            metrics.tasks_failed.get_or_create(&[("kind", kind)]).inc_by(0);
        }
        metrics
    }
}

impl Metrics {
    /// Has them told, with what this process used.
    pub fn register(&self, registry: &mut Registry) {
        let worker = registry.sub_registry_with_prefix("plat_worker");
        worker.register("tasks_done", "Tasks finished", self.tasks_done.clone());
        worker.register("tasks_failed", "Tasks that ended without a result, by why", self.tasks_failed.clone());
        worker.register("tasks_stopped", "Tasks given back or not needed any more", self.tasks_stopped.clone());
        worker.register("steps", "Optimiser steps, those of healing included", self.steps.clone());
        worker.register("splats", "Splats of the block in hand", self.splats.clone());
        worker.register(
            "cache_bytes",
            "Bytes of windows that the block in hand keeps in memory",
            self.cache_bytes.clone(),
        );
        worker.register("window_read_bytes", "Bytes read for windows of photos", self.window_read_bytes.clone());
        worker.register(
            "window_used_bytes",
            "The part of them that the windows' own pixels take of their tiles",
            self.window_used_bytes.clone(),
        );
        worker.register("checkpoints", "Checkpoints left in the store", self.checkpoints.clone());
        worker.register_collector(Box::new(Usage { store: self.store.clone() }));
    }

    /// From now on what is moved from and to this store is told, as its meter shows it. The first one stays.
    pub fn moves_from_and_to(&self, store: Store) {
        let _ = self.store.set(store);
    }

    /// Counts what a reader of a task that ended has read.
    pub(crate) fn has_read(&self, stats: WindowStats) {
        self.window_read_bytes.inc_by(stats.bytes_read);
        self.window_used_bytes.inc_by(stats.bytes_used);
    }

    /// Bytes read for windows of photos in tasks that ended, and the part of them that the windows' own pixels take.
    pub fn window_bytes(&self) -> (u64, u64) {
        (self.window_read_bytes.get(), self.window_used_bytes.get())
    }

    /// Tasks finished so far.
    pub fn done(&self) -> u64 {
        self.tasks_done.get()
    }
}

/// What is known without being counted here.
#[derive(Debug)]
struct Usage {
    store: Arc<OnceLock<Store>>,
}

impl Collector for Usage {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        let traffic = self.store.get().map(Store::traffic).unwrap_or_default();
        let mut tell = |name: &str, help: &str, counter: &dyn EncodeMetric| {
            counter.encode(encoder.encode_descriptor(name, help, None, counter.metric_type())?)
        };
        let seconds = ConstCounter::new(cpu_seconds());
        tell("cpu_seconds", "CPU seconds of this process, user and system", &seconds)?;
        tell("store_read_bytes", "Bytes read from the store", &ConstCounter::new(traffic.read))?;
        tell("store_written_bytes", "Bytes written to the store", &ConstCounter::new(traffic.written))
    }
}

/// An executor whose tasks are counted.
#[derive(Debug)]
pub struct Measured<E> {
    executor: E,
    metrics: Metrics,
}

impl<E: Execute> Measured<E> {
    /// Counts what this one does.
    pub fn new(executor: E, metrics: Metrics) -> Self {
        Self { executor, metrics }
    }
}

impl<E: Execute> Execute for Measured<E> {
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        let mut stopped = false;
        let mut report = |line: Report| {
            let flow = report(line);
            stopped |= flow == Flow::Stop;
            flow
        };
        // Whoever waits for the task sees the panic as it was.
        let ended = catch_unwind(AssertUnwindSafe(|| self.executor.execute(order, &mut report)));
        match &ended {
            Ok(Ok(_)) => self.metrics.tasks_done.inc(),
            Ok(Err(_)) if stopped => self.metrics.tasks_stopped.inc(),
            Ok(Err(error)) => self.failed(word_of(error.kind)),
            Err(_) => self.failed("panic"),
        };
        ended.unwrap_or_else(|panic: Box<dyn Any + Send>| resume_unwind(panic))
    }
}

impl<E> Measured<E> {
    fn failed(&self, kind: &'static str) -> u64 {
        self.metrics.tasks_failed.get_or_create(&[("kind", kind)]).inc()
    }
}

/// One of [`FAILURES`].
fn word_of(kind: FailureKind) -> &'static str {
    match kind {
        FailureKind::Input => "input",
        FailureKind::Work | FailureKind::GivenBack => "work",
        FailureKind::Infrastructure => "infrastructure",
        FailureKind::OutOfMemory => "out_of_memory",
        FailureKind::Numeric => "numeric",
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    struct Fake;

    impl Execute for Fake {
        fn execute(
            &self,
            order: &TaskOrder,
            report: &mut (dyn FnMut(Report) -> Flow + Send),
        ) -> Result<ArtefactId, ExecuteError> {
            let flow = report(Report::default());
            match order.task {
                0 => Ok(order.plan),
                1 => panic!("broken"),
                task => {
                    assert_eq!(flow == Flow::Stop, task == 4);
                    Err(ExecuteError::of(if task == 2 { FailureKind::Input } else { FailureKind::Work }, ""))
                }
            }
        }
    }

    #[test]
    fn every_end_of_a_task_is_counted_once() {
        let metrics = Metrics::default();
        let measured = Measured::new(Fake, metrics.clone());
        for task in 0..5 {
            let (plan, inputs) = (ArtefactId([1; 32]), BTreeMap::new());
            let order = TaskOrder { job: 1, plan, task, attempt: 1, inputs, rate_permille: crate::FULL_RATE };
            let mut report = |_| if task == 4 { Flow::Stop } else { Flow::Continue };
            let ended = catch_unwind(AssertUnwindSafe(|| measured.execute(&order, &mut report)));
            assert_eq!((ended.is_err(), matches!(ended, Ok(Ok(_)))), (task == 1, task == 0));
        }
        let mut registry = Registry::default();
        metrics.register(&mut registry);
        let store = Store::open("memory://").unwrap();
        metrics.moves_from_and_to(store.clone());
        store.blocking().put_record("seven", "letters").unwrap();
        let text = telemetry::metrics::text(&registry).unwrap();
        for line in [
            "plat_worker_tasks_done_total 1",
            "plat_worker_tasks_stopped_total 1",
            "plat_worker_tasks_failed_total{kind=\"input\"} 1",
            "plat_worker_tasks_failed_total{kind=\"work\"} 1",
            "plat_worker_tasks_failed_total{kind=\"panic\"} 1",
            "plat_worker_store_read_bytes_total 0",
            "plat_worker_store_written_bytes_total 7",
        ] {
            assert!(text.lines().any(|other| other == line), "{line}: {text}");
        }
    }
}
