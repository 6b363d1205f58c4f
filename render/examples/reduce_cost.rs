//! Measures the cost of the ordered gradient reduction against float atomics, and the gain of subgroups and half
//! precision:
//!
//! ```sh
//! cargo run --release -p render --example reduce_cost -- [ROUNDS] [SPLATS]...
//! ```
//! Each round times, for every path of the adapter, both reductions (`rasterize_backward` and `reduce`;
//! `rasterize_backward` with atomics) and a whole forward and backward pass. The runs are interleaved, so that other
//! load affects all of them alike. The example prints the shortest wall times, which are relevant on a GPU, and the
//! median CPU times of the process, which are relevant for a software adapter on a busy machine.

use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use glam::{DQuat, DVec3, Vec3};
use render::Options;
use render::gpu::{Gpu, GpuError, GpuOptions, GpuRenderer, GpuSplats, Path, Reduction, UpstreamPlanes};
use scene::{Camera, Pinhole, Rigid, Splat, Splats};

const WIDTH: u32 = 480;
const HEIGHT: u32 = 270;

fn main() -> Result<(), Box<dyn Error>> {
    let numbers = std::env::args().skip(1).map(|word| word.parse::<usize>().map_err(|e| format!("{word}: {e}")));
    let numbers = numbers.collect::<Result<Vec<usize>, String>>()?;
    let rounds = numbers.first().copied().unwrap_or(15).max(1);
    let counts = if numbers.len() > 1 { &numbers[1..] } else { &[12_000, 48_000] };
    let options = GpuOptions::from_env()?;
    let mut gpus = vec![Gpu::open_with(&options)?];
    for path in [Path::Portable, Path::Half] {
        match Gpu::open_with(&GpuOptions { path, ..options.clone() }) {
            Ok(gpu) if gpu.path() != gpus[0].path() => gpus.push(gpu),
            Ok(_) | Err(GpuError::NoHalf(_)) => {}
            Err(error) => return Err(error.into()),
        }
    }
    for &count in counts {
        let splats = random_splats(count);
        let mut timed = gpus.iter().map(|gpu| Timed::new(gpu, &splats)).collect::<Result<Vec<_>, _>>()?;
        // Round 0 warms up.
        for round in 0..=rounds {
            for path in &mut timed {
                path.round(round > 0)?;
            }
        }
        for path in &mut timed {
            for (clock, [step, ordered, atomic]) in [("wall", path.wall_millis()), ("CPU", path.cpu_millis())] {
                println!(
                    "{count} splats, {WIDTH}×{HEIGHT}, {}, {rounds} rounds: {clock} forward and backward {step:.2} ms, ordered sums \
                     {ordered:.2} ms, atomic sums {atomic:.2} ms, ratio {:.3}",
                    path.gpu.name(),
                    ordered / atomic,
                );
            }
        }
        let (baseline, others) = timed.split_at_mut(1);
        for other in others {
            let [name, baseline_name] = [other.gpu.name(), baseline[0].gpu.name()];
            let compare = |clock: &str, [a_step, a, _]: [f64; 3], [b_step, b, _]: [f64; 3]| {
                println!(
                    "{count} splats, {clock}: {name} takes {:.3} of the time of {baseline_name} for the sums, {:.3} for the whole pass",
                    a / b,
                    a_step / b_step
                );
            };
            compare("wall", other.wall_millis(), baseline[0].wall_millis());
            compare("CPU", other.cpu_millis(), baseline[0].cpu_millis());
        }
    }
    Ok(())
}

/// A renderer on one path and its times.
struct Timed {
    gpu: Arc<Gpu>,
    renderer: GpuRenderer,
    splats: GpuSplats,
    /// Wall and CPU times of the whole pass, of the ordered sums and of the atomic sums.
    millis: [Vec<[f64; 2]>; 3],
}

impl Timed {
    fn new(gpu: &Arc<Gpu>, splats: &Splats) -> Result<Self, GpuError> {
        let splats = GpuSplats::upload(gpu, splats, 0)?;
        let mut renderer = GpuRenderer::new(Arc::clone(gpu))?;
        renderer.draw(&splats, &[], &camera(), &Options::default())?;
        gpu.upload(renderer.upstream(), 0, &vec![1e-3f32; (3 * WIDTH * HEIGHT) as usize])?;
        Ok(Self { gpu: Arc::clone(gpu), renderer, splats, millis: Default::default() })
    }

    fn round(&mut self, is_recorded: bool) -> Result<(), GpuError> {
        let Self { gpu, renderer, splats, millis } = self;
        let planes = UpstreamPlanes::default();
        let mut time = |which: usize, encode: &mut dyn FnMut(&mut wgpu::CommandEncoder) -> Result<(), GpuError>| {
            let mut encoder = gpu.encoder();
            encode(&mut encoder)?;
            gpu.wait()?;
            let (start, cpu) = (Instant::now(), cpu_millis());
            gpu.submit(encoder)?;
            gpu.wait()?;
            if is_recorded {
                millis[which].push([1e3 * start.elapsed().as_secs_f64(), cpu_millis() - cpu]);
            }
            Ok::<(), GpuError>(())
        };
        time(0, &mut |encoder| {
            renderer.forward(encoder, splats, &[], &[camera()], &Options::default())?;
            renderer.backward(encoder, splats, planes)
        })?;
        time(1, &mut |encoder| renderer.reduce_moments(encoder, planes, Reduction::Ordered))?;
        time(2, &mut |encoder| renderer.reduce_moments(encoder, planes, Reduction::Atomic))
    }
}

impl Timed {
    fn wall_millis(&self) -> [f64; 3] {
        self.millis.each_ref().map(|all| all.iter().map(|[wall, _]| *wall).fold(f64::INFINITY, f64::min))
    }

    fn cpu_millis(&self) -> [f64; 3] {
        self.millis.each_ref().map(|all| {
            let mut all: Vec<f64> = all.iter().map(|[_, cpu]| *cpu).collect();
            all.sort_by(f64::total_cmp);
            all[all.len() / 2]
        })
    }
}

/// CPU time of all threads of this process.
fn cpu_millis() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    1e3 * time.tv_sec as f64 + 1e-6 * time.tv_nsec as f64
}

/// A camera that sees the whole box.
fn camera() -> Camera {
    let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 480.0, fy: 480.0, cx: 240.0, cy: 135.0 };
    let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, 8.0) };
    Camera { pinhole, camera_from_world }
}

/// Random splats in a box in front of the camera, as in `plat bench kernels`; their sizes cover the image a few times.
fn random_splats(count: usize) -> Splats {
    let mut splats = Splats::new(3);
    let mut state = 1u64;
    // SplitMix64.
    let mut number = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    };
    let edge = 6.0 / (count as f32).cbrt();
    for _ in 0..count {
        let place = 6.0 * (Vec3::new(number(), number(), number()) - 0.5);
        let size = (0.3 * edge * (0.5 + number())).ln();
        let colour = Vec3::new(number(), number(), number());
        let mut splat = Splat::round(place, size, colour, 0.1 + 0.8 * number());
        splat.log_scale += Vec3::new(number(), number(), number()) - 0.5;
        splat.quat = [number() - 0.5, number() - 0.5, number() - 0.5, number() - 0.5];
        splats.push(&splat);
    }
    splats
}
