//! The plan: an immutable, hashed list of tasks, with its settings and its codec.
//!
//! A plan is stored as positional bincode in a frame, and as JSON. The order of fields and the serde names are part of
//! both formats.

use std::collections::BTreeSet;
use std::ops::Range;

use scene::frame::{self, Kind};
use scene::{ArtefactId, BlockId, CodecError, Rect};
use serde::{Deserialize, Serialize};

use crate::ground::Ground;
use crate::lod::{Cut, training_order};
use crate::task::{DetectTask, EvalTask, ObjectTask, Task, ViewUse, tasks_of_views};

/// The format version of [`Plan`] that this program reads and writes.
pub const VERSION: u32 = 13;
/// The frame kind of a plan.
pub const PLAN: Kind = Kind(*b"plan", VERSION);
/// The maximum depth of a plan: 65,536 blocks a side.
pub const MAX_LEVELS: u8 = 16;

/// The maximum of [`PlanSettings::views_per_step`].
pub const MAX_VIEWS_PER_STEP: u32 = 16;

/// The maximum number of evaluation tasks. Each depends on all blocks.
pub(crate) const MAX_EVAL_TASKS: usize = 256;
/// The maximum number of detection tasks: the root depends on all of them.
pub(crate) const MAX_DETECT_TASKS: usize = 4096;
/// The maximum number of blocks of a plan with evaluation tasks: a grant names all results, 40 bytes each, in a message of
/// at most 4 MiB.
pub(crate) const MAX_EVALUATED_BLOCKS: usize = 1 << 16;

/// The maximum width and height of a window, pixels.
const MAX_SIDE: u32 = 1 << 24;

/// How the scene is divided into blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// The level-of-detail tree: every block is a task, initialised from its parent and trained against its context.
    #[default]
    Tree,
    /// Only the leaves, each initialised from sparse points and trained without context: the baseline.
    Flat,
    /// One task on full images.
    Whole,
}

/// The user's settings. Everything else in a plan follows from them and the capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlanSettings {
    /// How the scene is divided.
    pub mode: Mode,
    /// Levels below the root. `None`: chosen from extent, resolution, views and points.
    pub levels: Option<u8>,
    /// Seed of all random numbers of the job.
    pub seed: u64,
    /// Training work, as steps on full images of the whole scene. Plans of all modes cost about the same. A step of a
    /// scene of more than 100,000 splats costs as much as one of 100,000, so that the cost grows linearly with the
    /// scene.
    pub steps: u32,
    /// Batch size: windows rendered per optimiser step, 1 to [`MAX_VIEWS_PER_STEP`]. Larger batches fill a large GPU.
    pub views_per_step: u32,
    /// Splats of the merged model.
    pub budget: u32,
    /// PSNR that pruning of a block may lose, dB. 0: no pruning.
    pub tolerance_db: f64,
    /// Refinement threshold, relative: a block is trained only if the RMS error of its parent's splats in the block's
    /// windows exceeds this many times the root's overall RMS error. 0: every block is trained.
    pub residual: f64,
    /// Every n-th view is held out for testing. 0: none.
    pub test_every: u32,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Anti-aliased mode: opacity is compensated for the screen-space filter (Mip-Splatting's 2D filter), so that the
    /// model renders at any resolution. Otherwise classic 3DGS.
    pub antialiased: bool,
    /// Whether the root trains an exposure per view, which all other blocks reuse unchanged.
    pub exposure: bool,
    /// Whether blocks that start from points have a backdrop: splats on a sphere around the scene, for sky and distance.
    pub backdrop: bool,
    /// Memory limit of one task, bytes. Automatic levels are as many as it takes to keep to it, if the capture supports them.
    pub memory_limit_bytes: u64,
    /// Each splat carries the block that trained it, as the attribute [`scene::BLOCK_ATTRIBUTE`].
    pub label_blocks: bool,
    /// Weight of the depth loss against the capture's sparse points; 0 leaves it out.
    pub depth_weight: f64,
    /// Additional weight of pixels in the capture's zones, in training and in pruning; 0: they count as others do.
    pub zone_weight: f64,
    /// Weight of the perception-aligned loss of [`Plan::detector`], λ_perc of equation 7 of perception-aware 3DGS; 0 leaves it out.
    pub aligned_weight: f64,
    /// Whether tasks of the job measure the merged model on the held-out views after training.
    pub evaluate: bool,
    /// Width of the stretches of streets of which about one in ten is held out as well, metres; see [`crate::Split`]. 0: none.
    pub test_stretches: f64,
    /// Whether the root refines the poses of the training views, which all other blocks reuse unchanged.
    pub refine_poses: bool,
    /// Whether the root refines the mounts, focal lengths and clocks of the sensors that took the photos; all other blocks reuse the cameras.
    pub refine_sensors: bool,
    /// Whether tasks of the job train the capture's objects that move.
    pub objects: bool,
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self {
            mode: Mode::Tree,
            levels: None,
            seed: 0,
            steps: 3000,
            views_per_step: 1,
            budget: 200_000,
            tolerance_db: 0.0,
            residual: 0.0,
            test_every: 8,
            sh_degree: 3,
            antialiased: false,
            exposure: false,
            backdrop: true,
            memory_limit_bytes: 4 << 30,
            label_blocks: false,
            depth_weight: 0.0,
            zone_weight: 0.0,
            aligned_weight: 0.0,
            evaluate: false,
            test_stretches: 0.0,
            refine_poses: false,
            refine_sensors: false,
            objects: false,
        }
    }
}

/// A task of any kind, as [`Plan::planned`] finds it. A new kind of task is a list in [`Plan`] and a variant here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PlannedTask<'a> {
    /// Trains a block.
    Train(&'a Task),
    /// Measures the merged model.
    Evaluate(&'a EvalTask),
    /// Looks for objects on photos.
    Detect(&'a DetectTask),
    /// Trains an object that moves.
    Object(&'a ObjectTask),
}

impl PlannedTask<'_> {
    /// The steps that its progress counts: optimiser steps, or views.
    pub fn steps(&self) -> u64 {
        match self {
            Self::Train(task) => task.steps.into(),
            Self::Evaluate(task) => task.views.len() as u64,
            Self::Detect(task) => task.count.into(),
            Self::Object(task) => task.steps.into(),
        }
    }

    /// Estimated peak memory, bytes.
    pub fn memory_bytes(&self) -> u64 {
        match self {
            Self::Train(task) => task.memory_bytes,
            Self::Evaluate(task) => task.memory_bytes,
            Self::Detect(task) => task.memory_bytes,
            Self::Object(task) => task.memory_bytes,
        }
    }
}

/// An immutable list of tasks. Those that train are in topological order: each follows the blocks that it reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// [`VERSION`].
    pub version: u32,
    /// The capture that the plan is for.
    pub capture: ArtefactId,
    /// The objects on its photos, if they are known before the job. Else [`Plan::detect_tasks`] look for them, if anyone does.
    pub zones: Option<ArtefactId>,
    /// The detector that looks for objects, and whose loss is in training if [`PlanSettings::aligned_weight`] is not 0.
    pub detector: Option<ArtefactId>,
    /// The user's settings.
    pub settings: PlanSettings,
    /// Full name of the backend that every task must run on.
    pub backend: String,
    /// The ground plane and the root square.
    pub ground: Ground,
    /// The depth of the tree: the level of its finest blocks.
    pub levels: u8,
    /// Resolution of each level, metres per pixel; `levels + 1` entries.
    pub rho_metres: Vec<f64>,
    /// The training tasks, sorted by level, sweep, row and column. Each task follows its parent and its context.
    pub tasks: Vec<Task>,
    /// Tasks after training: each view that they measure is held out and named once. Empty without
    /// [`PlanSettings::evaluate`].
    pub eval_tasks: Vec<EvalTask>,
    /// Tasks before training: together they run the detector on each view of the capture once, in order. Empty unless a
    /// detector is to find the zones.
    pub detect_tasks: Vec<DetectTask>,
    /// Tasks that train the objects which move, in the order of the capture's objects. Empty without [`PlanSettings::objects`].
    pub object_tasks: Vec<ObjectTask>,
}

impl Plan {
    /// The id of the plan: the hash of its frame.
    pub fn id(&self) -> ArtefactId {
        ArtefactId::of(&self.to_frame())
    }

    /// Encodes the plan as a frame.
    pub fn to_frame(&self) -> Vec<u8> {
        frame::encode(PLAN, self, &[])
    }

    /// Decodes and checks a plan.
    ///
    /// # Errors
    /// A damaged frame, another version, or values that fail [`Plan::check`].
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (plan, _): (Self, _) = frame::decode(PLAN, bytes)?;
        plan.check()?;
        Ok(plan)
    }

    /// Checks that all values are in range and consistent. Call it for a plan read from JSON.
    ///
    /// # Errors
    /// The first value that is out of range.
    pub fn check(&self) -> Result<(), CodecError> {
        let bad = |problem: String| Err(CodecError::new(format!("plan {problem}")));
        if self.version != VERSION {
            return bad(format!("has version {}; this program reads version {VERSION}", self.version));
        }
        let PlanSettings { sh_degree, views_per_step, depth_weight, zone_weight, aligned_weight, .. } = self.settings;
        let is_batch = (1..=MAX_VIEWS_PER_STEP).contains(&views_per_step);
        let weights = [depth_weight, zone_weight, aligned_weight, self.settings.test_stretches];
        let are_positive = weights.iter().all(|value| value.is_finite() && *value >= 0.0);
        if !self.ground.is_sane() || self.levels > MAX_LEVELS || sh_degree > 3 || !is_batch || !are_positive {
            return bad(
                "has a ground, depth, SH degree, number of views per step, weight or stretches out of range".into()
            );
        }
        if aligned_weight > 0.0 && self.detector.is_none() {
            return bad("has a weight for the loss of a detector and no detector".into());
        }
        if !self.detect_tasks.is_empty() && (self.detector.is_none() || self.zones.is_some()) {
            return bad("has detection tasks and no detector, or zones that are known".into());
        }
        let mut detected = Some(0u32);
        for task in &self.detect_tasks {
            detected = detected.filter(|end| task.first == *end && task.count > 0);
            detected = detected.and_then(|end| end.checked_add(task.count));
        }
        if detected.is_none() || self.detect_tasks.len() > MAX_DETECT_TASKS {
            return bad(format!("has detection tasks that do not follow each other, or more than {MAX_DETECT_TASKS}"));
        }
        let sane = |rho: &f64| rho.is_finite() && *rho > 0.0;
        if self.rho_metres.len() != usize::from(self.levels) + 1 || !self.rho_metres.iter().all(sane) {
            return bad("has resolutions that do not match its levels".into());
        }
        let is_bad = |v: &ViewUse| {
            let Rect { width, height, .. } = v.window;
            v.mip > 31 || ![width, height].iter().all(|side| (1..=MAX_SIDE).contains(side))
        };
        let in_tree = |b: &BlockId| b.level <= self.levels && b.x >> b.level == 0 && b.y >> b.level == 0;
        for task in &self.tasks {
            if !task.context.iter().chain(&task.parent).chain([&task.block]).all(in_tree) || !sane(&task.rho_metres) {
                return bad(format!("has task {}, which is not in its tree", task.block));
            }
            if task.views.iter().chain(&task.test_views).any(is_bad) {
                return bad(format!("has an empty or too large window in task {}", task.block));
            }
        }
        if !self.object_tasks.is_sorted_by(|a, b| a.object < b.object) {
            return bad("has tasks of objects twice or out of order".into());
        }
        for task in &self.object_tasks {
            if task.views.is_empty() || task.views.iter().any(is_bad) || !task.context.iter().all(in_tree) {
                return bad(format!("has a task of object {} without sound windows or context", task.object));
            }
        }
        let measured = self.eval_tasks.iter().flat_map(|task| &task.views);
        if !measured.is_sorted_by(|a, b| a < b) || self.eval_tasks.iter().any(|task| task.views.is_empty()) {
            return bad("has evaluation tasks without views, or with views twice or out of order".into());
        }
        let has_too_many = self.eval_tasks.len() > MAX_EVAL_TASKS || self.tasks.len() > MAX_EVALUATED_BLOCKS;
        if !self.eval_tasks.is_empty() && has_too_many {
            return bad(format!(
                "has {} evaluation tasks on {} blocks; at most {MAX_EVAL_TASKS} on {MAX_EVALUATED_BLOCKS} are supported",
                self.eval_tasks.len(),
                self.tasks.len()
            ));
        }
        if self.tasks.is_empty() || !self.tasks.is_sorted_by(|a, b| training_order(a.block) < training_order(b.block)) {
            return bad("has no tasks, or its tasks are out of order".into());
        }
        Ok(())
    }

    /// The task of a block, if it has one.
    pub fn task(&self, block: BlockId) -> Option<&Task> {
        self.index(block).map(|index| &self.tasks[index as usize])
    }

    /// The number of tasks of all kinds.
    pub fn len(&self) -> usize {
        self.first_object() + self.object_tasks.len()
    }

    /// Whether there is no task of any kind; false for a plan that passed [`Plan::check`].
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The task of an index: first those of blocks, then those that evaluate, that detect, and those of
    /// objects. The index identifies
    /// the task towards the coordinator and its workers.
    pub fn planned(&self, index: u32) -> Option<PlannedTask<'_>> {
        let index = index as usize;
        let Some(index) = index.checked_sub(self.tasks.len()) else {
            return self.tasks.get(index).map(PlannedTask::Train);
        };
        match index.checked_sub(self.eval_tasks.len()) {
            None => self.eval_tasks.get(index).map(PlannedTask::Evaluate),
            Some(index) => match index.checked_sub(self.detect_tasks.len()) {
                None => self.detect_tasks.get(index).map(PlannedTask::Detect),
                Some(index) => self.object_tasks.get(index).map(PlannedTask::Object),
            },
        }
    }

    /// All tasks, by index.
    pub fn all_tasks(&self) -> impl Iterator<Item = PlannedTask<'_>> {
        let evaluate = self.eval_tasks.iter().map(PlannedTask::Evaluate);
        let detect = self.detect_tasks.iter().map(PlannedTask::Detect);
        let objects = self.object_tasks.iter().map(PlannedTask::Object);
        self.tasks.iter().map(PlannedTask::Train).chain(evaluate).chain(detect).chain(objects)
    }

    /// The index of the first detection task; that of no task if there are none.
    pub fn first_detection(&self) -> usize {
        self.tasks.len() + self.eval_tasks.len()
    }

    /// The index of the first task of an object that moves; that of no task if there are none.
    pub fn first_object(&self) -> usize {
        self.first_detection() + self.detect_tasks.len()
    }

    /// The blocks whose results a task reads.
    pub fn inputs(&self, task: PlannedTask) -> BTreeSet<BlockId> {
        match task {
            PlannedTask::Train(task) => task.context_cut().blocks(),
            PlannedTask::Evaluate(_) => self.tasks.iter().map(|task| task.block).collect(),
            PlannedTask::Detect(_) => BTreeSet::new(),
            PlannedTask::Object(task) => task.context.iter().copied().collect(),
        }
    }

    /// The detection tasks whose results a task reads, by index, ascending: those of its training views and, as zones are
    /// smoothed over three photos, of the views before and after each.
    pub fn detections(&self, task: PlannedTask) -> Vec<u32> {
        match task {
            PlannedTask::Train(task) if self.settings.zone_weight > 0.0 => {
                let views = task.views.iter().map(|used| used.view);
                let first = self.first_detection();
                let places = tasks_of_views(&self.detect_tasks, views);
                places.into_iter().map(|place| (first + place) as u32).collect()
            }
            _ => Vec::new(),
        }
    }

    /// The tasks of objects whose results a task reads, by index, ascending.
    pub fn objects(&self, task: PlannedTask) -> Range<u32> {
        match task {
            PlannedTask::Evaluate(_) => self.first_object() as u32..self.len() as u32,
            _ => 0..0,
        }
    }

    /// The tasks whose results a task reads, by index.
    ///
    /// # Errors
    /// A block that has no task.
    pub fn dependencies(&self, task: PlannedTask) -> Result<BTreeSet<u32>, CodecError> {
        let index = |block| {
            let missing = || CodecError::new(format!("a task needs block {block}, which has no task"));
            self.index(block).ok_or_else(missing)
        };
        let others = self.detections(task).into_iter().chain(self.objects(task)).map(Ok);
        self.inputs(task).into_iter().map(index).chain(others).collect()
    }

    /// The index of a block's training task.
    pub fn index(&self, block: BlockId) -> Option<u32> {
        let found = self.tasks.binary_search_by_key(&training_order(block), |t| training_order(t.block));
        found.ok().map(|index| index as u32)
    }

    /// How often these tasks of the plan draw each of their windows, on average.
    pub fn visits<'a>(&self, tasks: impl IntoIterator<Item = &'a Task>) -> f64 {
        let (draws, windows) = (tasks.into_iter()).fold((0.0, 0.0), |(draws, windows), task| {
            (draws + f64::from(task.steps), windows + task.views.len() as f64)
        });
        draws * f64::from(self.settings.views_per_step) / f64::max(windows, 1.0)
    }

    /// [`Plan::visits`] of the blocks without children.
    pub fn leaf_visits(&self) -> f64 {
        let parents: BTreeSet<BlockId> = self.tasks.iter().filter_map(|task| task.parent).collect();
        self.visits(self.tasks.iter().filter(|task| !parents.contains(&task.block)))
    }

    /// The finest cut: the owner of every place in the merged model. Every place has exactly one.
    ///
    /// In a tree the owner is the deepest task whose core contains the place, so the area of a block without a task
    /// stays with its nearest ancestor. In a flat plan such an area belongs to the task with the nearest centre.
    pub fn leaves(&self) -> Cut {
        let blocks = self.tasks.iter().map(|t| t.block);
        match self.settings.mode {
            Mode::Flat => Cut::nearest(&self.ground, blocks),
            Mode::Tree | Mode::Whole => blocks.collect(),
        }
    }
}
