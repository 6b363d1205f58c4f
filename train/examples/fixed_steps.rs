//! Trains a fixed job on one thread, for counting instructions: `.ci/check-instructions.sh` runs it under valgrind.
//! Prints the instruction set of the kernels.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3, Vec3};
use render::cpu::{Isa, Renderer};
use render::{Options, Part};
use scene::{Camera, Pinhole, Pixels, Rect, Rigid, Splat, Splats};
use train::{Backend, Flow, Job, Recipe, TrainView, WindowSource, random, train};

const WIDTH: u32 = 96;
const HEIGHT: u32 = 72;
const VIEWS: u32 = 6;
const SPLATS: u64 = 1000;
const STEPS: u32 = 32;

/// Whole photos in memory.
struct Photos(Vec<Arc<Pixels>>);

impl WindowSource for Photos {
    fn window(&self, view: u32, _mip: u8, _rect: Rect) -> Result<Arc<Pixels>, String> {
        self.0.get(view as usize).cloned().ok_or_else(|| format!("there is no view {view}"))
    }
}

fn main() {
    println!("{}", Isa::detect().name());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().expect("one thread");
    let splats = pool.install(steps);
    assert!(splats.len() as u64 > SPLATS, "the count must include densification");
}

fn steps() -> Splats {
    let views: Vec<TrainView> = (0..VIEWS).map(view).collect();
    let (truth, context) = (cloud(1, 1.0), cloud(2, 3.0));
    let photo = |view: &TrainView| {
        let mut renderer = Renderer::default();
        let frame = renderer.forward(&truth, &[Part::beside(&context)], &view.camera, &Options::default());
        let rgb = frame.colour.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        Arc::new(Pixels { width: WIDTH, height: HEIGHT, rgb, ..Pixels::default() })
    };
    let photos = Photos(views.iter().map(photo).collect());
    let recipe = Recipe { coarse: Vec::new(), sh_from: [0.0; 3], ..Recipe::default() };
    let job = Job {
        initial: cloud(3, 1.0),
        context: Some(&context),
        views: &views,
        counts: &|_| true,
        keeps: &|_| true,
        free_space: None,
        budget: 2 * SPLATS as usize,
        steps: STEPS,
        antialiased: false,
        seed: 0,
        size_bounds_metres: [1e-3, 10.0],
        exposures: None,
        trains_exposures: false,
        trains_poses: false,
        sensors: None,
        path: None,
        recipe: &recipe,
        source: &photos,
        picture_loss: None,
        backend: &Backend::Cpu,
    };
    train(job, &mut |_| Flow::Continue).expect("the views see the splats")
}

/// A camera on a ring around the origin, looking at it.
fn view(n: u32) -> TrainView {
    let (sin, cos) = (f64::from(n) / f64::from(VIEWS) * std::f64::consts::TAU).sin_cos();
    let centre = DVec3::new(5.0 * cos, 5.0 * sin, 0.5);
    let forward = -centre.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward).transpose());
    let [cx, cy] = [WIDTH, HEIGHT].map(|side| 0.5 * f64::from(side));
    let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 102.0, fy: 102.0, cx, cy };
    let camera = Camera { pinhole, camera_from_world: Rigid { rotation, translation: rotation * -centre } };
    TrainView { view: n, mip: 0, rect: camera.full(), camera, camera_from_context: None }
}

/// Coloured splats of SH degree 3 in a ball of `radius` times 1.2 m. If `radius` is above 1, its inner part is empty.
fn cloud(key: u64, radius: f32) -> Splats {
    let mut splats = Splats::new(3);
    let mut next = 0;
    while (splats.len() as u64) < SPLATS {
        let row = next;
        let number = |k: u64| random::uniform(key, 32 * row + k);
        next += 1;
        let position = (Vec3::new(number(0), number(1), number(2)) * 2.0 - 1.0) * radius;
        if radius > 1.0 && position.length() < 2.0 {
            continue;
        }
        let colour = Vec3::new(number(3), number(4), number(5));
        let mut splat = Splat::round(position * 1.2, (0.06 * radius).ln(), colour, 0.3 + 0.6 * number(6));
        splat.log_scale += Vec3::new(number(7), number(8), number(9)) - 0.5;
        splat.quat = [number(10) + 0.1, number(11), number(12), number(13)];
        splats.push(&splat);
    }
    splats
}
