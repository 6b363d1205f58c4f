//! Plans the tasks that look for objects on the photos.

use scene::{Capture, View};

use crate::budgets::BASE_BYTES;
use crate::plan::MAX_DETECT_TASKS;
use crate::task::DetectTask;

/// CPU microseconds of a task at most, about: longer ones leave workers idle while the last ones run.
const TASK_MICROS: u64 = 15_000_000;
/// Where this gives few tasks, there are more, so that several workers have work,
const FEW_TASKS: u64 = 8;
/// but not shorter ones: each loads the network.
const SHORT_MICROS: u64 = 2_000_000;
/// CPU microseconds of reading a pixel of a photo and scaling it to the network's input.
const MICROS_PER_PIXEL: f64 = 0.02;
/// Bytes per pixel of the largest photo: compressed tiles, planes, mask, and rows of colours.
const BYTES_PER_PIXEL: u64 = 12;

/// What running a detector on one picture takes, estimated from the network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectorCost {
    /// CPU seconds, on the machine of [`StepCost::CPU_SECONDS`](crate::StepCost::CPU_SECONDS).
    pub cpu_seconds: f64,
    /// Memory, bytes, that of the network included.
    pub memory_bytes: u64,
}

/// Tasks that run a detector on every view of a capture once, in the order of the views, each for about equally long.
/// Equal inputs give equal tasks.
pub fn detect_tasks(capture: &Capture, cost: DetectorCost) -> Vec<DetectTask> {
    let pixels = |view: &View| view.camera.full().area();
    let micros = |view: &View| {
        let micros = (1e6 * cost.cpu_seconds + MICROS_PER_PIXEL * pixels(view) as f64) as u64;
        // `as` saturates. No sum is 0 or overflows.
        micros.clamp(1, 1 << 40)
    };
    let all: u64 = capture.views.iter().map(micros).sum();
    let count = all.div_ceil(TASK_MICROS).max((all / SHORT_MICROS).min(FEW_TASKS)).clamp(1, MAX_DETECT_TASKS as u64);
    let mut tasks: Vec<DetectTask> = Vec::new();
    let (mut before, mut number_of_last) = (0, None);
    for (view, first) in capture.views.iter().zip(0..) {
        let number = u128::from(before) * u128::from(count) / u128::from(all);
        let memory_bytes = BASE_BYTES + cost.memory_bytes + pixels(view) * BYTES_PER_PIXEL;
        match tasks.last_mut().filter(|_| number_of_last == Some(number)) {
            Some(task) => {
                task.count += 1;
                task.work_millis += micros(view) / 1000;
                task.memory_bytes = task.memory_bytes.max(memory_bytes);
            }
            None => tasks.push(DetectTask { first, count: 1, work_millis: micros(view) / 1000, memory_bytes }),
        }
        (before, number_of_last) = (before + micros(view), Some(number));
    }
    tasks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::street;

    const COST: DetectorCost = DetectorCost { cpu_seconds: 0.1, memory_bytes: 1 << 20 };

    #[test]
    fn every_view_is_looked_at_once_in_tasks_of_equal_work() {
        let capture = street(700, 100);
        let tasks = detect_tasks(&capture, COST);
        assert_eq!(tasks.len(), 8);
        let views: Vec<u32> = tasks.iter().flat_map(DetectTask::views).collect();
        assert_eq!(views, (0..700).collect::<Vec<u32>>());
        assert!(tasks.iter().all(|task| (87..=88).contains(&task.count) && task.memory_bytes > 1 << 20));
        assert!(tasks.iter().all(|task| (8_000..10_000).contains(&task.work_millis)), "{tasks:?}");
        let of = |cpu_seconds: f64| detect_tasks(&capture, DetectorCost { cpu_seconds, ..COST }).len();
        assert_eq!([of(0.001), of(0.006), of(0.03), of(0.5), of(60.0)], [2, 4, 8, 24, 700]);
        // A network that takes no time, one that takes too long, and no photo.
        assert_eq!([of(0.0), detect_tasks(&street(70, 10), DetectorCost { cpu_seconds: 0.0, ..COST }).len()], [2, 1]);
        assert_eq!(detect_tasks(&street(9000, 10), DetectorCost { cpu_seconds: 60.0, ..COST }).len(), MAX_DETECT_TASKS);
        for cpu_seconds in [f64::INFINITY, f64::NAN, -1.0] {
            assert!(!detect_tasks(&capture, DetectorCost { cpu_seconds, ..COST }).is_empty());
        }
        assert!(detect_tasks(&Capture::default(), COST).is_empty());
    }
}
