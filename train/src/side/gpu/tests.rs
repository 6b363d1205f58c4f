//! Each stage of a step against the CPU's, from what the stages before it left on the device.

use glam::{DQuat, DVec3, Vec3};
use render::Options;
use scene::{Camera, Pinhole, Pixels, Rigid, Splat};

use super::*;
use crate::loss::Photometric;
use crate::need::Need;
use crate::optimiser;
use crate::random::{bits, uniform};

fn gpu() -> Option<Arc<Gpu>> {
    match Gpu::open() {
        Ok(gpu) => Some(gpu),
        Err(error) if std::env::var("PLAT_GPU").is_ok_and(|value| value == "required") => panic!("{error}"),
        Err(error) => {
            println!("skipped: no adapter ({error})");
            None
        }
    }
}

/// Splats before the camera, every number from `key`; some needles, with all columns of the SH degree.
fn cloud(key: u64, count: u64, sh_degree: u8) -> Splats {
    let mut splats = Splats::new(sh_degree);
    for i in 0..count {
        let number = |k: u64| uniform(key, 64 * i + k);
        let place = Vec3::new(3.0 * number(0) - 1.5, 2.0 * number(1) - 1.0, 3.0 + 2.0 * number(2));
        let mut splat = Splat::round(place, -2.0, Vec3::new(number(3), number(4), number(5)), 0.1 + 0.8 * number(6));
        splat.log_scale += Vec3::new(number(7), number(8), number(9)) - 0.5;
        if i % 9 == 0 {
            splat.log_scale.x -= 4.0;
            splat.log_scale.y -= 4.0;
        }
        splat.quat = [number(10) + 0.1, number(11), number(12), number(13)];
        splat.sh[1..].iter_mut().flatten().zip(14..).for_each(|(value, k)| *value = 0.3 * (number(k) - 0.5));
        splats.push(&splat);
    }
    splats
}

/// A photo of noise; masked on the right where asked.
fn look(masked: bool, key: u64, [width, height]: [u32; 2], translation: DVec3) -> Look {
    let area = (width * height) as usize;
    let rgb = (0..3 * area).map(|i| bits(key, i as u64) as u8).collect();
    let mask = masked.then(|| (0..area).map(|i| if i % width as usize > 50 { 0 } else { 255 }).collect());
    let pinhole = Pinhole { width, height, fx: 70.0, fy: 72.0, cx: 37.0, cy: 27.0 };
    let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation };
    let photo = Arc::new(Pixels { width, height, rgb, mask });
    Look { view: 0, photo, camera: Camera { pinhole, camera_from_world }, exposure: None }
}

/// One look of a size that is no multiple of a tile.
fn step(masked: bool, extras: bool, key: u64) -> Step {
    Step {
        looks: vec![look(masked, key, [75, 53], DVec3::ZERO)],
        options: Options { extras, sh_degree: 3, ..Options::default() },
        rates: optimiser::Rates {
            mean: 0.03,
            log_scale: 0.01,
            quat: 0.002,
            opacity: 0.05,
            sh_dc: 0.01,
            sh_rest: 0.0005,
            beta2: 0.999,
            opacity_pull: 0.02,
            needle_pull: 0.01,
            log_scale_bounds: [-5.0, -1.0],
        },
        exposure_rate: 0.0,
    }
}

fn state(splats: Splats) -> State {
    State {
        step: 0,
        skipped: 0,
        start_count: splats.len(),
        need: Need::default(),
        adam: Adam::new(Isa::detect(), &splats),
        evidence: Evidence::default(),
        exposures: None,
        splats,
        loss: f64::NAN,
    }
}

/// The largest difference between values, in units of the largest value.
fn off(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(1e-30f32, |most, value| most.max(value.abs()));
    found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / largest
}

fn words(state: &State) -> Vec<u32> {
    let (_, first, second) = state.adam.parts();
    let columns = state.splats.columns().iter().chain(first).chain(second);
    let Evidence { error, weight, .. } = &state.evidence;
    columns.chain([error, weight]).flatten().map(|value| value.to_bits()).collect()
}

#[test]
fn stages_agree_with_the_cpus() {
    let Some(gpu) = gpu() else { return };
    for (sh_degree, masked, extras) in [(0, false, false), (1, true, false), (2, false, true), (3, true, true)] {
        let context = extras.then(|| cloud(7, 60, 3));
        let mut now = state(cloud(3, 300, sh_degree));
        let mut side = GpuSide::new(&gpu, &now, 0.2, context.as_ref()).unwrap();
        // The second step has moments to go on from.
        for key in [1, 2] {
            let step = step(masked, extras, key);
            let photo = &step.looks[0].photo;
            side.fetch(&mut now, Part::All).unwrap();
            let mut expected = now.clone();
            side.step(&mut now, step.clone()).unwrap();
            side.fetch(&mut now, Part::All).unwrap();

            let frame = side.renderer.read_frame(0).unwrap();
            let mut weights = Vec::new();
            super::super::cpu::pixel_weights(&frame, photo, &mut weights);
            let mut upstream = Vec::new();
            let value = Photometric::new(Isa::detect(), 0.2).evaluate(&frame.colour, photo, &weights, &mut upstream);
            let found: Vec<f32> = gpu.read(side.renderer.upstream(), 0, upstream.len()).unwrap();
            let loss_off = (now.loss - value.total).abs() / value.total;
            let l1_off = (now.need.tally.sum - expected.need.tally.sum - value.l1).abs() / value.l1;
            let upstream_off = off(&found, &upstream);

            let gradients = side.renderer.read_gradients(&side.splats).unwrap();
            expected.adam.step(&mut expected.splats, &gradients, 3, &step.rates);
            expected.evidence.add(&gradients, photo.area() as f32);
            let by_column = |found: &[Vec<f32>], expected: &[Vec<f32>]| {
                found.iter().zip(expected).map(|(a, b)| off(a, b)).fold(0.0, f32::max)
            };
            let splats_off = by_column(now.splats.columns(), expected.splats.columns());
            let ((steps, first, second), (cpu_steps, cpu_first, cpu_second)) =
                (now.adam.parts(), expected.adam.parts());
            let moments_off = by_column(first, cpu_first).max(by_column(second, cpu_second));
            let evidence_off = off(&now.evidence.error, &expected.evidence.error)
                .max(off(&now.evidence.weight, &expected.evidence.weight));
            println!(
                "SH {sh_degree}, masked {masked}, context {extras}, step {key}: loss {loss_off:.1e}, L1 {l1_off:.1e}, \
                 upstream {upstream_off:.1e}, splats {splats_off:.1e}, moments {moments_off:.1e}, evidence {evidence_off:.1e}"
            );
            assert_eq!((steps, now.evidence.views.clone()), (cpu_steps, expected.evidence.views));
            assert!(
                now.evidence.views.iter().any(|&views| views > 0)
                    && now.splats != state(cloud(3, 300, sh_degree)).splats
            );
            assert!(loss_off < 1e-6 && l1_off < 1e-6 && upstream_off < 1e-5, "the loss");
            assert!(splats_off < 2e-6 && moments_off < 2e-6 && evidence_off < 1e-6, "Adam or the evidence");
        }
    }
}

/// Of looks of several sizes, one of them masked, before a context: as on the CPU, which takes one after the other.
#[test]
fn a_step_of_several_looks_is_the_cpus() {
    let Some(gpu) = gpu() else { return };
    let context = cloud(7, 60, 3);
    let begin = state(cloud(3, 300, 2));
    let looks: Vec<Look> = [[75, 53], [16, 16], [33, 90], [64, 48]]
        .into_iter()
        .zip(1..)
        .map(|(size, key)| look(key == 3, key, size, DVec3::new(0.3 * key as f64, 0.0, 0.5)))
        .collect();
    let one = |looks: &[Look]| {
        let mut step = step(false, true, 1);
        // So that what pulls is more than rounding.
        (step.rates.opacity_pull, step.rates.needle_pull) = (30.0, 30.0);
        Step { looks: looks.to_vec(), ..step }
    };
    let run = |side: &mut dyn Side, looks: &[Look]| {
        let mut now = begin.clone();
        side.step(&mut now, one(looks)).unwrap();
        side.fetch(&mut now, Part::All).unwrap();
        now
    };
    let cpu = run(&mut super::super::cpu::CpuSide::new(0.2, Some(&context)), &looks);
    let gpu_side = || GpuSide::new(&gpu, &begin, 0.2, Some(&context)).unwrap();
    let there = run(&mut gpu_side(), &looks);
    assert!(words(&there) == words(&run(&mut gpu_side(), &looks)), "the same bits");

    let by_column = |found: &[Vec<f32>], expected: &[Vec<f32>]| {
        found.iter().zip(expected).map(|(a, b)| off(a, b)).fold(0.0, f32::max)
    };
    let moments_off = |a: &State, b: &State| {
        let ((steps, first, second), (others, other_first, other_second)) = (a.adam.parts(), b.adam.parts());
        assert_eq!((steps, others), (1, 1));
        by_column(first, other_first).max(by_column(second, other_second))
    };
    let loss_off = (there.loss - cpu.loss).abs() / cpu.loss;
    let (tally, of_cpu) = (there.need.tally, cpu.need.tally);
    let l1_off = (tally.sum - of_cpu.sum).abs() / of_cpu.sum;
    let evidence_off =
        off(&there.evidence.error, &cpu.evidence.error).max(off(&there.evidence.weight, &cpu.evidence.weight));
    let off_by = moments_off(&there, &cpu);
    println!("loss {loss_off:.1e}, L1 {l1_off:.1e}, moments {off_by:.1e}, evidence {evidence_off:.1e}");
    assert_eq!((tally.count, of_cpu.count), (4, 4));
    assert_eq!(there.evidence.views, cpu.evidence.views);
    assert!((0..=4).filter(|n| cpu.evidence.views.contains(n)).count() >= 4, "{:?}", cpu.evidence.views);
    assert!(loss_off < 1e-5 && l1_off < 1e-5 && evidence_off < 1e-4 && off_by < 1e-4);
    // Every look counts, for the splats as for the books.
    for n in 0..looks.len() {
        let mut fewer = looks.clone();
        fewer.remove(n);
        let without = run(&mut gpu_side(), &fewer);
        assert!(moments_off(&without, &there) > 1e-2 && without.loss != there.loss, "look {n} is lost");
    }
    // One that is no number spoils the step for all.
    let mut gpu_without = GpuSide::new(&gpu, &begin, f32::NAN, Some(&context)).unwrap();
    let mut cpu_without = super::super::cpu::CpuSide::new(f32::NAN, Some(&context));
    for side in [&mut gpu_without as &mut dyn Side, &mut cpu_without] {
        let left_out = run(side, &looks);
        assert_eq!((left_out.skipped, left_out.need.tally.count, left_out.adam.parts().0), (1, 0, 0));
        assert!(left_out.splats == begin.splats && left_out.evidence.views.iter().all(|&views| views == 0));
    }
}

#[test]
fn room_for_pairs_shows_in_no_byte() {
    let Some(gpu) = gpu() else { return };
    // Every splat covers the whole window of twenty tiles: more pairs than there is room for at first.
    let mut splats = cloud(5, 20_000, 0);
    splats.columns_mut()[column::OPACITY].fill(-5.0);
    (0..3).for_each(|axis| splats.columns_mut()[column::LOG_SCALE + axis].fill(0.5));
    let begin = state(splats);
    let mut side = GpuSide::new(&gpu, &begin, 0.2, None).unwrap();
    let mut run = |expect_overflow: bool| {
        let mut now = begin.clone();
        side.give(&now, Part::All).unwrap();
        for key in 0..3 {
            let mut step = step(false, false, key);
            step.rates.log_scale_bounds = [-5.0, 1.0];
            side.step(&mut now, step).unwrap();
        }
        let status: shaders::Status = gpu.read(side.renderer.status_buffer(), 0, 1).unwrap()[0];
        assert_eq!(status.overflow != 0, expect_overflow, "{status:?}");
        side.fetch(&mut now, Part::All).unwrap();
        let (steps, ..) = now.adam.parts();
        assert_eq!((steps, now.need.tally.count, now.skipped), (3, 3, 0));
        words(&now)
    };
    assert!(run(true) == run(false), "what was done again is not what is done at once");
}
