//! Bit-identical results: from run to run, after other views, and with several views in one dispatch.

use render::gpu::{GpuPart, GpuRenderer, GpuSplats, UpstreamPlanes};
use render::{Options, Upstream};
use scene::Camera;

use crate::common::{Drawn, bits, columns, gpu, gpus, noise, on_gpu, options};
use crate::reference::Random;
use crate::reference::mixture::{Kind, camera_of, mixture};

#[test]
fn two_runs_give_the_same_bits() {
    let Some(gpu) = gpu() else { return };
    let camera = camera_of(250, 187);
    let mut random = Random(11);
    let splats = mixture(&mut random, &camera, Kind::Opaque, 3000);
    let context = mixture(&mut random, &camera, Kind::Common, 1000);
    let options = options(true);
    let upstream = noise(&camera, &options);
    let draw = |renderer: &mut GpuRenderer| {
        bits(&on_gpu(&gpu, renderer, &splats, Some(&context), &camera, &options, &upstream))
    };
    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    let first = draw(&mut renderer);
    assert!(first.iter().filter(|&&v| v != 0).count() > first.len() / 2, "most values are zero");
    // Not assert_eq, which would print a million numbers.
    assert!(first == draw(&mut renderer), "the same renderer differs");
    assert!(first == draw(&mut GpuRenderer::new(gpu.clone()).expect("a renderer")), "another renderer differs");
}

#[test]
fn reused_buffers_do_not_affect_later_views() {
    let Some(gpu) = gpu() else { return };
    let mut used = GpuRenderer::new(gpu.clone()).expect("a renderer");
    for (seed, (width, height), count) in [(1, (250, 187), 900), (2, (17, 33), 40), (3, (64, 64), 500), (4, (3, 5), 0)]
    {
        let camera = camera_of(width, height);
        let splats = mixture(&mut Random(seed), &camera, Kind::Behind, count);
        let options = Options { extras: seed % 2 == 0, ..options(true) };
        let upstream = noise(&camera, &options);
        let mut fresh = GpuRenderer::new(gpu.clone()).expect("a renderer");
        let [a, b] = [&mut used, &mut fresh]
            .map(|renderer| bits(&on_gpu(&gpu, renderer, &splats, None, &camera, &options, &upstream)));
        assert!(a == b, "view {seed}");
    }
}

#[test]
fn several_views_in_one_dispatch_equal_single_views() {
    for gpu in gpus() {
        let sizes = [(250, 187), (17, 33), (64, 64), (3, 5)];
        let cameras: Vec<Camera> = (sizes.iter().enumerate())
            .map(|(n, &(width, height))| {
                let mut camera = camera_of(width, height);
                camera.camera_from_world.translation.x += 0.2 * n as f64;
                camera
            })
            .collect();
        let mut random = Random(23);
        let splats = mixture(&mut random, &cameras[0], Kind::Behind, 900);
        let context = mixture(&mut random, &cameras[0], Kind::Common, 300);
        let options = options(true);
        let upstreams: Vec<Upstream> = cameras.iter().map(|camera| noise(camera, &options)).collect();
        let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
        let alone: Vec<Drawn> = (cameras.iter().zip(&upstreams))
            .map(|(camera, upstream)| on_gpu(&gpu, &mut renderer, &splats, Some(&context), camera, &options, upstream))
            .collect();

        let [on_device, context] =
            [&splats, &context].map(|splats| GpuSplats::upload(&gpu, splats, 0).expect("splats fit"));
        let mut encoder = gpu.encoder();
        renderer.forward(&mut encoder, &on_device, &[GpuPart::beside(&context)], &cameras, &options).expect("encoded");
        let mut first = 0;
        for upstream in &upstreams {
            let planes = [&upstream.colour[..], &upstream.transmittance, &upstream.depth].concat();
            gpu.write(&mut encoder, renderer.upstream(), 4 * first, &planes);
            first += planes.len() as u64;
        }
        let planes = UpstreamPlanes { transmittance: true, depth: true };
        renderer.backward(&mut encoder, &on_device, planes).expect("backward");
        gpu.submit(encoder).expect("submitted");
        assert!(!renderer.grow_after_overflow().expect("a status"));
        for (n, alone) in alone.iter().enumerate() {
            assert!(renderer.read_frame(n).expect("a frame") == alone.frame, "{}: view {n} differs", gpu.name());
        }
        // Gradients are the sum of the single views' gradients, in the order of the views.
        let together = renderer.read_gradients(&on_device).expect("gradients");
        let mut sums: Vec<Vec<f32>> = vec![vec![0.0; splats.len()]; columns(&together).len()];
        let mut views_of_splat = vec![0; splats.len()];
        for Drawn { gradients, .. } in &alone {
            for (i, views_of_splat) in views_of_splat.iter_mut().enumerate() {
                if gradients.seen[i / 16] >> (i % 16) & 1 == 1 {
                    *views_of_splat += 1;
                    sums.iter_mut().zip(columns(gradients)).for_each(|(sum, (_, column))| sum[i] += column[i]);
                }
            }
        }
        assert!((0..=4).all(|views| views_of_splat.iter().filter(|&&n| n == views).count() > 3), "{views_of_splat:?}");
        for ((name, column), sum) in columns(&together).iter().zip(&sums) {
            assert!(column == sum, "{}: gradients of {name} differ", gpu.name());
        }
        let mut encoder = gpu.encoder();
        let mut forward = |cameras: &[Camera]| renderer.forward(&mut encoder, &on_device, &[], cameras, &options);
        for number in [0, 17] {
            let error = forward(&vec![cameras[0]; number]).expect_err("too few or too many").to_string();
            assert!(error.contains("1 to 16"), "{error}");
        }
        assert!(renderer.read_forward_intermediates().is_err() && renderer.read_frame(4).is_err());
    }
}
