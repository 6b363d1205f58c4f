//! The plan: an immutable, hashed list of what to do.

use glam::DVec3;
use scene::frame::{self, Kind};
use scene::{ArtefactId, BlockId, CodecError, Rect};
use serde::{Deserialize, Serialize};

use crate::allot::first_splats;
use crate::ground::{Ground, HALO_SCALE};
use crate::lod::{Cut, training_order};

/// The version of [`Plan`] that this program writes and reads.
pub const VERSION: u32 = 5;
/// The frame that carries a plan.
pub const PLAN: Kind = Kind(*b"plan", VERSION);
/// The deepest level a plan may have: 65,536 blocks a side.
pub const MAX_LEVELS: u8 = 16;

/// The most [`PlanSettings::views_per_step`].
pub const MOST_VIEWS_PER_STEP: u32 = 16;

/// No image is wider or higher, in pixels.
const MAX_SIDE: u32 = 1 << 24;

/// How the scene is divided. All three share everything below the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// The level-of-detail tree: every block a task, children initialised from their parent, against its neighbours.
    #[default]
    Tree,
    /// Only the leaves, each from the sparse points and for itself: the baseline to beat.
    Flat,
    /// One task, full images.
    Whole,
}

/// What a person decides; everything else follows from the capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlanSettings {
    /// How the scene is divided.
    pub mode: Mode,
    /// Levels below the root; `None` chooses from extent, resolution, views and points.
    pub levels: Option<u8>,
    /// Seeds every random number of the job.
    pub seed: u64,
    /// Steps of full images of the whole scene; plans of all modes cost about this much. Trees of a scene too large for one block
    /// (100,000 splats) cost what these steps do on so much of it, so that cost grows with the scene and not with its square.
    pub steps: u32,
    /// Windows that a task draws before splats move: more of them fill a large GPU.
    pub views_per_step: u32,
    /// Splats of the merged model.
    pub budget: u32,
    /// What leaves may lose of their PSNR for fewer splats, dB; 0 prunes nothing.
    pub tolerance_db: f64,
    /// A block is refined where its parent's splats are off, in its own photos, by more than this many times what the root is
    /// off by in all (root mean squares); 0 refines all, and lets no schedule follow what training says.
    pub residual: f64,
    /// Every which view is held out; 0 holds out none.
    pub test_every: u32,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Opacity compensated for the pixel's blur, so that the model may be drawn at any resolution (Mip-Splatting's 2D filter);
    /// else a plain 3DGS model.
    pub antialiased: bool,
    /// Whether the root trains an exposure of each view, which all others take as it is.
    pub exposure: bool,
    /// What one task may take, bytes.
    pub memory_limit_bytes: u64,
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
        }
    }
}

/// A window of a view at a mip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ViewUse {
    /// Index into the capture's views.
    pub view: u32,
    /// Mip of the image, 0 = full size.
    pub mip: u8,
    /// The part of that mip's image that is used, in its pixels.
    pub window: Rect,
}

/// Train one block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// The block; its name within the plan.
    pub block: BlockId,
    /// Where the first splats come from; `None` = the sparse points.
    pub parent: Option<BlockId>,
    /// Blocks that are rendered along, frozen: coarser ones outside the halo, and the finished neighbours of its own level,
    /// inside the halo too. With the parent they cover the plane; where one lies inside another the deeper counts
    /// ([`Task::context_cut`]).
    pub context: Vec<BlockId>,
    /// What it trains on, by view.
    pub views: Vec<ViewUse>,
    /// What it is measured on, by view.
    pub test_views: Vec<ViewUse>,
    /// Sparse points in the halo.
    pub points: u32,
    /// Splats to end with inside the core.
    pub budget: u32,
    /// Splats that a window shows at the end, halo included, mean over the windows; an estimate.
    pub drawn: u32,
    /// Frozen splats of the context that a window shows, mean over the windows; an estimate.
    pub context_drawn: u32,
    /// Steps, counted in windows.
    pub steps: u32,
    /// Metres per pixel that the block is to resolve.
    pub rho_metres: f64,
    /// Estimate of the memory it takes, bytes.
    pub memory_bytes: u64,
}

impl Task {
    /// Pixels of all training windows.
    pub fn window_pixels(&self) -> u64 {
        self.views.iter().map(|v| v.window.area()).sum()
    }

    /// The finished neighbour whose splats this place of the block's own core starts from, if not from the parent's: the nearest of
    /// those in whose halo's inner half it lies. What a neighbour has there was trained together with what stays frozen on its side of
    /// the face; the outer half it saw too little of.
    pub fn lender(&self, ground: &Ground, place: DVec3) -> Option<BlockId> {
        const INNER: f64 = 0.25 * (HALO_SCALE - 1.0);
        if !ground.owns(self.block, place) || ground.is_far(place) {
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

    /// The already trained cut of the tree around (and, as the parent, under) the block.
    pub fn context_cut(&self) -> Cut {
        self.context.iter().copied().chain(self.parent).collect()
    }
}

/// An immutable list of tasks, each after those that it needs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// [`VERSION`].
    pub version: u32,
    /// The capture planned for.
    pub capture: ArtefactId,
    /// What the person decided.
    pub settings: PlanSettings,
    /// The backend that every task runs on, by full name.
    pub backend: String,
    /// The ground and its root square.
    pub ground: Ground,
    /// The deepest level.
    pub levels: u8,
    /// Metres per pixel of each level, `levels + 1` of them.
    pub rho_metres: Vec<f64>,
    /// By level, sweep, row and column, so that each comes after its parent and its context.
    pub tasks: Vec<Task>,
}

impl Plan {
    /// The plan's name: the hash of its frame.
    pub fn id(&self) -> ArtefactId {
        ArtefactId::of(&self.to_frame())
    }

    /// The plan as bytes.
    pub fn to_frame(&self) -> Vec<u8> {
        frame::encode(PLAN, self, &[])
    }

    /// A plan from bytes.
    ///
    /// # Errors
    /// Damage, another version, or numbers that no planner wrote.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (plan, _): (Self, _) = frame::decode(PLAN, bytes)?;
        plan.check()?;
        Ok(plan)
    }

    /// Refuses plans whose numbers would make other functions meaningless; also for plans read from JSON.
    ///
    /// # Errors
    /// What is out of range.
    pub fn check(&self) -> Result<(), CodecError> {
        let bad = |what: String| Err(CodecError::new(format!("plan {what}")));
        if self.version != VERSION {
            return bad(format!("of version {}, this program reads {VERSION}", self.version));
        }
        let PlanSettings { sh_degree, views_per_step, .. } = self.settings;
        let is_step = (1..=MOST_VIEWS_PER_STEP).contains(&views_per_step);
        if !self.ground.is_sane() || self.levels > MAX_LEVELS || sh_degree > 3 || !is_step {
            return bad("with a ground, depth, SH degree or number of views per step out of range".into());
        }
        let sane = |rho: &f64| rho.is_finite() && *rho > 0.0;
        if self.rho_metres.len() != usize::from(self.levels) + 1 || !self.rho_metres.iter().all(sane) {
            return bad("whose resolutions do not fit its levels".into());
        }
        let in_tree = |b: &BlockId| b.level <= self.levels && b.x >> b.level == 0 && b.y >> b.level == 0;
        for task in &self.tasks {
            if !task.context.iter().chain(&task.parent).chain([&task.block]).all(in_tree) || !sane(&task.rho_metres) {
                return bad(format!("whose task {} is not in its tree", task.block));
            }
            let window = |v: &ViewUse| {
                let Rect { width, height, .. } = v.window;
                v.mip > 31 || ![width, height].iter().all(|side| (1..=MAX_SIDE).contains(side))
            };
            if task.views.iter().chain(&task.test_views).any(window) {
                return bad(format!("whose task {} has a window that is empty or larger than any image", task.block));
            }
        }
        if self.tasks.is_empty() || !self.tasks.is_sorted_by(|a, b| training_order(a.block) < training_order(b.block)) {
            return bad("without tasks or with tasks out of order".into());
        }
        Ok(())
    }

    /// Splats at most that a task starts with where it starts from points.
    pub fn first_splats(&self, task: &Task) -> u32 {
        first_splats(task, self.tasks.iter().any(|t| t.parent == Some(task.block)))
    }

    /// The task of a block.
    pub fn task(&self, block: BlockId) -> Option<&Task> {
        self.tasks
            .binary_search_by_key(&training_order(block), |t| training_order(t.block))
            .ok()
            .map(|i| &self.tasks[i])
    }

    /// The finest model: which task's splats count where. Every place has exactly one owner.
    ///
    /// In a tree the owner is the deepest task around a place: the area of a block without a task stays with its
    /// nearest ancestor. In a flat plan such areas go to the task with the nearest centre.
    pub fn leaves(&self) -> Cut {
        let blocks = self.tasks.iter().map(|t| t.block);
        match self.settings.mode {
            Mode::Flat => Cut::nearest(&self.ground, blocks),
            Mode::Tree | Mode::Whole => blocks.collect(),
        }
    }
}

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// A setting out of its range.
    #[error("{setting}: {problem}; {advice}")]
    Setting {
        /// Which one.
        setting: &'static str,
        /// What is wrong.
        problem: String,
        /// What to do.
        advice: &'static str,
    },
    /// No view is left to train on.
    #[error(
        "no view to train on: of {views} views {usable} have a usable camera and {test} are held out; add views or hold out fewer (--test-every)"
    )]
    NoTrainViews {
        /// Views of the capture.
        views: usize,
        /// Those with a sane camera.
        usable: usize,
        /// Those held out.
        test: usize,
    },
    /// Nothing to start from.
    #[error(
        "the capture has no finite sparse points; plat needs them to divide the scene and to start from: run structure from motion or give a point cloud"
    )]
    NoPoints,
    /// Cameras and points do not fit together.
    #[error(
        "no training view sees any of the {points} sparse points; check that poses and points are in the same frame and that cameras look along +z"
    )]
    NothingSeen {
        /// Finite sparse points.
        points: usize,
    },
    /// Blocks too small for the capture.
    #[error(
        "no block of level {levels} is seen by {needed} views and holds enough points; use fewer levels (--levels)"
    )]
    NoBlocks {
        /// The level tried.
        levels: u8,
        /// Views a block needs.
        needed: usize,
    },
}
