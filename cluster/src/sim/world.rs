//! The simulated world: the event queue, and the state of all nodes, workers and jobs.

mod coordinators;
mod end_checks;
mod faults;
mod network;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use scene::ArtefactId;

use crate::events::{Action, Event};
use crate::sim::coordinator::{Node, StoreFaults};
use crate::sim::ground_truth::{JobGroundTruth, LARGEST_BYTES};
use crate::sim::random::Random;
use crate::sim::report::{Options, Report};
use crate::sim::store::Store;
use crate::sim::worker::{SimWorker, WorkFaults};
use crate::types::{AttemptId, JobId, Offer, Settings, TaskIndex, WorkerId};

const SETTINGS: Settings = Settings {
    lease_millis: 4000,
    stall_millis: 60_000,
    worker_timeout_millis: 20_000,
    unschedulable_millis: 30_000,
    exclusion_millis: 5000,
    backoff_millis: 500,
    backoff_limit_millis: 8000,
    poll_millis: 300,
    failures_limit: 3,
    losses_limit: 6,
    infrastructure_failures_limit: 8,
    failed_workers_limit: 3,
    tasks_limit: 1000,
    jobs_limit: 10,
    speculation: true,
    plan_order: false,
};
/// Number of coordinator nodes.
const NODES: usize = 2;
/// Liveness limit: all jobs must end within this time after the faults stop. A single full-size worker needs some
/// minutes for all work.
const LIVENESS_LIMIT_MILLIS: u64 = 3_600_000;

/// An event of the simulation, as printed in the trace.
#[derive(Debug, Clone)]
enum TraceEvent {
    /// A worker's request arrives at a coordinator.
    RequestArrives {
        node: usize,
        worker: usize,
        incarnation: u64,
        call: u64,
        event: Event,
    },
    /// An action arrives at a worker. `call`: the request that it answers.
    ReplyArrives {
        worker: usize,
        incarnation: u64,
        call: Option<u64>,
        action: Action,
    },
    /// A worker's timer fires, unless it was reset.
    TimerFires {
        worker: usize,
        timer: u64,
    },
    WorkerStarts {
        worker: usize,
    },
    /// A coordinator's periodic tick.
    Ticks {
        node: usize,
        incarnation: u64,
    },
    NodeStarts {
        node: usize,
    },
    /// A user sends a command to the leader and repeats it until it is answered.
    UserRequest {
        event: Event,
    },
    /// Injects a fault.
    Fault,
    /// All faults stop.
    FaultsEnd,
    /// A user retries failed tasks.
    Review,
}

pub(crate) struct World {
    random: Random,
    options: Options,
    now: u64,
    order: u64,
    queue: BTreeMap<(u64, u64), TraceEvent>,
    faults_ended: bool,
    faults_end: u64,
    /// Rate of lost, late and duplicated messages, per mille.
    loss_permille: u64,
    store_faults: StoreFaults,
    work_faults: WorkFaults,
    store: Store,
    nodes: Vec<Node>,
    workers: Vec<SimWorker>,
    jobs: BTreeMap<JobId, JobGroundTruth>,
    /// Partitioned pairs of worker and coordinator.
    partitions: BTreeSet<(usize, usize)>,
    granted: BTreeSet<AttemptId>,
    /// Results whose acceptance was acknowledged to a worker.
    committed: BTreeMap<(JobId, TaskIndex), ArtefactId>,
    report: Report,
}

impl World {
    pub(crate) fn new(seed: u64, options: Options) -> Self {
        let mut random = Random::new(seed);
        let backends = ["cpu", "gpu"];
        let kinds = random.between(1, 3) as usize;
        let count = random.between(2, 6) as usize;
        let worker = |place: usize, random: &mut Random| {
            // One worker of each backend has enough memory for every task.
            let memory_bytes =
                if place < kinds { LARGEST_BYTES } else { random.between(LARGEST_BYTES / 4, LARGEST_BYTES) };
            let offer = Offer { backend: backends[place % kinds].into(), memory_bytes, cached: Vec::new() };
            SimWorker {
                id: WorkerId(place as u32),
                offer,
                speed: [200, 1000, 4000][random.between(0, 3) as usize],
                incarnation: 0,
                timer: 0,
                up: false,
                hangs_until: 0,
                node: 0,
                call: 0,
                unanswered: 0,
                running: None,
            }
        };
        let workers = (0..count.max(kinds)).map(|place| worker(place, &mut random)).collect();
        let jobs = (1..=random.between(1, 4)).map(JobId).map(|id| {
            let backend = backends[random.between(0, kinds as u64) as usize];
            (id, JobGroundTruth::new(id, backend, &mut random))
        });
        let jobs = jobs.collect();
        let [loss_permille, store, slow, fails] = [120, 60, 150, 120].map(|max| random.between(0, max));
        let mut world = Self {
            faults_end: random.between(10_000, 120_000),
            random,
            options,
            now: 0,
            order: 0,
            queue: BTreeMap::new(),
            faults_ended: false,
            loss_permille,
            store_faults: StoreFaults(store),
            work_faults: WorkFaults { slow, fails },
            store: Store::default(),
            nodes: (0..NODES).map(|_| Node::default()).collect(),
            workers,
            jobs,
            partitions: BTreeSet::new(),
            granted: BTreeSet::new(),
            committed: BTreeMap::new(),
            report: Report::default(),
        };
        world.schedule_initial_events();
        world
    }

    pub(crate) fn report(mut self) -> Report {
        for node in 0..NODES {
            let journal = self.nodes[node].stop();
            self.report.journals.extend(journal);
        }
        self.report.millis = self.now;
        self.report
    }

    /// Runs the simulation to its end.
    pub(crate) fn run(&mut self, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<(), String> {
        while let Some(((now, _), event)) = self.queue.pop_first() {
            self.now = now;
            trace(format_args!("{now:>8} {event:?}"));
            self.handle_event(event)?;
            if self.faults_ended && self.is_over() {
                return self.check_end();
            }
            if now > self.faults_end + LIVENESS_LIMIT_MILLIS {
                return Err(format!(
                    "{} ms after the faults stopped: {}",
                    now - self.faults_end,
                    self.unfinished_work()
                ));
            }
        }
        Err("the event queue is empty".into())
    }

    fn handle_event(&mut self, event: TraceEvent) -> Result<(), String> {
        match event {
            TraceEvent::RequestArrives { node, worker, incarnation, call, event } => {
                self.on_request(node, worker, incarnation, call, event)?
            }
            TraceEvent::ReplyArrives { worker, incarnation, call, action } => {
                self.on_reply(worker, incarnation, call, action)?
            }
            TraceEvent::TimerFires { worker, timer } => self.on_timer(worker, timer),
            TraceEvent::WorkerStarts { worker } => {
                self.workers[worker].up = true;
                self.set_timer(worker, 0);
            }
            TraceEvent::Ticks { node, incarnation } => self.ticks(node, incarnation)?,
            TraceEvent::NodeStarts { node } => self.node_starts(node)?,
            TraceEvent::UserRequest { event } => self.on_user_request(event)?,
            TraceEvent::Fault if self.faults_ended => {}
            TraceEvent::Fault => self.inject_fault(),
            TraceEvent::FaultsEnd => self.end_faults(),
            TraceEvent::Review => self.review(),
        }
        Ok(())
    }

    fn after(&mut self, millis: u64, event: TraceEvent) {
        self.order += 1;
        self.queue.insert((self.now + millis, self.order), event);
    }

    fn count(&mut self, name: &'static str) {
        *self.report.counts.entry(name).or_default() += 1;
    }
}
