//! Empty scenes, non-finite parameters and invisible splats.

use render::gpu::GpuRenderer;
use scene::Splats;

use crate::common::{Drawn, columns, gpu, noise, on_gpu, options};
use crate::reference::Random;
use crate::reference::mixture::{KINDS, Kind, SIZES, camera_of, mixture};

#[test]
fn an_empty_scene_shows_the_background() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    for (width, height) in SIZES {
        let camera = camera_of(width, height);
        let area = (width * height) as usize;
        for context in [None, Some(Splats::new(0))] {
            let options = options(false);
            let upstream = noise(&camera, &options);
            let drawn = on_gpu(&gpu, &mut renderer, &Splats::new(2), context.as_ref(), &camera, &options, &upstream);
            assert!((0..3 * area).all(|i| drawn.frame.colour[i] == options.background[i / area]));
            assert!(drawn.frame.transmittance.iter().all(|&t| t == 1.0));
            assert!(drawn.frame.depth.iter().chain(&drawn.frame.trainable_alpha).all(|&v| v == 0.0));
            assert!(drawn.gradients.columns.iter().all(Vec::is_empty));
        }
    }
}

#[test]
fn non_finite_splats_are_culled_and_affect_nothing() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    let camera = camera_of(40, 30);
    let splats = mixture(&mut Random(3), &camera, Kind::Common, 37);
    let options = options(true);
    let upstream = noise(&camera, &options);
    let mut failed = Vec::new();
    let mut draw = |splats: &Splats, context: Option<&Splats>| {
        on_gpu(&gpu, &mut renderer, splats, context, &camera, &options, &upstream)
    };
    let few = splats.filter(|i| i != 20);
    let without = draw(&few, None);
    assert!(draw(&splats, None).frame != without.frame, "splat 20 must be visible in the image");
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38, -3e38] {
        for k in 0..splats.columns().len() {
            let mut broken = splats.clone();
            broken.columns_mut()[k][20] = value;
            let alone = draw(&broken, None);
            let as_context = draw(&few, Some(&broken));
            let finite = |v: &f32| v.is_finite();
            let frames = [&alone.frame, &as_context.frame];
            let images =
                frames.iter().all(|f| [&f.colour, &f.transmittance, &f.depth].iter().all(|p| p.iter().all(finite)));
            let others = columns(&alone.gradients).iter().all(|(_, c)| (0..37).all(|i| i == 20 || c[i].is_finite()));
            let context = columns(&as_context.gradients).iter().all(|(_, c)| c.iter().all(finite));
            // A NaN splat is culled, so the frame equals that without it.
            let culled = !value.is_nan() || alone.frame == without.frame;
            if !(images && others && context && culled) {
                failed.push(format!(
                    "column {k} = {value:e}: images {images}, others {others}, context {context}, culled {culled}"
                ));
            }
        }
    }
    assert!(failed.is_empty(), "{} cases: {failed:#?}", failed.len());
}

#[test]
fn gradients_are_finite_and_zero_for_invisible_splats() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    for kind in KINDS {
        for (seed, (width, height)) in SIZES.into_iter().enumerate() {
            let camera = camera_of(width, height);
            let splats = mixture(&mut Random(seed as u64 + 50), &camera, kind, 150);
            let options = options(seed % 2 == 0);
            let upstream = noise(&camera, &options);
            let Drawn { gradients, .. } = on_gpu(&gpu, &mut renderer, &splats, None, &camera, &options, &upstream);
            for (name, column) in columns(&gradients) {
                for (i, &value) in column.iter().enumerate() {
                    let seen = gradients.seen[i / 16] >> (i % 16) & 1 == 1;
                    let what = format!("{kind:?} {width}x{height}, splat {i} (seen {seen}), {name}: {value}");
                    assert!(value.is_finite() && (seen || value == 0.0), "{what}");
                }
            }
        }
    }
}
