//! Finds the pose of a view against splats that stay as they are (test-time pose optimisation, as BARF evaluates).
//!
//! A held-out photo of a capture with pose errors has such an error too, and training cannot remove it. The steps are
//! those of training with refined poses, without an update of the splats, coarse mips first. They run on the CPU.

use std::sync::Arc;

use render::Options;
use render::cpu::Isa;
use scene::{Rigid, Splats};

use crate::checkpoint::State;
use crate::coarse_to_fine::CoarseToFine;
use crate::device::Backend;
use crate::device::step::{StatePart, Step, TrainDevice, ViewSample};
use crate::error::TrainError;
use crate::growth::DensificationStats;
use crate::optimiser::Adam;
use crate::pose::{GivenPoses, PoseRates, PoseTraining, Rates};
use crate::recipe::Recipe;
use crate::source::WindowSource;
use crate::view::TrainView;

/// Steps of a view at the finest mip, and at all coarser ones together.
const FINEST_STEPS: u32 = 20;
const COARSE_STEPS: u32 = 100;
/// The coarsest mip has at least this width and height, pixels.
const MIN_SIDE: u32 = 24;
/// First learning rate: radians, and metres per metre of depth. The last is a share of a pixel.
const FIRST_RATE: f32 = 4e-3;
const LAST_RATE_PIXELS: f32 = 0.02;

/// Finds poses of views against one model.
pub struct PoseFinder<'a> {
    device: Box<dyn TrainDevice + 'a>,
    given: Arc<GivenPoses>,
    state: State,
    antialiased: bool,
    source: &'a dyn WindowSource,
}

impl<'a> PoseFinder<'a> {
    /// Copies the splats. Only the poses of these views can be found.
    ///
    /// # Errors
    /// A device that fails or has too little memory.
    pub fn new(
        splats: &Splats,
        antialiased: bool,
        views: &[TrainView],
        source: &'a dyn WindowSource,
    ) -> Result<Self, TrainError> {
        let given = Arc::new(GivenPoses::of(views, splats, false, None, None));
        let isa = Isa::detect();
        let state = State {
            step: 0,
            skipped: 0,
            start_count: splats.len(),
            coarse_to_fine: CoarseToFine::default(),
            // Frozen splats need no moments.
            adam: Adam::new(isa, &Splats::new(splats.sh_degree())),
            densification: DensificationStats::default(),
            exposures: None,
            poses: Some(PoseTraining::new(&given)),
            swing: None,
            splats: splats.clone(),
            loss: f64::NAN,
        };
        let device = Backend::Cpu.open(&state, Recipe::default().lambda, None, None, &given)?;
        Ok(Self { device, given, state, antialiased, source })
    }

    /// The pose that brings the render of a view closest to its photo, starting from the view's own.
    ///
    /// # Errors
    /// A photo that cannot be read, or a device that fails.
    pub fn find(&mut self, view: &TrainView) -> Result<Rigid, TrainError> {
        let is_large = |coarser: u8| {
            let rect = view.at(coarser).map(|(_, rect, _)| rect);
            rect.is_some_and(|rect| rect.width.min(rect.height) >= MIN_SIDE)
        };
        let coarsest = (0..16).take_while(|&coarser| is_large(coarser)).last().unwrap_or(0);
        let focal = view.camera.mip(view.mip).pinhole.fx as f32;
        let last_rate = (LAST_RATE_PIXELS / focal).min(FIRST_RATE);
        let of_mip = COARSE_STEPS / u32::from(coarsest).max(1);
        let all = FINEST_STEPS + of_mip * u32::from(coarsest);
        let mut done = 0;
        for coarser in (0..=coarsest).rev() {
            let Some((mip, rect, camera)) = view.at(coarser) else { continue };
            let photo = self.source.window(view.view, mip, rect).map_err(TrainError::Source)?;
            for _ in 0..if coarser == 0 { FINEST_STEPS } else { of_mip } {
                let sample = ViewSample {
                    view: view.view,
                    mip,
                    rect,
                    photo: Arc::clone(&photo),
                    camera,
                    camera_from_context: None,
                    exposure: None,
                };
                let progress = done as f32 / all as f32;
                let step = Step {
                    samples: vec![sample],
                    options: Options {
                        antialiased: self.antialiased,
                        sh_degree: self.state.splats.sh_degree(),
                        ..Options::default()
                    },
                    rates: None,
                    swing: None,
                    depth_weight: 0.0,
                    silhouette_weight: 0.0,
                    picture_weight: 0.0,
                    exposure_rate: 0.0,
                    pose_rates: Some(PoseRates {
                        views: Some(Rates { rate: FIRST_RATE * (last_rate / FIRST_RATE).powf(progress), decay: 0.0 }),
                        sensors: None,
                        path: None,
                    }),
                };
                self.device.step(&mut self.state, step)?;
                done += 1;
            }
        }
        self.device.download(&mut self.state, StatePart::Tally)?;
        let poses = self.state.poses.as_ref().map(|poses| poses.apply(&self.given, view.view, &view.camera));
        Ok(poses.unwrap_or(view.camera).camera_from_world)
    }
}
