//! The worker's Prometheus metrics, which `docs/src/metrics.md` lists.

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
use crate::task::{Execute, ExecuteError, Flow, Report, TaskOrder};
use proto::FailureKind;

/// Values of the label `kind` of failed tasks.
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
        // Present from the start as 0: a rate over a series that appears later misses its first increment.
        for kind in FAILURES {
            metrics.tasks_failed.get_or_create(&[("kind", kind)]).inc_by(0);
        }
        metrics
    }
}

impl Metrics {
    /// Registers them under `plat_worker_`, with the CPU time of this process.
    pub fn register(&self, registry: &mut Registry) {
        let worker = registry.sub_registry_with_prefix("plat_worker");
        worker.register("tasks_done", "Tasks finished", self.tasks_done.clone());
        worker.register(
            "tasks_failed",
            "Tasks that ended without a result, by failure kind",
            self.tasks_failed.clone(),
        );
        worker.register("tasks_stopped", "Tasks given back or no longer needed", self.tasks_stopped.clone());
        worker.register("steps", "Optimiser steps, those of recovery after pruning included", self.steps.clone());
        worker.register("splats", "Splats of the current block", self.splats.clone());
        worker.register(
            "cache_bytes",
            "Bytes of decoded windows that are cached for the current block",
            self.cache_bytes.clone(),
        );
        worker.register("window_read_bytes", "Bytes read for windows of photos", self.window_read_bytes.clone());
        worker.register(
            "window_used_bytes",
            "Bytes of those that belong to the windows' own pixels",
            self.window_used_bytes.clone(),
        );
        worker.register("checkpoints", "Checkpoints written to the store", self.checkpoints.clone());
        worker.register_collector(Box::new(Usage { store: self.store.clone() }));
    }

    /// Exports the traffic of this store from now on. Later calls have no effect.
    pub fn export_traffic_of(&self, store: Store) {
        let _ = self.store.set(store);
    }

    /// Adds what a task's window reader has read.
    pub(crate) fn count_reads(&self, stats: WindowStats) {
        self.window_read_bytes.inc_by(stats.bytes_read);
        self.window_used_bytes.inc_by(stats.bytes_used);
    }

    /// Bytes read for windows of photos in ended tasks, and those of them that belong to the windows' own pixels.
    pub fn window_bytes(&self) -> (u64, u64) {
        (self.window_read_bytes.get(), self.window_used_bytes.get())
    }

    /// Tasks finished so far.
    pub fn tasks_done(&self) -> u64 {
        self.tasks_done.get()
    }
}

/// Values that are read at each scrape: CPU time and store traffic.
#[derive(Debug)]
struct Usage {
    store: Arc<OnceLock<Store>>,
}

impl Collector for Usage {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        let traffic = self.store.get().map(Store::traffic).unwrap_or_default();
        let mut encode = |name: &str, help: &str, counter: &dyn EncodeMetric| {
            counter.encode(encoder.encode_descriptor(name, help, None, counter.metric_type())?)
        };
        let seconds = ConstCounter::new(cpu_seconds());
        encode("cpu_seconds", "CPU seconds of this process, user and system", &seconds)?;
        encode("store_read_bytes", "Bytes read from the store", &ConstCounter::new(traffic.read))?;
        encode("store_written_bytes", "Bytes written to the store", &ConstCounter::new(traffic.written))
    }
}

/// An executor that counts its tasks.
#[derive(Debug)]
pub struct CountedExecutor<E> {
    executor: E,
    metrics: Metrics,
}

impl<E: Execute> CountedExecutor<E> {
    /// Counts the tasks of `executor`.
    pub fn new(executor: E, metrics: Metrics) -> Self {
        Self { executor, metrics }
    }
}

impl<E: Execute> Execute for CountedExecutor<E> {
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
        // The panic is passed on unchanged.
        let ended = catch_unwind(AssertUnwindSafe(|| self.executor.execute(order, &mut report)));
        match &ended {
            Ok(Ok(_)) => self.metrics.tasks_done.inc(),
            Ok(Err(_)) if stopped => self.metrics.tasks_stopped.inc(),
            Ok(Err(error)) => self.count_failure(label_of(error.kind)),
            Err(_) => self.count_failure("panic"),
        };
        ended.unwrap_or_else(|panic: Box<dyn Any + Send>| resume_unwind(panic))
    }
}

impl<E> CountedExecutor<E> {
    fn count_failure(&self, kind: &'static str) -> u64 {
        self.metrics.tasks_failed.get_or_create(&[("kind", kind)]).inc()
    }
}

/// One of [`FAILURES`].
fn label_of(kind: FailureKind) -> &'static str {
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
    fn each_task_end_is_counted_once() {
        let metrics = Metrics::default();
        let counted = CountedExecutor::new(Fake, metrics.clone());
        for task in 0..5 {
            let (plan, inputs) = (ArtefactId([1; 32]), BTreeMap::new());
            let order = TaskOrder { job: 1, plan, task, attempt: 1, inputs, rate_permille: crate::task::FULL_RATE };
            let mut report = |_| if task == 4 { Flow::Stop } else { Flow::Continue };
            let ended = catch_unwind(AssertUnwindSafe(|| counted.execute(&order, &mut report)));
            assert_eq!((ended.is_err(), matches!(ended, Ok(Ok(_)))), (task == 1, task == 0));
        }
        let mut registry = Registry::default();
        metrics.register(&mut registry);
        let store = Store::open("memory://").unwrap();
        metrics.export_traffic_of(store.clone());
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
