//! Evaluates the merged model while a job runs: the model that the job would end with if every block stayed as it is now, on the job's
//! held-out photos. So the figures of different tasks belong to one curve.
//!
//! Architecture invariant: no result depends on an evaluation.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Mutex, PoisonError};

use blocks::{Cut, Mode, Part, Plan, Split};
use dataset::windows::WindowReader;
use render::Options;
use render::cpu::Renderer;
use scene::splats::sh_coefficients;
use scene::{ArtefactId, BlockId, Splats, column};
use store::BlockingStore;
use train::{metrics, source};

/// Photos are compared at the finest mip of at most this many pixels, which bounds the memory.
const MAX_PIXELS: u64 = 4 << 20;
/// About the number of tasks after which a plan's merged model is evaluated. After every task it would cost a city of many blocks more
/// than its training.
const EVALUATIONS: usize = 16;
/// Cache of decoded photos.
const CACHE_BYTES: usize = 32 << 20;
/// Largest merged model that is evaluated, bytes: a larger one would take most of a worker's memory.
const MAX_MERGED_BYTES: u64 = 64 << 20;

/// The finished blocks of a job that this process knows: those that its workers trained, and the inputs of their tasks.
#[derive(Debug, Default)]
pub struct FinishedBlocks {
    /// The plan, and of each block the splats that no deeper finished block owns.
    parts: Mutex<(Option<ArtefactId>, BTreeMap<BlockId, Splats>)>,
}

impl FinishedBlocks {
    /// Adds a result.
    pub(crate) fn insert(&self, id: ArtefactId, plan: &Plan, block: BlockId, splats: &Splats) {
        self.parts(id, |parts| {
            let cut = cut_of(plan, parts.keys().copied().chain([block]));
            parts.insert(block, Splats::new(plan.settings.sh_degree));
            let tree = plan.settings.mode == Mode::Tree;
            for (&of, part) in parts.iter_mut() {
                // In a tree a block only replaces splats of its ancestors.
                let touched = !tree || (of.level < block.level && block.ancestor(of.level) == of);
                if of == block {
                    *part = cut.keep(splats, &plan.ground, of);
                } else if touched {
                    *part = cut.keep(part, &plan.ground, of);
                }
            }
        });
    }

    /// Adds the inputs of a task that are not known yet.
    pub(crate) fn learn(&self, id: ArtefactId, plan: &Plan, results: &BTreeMap<BlockId, Splats>) {
        for (&block, splats) in results {
            if !self.parts(id, |parts| parts.contains_key(&block)) {
                self.insert(id, plan, block, splats);
            }
        }
    }

    /// The merged model with these splats of `block`.
    pub(crate) fn merged_with(&self, id: ArtefactId, plan: &Plan, block: BlockId, splats: &Splats) -> Splats {
        self.parts(id, |parts| {
            let cut = cut_of(plan, parts.keys().copied().chain([block]));
            let mut all: BTreeMap<BlockId, &Splats> = parts.iter().map(|(&of, part)| (of, part)).collect();
            all.insert(block, splats);
            let all = all.into_iter().map(Ok);
            blocks::merge_cut(&cut, &plan.ground, all).unwrap_or_else(|never: Infallible| match never {})
        })
    }

    fn parts<T>(&self, id: ArtefactId, f: impl FnOnce(&mut BTreeMap<BlockId, Splats>) -> T) -> T {
        // After a panic a block may have too many splats, which only affects figures.
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        if parts.0 != Some(id) {
            *parts = (Some(id), BTreeMap::new());
        }
        f(&mut parts.1)
    }
}

/// Whether the merged model is evaluated while the job runs: if it is a single block, which is in memory anyway, or small.
pub fn is_evaluated(plan: &Plan) -> bool {
    let columns = column::SH + 3 * sh_coefficients(plan.settings.sh_degree);
    plan.tasks.len() == 1 || u64::from(plan.settings.budget) * 4 * columns as u64 <= MAX_MERGED_BYTES
}

/// Whether the merged model is evaluated after this task. It is after the last one.
pub(crate) fn evaluates_after(plan: &Plan, task: u32) -> bool {
    let (done, all) = (task as usize + 1, plan.tasks.len());
    done == all || done.is_multiple_of(all.div_ceil(EVALUATIONS).max(1))
}

/// The cut that assigns each place to one of some blocks of a plan, as [`Plan::leaves`] does for all.
fn cut_of(plan: &Plan, blocks: impl Iterator<Item = BlockId>) -> Cut {
    match plan.settings.mode {
        Mode::Flat => Cut::nearest(&plan.ground, blocks),
        Mode::Tree | Mode::Whole => blocks.collect(),
    }
}

/// Compares merged models with the held-out photos.
pub(crate) struct MergedEvaluator {
    reader: WindowReader,
    antialiased: bool,
    /// Held-out views and the mips at which they are compared.
    views: Vec<(u32, u8)>,
    renderer: Renderer,
}

impl MergedEvaluator {
    /// `None` if no view is held out or the merged model is too large. Its own reads do not count towards the store's traffic or the
    /// reader's statistics.
    pub(crate) fn new(plan: &Plan, reader: &WindowReader, store: &BlockingStore) -> Option<Self> {
        if !is_evaluated(plan) {
            return None;
        }
        let capture = reader.capture();
        // Stretches are left out, so that figures of runs with and without them compare.
        let held_out = Split::of(plan, capture).views(Part::Test);
        let mip = |camera: &scene::Camera| {
            (0..31).find(|&mip| camera.mip(mip).full().area() <= MAX_PIXELS).unwrap_or_default()
        };
        let views: Vec<_> =
            held_out.into_iter().map(|view| (view, mip(&capture.views[view as usize].camera))).collect();
        let reader = reader.with_store(store.store().metered().blocking(), CACHE_BYTES);
        let antialiased = plan.settings.antialiased;
        (!views.is_empty()).then(|| Self { reader, antialiased, views, renderer: Renderer::default() })
    }

    /// Mean PSNR, dB; `None` if masks cover every photo or one cannot be read, which training reports.
    pub(crate) fn psnr(&mut self, model: &Splats) -> Option<f64> {
        let options = Options { antialiased: self.antialiased, sh_degree: model.sh_degree(), ..Options::default() };
        let (mut sum, mut count) = (0.0, 0);
        let capture = self.reader.capture();
        let windows =
            self.views.iter().map(|&(view, mip)| (view, mip, capture.views[view as usize].camera.mip(mip).full()));
        for ((view, mip, _), photo) in windows.clone().zip(source::each(&self.reader, windows)) {
            let (photo, camera) = (photo.ok()?, capture.views[view as usize].camera.mip(mip));
            let frame = self.renderer.forward(model, &[], &camera, &options);
            let reference: Vec<f32> = photo.rgb.iter().map(|&value| f32::from(value) / 255.0).collect();
            let render: Vec<f32> = frame.colour.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            if let Some(psnr) = metrics::psnr(&render, &reference, photo.mask.as_deref()) {
                sum += psnr;
                count += 1;
            }
        }
        (count > 0).then(|| sum / f64::from(count))
    }
}

#[cfg(test)]
mod tests {
    use blocks::PlanSettings;
    use glam::Vec3;
    use scene::Splat;

    use super::*;
    use crate::testing::{plan_of, task};

    fn plan(mode: Mode) -> Plan {
        let plan = plan_of(mode, Vec::new());
        Plan { settings: PlanSettings { sh_degree: 0, ..plan.settings.clone() }, ..plan }
    }

    /// A splat of log-scale `size` at the centre of each quarter of the ground.
    fn four(size: f32) -> Splats {
        let mut splats = Splats::new(0);
        for (x, y) in [(2.0, 2.0), (6.0, 2.0), (2.0, 6.0), (6.0, 6.0)] {
            splats.push(&Splat::round(Vec3::new(x, y, 0.0), size, Vec3::ONE, 0.5));
        }
        splats
    }

    #[test]
    fn every_place_shows_its_deepest_finished_block() {
        let [a, b] = [BlockId { level: 1, x: 0, y: 0 }, BlockId { level: 1, x: 1, y: 0 }];
        let (finished, plan, id) = (FinishedBlocks::default(), plan(Mode::Tree), ArtefactId([2; 32]));
        let sizes = |splats: &Splats| {
            let mut sizes: Vec<i32> = (0..splats.len()).map(|i| splats.get(i).log_scale.x as i32).collect();
            sizes.sort_unstable();
            sizes
        };
        assert_eq!(sizes(&finished.merged_with(id, &plan, BlockId::ROOT, &four(1.0))), [1, 1, 1, 1]);
        finished.learn(id, &plan, &BTreeMap::from([(BlockId::ROOT, four(1.0))]));
        finished.insert(id, &plan, a, &four(2.0));
        finished.learn(id, &plan, &BTreeMap::from([(BlockId::ROOT, four(9.0)), (a, four(9.0))]));
        assert_eq!(sizes(&finished.merged_with(id, &plan, b, &four(3.0))), [1, 1, 2, 3]);
        // Merging does not change the finished blocks, and a second attempt replaces the first.
        assert_eq!(sizes(&finished.merged_with(id, &plan, a, &four(4.0))), [1, 1, 1, 4]);
        // Another job starts empty.
        assert_eq!(sizes(&finished.merged_with(ArtefactId([3; 32]), &plan, b, &four(3.0))), [3]);
    }

    #[test]
    fn large_merged_models_are_not_evaluated() {
        let evaluated = |tasks: usize, budget: u32, sh_degree: u8| {
            let plan = plan(Mode::Tree);
            let settings = PlanSettings { budget, sh_degree, ..plan.settings.clone() };
            is_evaluated(&Plan { tasks: vec![task(BlockId::ROOT, 1); tasks], settings, ..plan })
        };
        // 59 floats of four bytes each: 284,359 splats are 64 MiB.
        assert!(evaluated(5, 284_359, 3) && !evaluated(5, 284_360, 3));
        assert!(evaluated(5, 1_000_000, 0) && evaluated(1, u32::MAX, 3));
    }

    #[test]
    fn large_plans_are_evaluated_after_some_tasks_and_the_last() {
        let mut plan = plan(Mode::Tree);
        let mut evaluations = |count: usize| {
            plan.tasks = vec![task(BlockId::ROOT, 1); count];
            (0..count as u32).filter(|&i| evaluates_after(&plan, i)).collect::<Vec<u32>>()
        };
        assert_eq!(evaluations(5), [0, 1, 2, 3, 4]);
        assert_eq!(evaluations(21).len(), 11);
        let many = evaluations(1365);
        assert!(many.len() <= EVALUATIONS + 1 && many.last() == Some(&1364), "{many:?}");
    }

    #[test]
    fn in_a_flat_plan_the_nearest_block_fills_gaps() {
        let [a, b] = [BlockId { level: 1, x: 0, y: 0 }, BlockId { level: 1, x: 1, y: 1 }];
        let (finished, plan, id) = (FinishedBlocks::default(), plan(Mode::Flat), ArtefactId([2; 32]));
        finished.insert(id, &plan, a, &four(1.0));
        assert_eq!(finished.merged_with(id, &plan, a, &four(1.0)).len(), 4);
        assert_eq!(finished.merged_with(id, &plan, b, &four(2.0)).len(), 4);
    }
}
