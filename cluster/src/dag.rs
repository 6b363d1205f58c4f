//! Whether a list of tasks is a directed acyclic graph, and how long the chains are that wait for each task.

use crate::scheduler::Scheduler;
use crate::words::{TaskIndex, TaskNode};

/// Why tasks cannot become part of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DagError {
    /// A dependency that is not there.
    #[error("task {task} depends on task {dependency}, but there are only {tasks} tasks")]
    OutOfRange {
        /// The task.
        task: u32,
        /// What it names.
        dependency: u32,
        /// How many tasks there are.
        tasks: usize,
    },
    /// A task that waits for itself.
    #[error("task {task} depends on itself, directly or through others")]
    Cycle {
        /// A task on or behind the cycle.
        task: u32,
    },
    /// More tasks than a job may have.
    #[error("{tasks} tasks are more than the limit of {limit}")]
    TooMany {
        /// How many.
        tasks: usize,
        /// How many there may be.
        limit: u32,
    },
}

/// Tasks that may be added to a job which has `first` already: dependencies sorted, without repetitions, and counted as
/// the job counts.
#[derive(Debug)]
pub(crate) struct Addition {
    pub(crate) first: u32,
    pub(crate) nodes: Vec<TaskNode>,
    /// Places in `nodes`, each after those that it depends on.
    pub(crate) order: Vec<usize>,
}

impl Addition {
    /// Checks the new tasks, in `O(tasks + dependencies · log)`.
    pub(crate) fn new(mut nodes: Vec<TaskNode>, first: u32, limit: u32) -> Result<Self, DagError> {
        let tasks = (first as usize).saturating_add(nodes.len());
        if tasks > limit.min(Scheduler::FOLLOWER) as usize {
            return Err(DagError::TooMany { tasks, limit });
        }
        for (task, node) in (first..).zip(&mut nodes) {
            for dependency in &mut node.dependencies {
                // A follower counts its siblings from FOLLOWER, as it cannot know how many tasks there will be.
                let index = match dependency.0.checked_sub(Scheduler::FOLLOWER) {
                    Some(sibling) if first > 0 => sibling.saturating_add(first),
                    _ => dependency.0,
                };
                if index as usize >= tasks {
                    return Err(DagError::OutOfRange { task, dependency: dependency.0, tasks });
                }
                *dependency = TaskIndex(index);
            }
            node.dependencies.sort_unstable();
            node.dependencies.dedup();
        }
        let order = order(&nodes, first).map_err(|place| DagError::Cycle { task: first + place as u32 })?;
        Ok(Self { first, nodes, order })
    }
}

/// Kahn's algorithm among the new tasks; those that are there already depend on none of these. The first that no order of
/// work reaches is the error.
fn order(nodes: &[TaskNode], first: u32) -> Result<Vec<usize>, usize> {
    let inner = |node: &TaskNode| -> Vec<usize> {
        node.dependencies.iter().filter_map(|task| task.0.checked_sub(first)).map(|place| place as usize).collect()
    };
    let mut dependents: Vec<Vec<usize>> = vec![Vec::new(); nodes.len()];
    let mut missing = Vec::with_capacity(nodes.len());
    for (place, node) in nodes.iter().enumerate() {
        let inner = inner(node);
        missing.push(inner.len());
        inner.into_iter().for_each(|dependency| dependents[dependency].push(place));
    }
    let mut reached: Vec<usize> = (0..nodes.len()).filter(|&place| missing[place] == 0).collect();
    let mut next = 0;
    while let Some(&place) = reached.get(next) {
        next += 1;
        for &dependent in &dependents[place] {
            missing[dependent] -= 1;
            if missing[dependent] == 0 {
                reached.push(dependent);
            }
        }
    }
    missing.iter().position(|&missing| missing > 0).map_or(Ok(reached), Err)
}

/// Half octaves of the work on the longest chain that begins with a task: tasks of the same class count as equal.
pub(crate) fn class(chain: u64) -> u8 {
    let octave = chain.max(1).ilog2();
    let half = octave > 0 && chain >> (octave - 1) & 1 == 1;
    (2 * octave + u32::from(half)) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_grow_by_half_octaves() {
        let classes: Vec<u8> = [0, 1, 2, 3, 4, 5, 6, 7, 8, u64::MAX].into_iter().map(class).collect();
        assert_eq!(classes, [0, 0, 2, 3, 4, 4, 5, 5, 6, 127]);
    }
}
