//! The plan: an immutable, hashed list of tasks, with its settings and its codec.
//!
//! A plan is stored as positional bincode in a frame, and as JSON. The order of fields and the serde names are part of
//! both formats.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::frame::{self, Kind};
use scene::{ArtefactId, BlockId, CodecError, Rect};
use serde::{Deserialize, Serialize};

use crate::ground::{Ground, HALO_SCALE};
use crate::lod::{Cut, training_order};

/// The format version of [`Plan`] that this program reads and writes.
pub const VERSION: u32 = 10;
/// The frame kind of a plan.
pub const PLAN: Kind = Kind(*b"plan", VERSION);
/// The maximum depth of a plan: 65,536 blocks a side.
pub const MAX_LEVELS: u8 = 16;

/// The maximum of [`PlanSettings::views_per_step`].
pub const MAX_VIEWS_PER_STEP: u32 = 16;

/// The maximum number of evaluation tasks. Each depends on all blocks.
pub(crate) const MAX_EVAL_TASKS: usize = 256;
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
    /// Memory limit of one task, bytes.
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
            memory_limit_bytes: 4 << 30,
            label_blocks: false,
            depth_weight: 0.0,
            zone_weight: 0.0,
            aligned_weight: 0.0,
            evaluate: false,
            test_stretches: 0.0,
            refine_poses: false,
        }
    }
}

/// A window of a view at one mip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ViewUse {
    /// Index into the capture's views.
    pub view: u32,
    /// Mip of the image; 0 is full resolution.
    pub mip: u8,
    /// The window, pixels of that mip.
    pub window: Rect,
}

/// The task of training one block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// The block. It identifies the task within the plan.
    pub block: BlockId,
    /// The block whose result initialises this one. `None`: initialised from sparse points.
    pub parent: Option<BlockId>,
    /// Context: blocks that are rendered frozen with this one. Coarser blocks outside the halo, and finished neighbours
    /// of the same level, which also count inside the halo. Together with the parent they cover the plane; see
    /// [`Task::context_cut`].
    pub context: Vec<BlockId>,
    /// Training windows, sorted by view.
    pub views: Vec<ViewUse>,
    /// Held-out windows for evaluation, sorted by view.
    pub test_views: Vec<ViewUse>,
    /// Number of sparse points in the halo.
    pub points: u32,
    /// Target number of splats in the core at the end of training.
    pub budget: u32,
    /// Estimated number of own splats (core and halo) that a window shows at the end, mean over the windows.
    #[serde(rename = "drawn")]
    pub visible_splats: u32,
    /// Estimated number of frozen context splats that a window shows, mean over the windows.
    #[serde(rename = "context_drawn")]
    pub visible_context_splats: u32,
    /// Training steps, one window each.
    pub steps: u32,
    /// Target resolution, metres per pixel.
    pub rho_metres: f64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

impl Task {
    /// The total number of pixels of all training windows.
    pub fn window_pixels(&self) -> u64 {
        self.views.iter().map(|v| v.window.area()).sum()
    }

    /// The share of the pixels of the training windows that are finer than the parent's of the same view, 0 to 1: what
    /// the parent has not been trained on.
    pub fn finer_share(&self, parent: &Task) -> f64 {
        let mips: BTreeMap<u32, u8> = parent.views.iter().map(|used| (used.view, used.mip)).collect();
        let is_finer = |used: &&ViewUse| mips.get(&used.view).is_none_or(|mip| used.mip < *mip);
        let finer: u64 = self.views.iter().filter(is_finer).map(|used| used.window.area()).sum();
        finer as f64 / self.window_pixels().max(1) as f64
    }

    /// The donor of a place (world metres): the finished neighbour whose splats initialise that part of this block's
    /// core. `None`: the parent's splats are used.
    ///
    /// The donor is the nearest finished neighbour whose halo contains the place in its inner half. The neighbour
    /// trained its splats there together with the splats that stay frozen on its side of the face. In the outer half of
    /// its halo it has too few observations.
    pub fn donor(&self, ground: &Ground, place: DVec3) -> Option<BlockId> {
        const INNER: f64 = 0.25 * (HALO_SCALE - 1.0);
        if !ground.owns(self.block, place) || ground.is_background(place) {
            return None;
        }
        let reach = INNER * ground.core_edge_metres(self.block.level);
        (self.context.iter())
            .filter(|neighbour| neighbour.level == self.block.level)
            .map(|&neighbour| (ground.metres_from_core(neighbour, place), neighbour))
            .filter(|&(metres, _)| metres <= reach)
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, neighbour)| neighbour)
    }

    /// The cut that the block is trained against: its context and its parent.
    pub fn context_cut(&self) -> Cut {
        self.context.iter().copied().chain(self.parent).collect()
    }
}

/// The task of measuring the merged model on some held-out views. It reads the results of all blocks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EvalTask {
    /// Indices of the views, ascending. They are compared at full resolution.
    pub views: Vec<u32>,
    /// Pixels of all these views.
    pub pixels: u64,
    /// Estimated peak memory, bytes.
    pub memory_bytes: u64,
}

/// A task of any kind, as [`Plan::planned`] finds it. A new kind of task is a list in [`Plan`] and a variant here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PlannedTask<'a> {
    /// Trains a block.
    Train(&'a Task),
    /// Measures the merged model.
    Evaluate(&'a EvalTask),
}

impl PlannedTask<'_> {
    /// The steps that its progress counts: optimiser steps, or views.
    pub fn steps(&self) -> u64 {
        match self {
            Self::Train(task) => task.steps.into(),
            Self::Evaluate(task) => task.views.len() as u64,
        }
    }

    /// Estimated peak memory, bytes.
    pub fn memory_bytes(&self) -> u64 {
        match self {
            Self::Train(task) => task.memory_bytes,
            Self::Evaluate(task) => task.memory_bytes,
        }
    }
}

/// An immutable list of tasks in topological order: each task follows its dependencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// [`VERSION`].
    pub version: u32,
    /// The capture that the plan is for.
    pub capture: ArtefactId,
    /// The objects on its photos, if anyone looked for them.
    pub zones: Option<ArtefactId>,
    /// The detector whose loss is in training, if [`PlanSettings::aligned_weight`] is not 0.
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
        let sane = |rho: &f64| rho.is_finite() && *rho > 0.0;
        if self.rho_metres.len() != usize::from(self.levels) + 1 || !self.rho_metres.iter().all(sane) {
            return bad("has resolutions that do not match its levels".into());
        }
        let in_tree = |b: &BlockId| b.level <= self.levels && b.x >> b.level == 0 && b.y >> b.level == 0;
        for task in &self.tasks {
            if !task.context.iter().chain(&task.parent).chain([&task.block]).all(in_tree) || !sane(&task.rho_metres) {
                return bad(format!("has task {}, which is not in its tree", task.block));
            }
            let is_bad = |v: &ViewUse| {
                let Rect { width, height, .. } = v.window;
                v.mip > 31 || ![width, height].iter().all(|side| (1..=MAX_SIDE).contains(side))
            };
            if task.views.iter().chain(&task.test_views).any(is_bad) {
                return bad(format!("has an empty or too large window in task {}", task.block));
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
        self.tasks.len() + self.eval_tasks.len()
    }

    /// Whether there is no task of any kind; false for a plan that passed [`Plan::check`].
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The task of an index: first the training tasks, then those that evaluate. The index identifies the task towards
    /// the coordinator and its workers.
    pub fn planned(&self, index: u32) -> Option<PlannedTask<'_>> {
        let index = index as usize;
        match index.checked_sub(self.tasks.len()) {
            None => self.tasks.get(index).map(PlannedTask::Train),
            Some(index) => self.eval_tasks.get(index).map(PlannedTask::Evaluate),
        }
    }

    /// All tasks, by index.
    pub fn all_tasks(&self) -> impl Iterator<Item = PlannedTask<'_>> {
        let evaluate = self.eval_tasks.iter().map(PlannedTask::Evaluate);
        self.tasks.iter().map(PlannedTask::Train).chain(evaluate)
    }

    /// The blocks whose results a task reads.
    pub fn inputs(&self, task: PlannedTask) -> BTreeSet<BlockId> {
        match task {
            PlannedTask::Train(task) => task.context_cut().blocks(),
            PlannedTask::Evaluate(_) => self.tasks.iter().map(|task| task.block).collect(),
        }
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

/// Why a capture cannot be planned.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// A setting is out of range.
    #[error("{setting}: {problem}; {advice}")]
    Setting {
        /// The command-line flag or name of the setting.
        setting: &'static str,
        /// The problem.
        problem: String,
        /// What to do about it.
        advice: &'static str,
    },
    /// No training view remains.
    #[error(
        "no training view: of {views} views, {usable} have a usable camera and {test} are held out; add views or hold out fewer (--test-every)"
    )]
    NoTrainViews {
        /// Number of views of the capture.
        views: usize,
        /// Number of views with a usable camera.
        usable: usize,
        /// Number of held-out views.
        test: usize,
    },
    /// The capture has no sparse points.
    #[error(
        "the capture has no finite sparse points, which plat needs to divide and initialise the scene; run structure from motion or provide a point cloud"
    )]
    NoPoints,
    /// No training view observes a sparse point.
    #[error(
        "no training view observes any of the {points} sparse points; check that poses and points are in the same frame and that cameras look along +z"
    )]
    NoObservations {
        /// Number of finite sparse points.
        points: usize,
    },
    /// The blocks are too small for the capture.
    #[error("no block of level {levels} has {needed} views and enough sparse points; use fewer levels (--levels)")]
    NoBlocks {
        /// The level that was tried.
        levels: u8,
        /// Minimum number of views of a block.
        needed: usize,
    },
}
