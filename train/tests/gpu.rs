//! Compares training on a GPU with the CPU, and checks that its bytes are reproducible.

#![cfg(feature = "gpu")]

mod common;

use common::*;
use render::gpu::{Gpu, GpuError, GpuOptions, Path};
use scene::Splats;
use train::{Backend, Flow, Recipe, State, TrainError};

/// The GPU, or `None` after printing why the test is skipped. PLAT_GPU=required makes a missing GPU a failure.
fn gpu() -> Option<Backend> {
    match Gpu::open() {
        Ok(gpu) => Some(Backend::Gpu(gpu)),
        Err(error) if std::env::var("PLAT_GPU").is_ok_and(|value| value == "required") => panic!("{error}"),
        Err(error) => {
            println!("skipped: no adapter ({error})");
            None
        }
    }
}

/// A job with densification and a context.
fn job<'a>(photos: &'a Photos, context: &'a Splats, ground_truth: &Splats, backend: &Backend) -> Setup<'a> {
    let (context, backend) = (Some(context), backend.clone());
    Setup { context, backend, budget: 300, steps: 90, ..Setup::new(perturbed(ground_truth), photos) }
}

fn bits(splats: &Splats) -> Vec<u32> {
    splats.columns().iter().flatten().map(|value| value.to_bits()).collect()
}

#[test]
fn gpu_matches_the_cpu_in_psnr() {
    let Some(gpu) = gpu() else { return };
    let ground_truth = cloud(1, 200, 0.8);
    let photos = photos(&ground_truth);
    let initial = perturbed(&ground_truth);
    let before = psnr(&initial, &photos, |_| true);
    for views_per_step in [1, 4] {
        let run = |backend: &Backend| {
            let setup = Setup::new(initial.clone(), &photos);
            let recipe = Recipe { views_per_step, ..Recipe::default() };
            Setup { backend: backend.clone(), budget: 300, steps: 100, recipe, ..setup }.run()
        };
        let [cpu, gpu] = [run(&Backend::Cpu), run(&gpu)];
        let [cpu_db, gpu_db] = [&cpu, &gpu].map(|splats| psnr(splats, &photos, |_| true));
        println!(
            "{views_per_step} a step: {before:.2} dB before; CPU {cpu_db:.3} dB, {} splats; GPU {gpu_db:.3} dB, {} splats",
            cpu.len(),
            gpu.len()
        );
        assert!(cpu_db > before + 3.0, "the CPU must improve the PSNR");
        assert!((cpu_db - gpu_db).abs() < 0.1, "{cpu_db} dB on the CPU, {gpu_db} on the GPU");
        assert!(gpu.len().abs_diff(cpu.len()) <= 3 && all_finite(&gpu));
    }
}

#[test]
fn half_precision_matches_single_in_psnr() {
    let Some(full) = gpu() else { return };
    let options = GpuOptions { path: Path::Half, ..GpuOptions::from_env().expect("a sound environment") };
    let half = match Gpu::open_with(&options) {
        Ok(half) => Backend::Gpu(half),
        Err(error @ GpuError::NoHalf(_)) => return println!("skipped: {error}"),
        Err(error) => panic!("{error}"),
    };
    let ground_truth = cloud(1, 200, 0.8);
    let photos = photos(&ground_truth);
    let run = |backend: &Backend| {
        let setup = Setup::new(perturbed(&ground_truth), &photos);
        Setup { backend: backend.clone(), budget: 300, steps: 100, ..setup }.run()
    };
    let [full, half] = [run(&full), run(&half)];
    let [full_db, half_db] = [&full, &half].map(|splats| psnr(splats, &photos, |_| true));
    println!("{full_db:.3} dB in single precision, {half_db:.3} in half");
    assert!(bits(&full) != bits(&half), "half precision must change the bits");
    assert!((full_db - half_db).abs() < 0.1, "{full_db} and {half_db} dB");
}

#[test]
fn reports_and_resumption_change_no_byte() {
    let Some(gpu) = gpu() else { return };
    // With five views per step, an epoch of twelve views has steps of five, five and two.
    [1, 5].into_iter().for_each(|views_per_step| check_same_bytes(&gpu, views_per_step));
}

fn check_same_bytes(gpu: &Backend, views_per_step: u32) {
    let ground_truth = cloud(2, 150, 0.8);
    let photos = photos(&ground_truth);
    let context = cloud(3, 40, 0.5);
    let run = |from: Option<State>, report: &mut dyn FnMut(train::Progress) -> Flow| {
        let recipe = Recipe { views_per_step, ..Recipe::default() };
        let job = Setup { recipe, ..job(&photos, &context, &ground_truth, gpu) };
        job.try_run_on(from, &|_| true, report).expect("training succeeds").splats
    };
    let uninterrupted = bits(&run(None, &mut |_| Flow::Continue));
    let mut left = None;
    let asked = run(None, &mut |mut now| {
        assert!(now.views == views_per_step || now.step % 12 == 0 || now.step == 90, "steps do not cross epochs");
        if now.step % 5 == 0 {
            assert!(now.loss().is_some_and(f64::is_finite) && now.skipped() == Some(0));
        }
        if now.step % 7 == 0 {
            assert_eq!(now.splats().map(Splats::len), Some(now.count()));
        }
        // In the middle of an epoch, after some densification.
        if left.is_none() && now.step >= 46 {
            left = now.state().map(State::to_frame);
        }
        Flow::Continue
    });
    assert!(asked.len() > 150, "densification must add splats");
    assert!(uninterrupted == bits(&asked), "reports change the result");
    let from = State::from_frame(&left.expect("a step was reported")).expect("a checkpoint is readable");
    assert!(uninterrupted == bits(&run(Some(from), &mut |_| Flow::Continue)), "a resumed run gives another result");
}

/// Opens a separate device, which a test may exhaust or destroy.
fn open_separate(memory_bytes: Option<u64>) -> std::sync::Arc<Gpu> {
    let options = GpuOptions { memory_bytes, ..GpuOptions::from_env().expect("a sound environment") };
    Gpu::open_with(&options).expect("it opened before")
}

#[test]
fn exceeding_the_memory_cap_is_reported() {
    if gpu().is_none() {
        return;
    }
    let ground_truth = cloud(6, 150, 0.8);
    let photos = photos(&ground_truth);
    let context = cloud(3, 40, 0.5);
    let run = |gpu: &std::sync::Arc<Gpu>| {
        let setup = Setup { steps: 30, ..job(&photos, &context, &ground_truth, &Backend::Gpu(gpu.clone())) };
        setup.try_run(&|_| true, &mut |_| Flow::Continue)
    };
    let uncapped = open_separate(None);
    let free = bits(&run(&uncapped).expect("there is memory"));
    let [left, peak] = uncapped.memory_bytes();
    println!("{peak} bytes at most");
    assert_eq!(left, 0, "all memory is freed");
    // A sufficient cap does not change the result.
    assert!(free == bits(&run(&open_separate(Some(peak))).expect("there is as much as it took")));
    for cap in [0, 1000, peak / 2] {
        let gpu = open_separate(Some(cap));
        match run(&gpu) {
            Err(TrainError::OutOfMemory(line)) => {
                assert!(line.contains(&format!("PLAT_GPU_MEMORY allows {cap}:")) && !line.contains('\n'), "{line}");
            }
            other => panic!("{cap} bytes: {:?}", other.map(|splats| splats.len())),
        }
        assert_eq!(gpu.memory_bytes()[0], 0);
    }
}

#[test]
fn device_loss_is_reported() {
    if gpu().is_none() {
        return;
    }
    let ground_truth = cloud(6, 150, 0.8);
    let photos = photos(&ground_truth);
    let context = cloud(3, 40, 0.5);
    // Between two synchronisations, and just before one.
    for lost_at in [1, 29] {
        let gpu = open_separate(None);
        let mut steps = 0;
        let out = job(&photos, &context, &ground_truth, &Backend::Gpu(gpu.clone())).try_run(&|_| true, &mut |now| {
            steps = now.step;
            if now.step == lost_at {
                gpu.device().destroy();
            }
            Flow::Continue
        });
        let line = match out {
            Err(TrainError::Device(line)) => line,
            other => panic!("lost at {lost_at}: {:?}", other.map(|splats| splats.len())),
        };
        println!("lost at {lost_at}, ended after {steps}: {line}");
        assert!(line.starts_with("the GPU was lost") && !line.contains('\n'), "{line}");
        // A report that downloads finds the loss at once.
        let gpu = open_separate(None);
        let out =
            job(&photos, &context, &ground_truth, &Backend::Gpu(gpu.clone())).try_run(&|_| true, &mut |mut now| {
                steps = now.step;
                if now.step == lost_at {
                    gpu.device().destroy();
                    assert_eq!(now.splats(), None, "a lost device has no splats");
                }
                Flow::Continue
            });
        assert!(steps == lost_at && matches!(out, Err(TrainError::Device(_))), "{steps}");
    }
}

#[test]
fn masked_pixels_do_not_affect_training() {
    let Some(gpu) = gpu() else { return };
    let ground_truth = cloud(4, 120, 0.8);
    let given = photos(&ground_truth);
    let hidden = |i: usize| i % AREA % WIDTH as usize >= 43;
    let masked = |content: u8| {
        let mut out = given.clone();
        for photo in &mut out.0 {
            photo.mask = Some((0..AREA).map(|i| if hidden(i) { 0 } else { 255 }).collect());
            photo.rgb.iter_mut().enumerate().filter(|(i, _)| hidden(*i)).for_each(|(_, byte)| *byte = content);
        }
        out
    };
    let run = |photos: &Photos| {
        let setup = Setup {
            backend: gpu.clone(),
            steps: 20,
            recipe: no_growth(),
            ..Setup::new(perturbed(&ground_truth), photos)
        };
        bits(&setup.run())
    };
    let bare = |mut photos: Photos| {
        photos.0.iter_mut().for_each(|photo| photo.mask = None);
        photos
    };
    assert!(run(&masked(0)) == run(&masked(200)), "masked pixels changed parameters");
    assert!(run(&bare(masked(0))) != run(&bare(masked(200))), "the pixels must matter without the mask");
}

#[test]
fn steps_with_a_non_finite_loss_are_skipped_and_counted() {
    let Some(gpu) = gpu() else { return };
    let ground_truth = cloud(5, 60, 0.8);
    let photos = photos(&ground_truth);
    let initial = perturbed(&ground_truth);
    // NaN for any render.
    let recipe = Recipe { lambda: f32::NAN, ..no_growth() };
    for backend in [Backend::Cpu, gpu] {
        let mut skipped = None;
        let setup = Setup { backend, steps: 12, recipe: recipe.clone(), ..Setup::new(initial.clone(), &photos) };
        let out = setup.try_run(&|_| true, &mut |mut now| {
            skipped = now.skipped();
            Flow::Continue
        });
        assert_eq!(skipped, Some(12));
        assert!(bits(&out.expect("steps may be skipped")) == bits(&initial), "a skipped step changed splats");
    }
}

#[test]
fn training_without_splats_is_refused() {
    let Some(gpu) = gpu() else { return };
    let photos = photos(&cloud(9, 60, 0.8));
    let empty = Setup { backend: gpu, ..Setup::new(Splats::new(1), &photos) };
    assert_eq!(empty.try_run(&|_| true, &mut |_| Flow::Continue), Err(TrainError::Empty(0)));
}
