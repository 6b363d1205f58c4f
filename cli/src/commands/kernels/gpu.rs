//! Times the stages on a GPU: by timestamps of the device where it supports them within a pass; else by wall time, as the difference
//! between a pass that ends with the stage and one that ends before it.
//!
//! Whole passes are timed separately, without timestamps.

use std::sync::Arc;

use ::render::cpu::Stage;
use ::render::gpu::{Gpu, GpuError, GpuRenderer, GpuSplats, UpstreamPlanes};
use bench::parts::{Kernels, StageTime};
use scene::Camera;

use super::scene::{Scene, WARM_UP, bytes, median};
use crate::args::KernelsArgs;
use crate::clock::Stopwatch;
use crate::failure::Failure;
use crate::run_record::{commit, invocation};

pub(super) fn time(gpu: &Arc<Gpu>, args: &KernelsArgs, scene: &Scene) -> Result<Kernels, Failure> {
    let mut bench = Bench::new(gpu, scene).map_err(failed)?;
    let mut millis: [Vec<f64>; 4] = Default::default();
    let mut stages: Vec<(Stage, Vec<f64>)> = Vec::new();
    for pass in 0..WARM_UP + args.passes as usize {
        let first = pass * args.views as usize;
        let cameras: Vec<Camera> =
            (first..first + args.views as usize).map(|n| scene.cameras[n % scene.cameras.len()]).collect();
        let of_pass = bench.pass(&cameras).map_err(failed)?;
        if pass >= WARM_UP {
            millis.iter_mut().zip(of_pass.millis).for_each(|(all, value)| all.push(value));
            for (stage, value) in of_pass.stages {
                match stages.iter_mut().find(|(of, _)| *of == stage) {
                    Some((_, all)) => all.push(value),
                    None => stages.push((stage, vec![value])),
                }
            }
        }
    }
    let [forward_cpu_millis, backward_cpu_millis, forward_wall_millis, backward_wall_millis] = millis.map(median);
    let pairs = u64::from(bench.renderer.status().map_err(failed)?.pairs) / u64::from(args.views);
    let at = |(stage, all): (Stage, Vec<f64>)| {
        let device_millis = median(all);
        let gbytes = bytes(stage, &scene.splats, pairs as f64).map(|bytes| bytes / (1e6 * device_millis.max(1e-9)));
        let stage = stage.name().to_owned();
        StageTime {
            stage,
            cpu_millis: None,
            device_millis: Some(device_millis),
            gflops: None,
            gbytes,
            of_ceiling: None,
        }
    };
    Ok(Kernels {
        commit: commit().to_owned(),
        machine: bench::machine(),
        backend: gpu.name().to_owned(),
        adapter_class: Some(gpu.class().to_owned()),
        threads: args.threads,
        splats: scene.splats.len() as u64,
        width: args.size.width,
        height: args.size.height,
        views: (args.views > 1).then_some(args.views),
        pairs,
        visits: None,
        ceiling_gflops: None,
        ceiling_gbytes: None,
        stages: stages.into_iter().map(at).collect(),
        clock: Some(if bench.has_clock { "device" } else { "wall" }.to_owned()),
        forward_cpu_millis,
        backward_cpu_millis,
        forward_wall_millis,
        backward_wall_millis,
        command: invocation(),
    })
}

/// Forward and backward pass of a scene.
struct Bench<'a> {
    gpu: &'a Arc<Gpu>,
    renderer: GpuRenderer,
    splats: GpuSplats,
    scene: &'a Scene,
    /// Whether stages are timed by timestamps.
    has_clock: bool,
}

/// Milliseconds of each stage, in order.
type Stages = Vec<(Stage, f64)>;

/// Times of one view; of several in one pass, their mean.
struct Pass {
    /// CPU forward, CPU backward, wall forward, wall backward.
    millis: [f64; 4],
    stages: Stages,
}

#[derive(Clone, Copy)]
enum Direction {
    Forward,
    Backward,
}

impl<'a> Bench<'a> {
    fn new(gpu: &'a Arc<Gpu>, scene: &'a Scene) -> Result<Self, GpuError> {
        let renderer = GpuRenderer::new(gpu.clone())?;
        let splats = GpuSplats::upload(gpu, &scene.splats, 0)?;
        Ok(Self { gpu, renderer, splats, scene, has_clock: gpu.has_timestamps() })
    }

    fn pass(&mut self, cameras: &[Camera]) -> Result<Pass, GpuError> {
        // Grows buffers first, so that the timed passes do not overflow.
        loop {
            self.once(Direction::Forward, cameras)?;
            if !self.renderer.grow_after_overflow()? {
                break;
            }
        }
        let area: usize =
            cameras.iter().map(|camera| camera.pinhole.width as usize * camera.pinhole.height as usize).sum();
        let mut encoder = self.gpu.encoder();
        self.gpu.write(&mut encoder, self.renderer.upstream(), 0, &vec![1e-3f32; 5 * area]);
        self.gpu.submit(encoder)?;
        self.gpu.wait()?;
        let (forward, mut stages) = self.timed(Direction::Forward, cameras)?;
        let (backward, of_backward) = self.timed(Direction::Backward, cameras)?;
        stages.extend(of_backward);
        let of_view = |millis: f64| millis / cameras.len() as f64;
        stages.iter_mut().for_each(|(_, millis)| *millis = of_view(*millis));
        Ok(Pass { millis: [forward[0], backward[0], forward[1], backward[1]].map(of_view), stages })
    }

    /// CPU and wall milliseconds of the whole pass, and milliseconds of each stage.
    fn timed(&mut self, direction: Direction, cameras: &[Camera]) -> Result<([f64; 2], Stages), GpuError> {
        let all = self.once(direction, cameras)?;
        self.gpu.start_timing(usize::MAX);
        self.once(direction, cameras)?;
        let dispatched = self.gpu.finish_timing()?;
        // Index of each stage's last dispatch.
        let mut ends: Vec<(Stage, usize)> = Vec::new();
        for (n, dispatch) in dispatched.iter().enumerate() {
            match ends.last_mut().filter(|(stage, _)| *stage == dispatch.stage) {
                Some((_, end)) => *end = n,
                None => ends.push((dispatch.stage, n)),
            }
        }
        let (mut stages, mut before) = (Vec::new(), 0.0);
        if !self.has_clock {
            before = self.up_to(direction, cameras, 0)?;
        }
        for (stage, last) in ends {
            let ended = match dispatched[last].ended_nanos.filter(|_| self.has_clock) {
                Some(nanos) => 1e-6 * nanos,
                None => self.up_to(direction, cameras, last + 1)?,
            };
            // By wall time, noise may exceed a short stage.
            stages.push((stage, (ended - before).max(0.0)));
            before = ended;
        }
        if !self.has_clock {
            // The backward pass needs a complete forward pass.
            self.once(Direction::Forward, cameras)?;
        }
        Ok((all, stages))
    }

    /// Wall milliseconds of the first `most` dispatches.
    fn up_to(&mut self, direction: Direction, cameras: &[Camera], most: usize) -> Result<f64, GpuError> {
        self.gpu.start_timing(most);
        let [_, wall] = self.once(direction, cameras)?;
        self.gpu.finish_timing().map(|_| wall)
    }

    /// CPU and wall milliseconds, from recording to completion.
    fn once(&mut self, direction: Direction, cameras: &[Camera]) -> Result<[f64; 2], GpuError> {
        let clock = Stopwatch::start();
        let mut encoder = self.gpu.encoder();
        match direction {
            Direction::Forward => {
                self.renderer.forward(&mut encoder, &self.splats, &[], cameras, &self.scene.options)?;
            }
            Direction::Backward => self.renderer.backward(&mut encoder, &self.splats, UpstreamPlanes::default())?,
        }
        self.gpu.submit(encoder)?;
        self.gpu.wait()?;
        Ok([1e3 * clock.cpu_seconds(), 1e3 * clock.wall_seconds()])
    }
}

pub(super) fn failed(error: GpuError) -> Failure {
    Failure::Work(error.to_string())
}

#[cfg(test)]
mod tests {
    use ::render::Options;

    use super::*;
    use crate::args::Size;
    use crate::commands::kernels::scene::{cloud, front};

    #[test]
    fn wall_timing_has_the_same_stages_and_changes_no_frame() {
        let gpu = match Gpu::open() {
            Ok(gpu) => gpu,
            Err(error) if std::env::var("PLAT_GPU").is_ok_and(|value| value == "required") => panic!("{error}"),
            Err(error) => return println!("skipped: no adapter ({error})"),
        };
        let camera = front(Size { width: 48, height: 32 });
        let scene = Scene { splats: cloud(100), options: Options::default(), cameras: vec![camera] };
        let mut bench = Bench::new(&gpu, &scene).unwrap();
        let usual = bench.renderer.draw(&bench.splats, &[], &camera, &scene.options).unwrap();
        for has_clock in [gpu.has_timestamps(), false] {
            bench.has_clock = has_clock;
            let pass = bench.pass(&[camera; 3]).unwrap();
            let stages: Vec<Stage> = pass.stages.iter().map(|(stage, _)| *stage).collect();
            assert_eq!(stages, Stage::ALL);
            assert!(pass.stages.iter().map(|(_, millis)| millis).sum::<f64>() > 0.0, "{:?}", pass.stages);
            assert!(pass.millis.iter().all(|&millis| millis > 0.0));
            assert!((0..3).all(|n| bench.renderer.read_frame(n).unwrap() == usual), "timing changes the frame");
        }
    }
}
