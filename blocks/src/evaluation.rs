//! Plans the tasks that measure the merged model on the held-out views.

use scene::Capture;

use crate::budgets::{BASE_BYTES, BYTES_PER_FROZEN_COLUMN, BYTES_PER_FROZEN_PROJECTED, COLUMNS};
use crate::cost::HALO_AREA;
use crate::plan::{MAX_EVAL_TASKS, PlanSettings};
use crate::split::Split;
use crate::task::{EvalTask, Task};

/// Least pixels of the views of one task, about. Larger tasks would leave workers without work.
const TASK_PIXELS: u64 = 8 << 20;
/// Further pixels for each splat. A task reads the whole model, which takes as long as measuring two thirds of a pixel for
/// each splat (docs/decisions/0055); so reading is at most a seventh of a task.
const PIXELS_PER_SPLAT: u64 = 4;
/// Results that a worker fetches at a time. Encoded they take less memory than as splats.
pub const CONCURRENT_FETCHES: usize = 8;
/// Bytes per pixel of the largest view: photo and render as floats, and the planes of SSIM and SSIMULACRA2.
const BYTES_PER_PIXEL: u64 = 220;

/// Tasks that measure every held-out view of a capture once, in the order of the views. Equal inputs give equal tasks.
pub(crate) fn eval_tasks(capture: &Capture, tasks: &[Task], split: &Split, settings: &PlanSettings) -> Vec<EvalTask> {
    let columns = COLUMNS[usize::from(settings.sh_degree.min(3))];
    let largest = tasks.iter().map(|task| u64::from(task.budget)).max().unwrap_or(0);
    let budget = u64::from(settings.budget);
    // The merged model, and the blocks that are being fetched while it is put together.
    let fetched = (CONCURRENT_FETCHES + 1).min(tasks.len()) as u64 * (largest as f64 * HALO_AREA) as u64;
    let model = budget * (BYTES_PER_FROZEN_COLUMN * columns + BYTES_PER_FROZEN_PROJECTED)
        + fetched * BYTES_PER_FROZEN_COLUMN * columns;
    let held_out = || split.held_out().into_iter().map(|view| (view, &capture.views[view as usize]));
    let all_pixels: u64 = held_out().map(|(_, view)| view.camera.full().area()).sum();
    // A task may stay up to one view short of its pixels, so a task may take twice its share.
    let task_pixels = (TASK_PIXELS + PIXELS_PER_SPLAT * budget).max(2 * all_pixels / MAX_EVAL_TASKS as u64 + 1);
    let mut planned: Vec<EvalTask> = Vec::new();
    for (index, view) in held_out() {
        let pixels = view.camera.full().area();
        let memory_bytes = BASE_BYTES + model + pixels * BYTES_PER_PIXEL;
        match planned.last_mut().filter(|task| task.pixels + pixels <= task_pixels) {
            Some(task) => {
                task.views.push(index);
                task.pixels += pixels;
                task.memory_bytes = task.memory_bytes.max(memory_bytes);
            }
            None => planned.push(EvalTask { views: vec![index], pixels, memory_bytes }),
        }
    }
    planned
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::Ground;
    use crate::testing::street;

    fn eval_tasks(capture: &Capture, settings: &PlanSettings) -> Vec<EvalTask> {
        let split = Split::new(capture, &Ground::of(capture), settings.test_every, 0.0);
        super::eval_tasks(capture, &[], &split, settings)
    }

    #[test]
    fn every_held_out_view_is_measured_once() {
        let capture = street(700, 100);
        let settings = PlanSettings { test_every: 8, budget: 1000, ..PlanSettings::default() };
        let tasks = eval_tasks(&capture, &settings);
        let views: Vec<u32> = tasks.iter().flat_map(|task| task.views.clone()).collect();
        assert_eq!(views, (0..700).step_by(8).collect::<Vec<u32>>());
        assert!(tasks.len() > 1 && tasks.iter().all(|task| task.pixels < TASK_PIXELS + 4001 && task.memory_bytes > 0));
        // A large model is read by few tasks.
        let large = PlanSettings { budget: 20_000_000, ..settings.clone() };
        assert_eq!(eval_tasks(&capture, &large).len(), 1);
        // Photos of 12 megapixels, each larger than a task would be.
        let mut wide = capture.clone();
        for view in &mut wide.views {
            (view.camera.pinhole.width, view.camera.pinhole.height) = (4000, 3000);
        }
        let all = PlanSettings { test_every: 1, ..settings.clone() };
        let tasks = eval_tasks(&wide, &all);
        assert!((MAX_EVAL_TASKS / 4..=MAX_EVAL_TASKS).contains(&tasks.len()), "{}", tasks.len());
        assert!(eval_tasks(&capture, &PlanSettings { test_every: 0, ..settings }).is_empty());
    }
}
