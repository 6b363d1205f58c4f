//! Devices, scenes and comparisons that the tests of the GPU backend share.

use std::sync::{Arc, OnceLock};

use render::cpu::{Isa, Renderer};
use render::gpu::{Gpu, GpuOptions, GpuPart, GpuRenderer, GpuSplats, Path, UpstreamPlanes};
use render::{Frame, Gradients, Options, Part, Upstream};
use scene::{Camera, Splats};

use crate::reference::Random;

/// The shared device; `None` without an adapter, unless `PLAT_GPU=required`.
pub(crate) fn gpu() -> Option<Arc<Gpu>> {
    static GPU: OnceLock<Option<Arc<Gpu>>> = OnceLock::new();
    let gpu = GPU.get_or_init(|| match Gpu::open() {
        Ok(gpu) => Some(gpu),
        Err(e) if std::env::var("PLAT_GPU").is_ok_and(|v| v == "required") => panic!("PLAT_GPU=required, but {e}"),
        Err(_) => None,
    });
    if gpu.is_none() {
        println!("skipped: no adapter");
    }
    gpu.clone()
}

/// The shared device with its fastest stages and, if those are not the portable ones, a device with the portable ones.
pub(crate) fn gpus() -> Vec<Arc<Gpu>> {
    static PORTABLE: OnceLock<Option<Arc<Gpu>>> = OnceLock::new();
    let Some(fast) = gpu() else { return Vec::new() };
    let open = || {
        let options =
            GpuOptions { path: Path::Portable, ..GpuOptions::from_env().expect("valid environment variables") };
        fast.has_subgroups().then(|| Gpu::open_with(&options).expect("the adapter opened before"))
    };
    let portable = PORTABLE.get_or_init(open).clone();
    [Some(fast), portable].into_iter().flatten().collect()
}

pub(crate) fn options(antialiased: bool) -> Options {
    Options { antialiased, sh_degree: 2, background: [0.2, 0.4, 0.1], extras: true, inverse_depth: false }
}

/// A frame and its gradients.
pub(crate) struct Drawn {
    pub(crate) frame: Frame,
    pub(crate) gradients: Gradients,
}

/// A random upstream gradient.
pub(crate) fn noise(camera: &Camera, options: &Options) -> Upstream {
    let area = (camera.pinhole.width * camera.pinhole.height) as usize;
    let mut random = Random(7);
    Upstream {
        colour: random.plane(3 * area),
        transmittance: random.plane(area),
        depth: if options.extras { random.plane(area) } else { Vec::new() },
        ..Upstream::default()
    }
}

pub(crate) fn on_cpu(
    isa: Isa,
    splats: &Splats,
    context: Option<&Splats>,
    camera: &Camera,
    options: &Options,
    upstream: &Upstream,
) -> Drawn {
    let mut renderer = Renderer::new(isa);
    let part = context.map(Part::beside);
    let frame = renderer.forward(splats, part.as_slice(), camera, options).clone();
    let gradients = renderer.backward(splats, upstream).clone();
    Drawn { frame, gradients }
}

pub(crate) fn on_gpu(
    gpu: &Arc<Gpu>,
    renderer: &mut GpuRenderer,
    splats: &Splats,
    context: Option<&Splats>,
    camera: &Camera,
    options: &Options,
    upstream: &Upstream,
) -> Drawn {
    let on_device = GpuSplats::upload(gpu, splats, 0).expect("splats fit");
    let context = context.map(|context| GpuSplats::upload(gpu, context, 0).expect("context fits"));
    let part = context.as_ref().map(GpuPart::beside);
    let frame = renderer.draw(&on_device, part.as_slice(), camera, options).expect("drawn");
    let area = frame.transmittance.len();
    let mut encoder = gpu.encoder();
    for (plane, values) in [(0, &upstream.colour), (3, &upstream.transmittance), (4, &upstream.depth)] {
        gpu.write(&mut encoder, renderer.upstream(), (4 * plane * area) as u64, values);
    }
    let planes =
        UpstreamPlanes { transmittance: !upstream.transmittance.is_empty(), depth: !upstream.depth.is_empty() };
    renderer.backward(&mut encoder, &on_device, planes).expect("backward");
    gpu.submit(encoder).expect("submitted");
    let gradients = renderer.read_gradients(&on_device).expect("gradients");
    Drawn { frame, gradients }
}

/// Norm of the difference of two columns, relative to the norm of the second.
pub(crate) fn difference(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |v: f64| v * v;
    let squared_error: f64 = a.iter().zip(b).map(|(&a, &b)| square(f64::from(a) - f64::from(b))).sum();
    let squared_norm: f64 = b.iter().map(|&b| square(f64::from(b))).sum();
    if squared_error == 0.0 { 0.0 } else { (squared_error / squared_norm).sqrt() }
}

/// Every column of the gradients, with its name.
pub(crate) fn columns(gradients: &Gradients) -> Vec<(String, &[f32])> {
    let columns = gradients.columns.iter().enumerate().map(|(k, column)| (format!("column {k}"), column.as_slice()));
    let statistics = [
        ("screen", gradients.screen_gradient.as_slice()),
        ("screen_abs", &gradients.screen_gradient_abs),
        ("weight", &gradients.weight),
    ];
    columns.chain(statistics.map(|(name, column)| (name.to_string(), column))).collect()
}

/// The largest difference between columns of gradients, and the column's name.
pub(crate) fn worst(a: &Gradients, b: &Gradients) -> (f64, String) {
    let pairs = columns(a).into_iter().zip(columns(b));
    let differences = pairs.map(|((name, a), (_, b))| (difference(a, b), name));
    differences.max_by(|(a, _), (b, _)| a.total_cmp(b)).expect("there are columns")
}

/// Every number of a frame and of its gradients, as bits.
pub(crate) fn bits(drawn: &Drawn) -> Vec<u32> {
    let frame = &drawn.frame;
    let planes = [&frame.colour, &frame.transmittance, &frame.depth, &frame.trainable_alpha];
    let columns = columns(&drawn.gradients);
    planes.into_iter().flatten().chain(columns.iter().flat_map(|(_, c)| c.iter())).map(|v| v.to_bits()).collect()
}

/// Tolerance of a column of gradients, relative to its norm. The worst on llvmpipe is 9.4e-4, from thresholds (α =
/// 1/255) that rounding decides differently.
pub(crate) const GRADIENTS: f64 = 3e-3;

/// The same for needles up to hundreds of times as long as wide: 2.1e-1 on llvmpipe, where the CPU's instruction sets
/// differ among themselves by 1.4e-1.
pub(crate) const NEEDLES: f64 = 0.4;
