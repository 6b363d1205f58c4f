//! Measures how fast this machine trains: the estimate's constants are those of one machine.

use std::sync::{Arc, OnceLock};

use glam::Vec3;
use scene::{Camera, Pinhole, Pixels, Rect, Rigid, Splat, Splats};
use train::{Backend, Flow, Job, Recipe, TrainView, WindowSource};

use crate::clock;

/// CPU seconds of one measured step on the machine of the estimate's constants (an EPYC core with AVX-512), known to a tenth
/// (docs/decisions/0054).
const REFERENCE_STEP_SECONDS: f64 = 5.0e-3;
/// Width and height of the measured window, pixels.
const SIZE: [u32; 2] = [256, 144];
/// Measured splats.
const SPLATS: usize = 4000;
/// Steps before the measured ones: they fill the caches and allocate.
const WARM_UP_STEPS: u32 = 4;
/// Measured steps.
const STEPS: u32 = 16;
/// Runs, of which the fastest counts: other programs only ever slow a run down.
const RUNS: usize = 5;

/// Speed of training on this machine's CPU, relative to the machine of the estimate's constants. Takes about half a CPU
/// second the first time, and is remembered.
pub fn relative_speed() -> f64 {
    static SPEED: OnceLock<f64> = OnceLock::new();
    *SPEED.get_or_init(|| {
        let fastest = (0..RUNS).map(|_| step_seconds()).fold(f64::INFINITY, f64::min);
        if fastest.is_finite() && fastest > 0.0 { REFERENCE_STEP_SECONDS / fastest } else { 1.0 }
    })
}

/// CPU seconds of one step of a fixed training.
fn step_seconds() -> f64 {
    let [width, height] = SIZE;
    let pinhole = Pinhole { width, height, fx: 200.0, fy: 200.0, cx: 128.0, cy: 72.0 };
    let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
    let views =
        [TrainView { view: 0, mip: 0, rect: Rect { x: 0, y: 0, width, height }, camera, camera_from_context: None }];
    let recipe = Recipe { coarse: Vec::new(), sh_from: [0.0; 3], ..Recipe::default() };
    let everywhere = |_: Vec3| true;
    let job = Job {
        initial: cloud(),
        context: None,
        views: &views,
        counts: &everywhere,
        keeps: &everywhere,
        free_space: None,
        budget: SPLATS,
        steps: WARM_UP_STEPS + STEPS,
        antialiased: false,
        seed: 0,
        size_bounds_metres: [1e-3, 10.0],
        exposures: None,
        trains_exposures: false,
        trains_poses: false,
        sensors: None,
        path: None,
        recipe: &recipe,
        source: &Photo,
        picture_loss: None,
        backend: &Backend::Cpu,
    };
    let mut started = 0.0;
    let trained = train::train(job, &mut |progress| {
        if progress.step == WARM_UP_STEPS {
            started = clock::cpu_seconds();
        }
        Flow::Continue
    });
    let seconds = clock::cpu_seconds() - started;
    if trained.is_ok() { seconds / f64::from(STEPS) } else { f64::INFINITY }
}

/// Splats that fill the window at several depths.
fn cloud() -> Splats {
    let mut splats = Splats::new(3);
    for i in 0..SPLATS as u64 {
        let random = |key: u64| train::random::bits(key, i) as f32 / u64::MAX as f32;
        let depth = 2.0 + 6.0 * random(0);
        let mean = Vec3::new((random(1) - 0.5) * 1.28, (random(2) - 0.5) * 0.72, 1.0) * depth;
        splats.push(&Splat::round(mean, (0.012 * depth).ln(), Vec3::splat(random(3)), 0.4));
    }
    splats
}

/// A photo of stripes.
struct Photo;

impl WindowSource for Photo {
    fn window(&self, _: u32, _: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let value = |i: u32| (i % rect.width * 255 / rect.width) as u8;
        let rgb = (0..3 * rect.width * rect.height).map(value).collect();
        Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, ..Pixels::default() }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_is_positive_and_remembered() {
        let speed = relative_speed();
        assert!(speed.is_finite() && speed > 0.0, "{speed}");
        assert_eq!(relative_speed(), speed);
    }
}
