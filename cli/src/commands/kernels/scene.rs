//! Splats and cameras that the kernels are timed on, and what the timings of both backends share.

use ::render::Options;
use ::render::cpu::Stage;
use glam::{DQuat, DVec3, Vec3};
use scene::{Camera, Pinhole, Rigid, Splat, Splats, View};
use train::random;

use crate::args::{KernelsArgs, Size};
use crate::captures;
use crate::failure::Failure;

/// Passes before timing starts: buffers grow, caches fill.
pub(super) const WARM_UP: usize = 2;

/// Splats and the cameras that render them.
pub(super) struct Scene {
    pub(super) splats: Splats,
    pub(super) options: Options,
    pub(super) cameras: Vec<Camera>,
}

/// Bytes that a memory-bound stage must read and write at least; `None` for the other stages.
pub(super) fn bytes(stage: Stage, splats: &Splats, pairs: f64) -> Option<f64> {
    /// Bytes of a projected splat or of a pair's moments: a cache line.
    const RECORD: f64 = 64.0;
    const FLOAT: f64 = 4.0;
    let count = splats.len() as f64;
    let parameters = FLOAT * splats.columns().len() as f64 * count;
    match stage {
        Stage::Project => Some(parameters + RECORD * count),
        Stage::Bin => Some(RECORD * count + 2.0 * 8.0 * pairs),
        Stage::Reduce => Some(RECORD * (pairs + count)),
        Stage::ProjectBackward => Some(2.0 * parameters + RECORD * count),
        Stage::Sort | Stage::Rasterize | Stage::RasterizeBackward => None,
    }
}

pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The model that the options name, or random splats.
pub(super) fn scene(args: &KernelsArgs) -> Result<Scene, Failure> {
    let (Some(path), Some(from)) = (&args.model, &args.cameras) else {
        let (splats, cameras) = (cloud(args.splats), vec![front(args.size)]);
        return Ok(Scene { splats, options: Options::default(), cameras });
    };
    let model = model::read(path)?;
    let views = captures::read_cameras(from)?.into_iter();
    let resized = |view: View| captures::resized(&view.camera, args.size.width, args.size.height);
    Ok(Scene { splats: model.splats.clone(), options: model.options(), cameras: views.map(resized).collect() })
}

/// Random splats of SH degree 3 in a box in front of the camera, of sizes that cover it a few times.
pub(super) fn cloud(count: u32) -> Splats {
    let mut splats = Splats::new(3);
    let edge = 6.0 / (count as f32).cbrt();
    for i in 0..u64::from(count) {
        let unit = |k: u64| (random::bits(i, k) >> 40) as f32 / (1u64 << 24) as f32;
        let at = Vec3::new(unit(0) - 0.5, unit(1) - 0.5, unit(2) - 0.5) * 6.0;
        let size = (0.3 * edge * (0.5 + unit(3))).ln();
        let mut splat = Splat::round(at, size, Vec3::new(unit(4), unit(5), unit(6)), 0.1 + 0.8 * unit(7));
        splat.log_scale += Vec3::new(unit(8), unit(9), unit(10)) - 0.5;
        splat.quat = [unit(11) - 0.5, unit(12) - 0.5, unit(13) - 0.5, unit(14) - 0.5];
        for (k, coefficient) in splat.sh.iter_mut().enumerate().skip(1) {
            *coefficient = [0.1 * (unit(15 + k as u64) - 0.5); 3];
        }
        splats.push(&splat);
    }
    splats
}

/// A camera that looks at the box.
pub(super) fn front(size: Size) -> Camera {
    let Size { width, height } = size;
    let focal = f64::from(width.max(height));
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    Camera {
        pinhole: Pinhole { width, height, fx: focal, fy: focal, cx, cy },
        camera_from_world: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, 8.0) },
    }
}
