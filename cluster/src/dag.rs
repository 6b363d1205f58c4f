//! Validation of new tasks: their dependencies must form a directed acyclic graph.

use crate::types::{SIBLING_BASE, TaskIndex, TaskNode};

/// Why tasks cannot be added to a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DagError {
    /// A dependency does not exist.
    #[error("task {task} depends on task {dependency}, but there are only {tasks} tasks")]
    OutOfRange {
        /// The task.
        task: u32,
        /// The dependency.
        dependency: u32,
        /// Number of tasks.
        tasks: usize,
    },
    /// A task depends on itself.
    #[error("task {task} depends on itself, directly or through others")]
    Cycle {
        /// A task on the cycle or dependent on it.
        task: u32,
    },
    /// The job would have too many tasks.
    #[error("{tasks} tasks are more than the limit of {limit}")]
    TooMany {
        /// Number of tasks.
        tasks: usize,
        /// The limit.
        limit: u32,
    },
}

/// Validated tasks for a job that has `first` tasks already. Dependencies are sorted, unique and use the job's indices.
#[derive(Debug)]
pub(crate) struct Addition {
    pub(crate) first: u32,
    pub(crate) nodes: Vec<TaskNode>,
    /// Indices into `nodes` in topological order.
    pub(crate) order: Vec<usize>,
}

impl Addition {
    /// Validates new tasks in `O(tasks + dependencies · log)`.
    pub(crate) fn new(mut nodes: Vec<TaskNode>, first: u32, limit: u32) -> Result<Self, DagError> {
        let tasks = (first as usize).saturating_add(nodes.len());
        if tasks > limit.min(SIBLING_BASE) as usize {
            return Err(DagError::TooMany { tasks, limit });
        }
        for (task, node) in (first..).zip(&mut nodes) {
            for dependency in &mut node.dependencies {
                // A follow-up task refers to its siblings relative to SIBLING_BASE.
                let index = match dependency.0.checked_sub(SIBLING_BASE) {
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

/// A topological order of the new tasks (Kahn's algorithm). Existing tasks depend on none of them. The error is the
/// first task that is not reachable.
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

/// The class of a critical path in half octaves. Tasks of the same class count as equally urgent.
pub(crate) fn urgency_class(critical_path: u64) -> u8 {
    let octave = critical_path.max(1).ilog2();
    let half = octave > 0 && critical_path >> (octave - 1) & 1 == 1;
    (2 * octave + u32::from(half)) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_grow_by_half_octaves() {
        let classes: Vec<u8> = [0, 1, 2, 3, 4, 5, 6, 7, 8, u64::MAX].into_iter().map(urgency_class).collect();
        assert_eq!(classes, [0, 0, 2, 3, 4, 4, 5, 5, 6, 127]);
    }
}
