//! `plat bench kernels`: CPU time of the renderer's forward and backward passes.

use ::render::cpu::Renderer;
use ::render::{Options, Upstream};
use bench::parts::Kernels;
use bench::{PartLine, append_part};
use glam::{DQuat, DVec3, Vec3};
use scene::{Camera, Pinhole, Rigid, Splat, Splats};
use train::random;

use crate::args::{KernelsArgs, Size};
use crate::clock::Stopwatch;
use crate::commands::bench::invoked;
use crate::commands::train::make_folder;
use crate::failure::Failure;
use crate::output::Output;
use crate::record::commit;
use crate::{cameras, model};

/// Passes before the clock counts: buffers grow, caches fill.
const WARM_UP: usize = 2;
/// The file of these measurements.
const LINES: &str = "kernels.jsonl";

pub(crate) fn run(args: &KernelsArgs, output: &Output) -> Result<(), Failure> {
    let (splats, options, all) = match (&args.model, &args.cameras) {
        (Some(path), Some(cameras)) => {
            let model = model::read(path)?;
            let views = cameras::read(cameras)?.into_iter();
            let all: Vec<Camera> =
                views.map(|(_, camera)| cameras::resized(&camera, args.size.width, args.size.height)).collect();
            (model.splats.clone(), model.options(), all)
        }
        _ => (cloud(args.splats), Options::default(), vec![front(args.size)]),
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads as usize).build();
    let pool = pool.map_err(|error| Failure::Work(format!("cannot start {} threads: {error}", args.threads)))?;
    let timed = pool.install(|| time(args, &splats, &options, &all));
    let text = format!(
        "{} splats, {}×{}, {} pairs, {} on {} thread{}: forward {:.2} ms CPU, backward {:.2} ms CPU",
        timed.splats,
        timed.width,
        timed.height,
        timed.pairs,
        timed.backend,
        timed.threads,
        if timed.threads == 1 { "" } else { "s" },
        timed.forward_cpu_millis,
        timed.backward_cpu_millis,
    );
    let line = PartLine::Kernels(timed);
    if let Some(results) = &args.results {
        make_folder(results)?;
        append_part(&results.join(LINES), &line)?;
    }
    output.result(&line, &text)
}

fn time(args: &KernelsArgs, splats: &Splats, options: &Options, cameras: &[Camera]) -> Kernels {
    let mut renderer = Renderer::default();
    let upstream = Upstream {
        colour: vec![1e-3; 3 * args.size.width as usize * args.size.height as usize],
        ..Upstream::default()
    };
    let mut millis: [Vec<f64>; 4] = Default::default();
    for pass in 0..WARM_UP + args.passes as usize {
        let clock = Stopwatch::start();
        renderer.forward(splats, None, &cameras[pass % cameras.len()], options);
        let forward = [clock.cpu_seconds(), clock.wall_seconds()];
        let clock = Stopwatch::start();
        renderer.backward(splats, &upstream);
        let backward = [clock.cpu_seconds(), clock.wall_seconds()];
        if pass >= WARM_UP {
            let taken = [forward[0], backward[0], forward[1], backward[1]];
            millis.iter_mut().zip(taken).for_each(|(all, seconds)| all.push(1e3 * seconds));
        }
    }
    let [forward_cpu_millis, backward_cpu_millis, forward_wall_millis, backward_wall_millis] = millis.map(median);
    Kernels {
        commit: commit().to_owned(),
        machine: bench::machine(),
        backend: renderer.name(),
        threads: args.threads,
        splats: splats.len() as u64,
        width: args.size.width,
        height: args.size.height,
        pairs: renderer.pairs() as u64,
        forward_cpu_millis,
        backward_cpu_millis,
        forward_wall_millis,
        backward_wall_millis,
        command: invoked(),
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Random splats of SH degree 3 in a box before the camera, of sizes that cover it a few times.
fn cloud(count: u32) -> Splats {
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

/// A camera that sees the box.
fn front(size: Size) -> Camera {
    let Size { width, height } = size;
    let focal = f64::from(width.max(height));
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    Camera {
        pinhole: Pinhole { width, height, fx: focal, fy: focal, cx, cy },
        camera_from_world: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, 8.0) },
    }
}
