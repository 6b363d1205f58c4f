//! `plat bench kernels`: CPU time of the renderer's stages, and how near they come to what the machine can do.
//!
//! Ceilings are measured in the same run (roofline, Williams et al. 2009): arithmetic by chains of fused multiply-adds in registers,
//! memory by adding two arrays that no cache holds. The rasterizers are held against the first, by the operations of
//! their inner loops ([`ceiling`]); the others against the second, by the bytes that they have to read and write once.

use ::render::cpu::{Isa, Renderer, Stage, ceiling};
use ::render::{Options, Upstream};
use bench::parts::{Kernels, StageTime};
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
    let mut text = format!(
        "{} splats, {}×{}, {} pairs, {} on {} thread{}: forward {:.2} ms CPU, backward {:.2} ms CPU ({:.2} and {:.2} ms wall)\n",
        timed.splats,
        timed.width,
        timed.height,
        timed.pairs,
        timed.backend,
        timed.threads,
        if timed.threads == 1 { "" } else { "s" },
        timed.forward_cpu_millis,
        timed.backward_cpu_millis,
        timed.forward_wall_millis,
        timed.backward_wall_millis,
    );
    let [flops, bytes] = [timed.ceiling_gflops, timed.ceiling_gbytes].map(Option::unwrap_or_default);
    text += &format!("ceilings of one core: {flops:.1} Gflop/s, {bytes:.1} GB/s\n");
    for StageTime { stage, cpu_millis, gflops, gbytes, of_ceiling } in &timed.stages {
        let rate = match (gflops, gbytes) {
            (Some(gflops), _) => format!("{gflops:>6.1} Gflop/s"),
            (None, Some(gbytes)) => format!("{gbytes:>6.1} GB/s   "),
            (None, None) => String::new(),
        };
        let share = of_ceiling.map_or(String::new(), |share| format!("{:>4.0} %", 100.0 * share));
        text += &format!("{stage:<19} {cpu_millis:>7.2} ms CPU  {rate} {share}\n");
    }
    let line = PartLine::Kernels(timed);
    if let Some(results) = &args.results {
        make_folder(results)?;
        append_part(&results.join(LINES), &line)?;
    }
    output.result(&line, text.trim_end())
}

fn time(args: &KernelsArgs, splats: &Splats, options: &Options, cameras: &[Camera]) -> Kernels {
    let mut renderer = Renderer::default();
    let upstream = Upstream {
        colour: vec![1e-3; 3 * args.size.width as usize * args.size.height as usize],
        ..Upstream::default()
    };
    let mut millis: [Vec<f64>; 4] = Default::default();
    let mut stages: Vec<(Stage, Vec<f64>)> = Vec::new();
    let (mut ceilings, mut arrays) = ([Vec::new(), Vec::new()], arrays());
    for pass in 0..WARM_UP + args.passes as usize {
        let counts = pass >= WARM_UP;
        let mut clock = Stopwatch::start();
        let mut note = |stage: Stage| {
            let seconds = clock.cpu_seconds();
            clock = Stopwatch::start();
            match stages.iter_mut().find(|(of, _)| *of == stage) {
                Some((_, all)) if counts => all.push(1e3 * seconds),
                Some(_) => {}
                None => stages.push((stage, Vec::new())),
            }
        };
        let pass_clock = Stopwatch::start();
        renderer.forward_watched(splats, None, &cameras[pass % cameras.len()], options, &mut note);
        let forward = [pass_clock.cpu_seconds(), pass_clock.wall_seconds()];
        let pass_clock = Stopwatch::start();
        renderer.backward_watched(splats, &upstream, &mut note);
        let backward = [pass_clock.cpu_seconds(), pass_clock.wall_seconds()];
        if counts {
            let taken = [forward[0], backward[0], forward[1], backward[1]];
            millis.iter_mut().zip(taken).for_each(|(all, seconds)| all.push(1e3 * seconds));
            // Beside the passes, as the machine's clock and its other users change.
            ceilings[0].push(gflops());
            ceilings[1].push(gbytes(&mut arrays));
        }
    }
    let [forward_cpu_millis, backward_cpu_millis, forward_wall_millis, backward_wall_millis] = millis.map(median);
    let [ceiling_gflops, ceiling_gbytes] = ceilings.map(median);
    let work = Work {
        splats: splats.len() as f64,
        columns: splats.columns().len() as f64,
        pairs: renderer.pairs() as f64,
        visits: renderer.visits() as f64,
    };
    let stages = stages.into_iter().map(|(stage, all)| work.at(stage, median(all), [ceiling_gflops, ceiling_gbytes]));
    Kernels {
        commit: commit().to_owned(),
        machine: bench::machine(),
        backend: renderer.name(),
        threads: args.threads,
        splats: splats.len() as u64,
        width: args.size.width,
        height: args.size.height,
        pairs: renderer.pairs() as u64,
        visits: renderer.visits(),
        ceiling_gflops: Some(ceiling_gflops),
        ceiling_gbytes: Some(ceiling_gbytes),
        stages: stages.collect(),
        forward_cpu_millis,
        backward_cpu_millis,
        forward_wall_millis,
        backward_wall_millis,
        command: invoked(),
    }
}

/// What the stages of a pass have to do.
struct Work {
    splats: f64,
    columns: f64,
    pairs: f64,
    visits: f64,
}

impl Work {
    /// A stage's time beside the ceilings.
    fn at(&self, stage: Stage, cpu_millis: f64, [ceiling_gflops, ceiling_gbytes]: [f64; 2]) -> StageTime {
        /// A projected splat or a pair's moments: a cache line.
        const RECORD: f64 = 64.0;
        /// A lane is a pixel.
        const LANES: f64 = 16.0;
        const FLOAT: f64 = 4.0;
        let parameters = FLOAT * self.columns * self.splats;
        let (name, flops, bytes) = match stage {
            Stage::Project => ("project", None, Some(parameters + RECORD * self.splats)),
            Stage::Sort => ("sort", None, None),
            Stage::Bin => ("bin", None, Some(RECORD * self.splats + 2.0 * 8.0 * self.pairs)),
            Stage::Rasterize => ("rasterize", Some(LANES * self.visits * ceiling::RASTERIZE_FLOPS as f64), None),
            Stage::RasterizeBackward => {
                ("rasterize_backward", Some(LANES * self.visits * ceiling::RASTERIZE_BACKWARD_FLOPS as f64), None)
            }
            Stage::Reduce => ("reduce", None, Some(RECORD * (self.pairs + self.splats))),
            Stage::ProjectBackward => ("project_backward", None, Some(2.0 * parameters + RECORD * self.splats)),
        };
        let rate = |work: Option<f64>| work.map(|work| work / (1e6 * cpu_millis.max(1e-9)));
        let (gflops, gbytes) = (rate(flops), rate(bytes));
        let of_ceiling = gflops.map(|rate| rate / ceiling_gflops).or(gbytes.map(|rate| rate / ceiling_gbytes));
        StageTime { stage: name.to_owned(), cpu_millis, gflops, gbytes, of_ceiling }
    }
}

/// 10⁹ floating-point operations a second of one core: fused multiply-adds in registers.
fn gflops() -> f64 {
    const ROUNDS: u64 = 400_000;
    let clock = Stopwatch::start();
    let (flops, value) = ceiling::multiply_adds(Isa::detect(), ROUNDS);
    std::hint::black_box(value);
    1e-9 * flops as f64 / clock.cpu_seconds()
}

/// Three arrays that together no cache holds: 96 MiB.
fn arrays() -> [Vec<f32>; 3] {
    const LENGTH: usize = 8 << 20;
    [vec![1.0; LENGTH], vec![2.0; LENGTH], vec![0.0; LENGTH]]
}

/// 10⁹ bytes a second of one core between memory and registers: the sum of two arrays into a third.
fn gbytes([a, b, c]: &mut [Vec<f32>; 3]) -> f64 {
    let clock = Stopwatch::start();
    for ((c, a), b) in c.iter_mut().zip(&*a).zip(&*b) {
        *c = a + b;
    }
    std::hint::black_box(&c);
    1e-9 * (3 * size_of::<f32>() * c.len()) as f64 / clock.cpu_seconds()
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
