//! What the tasks of the simulated jobs truly are, which the scheduler does not know.

use scene::ArtefactId;

use crate::scheduler::Scheduler;
use crate::sim::random::Random;
use crate::words::{AttemptId, JobId, JobSpec, TaskIndex, TaskNode};

/// The most memory that any task truly takes, bytes; some worker has it.
pub(crate) const LARGEST_BYTES: u64 = 16 << 20;

/// How a task behaves wherever it runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Nature {
    Honest,
    /// Its input is wrong.
    BadInput,
    /// It kills its worker.
    Poison,
    /// It diverges at the full rate.
    Diverges,
    /// It diverges at any rate.
    Hopeless,
}

/// A task as it is.
#[derive(Debug, Clone)]
pub(crate) struct Truth {
    pub(crate) nature: Nature,
    pub(crate) memory_bytes: u64,
    pub(crate) followers: Vec<TaskNode>,
}

/// A job as it is.
#[derive(Debug, Clone)]
pub(crate) struct JobTruth {
    pub(crate) id: JobId,
    pub(crate) spec: JobSpec,
    seed: u64,
}

impl JobTruth {
    pub(crate) fn new(id: JobId, backend: &str, random: &mut Random) -> Self {
        let count = random.between(1, 14);
        let tasks = (0..count).map(|task| node(task, random)).collect();
        let (priority, weight) = (random.between(0, 2) as u8, random.between(0, 5) as u32);
        let spec = JobSpec { backend: backend.into(), priority, weight, tasks };
        Self { id, spec, seed: random.number() }
    }

    /// What a task truly is: the same whenever it is asked. Followers are honest and have no followers.
    pub(crate) fn of(&self, task: TaskIndex) -> Truth {
        let mut random = Random::new(self.seed ^ u64::from(task.0).wrapping_mul(0x5851_f42d_4c95_7f2d));
        let first = self.spec.tasks.len() as u64;
        let is_follower = u64::from(task.0) >= first;
        let nature = match random.between(0, 60) {
            _ if is_follower => Nature::Honest,
            0 => Nature::BadInput,
            1 => Nature::Poison,
            2..5 => Nature::Diverges,
            5 => Nature::Hopeless,
            _ => Nature::Honest,
        };
        let memory_bytes = random.between(1 << 20, LARGEST_BYTES);
        let count = if is_follower || !random.chance(150) { 0 } else { random.between(1, 4) };
        let follower = |sibling: u64, random: &mut Random| {
            let mut follower = node(u64::from(task.0), random);
            if sibling > 0 && random.chance(500) {
                let sibling = random.between(0, sibling) as u32;
                follower.dependencies.push(TaskIndex(Scheduler::FOLLOWER + sibling));
            }
            follower
        };
        let followers = (0..count).map(|sibling| follower(sibling, &mut random)).collect();
        Truth { nature, memory_bytes, followers }
    }

    /// Whether the task can be done at all.
    pub(crate) fn can_be_done(&self, task: TaskIndex) -> bool {
        matches!(self.of(task).nature, Nature::Honest | Nature::Diverges)
    }
}

/// What an attempt makes. (Real results are the same for every attempt; here they differ, so that it shows whose was taken.)
pub(crate) fn result_of(attempt: AttemptId) -> ArtefactId {
    ArtefactId::of(attempt.to_string().as_bytes())
}

/// A task that depends on up to three of the first `task` ones.
fn node(task: u64, random: &mut Random) -> TaskNode {
    let count = if task == 0 { 0 } else { random.between(0, 4) };
    let dependencies = (0..count).map(|_| TaskIndex(random.between(0, task) as u32)).collect();
    let memory_bytes = random.between(1 << 20, LARGEST_BYTES / 2);
    TaskNode { dependencies, work: random.between(500, 20_000), memory_bytes }
}
