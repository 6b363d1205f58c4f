//! Compares each stage of a GPU step with the CPU, on the inputs that the previous stage left on the device.

use glam::{DQuat, DVec3, Vec3};
use render::{Options, Upstream};
use scene::sensors::{Motion, Taken};
use scene::{Camera, Exposure, Pinhole, Pixels, Rect, Rigid, Splat};

use super::*;
use crate::coarse_to_fine::CoarseToFine;
use crate::depth_loss::depth_loss;
use crate::exposure::ExposureTraining;
use crate::loss::PhotometricLoss;
use crate::picture_loss::tests::Cubes;
use crate::pose::sensors::SensorTraining;
use crate::pose::{PoseRates, PoseTraining, Rates};
use crate::random::{bits, uniform};
use crate::view::TrainView;

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

/// A photo of noise, masked on the right if `masked`.
fn sample(masked: bool, key: u64, [width, height]: [u32; 2], translation: DVec3) -> ViewSample {
    let area = (width * height) as usize;
    let rgb = (0..3 * area).map(|i| bits(key, i as u64) as u8).collect();
    let mask = masked.then(|| (0..area).map(|i| if i % width as usize > 50 { 0 } else { 255 }).collect());
    let pinhole = Pinhole { width, height, fx: 70.0, fy: 72.0, cx: 37.0, cy: 27.0 };
    let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation };
    let photo = Arc::new(Pixels { width, height, rgb, mask, ..Pixels::default() });
    let camera = Camera { pinhole, camera_from_world };
    ViewSample { view: 0, mip: 0, rect: camera.full(), photo, camera, camera_from_context: None, exposure: None }
}

/// A step with one sample whose size is no multiple of a tile.
fn step(masked: bool, extras: bool, key: u64) -> Step {
    Step {
        samples: vec![sample(masked, key, [75, 53], DVec3::ZERO)],
        options: Options { extras, sh_degree: 3, ..Options::default() },
        rates: Some(optimiser::LearningRates {
            mean: 0.03,
            log_scale: 0.01,
            quat: 0.002,
            opacity: 0.05,
            sh_dc: 0.01,
            sh_rest: 0.0005,
            beta2: 0.999,
            opacity_reg: 0.02,
            needle_reg: 0.01,
            log_scale_bounds: [-5.0, -1.0],
        }),
        depth_weight: 0.0,
        silhouette_weight: 0.0,
        picture_weight: 0.0,
        swing: None,
        exposure_rate: 0.0,
        pose_rates: None,
    }
}

/// The photo of a sample with noise as pixel weights and target depths: a third of each is 0.
fn with_weights_and_depth(mut sample: ViewSample, key: u64) -> ViewSample {
    let plane = |key: u64, of: &dyn Fn(f32) -> f32| {
        let value = |i: u64| if i.is_multiple_of(3) { 0.0 } else { of(uniform(key, i)) };
        Some((0..sample.photo.area() as u64).map(value).collect())
    };
    let (weights, depth) = (plane(key + 20, &|u| 0.2 + 2.0 * u), plane(key + 30, &|u| 2.5 + 3.0 * u));
    sample.photo = Arc::new(Pixels { weights, depth, ..Pixels::clone(&sample.photo) });
    sample
}

/// Poses of no view.
fn none() -> Arc<GivenPoses> {
    Arc::new(GivenPoses::of(&[], &Splats::new(0), true, None, None))
}

fn new_state(splats: Splats) -> State {
    State {
        step: 0,
        skipped: 0,
        start_count: splats.len(),
        coarse_to_fine: CoarseToFine::default(),
        adam: Adam::new(Isa::detect(), &splats),
        densification: DensificationStats::default(),
        exposures: None,
        poses: None,
        swing: None,
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
    columns.chain([&state.densification.error]).flatten().map(|value| value.to_bits()).collect()
}

#[test]
fn stages_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let cases = [(0, false, false, 0.0), (1, true, false, 0.0), (2, false, true, 0.0), (3, true, true, 0.0)];
    // With pixel weights and target depths.
    let deep = [(0, true, false, 0.5), (2, false, true, 3.0)];
    for (sh_degree, masked, extras, depth_weight) in cases.into_iter().chain(deep) {
        let context = extras.then(|| cloud(7, 60, 3));
        let mut state = new_state(cloud(3, 300, sh_degree));
        let mut device = GpuDevice::new(&gpu, &state, 0.2, None, context.as_ref(), &none()).unwrap();
        // The second step starts with nonzero moments.
        for key in [1, 2] {
            let mut step = step(masked, extras, key);
            if depth_weight > 0.0 {
                step.samples = step.samples.into_iter().map(|sample| with_weights_and_depth(sample, key)).collect();
                (step.options.extras, step.options.inverse_depth) = (true, true);
                step.depth_weight = depth_weight;
            }
            let photo = &step.samples[0].photo;
            device.download(&mut state, StatePart::All).unwrap();
            let mut expected = state.clone();
            device.step(&mut state, step.clone()).unwrap();
            device.download(&mut state, StatePart::All).unwrap();

            let frame = device.renderer.read_frame(0).unwrap();
            let mut weights = Vec::new();
            super::super::cpu::pixel_weights(&frame, photo, extras, &mut weights);
            let mut planes = Upstream::default();
            let mut value =
                PhotometricLoss::new(Isa::detect(), 0.2).evaluate(&frame.colour, photo, &weights, &mut planes.colour);
            let mut depth_off = 0.0;
            if depth_weight > 0.0 {
                let target = photo.depth.as_ref().unwrap();
                let depth = depth_loss(&frame, target, &weights, depth_weight, &mut planes);
                assert!(depth > 0.05 * value.total && planes.depth.iter().filter(|d| **d != 0.0).count() > 100);
                value.total += depth;
                let (area, buffer) = (photo.area(), device.renderer.upstream());
                depth_off = off(&gpu.read(buffer, 3 * area, area).unwrap(), &planes.transmittance)
                    .max(off(&gpu.read(buffer, 4 * area, area).unwrap(), &planes.depth));
            }
            let upstream = planes.colour;
            let found: Vec<f32> = gpu.read(device.renderer.upstream(), 0, upstream.len()).unwrap();
            let loss_off = (state.loss - value.total).abs() / value.total;
            let l1_off =
                (state.coarse_to_fine.tally.sum - expected.coarse_to_fine.tally.sum - value.l1).abs() / value.l1;
            let upstream_off = off(&found, &upstream).max(depth_off);

            let gradients = device.renderer.read_gradients(&device.splats).unwrap();
            expected.adam.step(&mut expected.splats, &gradients, 3, step.rates.as_ref().unwrap());
            expected.densification.add(&gradients, photo.area() as f32);
            let by_column = |found: &[Vec<f32>], expected: &[Vec<f32>]| {
                found.iter().zip(expected).map(|(a, b)| off(a, b)).fold(0.0, f32::max)
            };
            let splats_off = by_column(state.splats.columns(), expected.splats.columns());
            let ((steps, first, second), (cpu_steps, cpu_first, cpu_second)) =
                (state.adam.parts(), expected.adam.parts());
            let moments_off = by_column(first, cpu_first).max(by_column(second, cpu_second));
            let stats_off = off(&state.densification.error, &expected.densification.error);
            println!(
                "SH {sh_degree}, masked {masked}, context {extras}, depth {depth_weight}, step {key}: loss {loss_off:.1e}, L1 {l1_off:.1e}, \
                 upstream {upstream_off:.1e}, splats {splats_off:.1e}, moments {moments_off:.1e}, statistics {stats_off:.1e}"
            );
            assert_eq!(steps, cpu_steps);
            assert!(
                state.densification.error.iter().any(|&error| error > 0.0)
                    && state.splats != new_state(cloud(3, 300, sh_degree)).splats
            );
            assert!(loss_off < 1e-6 && l1_off < 1e-6 && upstream_off < 1e-5, "the loss");
            assert!(splats_off < 2e-6 && moments_off < 2e-6 && stats_off < 1e-6, "Adam or the statistics");
        }
    }
}

/// Samples of several sizes, one of them masked, in front of a context. The CPU renders them one after the other.
#[test]
fn steps_of_several_samples_agree_with_the_cpu() {
    several_samples_agree_with_the_cpu(0.0, 0.0);
}

/// The same, with pixel weights and target depths in two of the samples.
#[test]
fn steps_of_several_samples_with_weights_and_depth_agree_with_the_cpu() {
    several_samples_agree_with_the_cpu(1.0, 0.0);
}

/// The same, with a loss of whole pictures that the host computes; one sample has an exposure.
#[test]
fn steps_of_several_samples_with_a_picture_loss_agree_with_the_cpu() {
    several_samples_agree_with_the_cpu(1.0, 0.02);
}

fn several_samples_agree_with_the_cpu(depth_weight: f32, picture_weight: f32) {
    let Some(gpu) = gpu() else { return };
    let context = cloud(7, 60, 3);
    let begin = new_state(cloud(3, 300, 2));
    let mut samples: Vec<ViewSample> = [[75, 53], [16, 16], [33, 90], [64, 48]]
        .into_iter()
        .zip(1..)
        .map(|(size, key)| (key, sample(key == 3, key, size, DVec3::new(0.3 * key as f64, 0.0, 0.5))))
        .map(|(key, sample)| match depth_weight > 0.0 && key % 2 == 1 {
            true => with_weights_and_depth(sample, key),
            false => sample,
        })
        .collect();
    let picture_loss = (picture_weight > 0.0).then_some(&Cubes as &dyn PictureLoss);
    if picture_loss.is_some() {
        samples[1].exposure = Some(Exposure([[1.1, 0.1, 0.0, 0.05], [0.0, 0.9, 0.1, 0.0], [0.2, 0.0, 0.8, -0.05]]));
    }
    let one = |samples: &[ViewSample]| {
        let mut step = step(false, true, 1);
        // Regularisers large enough to exceed rounding errors.
        let rates = step.rates.as_mut().unwrap();
        (rates.opacity_reg, rates.needle_reg) = (30.0, 30.0);
        (step.depth_weight, step.picture_weight) = (depth_weight, picture_weight);
        Step { samples: samples.to_vec(), ..step }
    };
    let run = |device: &mut dyn TrainDevice, samples: &[ViewSample]| {
        let mut state = begin.clone();
        device.step(&mut state, one(samples)).unwrap();
        device.download(&mut state, StatePart::All).unwrap();
        state
    };
    let cpu = run(&mut super::super::cpu::CpuDevice::new(0.2, picture_loss, Some(&context), &none()), &samples);
    let gpu_device = || GpuDevice::new(&gpu, &begin, 0.2, picture_loss, Some(&context), &none()).unwrap();
    let on_gpu = run(&mut gpu_device(), &samples);
    assert!(words(&on_gpu) == words(&run(&mut gpu_device(), &samples)), "the same bits");

    let by_column = |found: &[Vec<f32>], expected: &[Vec<f32>]| {
        found.iter().zip(expected).map(|(a, b)| off(a, b)).fold(0.0, f32::max)
    };
    let moments_off = |a: &State, b: &State| {
        let ((steps, first, second), (others, other_first, other_second)) = (a.adam.parts(), b.adam.parts());
        assert_eq!((steps, others), (1, 1));
        by_column(first, other_first).max(by_column(second, other_second))
    };
    let loss_off = (on_gpu.loss - cpu.loss).abs() / cpu.loss;
    let (tally, cpu_tally) = (on_gpu.coarse_to_fine.tally, cpu.coarse_to_fine.tally);
    let l1_off = (tally.sum - cpu_tally.sum).abs() / cpu_tally.sum;
    let stats_off = off(&on_gpu.densification.error, &cpu.densification.error);
    let off_by = moments_off(&on_gpu, &cpu);
    println!("loss {loss_off:.1e}, L1 {l1_off:.1e}, moments {off_by:.1e}, statistics {stats_off:.1e}");
    assert_eq!((tally.count, cpu_tally.count), (4, 4));
    let seen = |state: &State| -> Vec<bool> { state.densification.error.iter().map(|&error| error > 0.0).collect() };
    assert_eq!(seen(&on_gpu), seen(&cpu));
    assert!(seen(&cpu).contains(&true));
    assert!(loss_off < 1e-5 && l1_off < 1e-5 && stats_off < 1e-4 && off_by < 1e-4);
    // Every sample contributes to the splats and to the loss.
    for n in 0..samples.len() {
        let mut fewer = samples.clone();
        fewer.remove(n);
        let without = run(&mut gpu_device(), &fewer);
        assert!(moments_off(&without, &on_gpu) > 1e-2 && without.loss != on_gpu.loss, "sample {n} has no effect");
    }
    // A loss that is not finite skips the whole step.
    let mut gpu_nan = GpuDevice::new(&gpu, &begin, f32::NAN, None, Some(&context), &none()).unwrap();
    let mut cpu_nan = super::super::cpu::CpuDevice::new(f32::NAN, None, Some(&context), &none());
    for device in [&mut gpu_nan as &mut dyn TrainDevice, &mut cpu_nan] {
        let skipped = run(device, &samples);
        assert_eq!((skipped.skipped, skipped.coarse_to_fine.tally.count, skipped.adam.parts().0), (1, 0, 0));
        assert!(skipped.splats == begin.splats && skipped.densification.error.iter().all(|&error| error == 0.0));
    }
}

/// An exposure with every number off the identity's by up to 0.1.
fn exposure(key: u64) -> Exposure {
    let mut exposure = Exposure::IDENTITY;
    exposure.0.iter_mut().flatten().zip(0..).for_each(|(value, k)| *value += 0.2 * (uniform(key, k) - 0.5));
    exposure
}

/// Samples of several sizes of views 2, 3, 5 and 9, one of them masked.
fn samples_of_views() -> Vec<ViewSample> {
    let sizes = [(2, [75, 53]), (9, [16, 16]), (3, [33, 90]), (5, [64, 48])];
    let of = |(view, size)| ViewSample {
        view,
        ..sample(view == 3, u64::from(view), size, DVec3::new(0.2 * f64::from(view), 0.0, 0.5))
    };
    sizes.into_iter().map(of).collect()
}

/// Fixed exposures of three of four views: after a step, moments of splats differ from the CPU's by rounding only.
#[test]
fn fixed_exposures_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let begin = new_state(cloud(3, 300, 2));
    let bare = samples_of_views();
    let mut exposed = bare.clone();
    exposed.iter_mut().filter(|sample| sample.view != 9).for_each(|sample| {
        sample.exposure = Some(exposure(sample.view.into()));
    });
    let run = |device: &mut dyn TrainDevice, samples: &[ViewSample]| {
        let mut state = begin.clone();
        device.step(&mut state, Step { samples: samples.to_vec(), ..step(false, false, 1) }).unwrap();
        device.download(&mut state, StatePart::All).unwrap();
        state
    };
    let cpu = run(&mut super::super::cpu::CpuDevice::new(0.2, None, None, &none()), &exposed);
    let mut device = GpuDevice::new(&gpu, &begin, 0.2, None, None, &none()).unwrap();
    let on_gpu = run(&mut device, &exposed);
    assert_eq!(on_gpu.exposures, None);
    let moments_off = |a: &State, b: &State| {
        let (a, b) = (a.adam.parts(), b.adam.parts());
        a.1.iter().zip(b.1).map(|(a, b)| off(a, b)).fold(0.0, f32::max)
    };
    let (loss_off, moments) = ((on_gpu.loss - cpu.loss).abs() / cpu.loss, moments_off(&on_gpu, &cpu));
    println!("loss {loss_off:.1e}, moments {moments:.1e}");
    // As without exposures.
    assert!(loss_off < 1e-5 && moments < 1e-4);
    device.upload(&begin, StatePart::All).unwrap();
    let without = run(&mut device, &bare);
    assert!(moments_off(&without, &on_gpu) > 1e-2, "exposures have no effect");
}

/// After each of three steps the exposures in training, and their Adam state, are the CPU's but for rounding.
#[test]
fn trained_exposures_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut cpu = new_state(cloud(3, 300, 2));
    let views = [2, 3, 4, 5, 9];
    let rows = |key: u64, size: f32| views.map(|view| [(); 12].map(|()| size * uniform(key, view))).to_vec();
    let values = views.map(|view| exposure(view).0.concat().try_into().unwrap()).to_vec();
    let steps = vec![7, 0, 1, 3, 2];
    let views = views.map(|view| view as u32).to_vec();
    cpu.exposures = Some(ExposureTraining { views, steps, values: [values, rows(51, 1e-3), rows(52, 1e-6)] });
    let mut on_gpu = cpu.clone();
    let mut cpu_device = super::super::cpu::CpuDevice::new(0.2, None, None, &none());
    let mut device = GpuDevice::new(&gpu, &cpu, 0.2, None, None, &none()).unwrap();
    for n in 0..3 {
        // Later steps have fewer samples, so that buffers are larger than the step needs.
        let samples: Vec<ViewSample> = samples_of_views().into_iter().skip(n).collect();
        let step = Step { samples, exposure_rate: 0.01, ..step(false, false, 1) };
        cpu_device.step(&mut cpu, step.clone()).unwrap();
        device.step(&mut on_gpu, step).unwrap();
        device.download(&mut on_gpu, StatePart::Splats).unwrap();
        let (found, expected) = (on_gpu.exposures.as_ref().unwrap(), cpu.exposures.as_ref().unwrap());
        assert_eq!((&found.views, &found.steps), (&expected.views, &expected.steps));
        let parts = found.values.iter().zip(&expected.values);
        let by_part: Vec<f32> = parts.map(|(a, b)| off(a.as_flattened(), b.as_flattened())).collect();
        println!("step {n}: exposures {:.1e}, moments {:.1e}, {:.1e}", by_part[0], by_part[1], by_part[2]);
        // Moments differ as those of splats do; Adam turns that into less than a hundredth of its rate.
        assert!(by_part[0] < 1e-5 && by_part[1] < 1e-4 && by_part[2] < 1e-4);
    }
    let before = on_gpu.exposures.clone();
    // A loss that is not finite changes no exposure.
    let mut device = GpuDevice::new(&gpu, &on_gpu, f32::NAN, None, None, &none()).unwrap();
    device
        .step(&mut on_gpu, Step { exposure_rate: 0.01, samples: samples_of_views(), ..step(false, false, 1) })
        .unwrap();
    device.download(&mut on_gpu, StatePart::All).unwrap();
    assert_eq!((on_gpu.skipped, on_gpu.exposures), (1, before));
}

/// After each of three steps the poses and the sensors in training, and their Adam state, are the CPU's but for rounding. The
/// first step has displaced cameras already. View 3 has a sensor of too few photos.
#[test]
fn trained_poses_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut cpu = new_state(cloud(3, 300, 2));
    let rect = Rect { x: 0, y: 0, width: 75, height: 53 };
    let mut views: Vec<TrainView> = samples_of_views()
        .iter()
        .map(|sample| TrainView { view: sample.view, mip: 0, rect, camera: sample.camera, camera_from_context: None })
        .collect();
    let mut aside = views[0];
    aside.view = 4;
    aside.camera.camera_from_world.rotation = DQuat::from_rotation_y(0.7);
    views.push(aside);
    let motion = |view: u64| Motion {
        velocity: DVec3::new(f64::from(uniform(54, view)), 0.3, 2.0),
        spin: DVec3::new(0.0, f64::from(uniform(55, view)), 0.1),
    };
    let taken: Vec<Taken> =
        (0..10).map(|view| Taken { sensor: u32::from(view == 3), motion: (view != 2).then(|| motion(view)) }).collect();
    let given = Arc::new(GivenPoses::of(&views, &cpu.splats, true, Some(&taken), None));
    let rows = |key: u64, size: f32| -> Vec<[f32; 6]> {
        let number = |view: &u32, k: u64| size * (uniform(key, 6 * u64::from(*view) + k) - 0.5);
        given.views.iter().map(|view| [0, 1, 2, 3, 4, 5].map(|k| number(view, k))).collect()
    };
    let second = rows(53, 1e-4).into_iter().map(|row| row.map(f32::abs)).collect();
    let values = [rows(51, 0.04), rows(52, 1e-2), second];
    let sensors = SensorTraining {
        steps: vec![4],
        values: [
            vec![[0.01, -0.02, 0.0, 0.004, 0.0, -0.003, 0.02, 0.01]],
            vec![[1e-3, 0.0, 2e-3, 0.0, 0.0, 1e-3, 0.0, -1e-3]],
            vec![[1e-5; 8]],
        ],
    };
    let (views, steps) = (given.views.clone(), vec![7, 0, 1, 3, 2]);
    cpu.poses = Some(PoseTraining { views, steps, values, sensors: Some(sensors), path: None });
    let mut on_gpu = cpu.clone();
    let mut cpu_device = super::super::cpu::CpuDevice::new(0.2, None, None, &given);
    let mut device = GpuDevice::new(&gpu, &cpu, 0.2, None, None, &given).unwrap();
    let rates = Some(Rates { rate: 2e-3, decay: 0.01 });
    let pose_rates = Some(PoseRates { views: rates, sensors: rates, path: None });
    for n in 0..3 {
        let samples: Vec<ViewSample> = samples_of_views().into_iter().skip(n).collect();
        let step = Step { samples, pose_rates, ..step(false, false, 1) };
        let before = cpu.poses.clone().unwrap();
        cpu_device.step(&mut cpu, step.clone()).unwrap();
        device.step(&mut on_gpu, step).unwrap();
        device.download(&mut on_gpu, StatePart::Splats).unwrap();
        let (found, expected) = (on_gpu.poses.as_ref().unwrap(), cpu.poses.as_ref().unwrap());
        assert_eq!((&found.views, &found.steps), (&expected.views, &expected.steps));
        let parts = found.values.iter().zip(&expected.values);
        let by_part: Vec<f32> = parts.map(|(a, b)| off(a.as_flattened(), b.as_flattened())).collect();
        let [by_sensor, of_sensor] = [found, expected].map(|poses| poses.sensors.as_ref().unwrap());
        assert_eq!(by_sensor.steps, of_sensor.steps);
        let parts = by_sensor.values.iter().zip(&of_sensor.values);
        let of_sensors: Vec<f32> = parts.map(|(a, b)| off(a.as_flattened(), b.as_flattened())).collect();
        println!(
            "step {n}: numbers of sensors {:.1e}, moments {:.1e}, {:.1e}",
            of_sensors[0], of_sensors[1], of_sensors[2]
        );
        assert!(of_sensors[0] < 1e-4 && of_sensors[1] < 1e-4 && of_sensors[2] < 1e-4);
        let moved = off(before.values[0].as_flattened(), expected.values[0].as_flattened());
        let loss_off = (on_gpu.loss - cpu.loss).abs() / cpu.loss;
        println!(
            "step {n}: loss {loss_off:.1e}, displacements {:.1e} of {moved:.1e}, moments {:.1e}, {:.1e}",
            by_part[0], by_part[1], by_part[2]
        );
        // Sums over all splats, in another order and at a camera that is displaced in single precision.
        assert!(loss_off < 1e-5 && by_part[0] < 1e-4 * moved && by_part[1] < 1e-4 && by_part[2] < 1e-4);
    }
    let before = on_gpu.poses.clone();
    // A loss that is not finite moves no camera.
    let mut device = GpuDevice::new(&gpu, &on_gpu, f32::NAN, None, None, &given).unwrap();
    device.step(&mut on_gpu, Step { pose_rates, samples: samples_of_views(), ..step(false, false, 1) }).unwrap();
    device.download(&mut on_gpu, StatePart::All).unwrap();
    assert_eq!((on_gpu.skipped, on_gpu.poses), (1, before));
}

#[test]
fn pair_buffer_size_changes_no_byte() {
    let Some(gpu) = gpu() else { return };
    // Every splat covers the whole window of twenty tiles: more pairs than the initial buffer holds.
    let mut splats = cloud(5, 20_000, 0);
    splats.columns_mut()[column::OPACITY].fill(-5.0);
    (0..3).for_each(|axis| splats.columns_mut()[column::LOG_SCALE + axis].fill(0.5));
    let mut begin = new_state(splats);
    let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]].concat().try_into().unwrap();
    let values = [vec![rows; 2], vec![[0.0; 12]; 2], vec![[0.0; 12]; 2]];
    begin.exposures = Some(ExposureTraining { views: vec![0, 1], steps: vec![0; 2], values });
    let mut device = GpuDevice::new(&gpu, &begin, 0.2, None, None, &none()).unwrap();
    let mut run = |expect_overflow: bool| {
        let mut state = begin.clone();
        device.upload(&state, StatePart::All).unwrap();
        for key in 0..3 {
            let mut step = Step { exposure_rate: 0.01, ..step(false, false, key) };
            step.rates.as_mut().unwrap().log_scale_bounds = [-5.0, 1.0];
            device.step(&mut state, step).unwrap();
        }
        let status: shaders::Status = gpu.read(device.renderer.status_buffer(), 0, 1).unwrap()[0];
        assert_eq!(status.overflow != 0, expect_overflow, "{status:?}");
        device.download(&mut state, StatePart::All).unwrap();
        let (steps, ..) = state.adam.parts();
        assert_eq!((steps, state.coarse_to_fine.tally.count, state.skipped), (3, 3, 0));
        assert_eq!(state.exposures.as_ref().unwrap().steps, [3, 0]);
        (words(&state), state.exposures)
    };
    assert!(run(true) == run(false), "resubmitted steps give other bytes");
}

#[test]
fn rows_are_rearranged_as_on_the_host() {
    let Some(gpu) = gpu() else { return };
    // 300 splats have room for 320: fewer, a few more, and more than there is room for.
    for (sh_degree, count) in [(0, 250), (3, 250), (3, 315), (3, 700)] {
        let begin = new_state(cloud(3, 300, sh_degree));
        let mut device = GpuDevice::new(&gpu, &begin, 0.2, None, None, &none()).unwrap();
        let run = |device: &mut GpuDevice, state: &mut State, key: u64| {
            (key..key + 3).for_each(|key| device.step(state, step(false, false, key)).unwrap());
            device.download(state, StatePart::All).unwrap();
        };
        let mut expected = begin.clone();
        run(&mut device, &mut expected, 0);
        // What the trainer has: the moments of the beginning, and all else that refinement needs.
        let mut state = begin.clone();
        device.download(&mut state, StatePart::Densification).unwrap();
        assert_eq!(state.densification.error, expected.densification.error);
        assert_ne!(words(&state), words(&expected), "the moments stayed on the device");

        let rows: Vec<u32> = (0..count).map(|i| (bits(11, i) % 300) as u32).collect();
        let old: Vec<Option<u32>> = rows.iter().map(|&row| (row % 5 > 0).then_some(row)).collect();
        for state in [&mut expected, &mut state] {
            state.splats = state.splats.select(&rows);
            state.densification.error.clear();
        }
        expected.adam.rearrange(&old);
        let mut fresh = GpuDevice::new(&gpu, &expected, 0.2, None, None, &none()).unwrap();
        device.rearrange(&mut state, &old).unwrap();
        device.download(&mut state, StatePart::All).unwrap();
        expected.densification.error.resize(rows.len(), 0.0);
        assert!(words(&state) == words(&expected), "degree {sh_degree}, {count} rows");
        // And so do the steps after it.
        run(&mut device, &mut state, 9);
        run(&mut fresh, &mut expected, 9);
        assert!(words(&state) == words(&expected), "degree {sh_degree}, {count} rows, three steps on");
        assert_eq!(state.coarse_to_fine.tally.count, 6);
    }
}
