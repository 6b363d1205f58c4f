//! Plans the tasks that measure the merged model on the held-out views.

use scene::Capture;

use crate::budgets::{BASE_BYTES, BYTES_PER_FROZEN_COLUMN, BYTES_PER_FROZEN_PROJECTED, COLUMNS};
use crate::cost::HALO_AREA;
use crate::plan::{EvalTask, PlanSettings, Task};

/// Pixels of the views of one task, about. Each task reads the whole model, so tasks must not be too small; too large
/// ones leave workers without work.
const TASK_PIXELS: u64 = 8 << 20;
/// Bytes per pixel of the largest view: photo and render as floats, and the planes of SSIM and SSIMULACRA2.
const BYTES_PER_PIXEL: u64 = 220;

/// Tasks that measure every held-out view of a capture once, in the order of the views. Equal inputs give equal tasks.
pub(crate) fn eval_tasks(capture: &Capture, tasks: &[Task], settings: &PlanSettings) -> Vec<EvalTask> {
    let columns = COLUMNS[usize::from(settings.sh_degree.min(3))];
    let largest = tasks.iter().map(|task| u64::from(task.budget)).max().unwrap_or(0);
    // The merged model, and one block with its halo while the model is put together.
    let model = u64::from(settings.budget) * (BYTES_PER_FROZEN_COLUMN * columns + BYTES_PER_FROZEN_PROJECTED)
        + (largest as f64 * HALO_AREA) as u64 * BYTES_PER_FROZEN_COLUMN * columns;
    let mut planned: Vec<EvalTask> = Vec::new();
    for (index, view) in capture.views.iter().enumerate() {
        if !Capture::is_test(index, settings.test_every) {
            continue;
        }
        let pixels = view.camera.full().area();
        let memory_bytes = BASE_BYTES + model + pixels * BYTES_PER_PIXEL;
        match planned.last_mut().filter(|task| task.pixels + pixels <= TASK_PIXELS) {
            Some(task) => {
                task.views.push(index as u32);
                task.pixels += pixels;
                task.memory_bytes = task.memory_bytes.max(memory_bytes);
            }
            None => planned.push(EvalTask { views: vec![index as u32], pixels, memory_bytes }),
        }
    }
    planned
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::street;

    #[test]
    fn every_held_out_view_is_measured_once() {
        let capture = street(700, 100);
        let settings = PlanSettings { test_every: 8, ..PlanSettings::default() };
        let tasks = eval_tasks(&capture, &[], &settings);
        let views: Vec<u32> = tasks.iter().flat_map(|task| task.views.clone()).collect();
        assert_eq!(views, (0..700).step_by(8).collect::<Vec<u32>>());
        assert!(tasks.len() > 1 && tasks.iter().all(|task| task.pixels <= TASK_PIXELS && task.memory_bytes > 0));
        assert!(eval_tasks(&capture, &[], &PlanSettings { test_every: 0, ..settings }).is_empty());
    }
}
