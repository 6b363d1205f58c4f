//! `plat bench kernels`: the time of the renderer's stages, on the CPU beside what the machine can do; and where the two
//! backends part.

mod bisect;
mod compare;
mod cpu;
mod gpu;

use ::render::Options;
use ::render::cpu::Stage;
use bench::parts::{Kernels, StageTime};
use bench::{PartLine, append_part};
use glam::{DQuat, DVec3, Vec3};
use scene::{Camera, Pinhole, Rigid, Splat, Splats};
use train::random;

use crate::args::{Backend, KernelsArgs, Size};
use crate::commands::train::{make_folder, open_gpu};
use crate::failure::Failure;
use crate::output::Output;
use crate::{cameras, model};

/// Passes before the clock counts: buffers grow, caches fill.
const WARM_UP: usize = 2;
/// The file of these measurements.
const LINES: &str = "kernels.jsonl";

/// What is drawn.
struct Scene {
    splats: Splats,
    options: Options,
    cameras: Vec<Camera>,
}

pub(crate) fn run(args: &KernelsArgs, output: &Output) -> Result<(), Failure> {
    let gpu = match (args.backend, args.from_stage) {
        (Backend::Gpu, _) | (_, Some(_)) => Some(open_gpu()?),
        _ => None,
    };
    if gpu.is_none() && args.views > 1 {
        return Err(Failure::Input("--views: only a GPU draws views side by side: give --backend gpu".into()));
    }
    let scene = scene(args)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads as usize).build();
    let pool = pool.map_err(|error| Failure::Work(format!("cannot start {} threads: {error}", args.threads)))?;
    if let (Some(gpu), Some(from)) = (&gpu, args.from_stage) {
        return pool.install(|| bisect::run(gpu, &scene, from, output));
    }
    let timed = match &gpu {
        Some(gpu) => pool.install(|| gpu::time(gpu, args, &scene))?,
        None => pool.install(|| cpu::time(args, &scene)),
    };
    let text = text(&timed);
    let line = PartLine::Kernels(timed);
    if let Some(results) = &args.results {
        make_folder(results)?;
        append_part(&results.join(LINES), &line)?;
    }
    output.result(&line, text.trim_end())
}

fn text(timed: &Kernels) -> String {
    let class = timed.adapter_class.as_ref().map_or(String::new(), |class| format!(" ({class})"));
    let mut text = format!(
        "{} splats, {}×{}, {}{} pairs, {}{class} on {} thread{}: forward {:.2} ms CPU, backward {:.2} ms CPU ({:.2} and {:.2} ms wall)\n",
        timed.splats,
        timed.width,
        timed.height,
        timed.views.map_or(String::new(), |views| format!("{views} views side by side, each "),),
        timed.pairs,
        timed.backend,
        timed.threads,
        if timed.threads == 1 { "" } else { "s" },
        timed.forward_cpu_millis,
        timed.backward_cpu_millis,
        timed.forward_wall_millis,
        timed.backward_wall_millis,
    );
    if let (Some(flops), Some(bytes)) = (timed.ceiling_gflops, timed.ceiling_gbytes) {
        text += &format!("ceilings of one core: {flops:.1} Gflop/s, {bytes:.1} GB/s\n");
    }
    if let Some(clock) = &timed.clock {
        text += &format!("stages by the clock: {clock}\n");
    }
    for StageTime { stage, cpu_millis, device_millis, gflops, gbytes, of_ceiling } in &timed.stages {
        let rate = match (gflops, gbytes) {
            (Some(gflops), _) => format!("{gflops:>6.1} Gflop/s"),
            (None, Some(gbytes)) => format!("{gbytes:>6.1} GB/s   "),
            (None, None) => String::new(),
        };
        let share = of_ceiling.map_or(String::new(), |share| format!("{:>4.0} %", 100.0 * share));
        let (millis, whose) = match (cpu_millis, device_millis) {
            (Some(millis), _) => (*millis, "CPU"),
            (None, millis) => (millis.unwrap_or_default(), "device"),
        };
        text += &format!("{stage:<19} {millis:>7.2} ms {whose}  {rate} {share}\n");
    }
    text
}

/// Bytes that a stage has to read and write at least, where that is what it is about.
fn bytes(stage: Stage, splats: &Splats, pairs: f64) -> Option<f64> {
    /// A projected splat or a pair's moments: a cache line.
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

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn scene(args: &KernelsArgs) -> Result<Scene, Failure> {
    let (Some(path), Some(from)) = (&args.model, &args.cameras) else {
        let (splats, cameras) = (cloud(args.splats), vec![front(args.size)]);
        return Ok(Scene { splats, options: Options::default(), cameras });
    };
    let model = model::read(path)?;
    let views = cameras::read(from)?.into_iter();
    let resized = |(_, camera): (String, Camera)| cameras::resized(&camera, args.size.width, args.size.height);
    Ok(Scene { splats: model.splats.clone(), options: model.options(), cameras: views.map(resized).collect() })
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
