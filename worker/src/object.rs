//! Trains an object that moves: in its own axes it stands still, and the cameras move around it. The static scene around its path is
//! drawn with it, frozen, from where each camera stands in the world.

use std::collections::BTreeMap;

use blocks::{Cut, ObjectTask, Plan, object_camera};
use dataset::windows::WindowReader;
use glam::Vec3;
use perceive::tracking::Kind;
use proto::FailureKind;
use scene::{BlockId, Camera, Capture, Exposures, MovingObject, PathPose, Poses, SparsePoints, Splats, Swing, View};
use train::growth::Growth;
use train::{Backend, Job, ObjectTimes, Recipe, TrainError, TrainView, Trained, Walk, random};

use crate::clock::Stopwatch;
use crate::memory_budget::MemoryBudget;
use crate::silhouettes::{SHADOW_METRES, Silhouettes, visual_hull};
use crate::task::{ExecuteError, FULL_RATE, Flow, Report, Reporter, TaskOrder};

/// Weight of the silhouette loss.
const SILHOUETTE_WEIGHT: f32 = 0.1;
/// Shadows lie on the ground, this far up and down, metres.
const SHADOW_HEIGHT: f64 = 0.2;
/// Share of the budget to start with.
const INITIAL_SHARE: f64 = 0.5;
/// Margin around a window, as a share of its size, within which frozen splats are kept in memory.
const CONTEXT_MARGIN: f32 = 0.2;
/// Limbs of a person who is less high on a photo are not told apart, pixels.
const LEAST_PERSON_PIXELS: usize = 20;
/// Steps between two reports.
const REPORT_EVERY: u32 = 20;

/// An object to be trained.
pub(crate) struct ObjectTraining<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) task: &'a ObjectTask,
    /// The task's object as the capture has it.
    pub(crate) object: &'a MovingObject,
    pub(crate) order: &'a TaskOrder,
    pub(crate) capture: &'a Capture,
    pub(crate) reader: &'a WindowReader,
    /// The exposures that the root trained.
    pub(crate) exposures: Option<&'a Exposures>,
    /// The poses that the root refined.
    pub(crate) poses: Option<&'a Poses>,
}

impl ObjectTraining<'_> {
    /// The object's path, refined with its splats, these, in its own axes, and how they swing if it is a person who walks. `results` are
    /// those of the blocks around its path.
    ///
    /// # Errors
    /// Photos that cannot be read, training that fails, memory above the budget, or a report that was answered with [`Flow::Stop`].
    pub(crate) fn train(
        &self,
        results: BTreeMap<BlockId, Splats>,
        mut memory: Option<MemoryBudget>,
        stopwatch: &Stopwatch,
        report: &mut Reporter,
    ) -> Result<(Vec<PathPose>, Splats, Option<Swing>), ExecuteError> {
        let (plan, task, object) = (self.plan, self.task, self.object);
        let number = task.object as usize;
        let views = self.views(object)?;
        let context = self.context(results, &views);
        let silhouettes = Silhouettes { photos: self.reader, capture: self.capture, object: number };
        let seed = random::bits(plan.settings.seed, 1 << 62 | u64::from(task.object));
        let recipe = Recipe {
            silhouette_weight: SILHOUETTE_WEIGHT,
            // Windows are small, and the first splats fill the silhouettes.
            coarse: Vec::new(),
            growth: Growth { worth_db: 0.0, ..Growth::default() },
            ..Recipe::default()
        };
        let recipe = recipe.at_rate(self.order.rate_permille as f32 / FULL_RATE as f32);
        let sizes = size_bounds_metres(object);
        let taken = views.iter().filter_map(|view| Some((view.view, self.capture.views[view.view as usize].seconds?)));
        let taken: Vec<(u32, f64)> = taken.collect();
        let mut times = ObjectTimes::of(taken.iter().copied(), (object.high - object.low).max_element());
        if Kind::of_class(&object.class) == Some(Kind::Person) {
            let shown = silhouettes.showing(&views, LEAST_PERSON_PIXELS).map_err(unread)?;
            times.walk = Walk::of(taken.into_iter(), |view| shown.contains(&view), object);
        }
        let count = (INITIAL_SHARE * f64::from(task.budget)) as usize;
        let hull = visual_hull(&silhouettes, &views, count.max(1), seed);
        let (positions, colours) = hull.map_err(unread)?.into_iter().unzip();
        let points = SparsePoints { positions, colours, ..SparsePoints::default() };
        let initial = train::init::from_points(&points, plan.settings.sh_degree, recipe.initial_opacity, sizes);
        let job = Job {
            initial,
            context: context.as_ref(),
            views: &views,
            counts: &|_| true,
            keeps: &|place| is_part(object, place),
            free_space: None,
            budget: task.budget as usize,
            steps: task.steps,
            antialiased: plan.settings.antialiased,
            seed,
            size_bounds_metres: sizes,
            exposures: self.exposures,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: Some(&times),
            recipe: &recipe,
            source: &silhouettes,
            picture_loss: None,
            // Windows of some thousand pixels leave a GPU idle, and it does not compute the silhouette loss.
            backend: &Backend::Cpu,
        };
        let (mut overrun, mut is_stopped) = (None, false);
        let trained = train::train_from(job, None, &mut |mut now| {
            if now.step % REPORT_EVERY >= now.views && now.step < now.steps {
                return train::Flow::Continue;
            }
            let (step, steps, splats) = (now.step.into(), now.steps.into(), now.count() as u64);
            let flow = report(Report {
                step,
                steps,
                loss: now.loss().unwrap_or(f64::NAN),
                splats,
                cpu_seconds: stopwatch.cpu_seconds(),
                wall_seconds: stopwatch.wall_seconds(),
                ..Report::default()
            });
            overrun = memory.as_mut().and_then(MemoryBudget::overrun);
            is_stopped |= (flow == Flow::Stop || overrun.is_some()) && step < steps;
            if is_stopped { train::Flow::Stop } else { train::Flow::Continue }
        });
        let Trained { mut splats, motions, swing, .. } = trained.map_err(|error| failure(object, &error))?;
        if let Some(resident) = overrun {
            let message = format!("object {}: the worker takes {} MiB, above its --memory", object.id, resident >> 20);
            return Err(ExecuteError::of(FailureKind::OutOfMemory, message));
        }
        if is_stopped {
            return Err(ExecuteError::work("stopped before its end, as requested"));
        }
        if !plan.settings.antialiased {
            train::low_pass::to_full_resolution(&mut splats, &views);
        }
        let is_kept = |i: &u32| is_part(object, splats.mean(*i as usize));
        let kept: Vec<u32> = (0..splats.len() as u32).filter(is_kept).collect();
        Ok((object.moved(&motions), splats.select(&kept), swing.map(|swing| swing.select(&kept))))
    }

    /// The windows, with cameras in the object's axes.
    fn views(&self, object: &MovingObject) -> Result<Vec<TrainView>, ExecuteError> {
        let window = |used: &blocks::ViewUse| {
            let seen = self.capture.views.get(used.view as usize);
            let placed = seen.and_then(|seen| {
                let in_world = self.in_world(used.view, seen);
                Some((in_world.camera_from_world, object_camera(&in_world, object, seen.seconds?)?))
            });
            let missing = || ExecuteError::work(format!("object {} is not on view {}", object.id, used.view));
            let (camera_from_world, camera) = placed.ok_or_else(missing)?;
            let camera_from_context = Some(camera_from_world);
            Ok(TrainView { view: used.view, mip: used.mip, rect: used.window, camera, camera_from_context })
        };
        self.task.views.iter().map(window).collect()
    }

    /// The camera of a view in the world, from its refined pose if there is one.
    fn in_world(&self, number: u32, view: &View) -> Camera {
        self.poses.map_or(view.camera, |poses| poses.apply(number, view.camera))
    }

    /// The splats around the path that the windows show.
    fn context(&self, results: BTreeMap<BlockId, Splats>, views: &[TrainView]) -> Option<Splats> {
        let cut: Cut = self.task.context.iter().copied().collect();
        let in_world: Vec<TrainView> = views
            .iter()
            .map(|view| {
                let camera = self.in_world(view.view, &self.capture.views[view.view as usize]);
                TrainView { camera, camera_from_context: None, ..*view }
            })
            .collect();
        let mut context = Splats::new(self.plan.settings.sh_degree);
        for (block, splats) in results {
            let frozen = cut.keep(&splats, &self.plan.ground, block);
            let visible = train::visibility::finest_pixels(&frozen, &in_world, CONTEXT_MARGIN);
            let mut shown = frozen.filter(|i| visible[i].is_visible());
            if !self.plan.settings.antialiased {
                train::low_pass::from_full_resolution(&mut shown, &in_world);
            }
            context.append(&shown);
        }
        (!context.is_empty()).then_some(context)
    }
}

/// Smallest and largest standard deviation of a splat, metres: from a millimetre to a quarter of the box's longest side.
fn size_bounds_metres(object: &MovingObject) -> [f32; 2] {
    [0.001, (0.25 * (object.high - object.low).max_element()) as f32]
}

/// Whether a place in the object's axes is in its box, or in its shadow.
fn is_part(object: &MovingObject, place: Vec3) -> bool {
    let place = place.as_dvec3();
    let [low, .., high] = object.splat_box();
    let in_box = place.cmpge(low).all() && place.cmple(high).all();
    let beside = |axis: usize| {
        place[axis] >= object.low[axis] - SHADOW_METRES && place[axis] <= object.high[axis] + SHADOW_METRES
    };
    in_box || ((place.z - object.low.z).abs() <= SHADOW_HEIGHT && beside(0) && beside(1))
}

fn unread(error: String) -> ExecuteError {
    ExecuteError::of(FailureKind::Infrastructure, error)
}

fn failure(object: &MovingObject, error: &TrainError) -> ExecuteError {
    let kind = match error {
        TrainError::Source(_) => return unread(error.to_string()),
        TrainError::OutOfMemory(_) => FailureKind::OutOfMemory,
        _ => FailureKind::Work,
    };
    ExecuteError::of(kind, format!("object {}: {error}", object.id))
}
