//! What does not change of a job: its plan and its capture, and where its photos and results are.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

use blocks::{Part, Plan, PlannedTask, Split, StepCost, ViewKind, view_kinds};
use dataset::windows::WindowReader;
use eval::ViewFigures;
use glam::{DMat4, DVec3};
use scene::{ArtefactId, BlockId, Capture, Pixels, Rect, Splats, frame};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use store::BlockingStore;

/// Cameras, and points, of a drawn plan at most.
const DRAWN_LIMIT: usize = 20_000;
/// Widest photo that is sent, pixels.
const PHOTO_WIDTH: u32 = 1280;
const JPEG_QUALITY: u8 = 85;
/// Bytes of decoded photos that a job keeps.
const PHOTO_CACHE_BYTES: usize = 64 << 20;

/// Where the splats of blocks are.
#[derive(Debug)]
pub(crate) enum Results {
    /// In a store, by artefact.
    Store(BlockingStore),
    /// In the folder `model/blocks` that `plat train` wrote.
    Folder(PathBuf),
}

/// The fixed part of a job.
#[derive(Debug)]
pub(crate) struct Project {
    pub(crate) name: String,
    pub(crate) plan: Plan,
    pub(crate) plan_id: ArtefactId,
    /// Of the blocks' tasks, the planner's cost of each.
    pub(crate) work: Vec<f64>,
    /// Of the blocks' tasks, the tasks of their children.
    pub(crate) children: Vec<Vec<u32>>,
    tasks: BTreeMap<BlockId, u32>,
    results: Results,
    capture: Option<Arc<Capture>>,
    photos: Option<WindowReader>,
    plan_json: OnceLock<Vec<u8>>,
    figures: RwLock<Figures>,
}

/// Figures of held-out views.
#[derive(Debug, Default)]
struct Figures {
    by_view: BTreeMap<u32, ViewFigures>,
    by_block: Vec<Option<f64>>,
    faces: Vec<Face>,
}

/// How well two blocks of the finest model fit where they meet, as `plat eval --seams` measured it.
#[derive(Debug, Deserialize)]
pub(crate) struct Face {
    a: BlockId,
    b: BlockId,
    /// How far the pictures of the two differ there, levels of 255.
    jump: Option<f64>,
    /// How much the error changes from one side to the other, levels of 255.
    step: Option<f64>,
}

/// About a task.
pub(crate) struct About {
    pub(crate) block: Option<BlockId>,
    pub(crate) parent: Option<u32>,
    pub(crate) neighbours: Vec<u32>,
    pub(crate) steps: u32,
    pub(crate) budget: u32,
    pub(crate) rho_metres: f64,
    pub(crate) memory_bytes: u64,
}

#[derive(Serialize)]
struct CameraView {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    world_from_camera: [f64; 16],
}

impl Project {
    /// A job of this plan. Without a capture there are no photos and no cameras.
    pub(crate) fn new(
        name: String,
        plan: Plan,
        results: Results,
        capture: Option<(Capture, Option<BlockingStore>)>,
    ) -> Self {
        let tasks: BTreeMap<BlockId, u32> =
            plan.tasks.iter().zip(0..).map(|(task, index)| (task.block, index)).collect();
        let child_tasks =
            |block: BlockId| block.children().into_iter().filter_map(|child| tasks.get(&child).copied()).collect();
        let (capture, store) = capture.map_or((None, None), |(capture, store)| (Some(Arc::new(capture)), store));
        let photos = capture.clone().zip(store);
        Self {
            name,
            plan_id: plan.id(),
            work: plan.tasks.iter().map(|task| StepCost::of(task).total() * f64::from(task.steps)).collect(),
            children: plan.tasks.iter().map(|task| child_tasks(task.block)).collect(),
            tasks,
            results,
            photos: photos.map(|(capture, store)| WindowReader::new(capture, store, PHOTO_CACHE_BYTES)),
            capture,
            plan,
            plan_json: OnceLock::new(),
            figures: RwLock::default(),
        }
    }

    /// Number of tasks that train a block, which are the first.
    pub(crate) fn blocks(&self) -> usize {
        self.plan.tasks.len()
    }

    pub(crate) fn task_of(&self, block: BlockId) -> Option<u32> {
        self.tasks.get(&block).copied()
    }

    pub(crate) fn about(&self, task: u32) -> About {
        let none = About {
            block: None,
            parent: None,
            neighbours: Vec::new(),
            steps: 0,
            budget: 0,
            rho_metres: 0.0,
            memory_bytes: 0,
        };
        match self.plan.planned(task) {
            Some(PlannedTask::Train(task)) => About {
                block: Some(task.block),
                parent: task.parent.and_then(|parent| self.task_of(parent)),
                neighbours: neighbours(task.block).filter_map(|block| self.task_of(block)).collect(),
                steps: task.steps,
                budget: task.budget,
                rho_metres: task.rho_metres,
                memory_bytes: task.memory_bytes,
            },
            Some(other @ (PlannedTask::Evaluate(_) | PlannedTask::Detect(_) | PlannedTask::Object(_))) => {
                About { steps: other.steps() as u32, memory_bytes: other.memory_bytes(), ..none }
            }
            None => none,
        }
    }

    /// The drawing of the plan, as JSON. It never changes.
    pub(crate) fn plan_json(&self) -> &[u8] {
        self.plan_json.get_or_init(|| serde_json::to_vec(&self.plan_view()).unwrap_or_default())
    }

    fn plan_view(&self) -> Value {
        let (plan, ground) = (&self.plan, &self.plan.ground);
        let column = |of: &dyn Fn(&blocks::Task) -> Value| plan.tasks.iter().map(of).collect::<Vec<Value>>();
        let held_out = self.capture.as_ref().map(|capture| Split::of(plan, capture));
        let (mut cameras, mut points) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
        let mut is_test = Vec::new();
        if let Some(capture) = &self.capture {
            let step = capture.views.len().div_ceil(DRAWN_LIMIT).max(1);
            for (index, view) in capture.views.iter().enumerate().step_by(step) {
                let at = ground.from_world(view.camera.centre());
                cameras.iter_mut().zip([at.x, at.y]).for_each(|(column, value)| column.push(centimetres(value)));
                is_test.push(u8::from(held_out.as_ref().is_some_and(|split| split.is_held_out(index as u32))));
            }
            let positions = &capture.points.positions;
            for &point in positions.iter().step_by(positions.len().div_ceil(DRAWN_LIMIT).max(1)) {
                let at = ground.from_world(point);
                points.iter_mut().zip([at.x, at.y]).for_each(|(column, value)| column.push(centimetres(value)));
            }
        }
        let geo = self.capture.as_ref().and_then(|capture| capture.geo_origin);
        let geo = geo.map(|geo| json!({"latitude": geo.latitude_degrees, "longitude": geo.longitude_degrees}));
        let [camera_x, camera_y] = cameras;
        let [point_x, point_y] = points;
        json!({
            "plan": self.plan_id.to_string(),
            "name": self.name,
            "levels": plan.levels,
            "root": self.root(),
            "north_up": geo.is_some(),
            "geo": geo,
            "blocks": {
                "level": column(&|task| task.block.level.into()),
                "x": column(&|task| task.block.x.into()),
                "y": column(&|task| task.block.y.into()),
                "steps": column(&|task| task.steps.into()),
                "budget": column(&|task| task.budget.into()),
                "rho_metres": column(&|task| task.rho_metres.into()),
                "views": column(&|task| task.views.len().into()),
            },
            "evaluations": plan.eval_tasks.len(),
            "detections": plan.detect_tasks.len(),
            "objects": plan.object_tasks.len(),
            "cameras": {"x": camera_x, "y": camera_y, "test": is_test},
            "points": {"x": point_x, "y": point_y},
        })
    }

    fn root(&self) -> Value {
        let ground = &self.plan.ground;
        json!({"x": ground.min.x, "y": ground.min.y, "edge": ground.edge_metres})
    }

    /// The middle of what a viewer shows, ground metres: places are sent relative to it, as f32 and f16 are exact near the origin only.
    pub(crate) fn centre(&self) -> DVec3 {
        let ground = &self.plan.ground;
        (ground.min + 0.5 * ground.edge_metres).extend(ground.height_metres).round()
    }

    /// Where a block's own origin is, ground metres from [`centre`](Self::centre).
    fn origin(&self, block: BlockId) -> DVec3 {
        let ground = &self.plan.ground;
        // Adding zero makes -0 a 0.
        (ground.core(block).centre().extend(ground.height_metres) - self.centre()).round() + DVec3::ZERO
    }

    /// The tree for a viewer; `done` has the artefact and the splats of a finished block, by task.
    pub(crate) fn model_view(&self, seq: u64, done: impl Fn(u32) -> Option<(String, u64)>) -> Value {
        let (plan, ground, centre) = (&self.plan, &self.plan.ground, self.centre());
        let [low, high] = self.heights();
        let block = |(task, index): (&blocks::Task, u32)| {
            let core = ground.core(task.block);
            let (min, max) = (core.min.extend(low) - centre, core.max.extend(high) - centre);
            let (artefact, splats) = done(index).unzip();
            json!({
                "block": task.block.to_string(), "task": index, "artefact": artefact, "splats": splats.unwrap_or(0),
                "backdrop": task.block == BlockId::ROOT,
                "origin": self.origin(task.block).to_array(), "rho_metres": task.rho_metres, "box": [min.x, min.y, min.z, max.x, max.y, max.z],
            })
        };
        let turn = ground.ground_from_world.to_array();
        let figures = self.figures.read().unwrap_or_else(PoisonError::into_inner);
        let face = |face: &Face| json!({"a": face.a.to_string(), "b": face.b.to_string(), "jump": face.jump, "step": face.step});
        json!({
            "seq": seq, "root": self.root(), "centre": centre.to_array(), "turn": turn, "formats": ["rad", "spz"],
            "sh_degree": plan.settings.sh_degree, "antialiased": plan.settings.antialiased,
            "blocks": plan.tasks.iter().zip(0..).map(block).collect::<Vec<Value>>(),
            "faces": figures.faces.iter().map(face).collect::<Vec<Value>>(),
        })
    }

    /// Between which heights above the ground plane the scene is: the 2nd and 98th percentile of its points.
    fn heights(&self) -> [f64; 2] {
        let ground = &self.plan.ground;
        let points = self.capture.iter().flat_map(|capture| &capture.points.positions);
        let mut heights: Vec<f64> = points.map(|&point| ground.from_world(point).z).collect();
        heights.sort_by(f64::total_cmp);
        match heights.len().checked_sub(1) {
            Some(last) => [0.02, 0.98].map(|share| heights[(share * last as f64) as usize]),
            None => [ground.height_metres - 5.0, ground.height_metres + 5.0],
        }
    }

    /// The splats that a finished block owns, about its own origin, in world axes; with `backdrop` the root's background instead, about the
    /// [`centre`](Self::centre).
    pub(crate) fn splats(&self, block: BlockId, artefact: ArtefactId, backdrop: bool) -> Result<Splats, String> {
        let bytes = match &self.results {
            Results::Store(store) => store.get(artefact).map_err(|error| error.to_string())?.to_vec(),
            Results::Folder(folder) => {
                let path = folder.join(format!("{}-{}-{}.plat", block.level, block.x, block.y));
                std::fs::read(&path).map_err(|error| format!("{} cannot be read ({error})", path.display()))?
            }
        };
        let (splats, _) = frame::decode_result(&bytes).map_err(|error| format!("block {block}: {error}"))?;
        let ground = &self.plan.ground;
        let origin = ground.to_world(self.centre() + if backdrop { DVec3::ZERO } else { self.origin(block) });
        let mut kept = splats.filter(|i| {
            let place = splats.mean(i).as_dvec3();
            splats.is_finite(i) && ground.is_background(place) == backdrop && (backdrop || ground.owns(block, place))
        });
        for (column, middle) in kept.columns_mut().iter_mut().zip(origin.to_array()) {
            column.iter_mut().for_each(|value| *value = (f64::from(*value) - middle) as f32);
        }
        Ok(kept)
    }

    /// A view's photo as JPEG; `None` if there is none.
    pub(crate) fn photo(&self, view: u32) -> Result<Option<Vec<u8>>, String> {
        let Some(reader) = &self.photos else { return Ok(None) };
        let Some(about) = reader.capture().views.get(view as usize).filter(|view| !view.mips.is_empty()) else {
            return Ok(None);
        };
        let (width, height) = (about.camera.pinhole.width, about.camera.pinhole.height);
        let mip = (0..about.mips.len() as u32).find(|mip| width >> mip <= PHOTO_WIDTH);
        let mip = mip.unwrap_or(about.mips.len() as u32 - 1);
        let size = |side: u32| (0..mip).fold(side, |side, _| (side / 2).max(1));
        let rect = Rect { x: 0, y: 0, width: size(width), height: size(height) };
        let pixels = reader.window(view, mip as u8, rect).map_err(|error| error.to_string())?;
        jpeg(&pixels).map(Some)
    }

    /// Takes over the figures of held-out views, by their names.
    pub(crate) fn add_figures(&self, measured: Vec<ViewFigures>) {
        let Some(capture) = &self.capture else { return };
        let index = |name: &str| capture.views.binary_search_by(|view| view.name.as_str().cmp(name)).ok();
        let mut figures = self.figures.write().unwrap_or_else(PoisonError::into_inner);
        let found = measured.into_iter().filter_map(|view| Some((index(&view.view)? as u32, view)));
        figures.by_view.extend(found);
        // A view counts for the finest block under its camera.
        let leaves = self.plan.leaves();
        let mut sums = vec![(0.0, 0u32); self.blocks()];
        for (view, of) in &figures.by_view {
            let place = capture.views[*view as usize].camera.centre();
            let task = leaves.owner_of(&self.plan.ground, place).and_then(|block| self.task_of(block));
            if let (Some(task), Some(psnr)) = (task, of.psnr) {
                let (sum, count) = &mut sums[task as usize];
                (*sum, *count) = (*sum + psnr, *count + 1);
            }
        }
        figures.by_block = sums.into_iter().map(|(sum, count)| (count > 0).then(|| sum / f64::from(count))).collect();
    }

    /// Takes over the figures of faces between blocks.
    pub(crate) fn set_faces(&self, faces: Vec<Face>) {
        self.figures.write().unwrap_or_else(PoisonError::into_inner).faces = faces;
    }

    /// Means of PSNR, SSIM and SSIMULACRA2 over the measured views.
    pub(crate) fn quality(&self) -> [Option<f64>; 3] {
        let figures = self.figures.read().unwrap_or_else(PoisonError::into_inner);
        let of = |figure: fn(&ViewFigures) -> Option<f64>| eval::mean(figures.by_view.values().map(figure));
        [of(|view| view.psnr), of(|view| Some(view.ssim)), of(|view| view.perceptual)]
    }

    /// PSNR of the held-out views taken in a block, dB.
    pub(crate) fn block_psnr(&self, task: usize) -> Option<f64> {
        let figures = self.figures.read().unwrap_or_else(PoisonError::into_inner);
        figures.by_block.get(task).copied().flatten()
    }

    /// The views, with their cameras on the ground's axes.
    pub(crate) fn views(&self) -> Value {
        let Some(capture) = &self.capture else { return json!({"views": []}) };
        let figures = self.figures.read().unwrap_or_else(PoisonError::into_inner);
        let (split, kinds, ground) = (Split::of(&self.plan, capture), view_kinds(capture), self.plan.ground);
        let leaves = self.plan.leaves();
        let view = |(index, view): (usize, &scene::View)| {
            let k = &view.camera.pinhole;
            let pose = view.camera.camera_from_world.inverse();
            let turned = (ground.ground_from_world * pose.rotation, ground.from_world(pose.translation));
            let matrix = DMat4::from_rotation_translation(turned.0, turned.1);
            let world_from_camera = matrix.transpose().to_cols_array();
            let of = figures.by_view.get(&(index as u32));
            json!({
                "task": leaves.owner_of(&self.plan.ground, pose.translation).and_then(|block| self.task_of(block)),
                "view": index, "name": view.name, "width": k.width, "height": k.height,
                "test": split.part(index as u32) != Part::Trained,
                "camera": CameraView { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, world_from_camera },
                "photo": self.photos.is_some() && !view.mips.is_empty(),
                "street": kinds.get(index).map(|kind| *kind == ViewKind::Street),
                "psnr": of.and_then(|of| of.psnr), "ssim": of.map(|of| of.ssim),
                "perceptual": of.and_then(|of| of.perceptual),
            })
        };
        json!({"views": capture.views.iter().enumerate().map(view).collect::<Vec<Value>>()})
    }

    /// The figures that an evaluation task left.
    pub(crate) fn figures_of(&self, artefact: ArtefactId) -> Result<Vec<ViewFigures>, String> {
        let Results::Store(store) = &self.results else { return Ok(Vec::new()) };
        let bytes = store.get(artefact).map_err(|error| error.to_string())?;
        eval::figures_from_frame(&bytes).map_err(|error| error.to_string())
    }
}

fn centimetres(metres: f64) -> f64 {
    (100.0 * metres).round() / 100.0
}

/// The blocks of the same level that share a face.
fn neighbours(block: BlockId) -> impl Iterator<Item = BlockId> {
    [(-1, 0), (1, 0), (0, -1), (0, 1)].into_iter().filter_map(move |(dx, dy)| {
        let (x, y) = (block.x.checked_add_signed(dx)?, block.y.checked_add_signed(dy)?);
        Some(BlockId { x, y, ..block })
    })
}

fn jpeg(pixels: &Pixels) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY);
    eval::photo_image(pixels).write_with_encoder(encoder).map_err(|error| error.to_string())?;
    Ok(bytes)
}
