//! A plan of one block, trained as [`BlockTrainer`] trains it (the same first splats, windows, random choices and measurements),
//! but by whatever recipe, unpruned, and with nothing left in the store: what recipes are compared by.

use std::collections::BTreeMap;
use std::sync::Arc;

use blocks::Plan;
use dataset::windows::WindowReader;
use glam::Vec3;
use scene::{ArtefactId, Capture, Splats};
use store::BlockingStore;
use train::{Backend, Flow, Recipe};

use crate::block::{Block, recipe_of};
use crate::clock::Stopwatch;
use crate::execute::{BlockTrainer, Shared, TrainerOptions, failed};
use crate::merged::Judge;
use crate::{ExecuteError, FULL_RATE, FailureKind, TaskOrder};

/// A training of one block.
pub struct Whole<'a> {
    /// One block without children.
    pub plan: &'a Plan,
    /// The capture that was ingested for it.
    pub capture: Arc<Capture>,
    /// Its photos.
    pub store: BlockingStore,
    /// What computes.
    pub backend: Backend,
    /// Threads of the host.
    pub threads: usize,
    /// Bound on the windows kept in memory.
    pub cache_bytes: usize,
    /// Measurements, evenly spaced over the steps; one more is of the first splats.
    pub looks: u32,
}

/// A measurement on the way. Seconds are of all work since the photos were there, without measurements.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Steps done.
    pub step: u32,
    /// CPU seconds, of the whole process.
    pub cpu_seconds: f64,
    /// Wall seconds.
    pub wall_seconds: f64,
    /// Over the held-out views, dB.
    pub psnr: f64,
    /// Splats.
    pub splats: u64,
}

impl Whole<'_> {
    /// Trains with what `change` makes of the recipe of such a block; the first look is before the first step, the last one after the last.
    ///
    /// # Errors
    /// A plan of several blocks or without held-out views, photos that cannot be read, or training that fails.
    pub fn train(&self, change: impl Fn(Recipe) -> Recipe + Send) -> Result<Vec<Look>, ExecuteError> {
        let options = TrainerOptions {
            threads: self.threads,
            eval_every: 0,
            cache_bytes: self.cache_bytes,
            memory_bytes: 0,
            resume: false,
            checkpoint_seconds: f64::INFINITY,
        };
        let shared = Arc::new(Shared::default());
        let trainer = BlockTrainer::new(self.store.clone(), options, shared, self.backend.clone()).map_err(failed)?;
        trainer.install(|| self.train_here(&trainer, change))
    }

    fn train_here(&self, trainer: &BlockTrainer, change: impl Fn(Recipe) -> Recipe) -> Result<Vec<Look>, ExecuteError> {
        let mut clock = Stopwatch::start();
        let Self { plan, capture, .. } = self;
        let [task] = &plan.tasks[..] else { return Err(input("has several blocks; one is compared at a time")) };
        let reader = WindowReader::new(capture.clone(), self.store.clone(), self.cache_bytes);
        let judge = Judge::new(plan, &reader, &self.store);
        let mut judge = judge.ok_or_else(|| input("holds out no view, so nothing can be measured"))?;
        let order = TaskOrder {
            job: 0,
            plan: ArtefactId([0; 32]),
            task: 0,
            attempt: 1,
            inputs: BTreeMap::new(),
            rate_permille: FULL_RATE,
        };
        let block = Block {
            trainer,
            order: &order,
            plan,
            task,
            capture,
            reader: &reader,
            memory: None,
            exposures_given: None,
            residual_given: None,
        };
        let recipe = change(recipe_of(&plan.settings, task));
        let views = block.windows(&task.views)?;
        let (initial, context) = block.start(BTreeMap::new(), &views, &recipe)?;
        let mut looks: Vec<Look> = Vec::new();
        let mut look = |step: u32, splats: &Splats| -> bool {
            let (cpu_seconds, wall_seconds) = (clock.cpu_seconds(), clock.wall_seconds());
            let psnr = clock.paused(|| judge.psnr(&block.handed_on(splats.clone(), &views)));
            let count = splats.len() as u64;
            let found = psnr.map(|psnr| Look { step, cpu_seconds, wall_seconds, psnr, splats: count });
            looks.extend(found);
            found.is_some()
        };
        let mut measurable = look(0, &initial);
        let due = |step: u32| is_due(step, task.steps, self.looks);
        let job = train::Job {
            initial,
            context: context.as_ref(),
            views: &views,
            counts: &|p: Vec3| block.owns(task, p.as_dvec3()),
            keeps: &|_| true,
            budget: task.budget as usize,
            steps: task.steps,
            antialiased: plan.settings.antialiased,
            seed: block.seed(),
            size_bounds_metres: block.size_bounds_metres(&views),
            exposures: None,
            trains_exposures: false,
            recipe: &recipe,
            source: &reader,
            backend: &self.backend,
        };
        train::train_on(job, None, &mut |mut now| {
            if due(now.step) {
                let step = now.step;
                // Where there are none to see, training ends with why.
                measurable &= now.splats().is_some_and(|splats| look(step, splats));
            }
            if measurable { Flow::Continue } else { Flow::Stop }
        })
        .map_err(failed)?;
        if measurable { Ok(looks) } else { Err(failed("held-out photos cannot be read or are masked throughout")) }
    }
}

/// Is this step one of so many that are spread evenly over all steps, the last one among them?
fn is_due(step: u32, steps: u32, looks: u32) -> bool {
    let share = |step: u32| u64::from(step) * u64::from(looks.clamp(1, steps.max(1))) / u64::from(steps.max(1));
    step > 0 && share(step) > share(step - 1)
}

fn input(what: &str) -> ExecuteError {
    ExecuteError::of(FailureKind::Input, format!("the plan {what}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_are_spread_evenly_and_the_last_step_is_one() {
        for (steps, looks, wanted) in
            [(10, 5, vec![2, 4, 6, 8, 10]), (7, 3, vec![3, 5, 7]), (3, 9, vec![1, 2, 3]), (5, 1, vec![5])]
        {
            let found: Vec<u32> = (0..=steps).filter(|&step| is_due(step, steps, looks)).collect();
            assert_eq!(found, wanted, "{looks} of {steps}");
        }
    }
}
