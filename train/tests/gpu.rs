//! Training on a GPU: as good as on the CPU, and always the same bytes.

#![cfg(feature = "gpu")]

mod ring;

use render::gpu::{Gpu, GpuError, GpuOptions, Path};
use ring::*;
use scene::{Exposures, Splats};
use train::{Backend, Flow, Recipe, State, TrainError};

/// The GPU, or a line that says why the test is skipped. With PLAT_GPU=required there has to be one.
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

/// A job with growth, in front of a context.
fn job<'a>(photos: &'a Photos, context: &'a Splats, truth: &Splats, backend: &Backend) -> Setup<'a> {
    let (context, backend) = (Some(context), backend.clone());
    Setup { context, backend, budget: 300, steps: 90, ..Setup::new(perturbed(truth), photos) }
}

fn bits(splats: &Splats) -> Vec<u32> {
    splats.columns().iter().flatten().map(|value| value.to_bits()).collect()
}

#[test]
fn a_gpu_trains_as_well_as_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let truth = cloud(1, 200, 0.8);
    let photos = photos(&truth);
    let initial = perturbed(&truth);
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
        assert!(cpu_db > before + 3.0, "the CPU must have learned something");
        assert!((cpu_db - gpu_db).abs() < 0.1, "{cpu_db} dB on the CPU, {gpu_db} on the GPU");
        assert!(gpu.len().abs_diff(cpu.len()) <= 3 && all_finite(&gpu));
    }
}

#[test]
fn half_precision_trains_as_well() {
    let Some(full) = gpu() else { return };
    let options = GpuOptions { path: Path::Half, ..GpuOptions::from_env().expect("a sound environment") };
    let half = match Gpu::open_with(&options) {
        Ok(half) => Backend::Gpu(half),
        Err(error @ GpuError::NoHalf(_)) => return println!("skipped: {error}"),
        Err(error) => panic!("{error}"),
    };
    let truth = cloud(1, 200, 0.8);
    let photos = photos(&truth);
    let run = |backend: &Backend| {
        let setup = Setup::new(perturbed(&truth), &photos);
        Setup { backend: backend.clone(), budget: 300, steps: 100, ..setup }.run()
    };
    let [full, half] = [run(&full), run(&half)];
    let [full_db, half_db] = [&full, &half].map(|splats| psnr(splats, &photos, |_| true));
    println!("{full_db:.3} dB in single precision, {half_db:.3} in half");
    assert!(bits(&full) != bits(&half), "is it half precision?");
    assert!((full_db - half_db).abs() < 0.1, "{full_db} and {half_db} dB");
}

#[test]
fn the_same_job_gives_the_same_bytes_whoever_asks_whatever_and_whenever() {
    let Some(gpu) = gpu() else { return };
    // Of twelve views: five, five and two are an epoch.
    [1, 5].into_iter().for_each(|views_per_step| gives_the_same_bytes(&gpu, views_per_step));
}

fn gives_the_same_bytes(gpu: &Backend, views_per_step: u32) {
    let truth = cloud(2, 150, 0.8);
    let photos = photos(&truth);
    let context = cloud(3, 40, 0.5);
    let run = |from: Option<State>, report: &mut dyn FnMut(train::Progress) -> Flow| {
        let recipe = Recipe { views_per_step, ..Recipe::default() };
        let job = Setup { recipe, ..job(&photos, &context, &truth, gpu) };
        job.try_run_on(from, &|_| true, report).expect("training goes well").0
    };
    let calm = bits(&run(None, &mut |_| Flow::Continue));
    let mut left = None;
    let asked = run(None, &mut |mut now| {
        assert!(now.views == views_per_step || now.step % 12 == 0 || now.step == 90, "an epoch ends a step");
        if now.step % 5 == 0 {
            assert!(now.loss().is_some_and(f64::is_finite) && now.skipped() == Some(0));
        }
        if now.step % 7 == 0 {
            assert_eq!(now.splats().map(Splats::len), Some(now.count()));
        }
        // Within an epoch, after some growth.
        if left.is_none() && now.step >= 46 {
            left = now.state().map(State::to_frame);
        }
        Flow::Continue
    });
    assert!(asked.len() > 150, "growth must have happened");
    assert!(calm == bits(&asked), "reports change the result");
    let from = State::from_frame(&left.expect("a step was reported")).expect("a checkpoint is readable");
    assert!(calm == bits(&run(Some(from), &mut |_| Flow::Continue)), "an interruption shows");
}

/// A device of its own, for what others must not notice.
fn another(memory_bytes: Option<u64>) -> std::sync::Arc<Gpu> {
    let options = GpuOptions { memory_bytes, ..GpuOptions::from_env().expect("a sound environment") };
    Gpu::open_with(&options).expect("it opened before")
}

#[test]
fn a_training_that_does_not_fit_ends_with_why() {
    if gpu().is_none() {
        return;
    }
    let truth = cloud(6, 150, 0.8);
    let photos = photos(&truth);
    let context = cloud(3, 40, 0.5);
    let run = |gpu: &std::sync::Arc<Gpu>| {
        let setup = Setup { steps: 30, ..job(&photos, &context, &truth, &Backend::Gpu(gpu.clone())) };
        setup.try_run(&|_| true, &mut |_| Flow::Continue)
    };
    let roomy = another(None);
    let free = bits(&run(&roomy).expect("there is memory"));
    let [left, peak] = roomy.memory_bytes();
    println!("{peak} bytes at most");
    assert_eq!(left, 0, "all is given back");
    // A cap is not seen in the result, and where it is too small there is none.
    assert!(free == bits(&run(&another(Some(peak))).expect("there is as much as it took")));
    for cap in [0, 1000, peak / 2] {
        let gpu = another(Some(cap));
        match run(&gpu) {
            Err(TrainError::OutOfMemory(line)) => {
                assert!(
                    line.contains(&format!("of {cap} that PLAT_GPU_MEMORY allows")) && !line.contains('\n'),
                    "{line}"
                );
            }
            other => panic!("{cap} bytes: {:?}", other.map(|splats| splats.len())),
        }
        assert_eq!(gpu.memory_bytes()[0], 0);
    }
}

#[test]
fn a_training_whose_device_is_lost_ends_with_why() {
    if gpu().is_none() {
        return;
    }
    let truth = cloud(6, 150, 0.8);
    let photos = photos(&truth);
    let context = cloud(3, 40, 0.5);
    // Between looks at the device, and just before one.
    for lost_at in [1, 29] {
        let gpu = another(None);
        let mut steps = 0;
        let out = job(&photos, &context, &truth, &Backend::Gpu(gpu.clone())).try_run(&|_| true, &mut |now| {
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
        // Asking finds it out at once.
        let gpu = another(None);
        let out = job(&photos, &context, &truth, &Backend::Gpu(gpu.clone())).try_run(&|_| true, &mut |mut now| {
            steps = now.step;
            if now.step == lost_at {
                gpu.device().destroy();
                assert_eq!(now.splats(), None, "there is nothing to be told");
            }
            Flow::Continue
        });
        assert!(steps == lost_at && matches!(out, Err(TrainError::Device(_))), "{steps}");
    }
}

#[test]
fn what_is_under_a_mask_does_not_matter() {
    let Some(gpu) = gpu() else { return };
    let truth = cloud(4, 120, 0.8);
    let given = photos(&truth);
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
        let setup =
            Setup { backend: gpu.clone(), steps: 20, recipe: no_growth(), ..Setup::new(perturbed(&truth), photos) };
        bits(&setup.run())
    };
    let bare = |mut photos: Photos| {
        photos.0.iter_mut().for_each(|photo| photo.mask = None);
        photos
    };
    assert!(run(&masked(0)) == run(&masked(200)), "hidden pixels moved parameters");
    assert!(run(&bare(masked(0))) != run(&bare(masked(200))), "without the mask it must matter");
}

#[test]
fn a_step_whose_loss_is_not_finite_is_left_out_and_counted() {
    let Some(gpu) = gpu() else { return };
    let truth = cloud(5, 60, 0.8);
    let photos = photos(&truth);
    let initial = perturbed(&truth);
    // Whatever is drawn, such a loss is no number.
    let recipe = Recipe { lambda: f32::NAN, ..no_growth() };
    for backend in [Backend::Cpu, gpu] {
        let mut skipped = None;
        let setup = Setup { backend, steps: 12, recipe: recipe.clone(), ..Setup::new(initial.clone(), &photos) };
        let out = setup.try_run(&|_| true, &mut |mut now| {
            skipped = now.skipped();
            Flow::Continue
        });
        assert_eq!(skipped, Some(12));
        assert!(
            bits(&out.expect("steps may be left out")) == bits(&initial),
            "a step that does not count moved splats"
        );
    }
}

#[test]
fn what_a_gpu_does_not_do_is_refused() {
    let Some(gpu) = gpu() else { return };
    let truth = cloud(9, 60, 0.8);
    let photos = photos(&truth);
    let exposures = Exposures::default();
    let setup = || Setup { backend: gpu.clone(), ..Setup::new(perturbed(&truth), &photos) };
    for setup in [Setup { trains_exposures: true, ..setup() }, Setup { exposures: Some(&exposures), ..setup() }] {
        let refused = setup.try_run(&|_| true, &mut |_| Flow::Continue).unwrap_err();
        assert_eq!(refused, TrainError::Exposures);
        assert!(refused.to_string().contains("--backend cpu"));
    }
    let empty = Setup { backend: gpu.clone(), ..Setup::new(Splats::new(1), &photos) };
    assert_eq!(empty.try_run(&|_| true, &mut |_| Flow::Continue), Err(TrainError::Empty(0)));
}
