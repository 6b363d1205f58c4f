//! A test scene of a few hundred splats in a ring of cameras, with photos rendered from the ground truth, and jobs that
//! train it.
#![allow(dead_code, unreachable_pub)] // Each test file uses a part.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3, Vec3};
use render::Options;
use render::cpu::Renderer;
use scene::splats::SH_C0;
use scene::{Camera, Exposures, Pinhole, Pixels, Rect, Rigid, Splat, Splats};
use train::{
    Backend, Flow, Job, PictureLoss, Recipe, State, TrainError, TrainView, Trained, WindowSource, metrics, random,
    train_from,
};

pub const WIDTH: u32 = 64;
pub const HEIGHT: u32 = 48;
pub const AREA: usize = (WIDTH * HEIGHT) as usize;

/// Photos in memory; coarser mips are means of 2^m × 2^m pixels.
#[derive(Clone)]
pub struct Photos(pub Vec<Pixels>);

impl WindowSource for Photos {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let photo = self.0.get(view as usize).ok_or_else(|| format!("view {view} is missing"))?;
        let side = 1u32 << mip;
        let mut rgb = Vec::new();
        let mut mask = photo.mask.as_ref().map(|_| Vec::new());
        let mean = |plane: &[u8], x: u32, y: u32| {
            let pixels = (0..side * side).map(|k| (x * side + k % side, y * side + k / side));
            let sum: u32 = pixels.map(|(x, y)| u32::from(plane[(y * photo.width + x) as usize])).sum();
            ((sum + side * side / 2) / (side * side)) as u8
        };
        let window = || (rect.y..rect.y + rect.height).flat_map(|y| (rect.x..rect.x + rect.width).map(move |x| (x, y)));
        for plane in photo.rgb.chunks(photo.area()) {
            rgb.extend(window().map(|(x, y)| mean(plane, x, y)));
        }
        if let (Some(mask), Some(plane)) = (&mut mask, &photo.mask) {
            // A coarse pixel is used only if all of it is.
            mask.extend(window().map(|(x, y)| if mean(plane, x, y) == 255 { 255 } else { 0 }));
        }
        // Weights and depths of a coarse pixel are those of its first pixel.
        let first = |plane: &Option<Vec<f32>>| {
            let of =
                |plane: &Vec<f32>| window().map(|(x, y)| plane[(y * side * photo.width + x * side) as usize]).collect();
            plane.as_ref().map(of)
        };
        let (weights, depth) = (first(&photo.weights), first(&photo.depth));
        Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, mask, weights, depth, silhouette: None }))
    }
}

/// Twelve cameras on a ring around the origin, looking at it from changing heights.
pub fn views() -> Vec<TrainView> {
    (0..12)
        .map(|n| {
            let (sin, cos) = (f64::from(n) / 12.0 * std::f64::consts::TAU).sin_cos();
            let centre = DVec3::new(5.0 * cos, 5.0 * sin, f64::from(n % 3) - 0.5);
            let forward = -centre.normalize();
            let right = forward.cross(DVec3::Z).normalize();
            // Rows are the camera's axes: x right, y down, z forward.
            let axes = DMat3::from_cols(right, forward.cross(right), forward).transpose();
            let rotation = DQuat::from_mat3(&axes);
            let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 70.0, fy: 70.0, cx: 32.0, cy: 24.0 };
            let camera = Camera { pinhole, camera_from_world: Rigid { rotation, translation: rotation * -centre } };
            TrainView { view: n, mip: 0, rect: camera.full(), camera, camera_from_context: None }
        })
        .collect()
}

/// `count` coloured splats in a ball; every number from `key`.
pub fn cloud(key: u64, count: usize, opacity: f32) -> Splats {
    let mut splats = Splats::new(1);
    for i in 0..count as u64 {
        let number = |k: u64| random::uniform(key, 16 * i + k);
        let position = Vec3::new(number(0), number(1), number(2)) * 2.0 - 1.0;
        let colour = Vec3::new(number(3), number(4), number(5));
        let mut splat = Splat::round(position * 1.2, 0.14f32.ln(), colour, opacity);
        splat.log_scale += Vec3::new(number(6), number(7), number(8)) - 0.5;
        splat.quat = [number(9) + 0.1, number(10), number(11), number(12)];
        splats.push(&splat);
    }
    splats
}

/// Initial splats as from a sparse cloud: displaced means, isotropic, of one size and opacity, colours half grey.
pub fn perturbed(splats: &Splats) -> Splats {
    let mut out = Splats::new(splats.sh_degree());
    for i in 0..splats.len() {
        let noise = |k: u64| random::uniform(99, 4 * i as u64 + k) - 0.5;
        let colour = Vec3::from_array(splats.get(i).sh[0]) * (0.5 * SH_C0) + 0.5;
        let position = splats.mean(i) + 0.1 * Vec3::new(noise(0), noise(1), noise(2));
        out.push(&Splat::round(position, 0.14f32.ln(), colour, 0.3));
    }
    out
}

pub fn photo(splats: &Splats, view: &TrainView) -> Vec<f32> {
    let options = Options { sh_degree: 1, ..Options::default() };
    Renderer::default().forward(splats, &[], &view.camera, &options).colour.clone()
}

pub fn photos(splats: &Splats) -> Photos {
    let bytes = |planes: Vec<f32>| planes.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let photo = |view| Pixels {
        width: WIDTH,
        height: HEIGHT,
        rgb: bytes(photo(splats, view)),
        mask: None,
        ..Pixels::default()
    };
    Photos(views().iter().map(photo).collect())
}

/// Mean PSNR over the views on the pixels for which `used` is true.
pub fn psnr(splats: &Splats, photos: &Photos, used: impl Fn(usize) -> bool) -> f64 {
    let mask: Vec<u8> = (0..AREA).map(|i| if used(i) { 255 } else { 0 }).collect();
    let views = views();
    let total: f64 = (views.iter().zip(&photos.0))
        .map(|(view, expected)| {
            let expected: Vec<f32> = expected.rgb.iter().map(|&b| f32::from(b) / 255.0).collect();
            metrics::psnr(&photo(splats, view), &expected, Some(&mask)).expect("equal sizes")
        })
        .sum();
    total / views.len() as f64
}

pub struct Setup<'a> {
    pub initial: Splats,
    pub photos: &'a Photos,
    pub context: Option<&'a Splats>,
    pub budget: usize,
    pub steps: u32,
    pub recipe: Recipe,
    pub exposures: Option<&'a Exposures>,
    pub trains_exposures: bool,
    pub trains_poses: bool,
    pub sensors: Option<&'a [scene::sensors::Taken]>,
    pub path: Option<&'a train::ObjectTimes>,
    pub picture_loss: Option<&'a dyn PictureLoss>,
    pub backend: Backend,
    pub views: Vec<TrainView>,
}

impl<'a> Setup<'a> {
    /// A job whose budget is the number of initial splats, without context.
    pub fn new(initial: Splats, photos: &'a Photos) -> Self {
        let budget = initial.len();
        let (exposures, trains_exposures, trains_poses) = (None, false, false);
        let recipe = Recipe::default();
        let backend = Backend::Cpu;
        Self {
            initial,
            photos,
            context: None,
            budget,
            steps: 240,
            recipe,
            exposures,
            trains_exposures,
            trains_poses,
            sensors: None,
            path: None,
            picture_loss: None,
            backend,
            views: views(),
        }
    }

    pub fn run(self) -> Splats {
        self.try_run(&|_| true, &mut |_| Flow::Continue).expect("training succeeds")
    }

    pub fn try_run(
        self,
        counts: &(dyn Fn(Vec3) -> bool + Sync),
        report: &mut dyn FnMut(train::Progress) -> Flow,
    ) -> Result<Splats, TrainError> {
        self.try_run_on(None, counts, report).map(|trained| trained.splats)
    }

    pub fn try_run_on(
        self,
        from: Option<State>,
        counts: &(dyn Fn(Vec3) -> bool + Sync),
        report: &mut dyn FnMut(train::Progress) -> Flow,
    ) -> Result<Trained, TrainError> {
        let job = Job {
            initial: self.initial,
            context: self.context,
            views: &self.views,
            counts,
            keeps: &|_| true,
            free_space: None,
            budget: self.budget,
            steps: self.steps,
            antialiased: false,
            seed: 5,
            size_bounds_metres: [1e-3, 2.0],
            exposures: self.exposures,
            trains_exposures: self.trains_exposures,
            trains_poses: self.trains_poses,
            sensors: self.sensors,
            path: self.path,
            recipe: &self.recipe,
            source: self.photos,
            picture_loss: self.picture_loss,
            backend: &self.backend,
        };
        train_from(job, from, report)
    }
}

/// The CPU and, where there is one, a GPU. PLAT_GPU=required makes a missing GPU a failure.
pub fn backends() -> Vec<Backend> {
    #[cfg(feature = "gpu")]
    match render::gpu::Gpu::open() {
        Ok(gpu) => return vec![Backend::Cpu, Backend::Gpu(gpu)],
        Err(error) if std::env::var("PLAT_GPU").is_ok_and(|value| value == "required") => panic!("{error}"),
        Err(error) => println!("skipped on a GPU: no adapter ({error})"),
    }
    vec![Backend::Cpu]
}

/// A recipe without densification, so that rows keep their order.
pub fn no_growth() -> Recipe {
    let mut recipe = Recipe::default();
    recipe.growth = recipe.growth.none();
    recipe
}

pub fn all_finite(splats: &Splats) -> bool {
    (0..splats.len()).all(|i| splats.is_finite(i))
}
