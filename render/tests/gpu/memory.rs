//! Buffers: the memory cap, limits, pair overflow, upload and readback, and the loss of the device.

use render::gpu::{Gpu, GpuError, GpuOptions, GpuRenderer, GpuSplats, UpstreamPlanes};
use scene::Splats;

use crate::common::{gpu, options};
use crate::reference::Random;
use crate::reference::mixture::{Kind, camera_of, mixture};

#[test]
fn the_memory_cap_is_enforced() {
    let Some(open) = gpu() else { return };
    let options =
        GpuOptions { memory_bytes: Some(1 << 20), ..GpuOptions::from_env().expect("valid environment variables") };
    let gpu = Gpu::open_with(&options).expect("a device with a cap");
    assert_eq!(gpu.name(), open.name(), "the cap is not part of the name");
    let half = gpu.buffer("half", 1 << 19).expect("a buffer within the cap");
    let other = gpu.buffer("other", (1 << 19) - 16).expect("a buffer within the cap");
    assert_eq!(gpu.memory_bytes(), [(1 << 20) - 16; 2]);
    let error = gpu.buffer("more", 20).expect_err("a buffer over the cap");
    assert!(error.is_out_of_memory() && error.to_string().contains("more would take 20 bytes"), "{error}");
    assert_eq!(gpu.buffer("rest", 16).map(|rest| rest.size()), Ok(16));
    drop((half, other));
    assert_eq!(gpu.memory_bytes(), [0, 1 << 20]);
    let camera = camera_of(250, 187);
    let splats = mixture(&mut Random(9), &camera, Kind::Common, 50);
    let drawn = GpuRenderer::new(gpu.clone()).and_then(|mut renderer| {
        renderer.draw(&GpuSplats::upload(&gpu, &splats, 0)?, &[], &camera, &self::options(false))
    });
    let error = drawn.expect_err("the pair buffers exceed the cap");
    println!("{error}");
    assert!(matches!(error, GpuError::OverCap { limit: 1_048_576, .. }), "{error}");
    assert_eq!(gpu.memory_bytes()[0], 0, "a failed constructor frees its buffers");
    gpu.buffer("all", 1 << 20).expect("the cap is free again");
}

#[test]
fn operations_on_a_lost_device_fail() {
    if gpu().is_none() {
        return;
    }
    let camera = camera_of(40, 30);
    let splats = mixture(&mut Random(1), &camera, Kind::Common, 50);
    for operation in 0..4 {
        let gpu = Gpu::open().expect("the adapter opened before");
        let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
        let on_device = GpuSplats::upload(&gpu, &splats, 0).expect("splats fit");
        renderer.draw(&on_device, &[], &camera, &options(false)).expect("drawn");
        gpu.device().destroy();
        let error = match operation {
            0 => renderer.draw(&on_device, &[], &camera, &options(false)).map(|_| ()),
            1 => renderer.read_frame(0).map(|_| ()),
            2 => on_device.download().map(|_| ()),
            _ => GpuRenderer::new(gpu.clone()).and_then(|mut fresh| {
                let on_device = GpuSplats::upload(&gpu, &splats, 0)?;
                fresh.draw(&on_device, &[], &camera, &options(false)).map(|_| ())
            }),
        };
        assert!(matches!(error, Err(GpuError::Lost(_))), "operation {operation}: {error:?}");
        assert!(matches!(gpu.wait(), Err(GpuError::Lost(_))), "the loss is permanent");
    }
}

#[test]
fn pair_overflow_is_sticky_until_the_buffers_grow() {
    let Some(gpu) = gpu() else { return };
    let camera = camera_of(250, 187);
    let options = options(false);
    // Each covers the image's 192 tiles: 384,000 pairs, more than the initial capacity.
    let many = mixture(&mut Random(9), &camera, Kind::Huge, 6000);
    let few = mixture(&mut Random(9), &camera, Kind::Common, 50);
    let [many, few] = [many, few].map(|splats| GpuSplats::upload(&gpu, &splats, 0).expect("splats fit"));
    let expected =
        GpuRenderer::new(gpu.clone()).expect("a renderer").draw(&few, &[], &camera, &options).expect("drawn");

    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    let forward = |renderer: &mut GpuRenderer, splats: &GpuSplats| {
        let mut encoder = gpu.encoder();
        renderer.forward(&mut encoder, splats, &[], &[camera], &options).expect("encoded");
        renderer.backward(&mut encoder, splats, UpstreamPlanes::default()).expect("encoded");
        gpu.submit(encoder).expect("submitted");
        renderer.status().expect("a status")
    };
    let status = forward(&mut renderer, &many);
    println!("{} pairs at first", status.max_pairs);
    assert!(status.overflow == 1 && status.visible_trainable == 0 && status.pairs == 0 && status.max_pairs > 1 << 18);
    // The flag stays set, whatever is drawn, until the host clears it.
    let status = forward(&mut renderer, &few);
    assert!(status.overflow == 1 && status.visible_trainable == 0 && status.pairs == 0);
    let area = 250 * 187;
    let frame = renderer.read_frame(0).expect("a frame");
    assert!((0..3 * area).all(|i| frame.colour[i] == options.background[i / area]));
    assert!(renderer.grow_after_overflow().expect("a status"), "the overflow must be reported");
    let status = forward(&mut renderer, &many);
    assert!(status.overflow == 0 && status.pairs == status.max_pairs && status.visible_trainable > 0);
    assert!(!renderer.grow_after_overflow().expect("a status"));
    assert_eq!(renderer.draw(&few, &[], &camera, &options).expect("drawn"), expected);
}

#[test]
fn splats_survive_upload_and_download() {
    let Some(gpu) = gpu() else { return };
    let camera = camera_of(40, 30);
    for degree in 0..=3 {
        let splats = mixture(&mut Random(1), &camera, Kind::Common, 131).with_sh_degree(degree);
        let mut on_device = GpuSplats::upload(&gpu, &splats, 200).expect("splats fit");
        assert_eq!(on_device.download().expect("splats"), splats);
        let more = mixture(&mut Random(2), &camera, Kind::Common, 777).with_sh_degree(3 - degree);
        on_device.replace(&more).expect("a larger allocation");
        assert_eq!((on_device.len(), on_device.sh_degree()), (777, 3 - degree));
        assert_eq!(on_device.download().expect("splats"), more);
    }
}

#[test]
fn large_buffers_are_copied_in_pieces() {
    let Some(gpu) = gpu() else { return };
    // Ten million words, 40 MB, from the second word on.
    let values: Vec<u32> = (0..10_000_000u32).map(|i| i.wrapping_mul(0x9e37_79b9)).collect();
    let buffer = gpu.buffer("words", 4 * 10_000_001).expect("a buffer within the cap");
    gpu.upload(&buffer, 4, &values).expect("uploaded");
    assert!(gpu.read::<u32>(&buffer, 1, values.len()).expect("read") == values);
    assert_eq!(gpu.read::<u32>(&buffer, 0, 2).expect("read"), [0, values[0]]);
    let [used, peak] = gpu.memory_bytes();
    assert!(peak >= used && used >= 40_000_000 && gpu.read::<u32>(&buffer, 0, 0).is_ok_and(|none| none.is_empty()));
}

#[test]
fn errors_of_oversized_requests_state_the_limit() {
    let Some(gpu) = gpu() else { return };
    let error =
        render::gpu::Columns::new(&gpu, "test", 3, usize::MAX / 128).expect_err("more than any binding").to_string();
    println!("{error}");
    assert!(error.contains("splats do not fit") && !error.contains('\n'), "{error}");
    let fit = (gpu.max_binding_bytes() / 60) as usize;
    assert!(error.contains(&(fit / 64 * 64).to_string()), "{error}");
    let mut renderer = GpuRenderer::new(gpu.clone()).expect("a renderer");
    let splats = GpuSplats::upload(&gpu, &Splats::new(0), 0).expect("an empty set");
    let camera = camera_of(200_000, 200_000);
    let error = renderer
        .draw(&splats, &[], &camera, &options(false))
        .expect_err("an image larger than any binding")
        .to_string();
    println!("{error}");
    assert!(!error.contains('\n'), "{error}");
}
