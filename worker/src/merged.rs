//! The merged model on the way: what the job would end with if every block stayed as it is now, measured on the job's
//! held-out photos. So figures of different tasks are of one thing and may stand on one curve.
//!
//! Architecture invariant: this only looks. No result depends on it.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Mutex, PoisonError};

use blocks::{Cut, Mode, Plan};
use dataset::windows::WindowReader;
use render::Options;
use render::cpu::Renderer;
use scene::splats::sh_coefficients;
use scene::{ArtefactId, BlockId, Capture, Splats, column};
use store::BlockingStore;
use train::{metrics, source};

/// Photos are compared at the finest mip of at most this many pixels, which bounds the memory that it takes.
const PIXELS_LIMIT: u64 = 4 << 20;
/// The ends of tasks at which a plan's merged model is measured, about: at every one it would cost a city of many blocks more
/// than their training.
const LOOKS: usize = 16;
/// Photos kept decoded.
const CACHE_BYTES: usize = 32 << 20;
/// A merged model of more bytes is not measured on the way: it would be most of what a worker takes, and more with every block.
const MERGED_BYTES: u64 = 64 << 20;

/// What is finished of a job, as far as the workers that share this know: those of one process know all of it, others
/// what their tasks were given.
#[derive(Debug, Default)]
pub struct Finished {
    /// Of the plan with this name, each block's splats without those that a deeper finished block owns.
    parts: Mutex<(Option<ArtefactId>, BTreeMap<BlockId, Splats>)>,
}

impl Finished {
    /// Notes a result.
    pub(crate) fn insert(&self, id: ArtefactId, plan: &Plan, block: BlockId, splats: &Splats) {
        self.parts(id, |parts| {
            let cut = cut_of(plan, parts.keys().copied().chain([block]));
            parts.insert(block, Splats::new(plan.settings.sh_degree));
            let tree = plan.settings.mode == Mode::Tree;
            for (&of, part) in parts.iter_mut() {
                // In a tree it takes from those above it alone.
                let touched = !tree || (of.level < block.level && block.ancestor(of.level) == of);
                if of == block {
                    *part = cut.keep(splats, &plan.ground, of);
                } else if touched {
                    *part = cut.keep(part, &plan.ground, of);
                }
            }
        });
    }

    /// Notes the results that a task was given, where they are not known.
    pub(crate) fn learn(&self, id: ArtefactId, plan: &Plan, results: &BTreeMap<BlockId, Splats>) {
        for (&block, splats) in results {
            if !self.parts(id, |parts| parts.contains_key(&block)) {
                self.insert(id, plan, block, splats);
            }
        }
    }

    /// The merged model with `block` as it is now.
    pub(crate) fn with(&self, id: ArtefactId, plan: &Plan, block: BlockId, splats: &Splats) -> Splats {
        self.parts(id, |parts| {
            let cut = cut_of(plan, parts.keys().copied().chain([block]));
            let mut all: BTreeMap<BlockId, &Splats> = parts.iter().map(|(&of, part)| (of, part)).collect();
            all.insert(block, splats);
            let all = all.into_iter().map(Ok);
            blocks::merge_cut(&cut, &plan.ground, all).unwrap_or_else(|never: Infallible| match never {})
        })
    }

    fn parts<T>(&self, id: ArtefactId, f: impl FnOnce(&mut BTreeMap<BlockId, Splats>) -> T) -> T {
        // A thread that panicked left at worst a block with too many splats, in figures only.
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        if parts.0 != Some(id) {
            *parts = (Some(id), BTreeMap::new());
        }
        f(&mut parts.1)
    }
}

/// Whether the merged model is measured on the way: where it is one block's, which is in memory anyway, or small. Else it is evaluated
/// at the end, by whoever wants to.
pub fn is_measured(plan: &Plan) -> bool {
    let columns = column::SH + 3 * sh_coefficients(plan.settings.sh_degree);
    plan.tasks.len() == 1 || u64::from(plan.settings.budget) * 4 * columns as u64 <= MERGED_BYTES
}

/// Whether the merged model is measured when this row of the plan's tasks has ended; after the last it is.
pub(crate) fn is_look(plan: &Plan, task: u32) -> bool {
    let (done, all) = (task as usize + 1, plan.tasks.len());
    done == all || done.is_multiple_of(all.div_ceil(LOOKS).max(1))
}

/// Who owns what among some blocks of a plan, as [`Plan::leaves`] says of all.
fn cut_of(plan: &Plan, blocks: impl Iterator<Item = BlockId>) -> Cut {
    match plan.settings.mode {
        Mode::Flat => Cut::nearest(&plan.ground, blocks),
        Mode::Tree | Mode::Whole => blocks.collect(),
    }
}

/// Compares models with the held-out photos.
pub(crate) struct Judge {
    reader: WindowReader,
    antialiased: bool,
    /// Held-out views and the mips at which they are looked at.
    views: Vec<(u32, u8)>,
    renderer: Renderer,
}

impl Judge {
    /// `None` where no view is held out, or the merged model is too large. It reads beside `reader`, and what it reads is not counted
    /// among what the store moved.
    pub(crate) fn new(plan: &Plan, reader: &WindowReader, store: &BlockingStore) -> Option<Self> {
        if !is_measured(plan) {
            return None;
        }
        let held_out =
            reader.capture().views.iter().enumerate().filter(|(i, _)| Capture::is_test(*i, plan.settings.test_every));
        let mip = |camera: &scene::Camera| {
            (0..31).find(|&mip| camera.mip(mip).full().area() <= PIXELS_LIMIT).unwrap_or_default()
        };
        let views: Vec<_> = held_out.map(|(i, view)| (i as u32, mip(&view.camera))).collect();
        let reader = reader.beside(store.store().metered().blocking(), CACHE_BYTES);
        let antialiased = plan.settings.antialiased;
        (!views.is_empty()).then(|| Self { reader, antialiased, views, renderer: Renderer::default() })
    }

    /// Mean PSNR, dB; `None` where masks leave nothing or a photo cannot be read (training will say why).
    pub(crate) fn psnr(&mut self, model: &Splats) -> Option<f64> {
        let options = Options { antialiased: self.antialiased, sh_degree: model.sh_degree(), ..Options::default() };
        let (mut sum, mut count) = (0.0, 0);
        let capture = self.reader.capture();
        let windows =
            self.views.iter().map(|&(view, mip)| (view, mip, capture.views[view as usize].camera.mip(mip).full()));
        for ((view, mip, _), photo) in windows.clone().zip(source::each(&self.reader, windows)) {
            let (photo, camera) = (photo.ok()?, capture.views[view as usize].camera.mip(mip));
            let frame = self.renderer.forward(model, None, &camera, &options);
            let truth: Vec<f32> = photo.rgb.iter().map(|&value| f32::from(value) / 255.0).collect();
            let render: Vec<f32> = frame.colour.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            if let Some(psnr) = metrics::psnr(&render, &truth, photo.mask.as_deref()) {
                sum += psnr;
                count += 1;
            }
        }
        (count > 0).then(|| sum / f64::from(count))
    }
}

#[cfg(test)]
mod tests {
    use blocks::{Ground, PlanSettings};
    use glam::{DQuat, DVec2, Vec3};
    use scene::Splat;

    use super::*;

    fn plan(mode: Mode) -> Plan {
        Plan {
            version: blocks::plan::VERSION,
            capture: ArtefactId([1; 32]),
            settings: PlanSettings { mode, sh_degree: 0, ..PlanSettings::default() },
            backend: "none".into(),
            ground: Ground {
                ground_from_world: DQuat::IDENTITY,
                min: DVec2::ZERO,
                edge_metres: 8.0,
                height_metres: 0.0,
                near_metres: 1e300,
            },
            levels: 1,
            rho_metres: vec![2.0, 1.0],
            tasks: Vec::new(),
        }
    }

    /// A splat at the centre of each quarter of the ground, as large as `size`.
    fn four(size: f32) -> Splats {
        let mut splats = Splats::new(0);
        for (x, y) in [(2.0, 2.0), (6.0, 2.0), (2.0, 6.0), (6.0, 6.0)] {
            splats.push(&Splat::round(Vec3::new(x, y, 0.0), size, Vec3::ONE, 0.5));
        }
        splats
    }

    #[test]
    fn every_place_shows_the_deepest_that_is_finished() {
        let [a, b] = [BlockId { level: 1, x: 0, y: 0 }, BlockId { level: 1, x: 1, y: 0 }];
        let (finished, plan, id) = (Finished::default(), plan(Mode::Tree), ArtefactId([2; 32]));
        let sizes = |splats: &Splats| {
            let mut sizes: Vec<i32> = (0..splats.len()).map(|i| splats.get(i).log_scale.x as i32).collect();
            sizes.sort_unstable();
            sizes
        };
        assert_eq!(sizes(&finished.with(id, &plan, BlockId::ROOT, &four(1.0))), [1, 1, 1, 1]);
        finished.learn(id, &plan, &BTreeMap::from([(BlockId::ROOT, four(1.0))]));
        finished.insert(id, &plan, a, &four(2.0));
        finished.learn(id, &plan, &BTreeMap::from([(BlockId::ROOT, four(9.0)), (a, four(9.0))]));
        assert_eq!(sizes(&finished.with(id, &plan, b, &four(3.0))), [1, 1, 2, 3]);
        // Looking at it changes nothing, and another attempt takes the place of the last.
        assert_eq!(sizes(&finished.with(id, &plan, a, &four(4.0))), [1, 1, 1, 4]);
        // Another job starts anew.
        assert_eq!(sizes(&finished.with(ArtefactId([3; 32]), &plan, b, &four(3.0))), [3]);
    }

    fn task() -> blocks::Task {
        blocks::Task {
            block: BlockId::ROOT,
            parent: None,
            context: Vec::new(),
            views: Vec::new(),
            test_views: Vec::new(),
            points: 0,
            budget: 1,
            visible_splats: 0,
            visible_context_splats: 0,
            steps: 1,
            rho_metres: 1.0,
            memory_bytes: 0,
        }
    }

    #[test]
    fn what_may_not_fit_beside_the_work_is_not_measured() {
        let measured = |tasks: usize, budget: u32, sh_degree: u8| {
            let plan = plan(Mode::Tree);
            let settings = PlanSettings { budget, sh_degree, ..plan.settings.clone() };
            is_measured(&Plan { tasks: vec![task(); tasks], settings, ..plan })
        };
        // 59 floats of four bytes each: 284,359 are 64 MiB.
        assert!(measured(5, 284_359, 3) && !measured(5, 284_360, 3));
        assert!(measured(5, 1_000_000, 0) && measured(1, u32::MAX, 3));
    }

    #[test]
    fn large_plans_are_looked_at_now_and_then_and_at_their_end() {
        let mut plan = plan(Mode::Tree);
        let mut looks = |count: usize| {
            plan.tasks = vec![task(); count];
            (0..count as u32).filter(|&i| is_look(&plan, i)).collect::<Vec<u32>>()
        };
        assert_eq!(looks(5), [0, 1, 2, 3, 4]);
        assert_eq!(looks(21).len(), 11);
        let many = looks(1365);
        assert!(many.len() <= LOOKS + 1 && many.last() == Some(&1364), "{many:?}");
    }

    #[test]
    fn of_a_flat_plan_the_nearest_fills_in() {
        let [a, b] = [BlockId { level: 1, x: 0, y: 0 }, BlockId { level: 1, x: 1, y: 1 }];
        let (finished, plan, id) = (Finished::default(), plan(Mode::Flat), ArtefactId([2; 32]));
        finished.insert(id, &plan, a, &four(1.0));
        assert_eq!(finished.with(id, &plan, a, &four(1.0)).len(), 4);
        assert_eq!(finished.with(id, &plan, b, &four(2.0)).len(), 4);
    }
}
