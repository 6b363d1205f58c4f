//! The variants of the stages against each other: portable, subgroups, half precision, atomics.

use std::sync::Arc;

use render::gpu::{Gpu, GpuError, GpuOptions, GpuRenderer, GpuSplats, Path, Reduction, UpstreamPlanes};

use crate::common::{NEEDLES, bits, difference, gpu, gpus, noise, on_gpu, options, worst};
use crate::reference::Random;
use crate::reference::mixture::{Kind, camera_of, mixture};

/// Subgroup stages may change only the summation order over the pixels of a tile.
#[test]
fn portable_and_subgroup_paths_differ_only_in_the_rounding_of_gradients() {
    let gpus = gpus();
    let [fast, portable] = gpus.as_slice() else {
        println!("skipped: no subgroups");
        return;
    };
    assert!(fast.name() == format!("{}-subgroups", portable.name()), "{} and {}", fast.name(), portable.name());
    for kind in [Kind::Common, Kind::Needle, Kind::Close] {
        // 475 tiles: the tile sort takes two radix passes.
        let camera = camera_of(400, 300);
        let mut random = Random(31);
        let splats = mixture(&mut random, &camera, kind, 1000);
        let context = mixture(&mut random, &camera, Kind::Common, 200);
        let options = options(true);
        let upstream = noise(&camera, &options);
        let [a, b] = [fast, portable].map(|gpu| {
            let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
            let drawn = on_gpu(gpu, &mut renderer, &splats, Some(&context), &camera, &options, &upstream);
            (drawn, renderer.read_forward_intermediates().expect("stages"))
        });
        assert!(a.1 == b.1 && a.0.frame == b.0.frame, "{kind:?}: frames differ");
        assert_eq!(a.0.gradients.seen, b.0.gradients.seen);
        let (error, column) = worst(&a.0.gradients, &b.0.gradients);
        println!("{kind:?}: {} pairs, gradients off by {error:.1e} ({column})", a.1.pairs.len());
        // Needles amplify rounding differences, as they do between the CPU's instruction sets.
        assert!(error > 0.0, "{kind:?}: bit-identical gradients: both ran the same stages");
        assert!(error < if kind == Kind::Needle { NEEDLES } else { 1e-4 }, "{kind:?}: {error} of {column}");
    }
}

/// Half precision may change only gradients, from their fourth digit on.
#[test]
fn half_precision_gives_the_same_frames_and_gradients_to_three_digits() {
    let Some(fast) = gpu() else { return };
    let options = GpuOptions { path: Path::Half, ..GpuOptions::from_env().expect("valid environment variables") };
    let half = match Gpu::open_with(&options) {
        Ok(half) => half,
        Err(error @ GpuError::NoHalf(_)) => return println!("skipped: {error}"),
        Err(error) => panic!("{error}"),
    };
    assert!(half.path() == Path::Half && half.name().ends_with("-subgroups-half"), "{}", half.name());
    for kind in [Kind::Common, Kind::Close, Kind::Opaque, Kind::Huge] {
        let camera = camera_of(400, 300);
        let mut random = Random(31);
        let splats = mixture(&mut random, &camera, kind, 1000);
        let context = mixture(&mut random, &camera, Kind::Common, 200);
        let options = self::options(true);
        // Gradients of a mean over pixels, the magnitude of a training loss.
        let mut upstream = noise(&camera, &options);
        for plane in [&mut upstream.colour, &mut upstream.transmittance, &mut upstream.depth] {
            plane.iter_mut().for_each(|value| *value /= 120_000.0);
        }
        let draw = |gpu: &Arc<Gpu>| {
            let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
            on_gpu(gpu, &mut renderer, &splats, Some(&context), &camera, &options, &upstream)
        };
        let [a, b] = [draw(&half), draw(&fast)];
        assert!(a.frame == b.frame && a.gradients.seen == b.gradients.seen, "{kind:?}: frames differ");
        assert!(bits(&a) == bits(&draw(&half)), "{kind:?}: two runs differ");
        let (error, column) = worst(&a.gradients, &b.gradients);
        println!("{kind:?}: gradients off by {error:.1e} ({column})");
        assert!(error > 0.0 && error < 1e-3, "{kind:?}: {error} of {column}");
    }
}

#[test]
fn atomic_and_ordered_reduction_agree() {
    for gpu in gpus() {
        let camera = camera_of(250, 187);
        let splats = mixture(&mut Random(17), &camera, Kind::Opaque, 2000);
        let on_device = GpuSplats::upload(&gpu, &splats, 0).expect("splats fit");
        let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
        let options = options(false);
        let frame = renderer.draw(&on_device, &[], &camera, &options).expect("drawn");
        let upstream = noise(&camera, &options);
        let [ordered, atomic] = [Reduction::Ordered, Reduction::Atomic].map(|reduction| {
            let mut encoder = gpu.encoder();
            gpu.write(&mut encoder, renderer.upstream(), 0, &upstream.colour);
            renderer.reduce_moments(&mut encoder, UpstreamPlanes::default(), reduction).expect("encoded");
            gpu.submit(encoder).expect("submitted");
            renderer.read_splat_moments(reduction).expect("moments")
        });
        assert!(frame.transmittance.iter().any(|&t| t < 0.5) && ordered.len() == 2000);
        for m in 0..ordered[0].len() {
            let [a, b] = [&atomic, &ordered].map(|sums| sums.iter().map(|sums| sums[m]).collect::<Vec<f32>>());
            let error = difference(&a, &b);
            // Moment 9 is that of depth, which has no upstream gradient here.
            assert!(error < 1e-5 && (m == 9) == b.iter().all(|&v| v == 0.0), "{}, moment {m}: {error}", gpu.name());
        }
    }
}
