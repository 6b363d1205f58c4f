//! The world: what happens when, and what must be true of it.

mod faults;
mod leading;
mod messages;
mod verdict;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use scene::ArtefactId;

use crate::events::{Action, Event};
use crate::sim::coordinator::{Node, StoreFaults};
use crate::sim::random::Random;
use crate::sim::store::Store;
use crate::sim::truth::{JobTruth, LARGEST_BYTES};
use crate::sim::worker::{SimWorker, WorkFaults};
use crate::sim::{Options, Report};
use crate::words::{AttemptId, JobId, Offer, Settings, TaskIndex, WorkerId};

const SETTINGS: Settings = Settings {
    lease_millis: 4000,
    stall_millis: 60_000,
    silence_millis: 20_000,
    strand_millis: 30_000,
    patience_millis: 5000,
    backoff_millis: 500,
    backoff_limit_millis: 8000,
    ask_millis: 300,
    failures_limit: 3,
    losses_limit: 6,
    troubles_limit: 8,
    culprits_limit: 3,
    tasks_limit: 1000,
    jobs_limit: 10,
    duplicates: true,
    plan_order: false,
};
/// Two coordinators' places.
const NODES: usize = 2;
/// Once the faults have stopped, a task that cannot get an end in this time is starved. The work of a world takes its only
/// whole worker some minutes.
const PEACE_MILLIS: u64 = 3_600_000;

/// What happens.
#[derive(Debug, Clone)]
enum Happening {
    /// A worker's call arrives at a coordinator.
    Arrives {
        node: usize,
        worker: usize,
        life: u64,
        call: u64,
        event: Event,
    },
    /// An action arrives at a worker; as an answer it names the call.
    Told {
        worker: usize,
        life: u64,
        call: Option<u64>,
        action: Action,
    },
    /// A worker's alarm, if it was not set anew since.
    Wakes {
        worker: usize,
        alarm: u64,
    },
    WorkerStarts {
        worker: usize,
    },
    /// Time goes by for a coordinator.
    Ticks {
        node: usize,
        life: u64,
    },
    NodeStarts {
        node: usize,
    },
    /// A person asks whoever leads, until there is an answer.
    Asks {
        event: Event,
    },
    /// Something goes wrong.
    Fault,
    /// Nothing goes wrong any more.
    Peace,
    /// A person looks after what failed.
    Review,
}

pub(crate) struct World {
    random: Random,
    options: Options,
    now: u64,
    order: u64,
    queue: BTreeMap<(u64, u64), Happening>,
    peace: bool,
    ends: u64,
    /// Thousandths of messages that are lost, and that come twice.
    lossy: u64,
    store_faults: StoreFaults,
    work_faults: WorkFaults,
    store: Store,
    nodes: Vec<Node>,
    workers: Vec<SimWorker>,
    jobs: BTreeMap<JobId, JobTruth>,
    /// Worker and coordinator that do not hear each other.
    cuts: BTreeSet<(usize, usize)>,
    granted: BTreeSet<AttemptId>,
    /// What workers were told is committed.
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
            // One of each backend has all the memory that any task takes.
            let memory_bytes =
                if place < kinds { LARGEST_BYTES } else { random.between(LARGEST_BYTES / 4, LARGEST_BYTES) };
            let offer = Offer { backend: backends[place % kinds].into(), memory_bytes, cached: Vec::new() };
            SimWorker {
                id: WorkerId(place as u32),
                offer,
                speed: [200, 1000, 4000][random.between(0, 3) as usize],
                life: 0,
                alarm: 0,
                up: false,
                hangs_until: 0,
                node: 0,
                call: 0,
                unanswered: 0,
                doing: None,
            }
        };
        let workers = (0..count.max(kinds)).map(|place| worker(place, &mut random)).collect();
        let jobs = (1..=random.between(1, 4)).map(JobId).map(|id| {
            let backend = backends[random.between(0, kinds as u64) as usize];
            (id, JobTruth::new(id, backend, &mut random))
        });
        let jobs = jobs.collect();
        let [lossy, store, slow, fails] = [120, 60, 150, 120].map(|most| random.between(0, most));
        let mut world = Self {
            ends: random.between(10_000, 120_000),
            random,
            options,
            now: 0,
            order: 0,
            queue: BTreeMap::new(),
            peace: false,
            lossy,
            store_faults: StoreFaults(store),
            work_faults: WorkFaults { slow, fails },
            store: Store::default(),
            nodes: (0..NODES).map(|_| Node::default()).collect(),
            workers,
            jobs,
            cuts: BTreeSet::new(),
            granted: BTreeSet::new(),
            committed: BTreeMap::new(),
            report: Report::default(),
        };
        world.plan();
        world
    }

    pub(crate) fn report(mut self) -> Report {
        for node in 0..NODES {
            let journal = self.nodes[node].die();
            self.report.journals.extend(journal);
        }
        self.report.millis = self.now;
        self.report
    }

    /// Plays to the end.
    pub(crate) fn play(&mut self, trace: &mut dyn FnMut(fmt::Arguments<'_>)) -> Result<(), String> {
        while let Some(((now, _), happening)) = self.queue.pop_first() {
            self.now = now;
            trace(format_args!("{now:>8} {happening:?}"));
            self.happens(happening)?;
            if self.peace && self.is_over() {
                return self.check_end();
            }
            if now > self.ends + PEACE_MILLIS {
                return Err(format!("{} ms after the faults stopped: {}", now - self.ends, self.left_over()));
            }
        }
        Err("nothing happens any more".into())
    }

    fn happens(&mut self, happening: Happening) -> Result<(), String> {
        match happening {
            Happening::Arrives { node, worker, life, call, event } => self.arrives(node, worker, life, call, event)?,
            Happening::Told { worker, life, call, action } => self.told(worker, life, call, action)?,
            Happening::Wakes { worker, alarm } => self.wakes(worker, alarm),
            Happening::WorkerStarts { worker } => {
                self.workers[worker].up = true;
                self.wake(worker, 0);
            }
            Happening::Ticks { node, life } => self.ticks(node, life)?,
            Happening::NodeStarts { node } => self.node_starts(node)?,
            Happening::Asks { event } => self.asks(event)?,
            Happening::Fault if self.peace => {}
            Happening::Fault => self.fault(),
            Happening::Peace => self.make_peace(),
            Happening::Review => self.review(),
        }
        Ok(())
    }

    fn after(&mut self, millis: u64, happening: Happening) {
        self.order += 1;
        self.queue.insert((self.now + millis, self.order), happening);
    }

    fn note(&mut self, what: &'static str) {
        *self.report.counts.entry(what).or_default() += 1;
    }
}
