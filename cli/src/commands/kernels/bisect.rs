//! `plat bench kernels --from-stage STAGE`: renders the same views on both backends and compares their stages in order.
//!
//! The first stage beyond its tolerance is the faulty one; later stages differ because of it.

use std::sync::Arc;

use ::render::cpu::{Renderer, Stage};
use ::render::gpu::{Gpu, GpuError, GpuRenderer, GpuSplats, UpstreamPlanes};
use ::render::{Options, Upstream};
use scene::Camera;
use serde::Serialize;
use train::random;

use super::compare::{Compared, Drawn};
use super::gpu::failed;
use super::scene::Scene;
use crate::failure::Failure;
use crate::output::Output;

#[derive(Serialize)]
struct Bisected<'a> {
    command: &'static str,
    backends: [String; 2],
    adapter_class: &'static str,
    views: usize,
    splats: usize,
    /// The first compared stage beyond its tolerance.
    first_mismatch: Option<&'static str>,
    stages: &'a [Compared],
}

pub(super) fn run(gpu: &Arc<Gpu>, scene: &Scene, from: Stage, output: &Output) -> Result<(), Failure> {
    let (mut cpu, mut renderer) = (Renderer::default(), GpuRenderer::new(gpu.clone()).map_err(failed)?);
    let splats = GpuSplats::upload(gpu, &scene.splats, 0).map_err(failed)?;
    let stages = Stage::ALL.into_iter().skip_while(|stage| *stage != from);
    let mut found: Vec<(Stage, Compared)> = stages.map(|stage| (stage, Compared::of(stage))).collect();
    for (view, camera) in scene.cameras.iter().enumerate() {
        let options = Options { extras: true, ..scene.options };
        let ours = Drawn::on_gpu(gpu, &mut renderer, &splats, camera, &options).map_err(failed)?;
        let theirs = Drawn::on_cpu(&mut cpu, scene, camera, &options);
        for (stage, compared) in &mut found {
            compared.add(*stage, view, &ours, &theirs);
        }
    }
    let compared: Vec<Compared> = found.into_iter().map(|(_, compared)| compared.judged()).collect();
    let first = compared.iter().find(|compared| !compared.within);
    let bisected = Bisected {
        command: "bench kernels",
        backends: [gpu.name().to_owned(), cpu.name()],
        adapter_class: gpu.class(),
        views: scene.cameras.len(),
        splats: scene.splats.len(),
        first_mismatch: first.map(|compared| compared.stage),
        stages: &compared,
    };
    let verdict = first.map_or("no stage differs".to_owned(), |of| {
        format!(
            "{} differs: {:.3e} at {} (relative {:.3e} at {}, tolerance {:.0e}), {} of {} on one backend only",
            of.stage,
            of.largest_absolute,
            of.absolute_at,
            of.largest_relative,
            of.relative_at,
            of.tolerance,
            of.alone,
            of.of
        )
    });
    let lines: Vec<String> = compared.iter().map(Compared::text).collect();
    output.result(&bisected, &format!("{} against {}\n{}\n{verdict}", gpu.name(), cpu.name(), lines.join("\n")))?;
    first.map_or(Ok(()), |_| Err(Failure::Work(verdict)))
}

impl Drawn {
    pub(super) fn on_cpu(renderer: &mut Renderer, scene: &Scene, camera: &Camera, options: &Options) -> Self {
        let frame = renderer.forward(&scene.splats, &[], camera, options).clone();
        let upstream = Upstream { colour: noise(camera), ..Upstream::default() };
        let gradients = renderer.backward(&scene.splats, &upstream).clone();
        Self { stages: renderer.forward_intermediates(), frame, moments: renderer.backward_intermediates(), gradients }
    }

    fn on_gpu(
        gpu: &Gpu,
        renderer: &mut GpuRenderer,
        splats: &GpuSplats,
        camera: &Camera,
        options: &Options,
    ) -> Result<Self, GpuError> {
        let frame = renderer.draw(splats, &[], camera, options)?;
        let mut encoder = gpu.encoder();
        gpu.write(&mut encoder, renderer.upstream(), 0, &noise(camera));
        renderer.backward(&mut encoder, splats, UpstreamPlanes::default())?;
        gpu.submit(encoder)?;
        let gradients = renderer.read_gradients(splats)?;
        Ok(Self {
            stages: renderer.read_forward_intermediates()?,
            frame,
            moments: renderer.read_backward_intermediates()?,
            gradients,
        })
    }
}

/// Random upstream gradients of both signs.
fn noise(camera: &Camera) -> Vec<f32> {
    let area = u64::from(camera.pinhole.width) * u64::from(camera.pinhole.height);
    (0..3 * area).map(|i| random::uniform(0, i) - 0.5).collect()
}
