//! The ground truth about the tasks of the simulated jobs, which the scheduler does not know.

use scene::ArtefactId;

use crate::sim::random::Random;
use crate::types::{AttemptId, JobId, JobSpec, SIBLING_BASE, TaskIndex, TaskNode};

/// The maximum memory of a task, bytes. Some worker has it.
pub(crate) const LARGEST_BYTES: u64 = 16 << 20;

/// The behaviour of a task, independent of the worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Behaviour {
    Succeeds,
    /// Its input is invalid.
    BadInput,
    /// It crashes its worker.
    CrashesWorker,
    /// It diverges at the full learning rate.
    Diverges,
    /// It diverges at every learning rate.
    AlwaysDiverges,
}

/// The ground truth about a task.
#[derive(Debug, Clone)]
pub(crate) struct GroundTruth {
    pub(crate) behaviour: Behaviour,
    pub(crate) memory_bytes: u64,
    pub(crate) follow_ups: Vec<TaskNode>,
}

/// The ground truth about a job.
#[derive(Debug, Clone)]
pub(crate) struct JobGroundTruth {
    pub(crate) id: JobId,
    pub(crate) spec: JobSpec,
    seed: u64,
}

impl JobGroundTruth {
    pub(crate) fn new(id: JobId, backend: &str, random: &mut Random) -> Self {
        let count = random.between(1, 14);
        let mut tasks: Vec<TaskNode> = (0..count).map(|task| node(task, random)).collect();
        add_detections(&mut tasks, random);
        let (priority, weight) = (random.between(0, 2) as u8, random.between(0, 5) as u32);
        let spec = JobSpec { backend: backend.into(), priority, weight, tasks };
        Self { id, spec, seed: random.number() }
    }

    /// Whether a task depends on one that follows it in the plan.
    pub(crate) fn has_detections(&self) -> bool {
        let later = |(task, node): (u32, &TaskNode)| node.dependencies.iter().any(|other| other.0 > task);
        (0..).zip(&self.spec.tasks).any(later)
    }

    /// The ground truth about a task; the same for every call. Follow-up tasks succeed and have no follow-up tasks.
    pub(crate) fn task(&self, task: TaskIndex) -> GroundTruth {
        let mut random = Random::new(self.seed ^ u64::from(task.0).wrapping_mul(0x5851_f42d_4c95_7f2d));
        let first = self.spec.tasks.len() as u64;
        let is_follower = u64::from(task.0) >= first;
        let behaviour = match random.between(0, 60) {
            _ if is_follower => Behaviour::Succeeds,
            0 => Behaviour::BadInput,
            1 => Behaviour::CrashesWorker,
            2..5 => Behaviour::Diverges,
            5 => Behaviour::AlwaysDiverges,
            _ => Behaviour::Succeeds,
        };
        let memory_bytes = random.between(1 << 20, LARGEST_BYTES);
        let count = if is_follower || !random.chance(150) { 0 } else { random.between(1, 4) };
        let follower = |sibling: u64, random: &mut Random| {
            let mut follower = node(u64::from(task.0), random);
            if sibling > 0 && random.chance(500) {
                let sibling = random.between(0, sibling) as u32;
                follower.dependencies.push(TaskIndex(SIBLING_BASE + sibling));
            }
            follower
        };
        let follow_ups = (0..count).map(|sibling| follower(sibling, &mut random)).collect();
        GroundTruth { behaviour, memory_bytes, follow_ups }
    }

    /// Whether the task can complete at all.
    pub(crate) fn can_complete(&self, task: TaskIndex) -> bool {
        matches!(self.task(task).behaviour, Behaviour::Succeeds | Behaviour::Diverges)
    }
}

/// The result of an attempt. Real results are identical for every attempt. Here they differ, to detect which one was
/// accepted.
pub(crate) fn result_of(attempt: AttemptId) -> ArtefactId {
    ArtefactId::of(attempt.to_string().as_bytes())
}

/// Adds tasks that depend on nothing, to half of the jobs: the first task waits for all of them and others for some, as blocks
/// wait for the detection tasks of their views, which a plan lists last.
fn add_detections(tasks: &mut Vec<TaskNode>, random: &mut Random) {
    let first = tasks.len() as u64;
    let end = first + if random.chance(500) { random.between(1, 5) } else { 0 };
    for detection in (first..end).map(|detection| TaskIndex(detection as u32)) {
        for (task, node) in (0..first).zip(&mut tasks[..]) {
            if task == 0 || random.chance(400) {
                node.dependencies.push(detection);
            }
        }
        tasks.push(node(0, random));
    }
}

/// A task that depends on up to three of the first `task` tasks.
fn node(task: u64, random: &mut Random) -> TaskNode {
    let count = if task == 0 { 0 } else { random.between(0, 4) };
    let dependencies = (0..count).map(|_| TaskIndex(random.between(0, task) as u32)).collect();
    let memory_bytes = random.between(1 << 20, LARGEST_BYTES / 2);
    TaskNode { dependencies, work: random.between(500, 20_000), memory_bytes }
}
