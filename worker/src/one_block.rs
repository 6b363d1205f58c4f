//! Trains a plan of one block in process with any recipe, to compare recipes. Initial splats, windows, random numbers and evaluation are
//! those of [`PlanExecutor`]; the block is not pruned, and nothing is written to the store.

use std::collections::BTreeMap;
use std::sync::Arc;

use blocks::Plan;
use dataset::windows::WindowReader;
use glam::Vec3;
use proto::FailureKind;
use scene::{ArtefactId, Capture, Splats};
use store::BlockingStore;
use train::{Backend, Flow, Recipe};

use crate::block::Block;
use crate::clock::Stopwatch;
use crate::execute::PlanExecutor;
use crate::initial_splats::InitialSplats;
use crate::merged_eval::MergedEvaluator;
use crate::recipe::recipe_of;
use crate::task::{ExecuteError, FULL_RATE, TaskOrder};
use crate::trainer_context::{Shared, TrainerOptions};

/// The training of a plan of one block.
pub struct OneBlockTraining<'a> {
    /// The plan: one block without children.
    pub plan: &'a Plan,
    /// The capture that was ingested for it.
    pub capture: Arc<Capture>,
    /// Its photos.
    pub store: BlockingStore,
    /// The device.
    pub backend: Backend,
    /// Threads of the compute pool.
    pub threads: usize,
    /// Size of the cache of decoded windows, bytes.
    pub cache_bytes: usize,
    /// Number of evaluations, evenly spaced over the steps. The initial splats are evaluated as well.
    pub evaluations: u32,
}

/// An evaluation during training. Times include all work from the start of the block on, without evaluations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evaluation {
    /// Steps done.
    pub step: u32,
    /// CPU seconds of the whole process.
    pub cpu_seconds: f64,
    /// Wall seconds.
    pub wall_seconds: f64,
    /// Mean PSNR over the held-out views, dB.
    pub psnr: f64,
    /// Number of splats.
    pub splats: u64,
}

impl OneBlockTraining<'_> {
    /// Trains with the recipe that `change` returns for the block's own one. The first evaluation is before the first step, the last one
    /// after the last step.
    ///
    /// # Errors
    /// A plan of several blocks or without held-out views, photos that cannot be read, or training that fails.
    pub fn train(&self, change: impl Fn(Recipe) -> Recipe + Send) -> Result<Vec<Evaluation>, ExecuteError> {
        let options = TrainerOptions {
            threads: self.threads,
            eval_every: 0,
            cache_bytes: self.cache_bytes,
            memory_bytes: 0,
            resume: false,
            checkpoint_seconds: f64::INFINITY,
        };
        let shared = Arc::new(Shared::default());
        let trainer =
            PlanExecutor::new(self.store.clone(), options, shared, self.backend.clone()).map_err(ExecuteError::work)?;
        trainer.install(|| self.train_with(&trainer, change))
    }

    fn train_with(
        &self,
        trainer: &PlanExecutor,
        change: impl Fn(Recipe) -> Recipe,
    ) -> Result<Vec<Evaluation>, ExecuteError> {
        let mut clock = Stopwatch::start();
        let Self { plan, capture, .. } = self;
        let [task] = &plan.tasks[..] else { return Err(wrong_plan("has several blocks; recipes are compared on one")) };
        let reader = WindowReader::new(capture.clone(), self.store.clone(), self.cache_bytes);
        let reader = if plan.settings.depth_weight > 0.0 { reader.with_depth() } else { reader };
        let evaluator = MergedEvaluator::new(plan, &reader, &self.store);
        let mut evaluator = evaluator.ok_or_else(|| wrong_plan("holds out no view, so nothing can be evaluated"))?;
        let order = TaskOrder {
            job: 0,
            plan: ArtefactId([0; 32]),
            task: 0,
            attempt: 1,
            inputs: BTreeMap::new(),
            rate_permille: FULL_RATE,
        };
        let block = Block {
            context: &trainer.context,
            order: &order,
            plan,
            task,
            capture,
            reader: &reader,
            aligned: None,
            cache: None,
            given_exposures: None,
            given_poses: None,
            given_residual: None,
        };
        let recipe = change(recipe_of(plan, task));
        let views = block.windows(&task.views)?;
        let InitialSplats { trained: initial, context } = block.initial_splats(BTreeMap::new(), &views, &recipe)?;
        let mut evaluations: Vec<Evaluation> = Vec::new();
        let mut evaluate = |step: u32, splats: &Splats| -> bool {
            let (cpu_seconds, wall_seconds) = (clock.cpu_seconds(), clock.wall_seconds());
            let psnr = clock.paused(|| evaluator.psnr(&block.at_full_resolution(splats.clone(), &views)));
            let count = splats.len() as u64;
            let found = psnr.map(|psnr| Evaluation { step, cpu_seconds, wall_seconds, psnr, splats: count });
            evaluations.extend(found);
            found.is_some()
        };
        let mut is_evaluable = evaluate(0, &initial);
        let free_space = block.free_space(&views);
        let due = |step: u32| is_due(step, task.steps, self.evaluations);
        let job = train::Job {
            initial,
            context: context.as_ref(),
            views: &views,
            counts: &|p: Vec3| block.owns(task, p.as_dvec3()),
            keeps: &|_| true,
            free_space: free_space.as_ref(),
            budget: task.budget as usize,
            steps: task.steps,
            antialiased: plan.settings.antialiased,
            seed: block.seed(),
            size_bounds_metres: block.size_bounds_metres(&views),
            exposures: None,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: None,
            recipe: &recipe,
            source: &reader,
            picture_loss: None,
            backend: &self.backend,
        };
        train::train_from(job, None, &mut |mut now| {
            if due(now.step) {
                let step = now.step;
                // `None` if the device failed: training then ends with its error.
                is_evaluable &= now.splats().is_some_and(|splats| evaluate(step, splats));
            }
            if is_evaluable { Flow::Continue } else { Flow::Stop }
        })
        .map_err(ExecuteError::work)?;
        if is_evaluable {
            Ok(evaluations)
        } else {
            Err(ExecuteError::work("held-out photos cannot be read or are fully masked"))
        }
    }
}

/// Whether this step is one of `evaluations` that are spread evenly over all steps, the last one included.
fn is_due(step: u32, steps: u32, evaluations: u32) -> bool {
    let share = |step: u32| u64::from(step) * u64::from(evaluations.clamp(1, steps.max(1))) / u64::from(steps.max(1));
    step > 0 && share(step) > share(step - 1)
}

fn wrong_plan(problem: &str) -> ExecuteError {
    ExecuteError::of(FailureKind::Input, format!("the plan {problem}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evaluations_are_spread_evenly_and_include_the_last_step() {
        for (steps, evaluations, wanted) in
            [(10, 5, vec![2, 4, 6, 8, 10]), (7, 3, vec![3, 5, 7]), (3, 9, vec![1, 2, 3]), (5, 1, vec![5])]
        {
            let found: Vec<u32> = (0..=steps).filter(|&step| is_due(step, steps, evaluations)).collect();
            assert_eq!(found, wanted, "{evaluations} of {steps}");
        }
    }
}
