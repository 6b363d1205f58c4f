//! Times the stages on the CPU and compares them with the roofline of one core (Williams et al. 2009).
//!
//! The ceilings are measured in the same run: arithmetic by chains of fused multiply-adds in registers, memory bandwidth by adding two
//! arrays that are larger than the caches. The rasterizers are compared with the first, by the operations of their inner loops
//! ([`ceiling`]); the other stages with the second, by the bytes that they must read and write.

use ::render::Upstream;
use ::render::cpu::{Isa, Renderer, Stage, ceiling};
use bench::parts::{Kernels, StageTime};

use super::scene::{Scene, WARM_UP, bytes, median};
use crate::args::KernelsArgs;
use crate::clock::Stopwatch;
use crate::run_record::{commit, invocation};

pub(super) fn time(args: &KernelsArgs, Scene { splats, options, cameras }: &Scene) -> Kernels {
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
        renderer.forward_timed(splats, &[], &cameras[pass % cameras.len()], options, &mut note);
        let forward = [pass_clock.cpu_seconds(), pass_clock.wall_seconds()];
        let pass_clock = Stopwatch::start();
        renderer.backward_timed(splats, &upstream, &mut note);
        let backward = [pass_clock.cpu_seconds(), pass_clock.wall_seconds()];
        if counts {
            let taken = [forward[0], backward[0], forward[1], backward[1]];
            millis.iter_mut().zip(taken).for_each(|(all, seconds)| all.push(1e3 * seconds));
            // Measured with every pass, as clock frequency and other load vary.
            ceilings[0].push(gflops());
            ceilings[1].push(gbytes(&mut arrays));
        }
    }
    let [forward_cpu_millis, backward_cpu_millis, forward_wall_millis, backward_wall_millis] = millis.map(median);
    let [ceiling_gflops, ceiling_gbytes] = ceilings.map(median);
    let at = |(stage, all): (Stage, Vec<f64>)| {
        let cpu_millis = median(all);
        let rate = |work: Option<f64>| work.map(|work| work / (1e6 * cpu_millis.max(1e-9)));
        let gflops = rate(flops(stage, renderer.visits()));
        let gbytes = rate(bytes(stage, splats, renderer.pairs() as f64));
        let of_ceiling = gflops.map(|rate| rate / ceiling_gflops).or(gbytes.map(|rate| rate / ceiling_gbytes));
        let stage = stage.name().to_owned();
        StageTime { stage, cpu_millis: Some(cpu_millis), device_millis: None, gflops, gbytes, of_ceiling }
    };
    Kernels {
        commit: commit().to_owned(),
        machine: bench::machine(),
        backend: renderer.name(),
        adapter_class: None,
        threads: args.threads,
        splats: splats.len() as u64,
        width: args.size.width,
        height: args.size.height,
        views: None,
        pairs: renderer.pairs() as u64,
        visits: Some(renderer.visits()),
        ceiling_gflops: Some(ceiling_gflops),
        ceiling_gbytes: Some(ceiling_gbytes),
        stages: stages.into_iter().map(at).collect(),
        clock: None,
        forward_cpu_millis,
        backward_cpu_millis,
        forward_wall_millis,
        backward_wall_millis,
        command: invocation(),
    }
}

/// Floating-point operations of a rasterizer that visits this many blocks of 4×4 pixels.
fn flops(stage: Stage, visits: u64) -> Option<f64> {
    /// One lane per pixel.
    const LANES: f64 = 16.0;
    let each = match stage {
        Stage::Rasterize => ceiling::RASTERIZE_FLOPS,
        Stage::RasterizeBackward => ceiling::RASTERIZE_BACKWARD_FLOPS,
        _ => return None,
    };
    Some(LANES * visits as f64 * each as f64)
}

/// 10⁹ floating-point operations a second of one core: fused multiply-adds in registers.
fn gflops() -> f64 {
    const ROUNDS: u64 = 400_000;
    let clock = Stopwatch::start();
    let (flops, value) = ceiling::multiply_adds(Isa::detect(), ROUNDS);
    std::hint::black_box(value);
    1e-9 * flops as f64 / clock.cpu_seconds()
}

/// Three arrays of together 96 MiB, larger than the caches.
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
