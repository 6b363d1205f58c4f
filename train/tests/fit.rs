//! Trains from end to end on a scene of a few hundred splats, with photos rendered from the ground ground_truth.

mod common;

use std::sync::{Arc, Mutex};

use common::*;
use glam::Vec3;
use render::cpu::Renderer;
use render::{Options, Part};
use scene::{Pixels, Rect, Splat, Splats, column};
use train::{Backend, Flow, Job, Recipe, TrainError, TrainView, WindowSource, random, train};

#[test]
fn perturbed_points_reach_30_db() {
    let ground_truth = cloud(1, 200, 0.8);
    let photos = photos(&ground_truth);
    let initial = perturbed(&ground_truth);
    let before = psnr(&initial, &photos, |_| true);
    let mut losses = Vec::new();
    let mut report = |mut p: train::Progress| {
        assert_eq!((p.steps, p.skipped()), (600, Some(0)));
        losses.extend(p.loss());
        Flow::Continue
    };
    let fitted = Setup { steps: 600, ..Setup::new(initial, &photos) }.try_run(&|_| true, &mut report).unwrap();
    let after = psnr(&fitted, &photos, |_| true);
    println!("{before:.2} dB before, {after:.2} dB after, {} splats", fitted.len());
    assert!(before < 22.0, "the initial splats must not fit already: {before}");
    assert!(after > 30.0, "{after}");
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    assert!(mean(&losses[588..]) < 0.3 * mean(&losses[..12]));
    assert!(all_finite(&fitted));
}

#[test]
fn result_does_not_depend_on_threads() {
    let ground_truth = cloud(2, 150, 0.8);
    let photos = photos(&ground_truth);
    let context = cloud(3, 40, 0.5);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let setup = Setup { context: Some(&context), budget: 250, ..Setup::new(perturbed(&ground_truth), &photos) };
        pool.install(|| setup.run())
    };
    let one = run(1);
    assert!(one.len() > 200, "densification must add splats");
    for threads in [2, 5] {
        let many = run(threads);
        assert_eq!(one.len(), many.len());
        let bits = |splats: &Splats| -> Vec<u32> { splats.columns().iter().flatten().map(|v| v.to_bits()).collect() };
        assert!(bits(&one) == bits(&many), "{threads} threads give other splats than one");
    }
}

/// Masks the right third and sets the masked pixels to `content(i)`.
fn masked(photos: &Photos, content: impl Fn(usize) -> u8) -> Photos {
    let mut out = photos.clone();
    let hidden = |i: usize| i % AREA % WIDTH as usize >= 43;
    for photo in &mut out.0 {
        photo.mask = Some((0..AREA).map(|i| if hidden(i) { 0 } else { 255 }).collect());
        for (i, byte) in photo.rgb.iter_mut().enumerate().filter(|(i, _)| hidden(*i)) {
            *byte = content(i);
        }
    }
    out
}

/// The largest difference between the results for two contents of the masked pixels, with the mask and without it.
fn mask_differences(recipe: &Recipe) -> (f32, f32) {
    let ground_truth = cloud(4, 120, 0.8);
    let photos = photos(&ground_truth);
    let black = masked(&photos, |_| 0);
    let noise = masked(&photos, |i| random::bits(8, i as u64) as u8);
    let bare = |photos: &Photos| Photos(photos.0.iter().map(|p| Pixels { mask: None, ..p.clone() }).collect());
    let run = |photos: &Photos| {
        Setup { steps: 60, recipe: recipe.clone(), ..Setup::new(perturbed(&ground_truth), photos) }.run()
    };
    let largest = |a: &Splats, b: &Splats| {
        let pairs = a.columns().iter().flatten().zip(b.columns().iter().flatten());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    let with = largest(&run(&black), &run(&noise));
    (with, largest(&run(&bare(&black)), &run(&bare(&noise))))
}

#[test]
fn masked_pixels_do_not_affect_l1() {
    let (with, without) = mask_differences(&Recipe { lambda: 0.0, coarse: Vec::new(), ..no_growth() });
    assert_eq!(with, 0.0);
    assert!(without > 0.1, "the pixels must matter without the mask: {without}");
}

#[test]
fn masked_pixels_do_not_affect_the_loss() {
    // SSIM windows have a radius of five pixels and must not carry masked pixels over the mask's edge.
    let (with, without) = mask_differences(&no_growth());
    assert!(without > 0.1, "the pixels must matter without the mask: {without}");
    assert_eq!(with, 0.0, "masked pixels changed parameters");
}

#[test]
fn non_finite_initial_splats_are_removed() {
    let ground_truth = cloud(5, 150, 0.8);
    let photos = photos(&ground_truth);
    let good = perturbed(&ground_truth);
    let wanted = [
        column::MEAN,
        column::MEAN + 2,
        column::LOG_SCALE + 1,
        column::QUAT,
        column::QUAT + 3,
        column::OPACITY,
        column::SH,
        column::SH + 5,
    ];
    // The same splats without the broken rows.
    let without = good.filter(|i| i % 16 != 7 || i / 16 >= wanted.len());
    assert_eq!(without.len(), good.len() - wanted.len());
    let healthy = psnr(&Setup { budget: good.len(), ..Setup::new(without, &photos) }.run(), &photos, |_| true);
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut initial = good.clone();
        for (n, k) in wanted.into_iter().enumerate() {
            initial.columns_mut()[k][7 + 16 * n] = value;
        }
        let mut skipped = 0;
        let mut report = |mut p: train::Progress| {
            skipped = p.skipped().unwrap();
            Flow::Continue
        };
        let fitted = Setup::new(initial, &photos).try_run(&|_| true, &mut report).unwrap();
        let after = psnr(&fitted, &photos, |_| true);
        println!("{value}: {after:.2} dB instead of {healthy:.2}, {skipped} steps skipped, {} splats", fitted.len());
        assert!(all_finite(&fitted), "{value}: broken rows remain");
        assert!(after > healthy - 1.0, "{value}: {after} dB instead of {healthy}");
        assert!(skipped == 0, "{value}: {skipped} steps were skipped");
    }
}

#[test]
fn growth_meets_the_budget() {
    let ground_truth = cloud(6, 200, 0.8);
    let photos = photos(&ground_truth);
    let initial = perturbed(&ground_truth).filter(|i| i % 3 == 0);
    for budget in [67, 100, 200, 300] {
        let setup = Setup { budget, steps: 600, ..Setup::new(initial.clone(), &photos) };
        let fitted = setup.run();
        println!("budget {budget}: {} splats, {:.2} dB", fitted.len(), psnr(&fitted, &photos, |_| true));
        assert!(fitted.len() <= budget, "{} splats exceed the budget of {budget}", fitted.len());
        assert!(fitted.len() * 100 >= budget * 97, "{} splats of {budget}", fitted.len());
    }
}

#[test]
fn only_counted_splats_use_the_budget() {
    let ground_truth = cloud(6, 200, 0.8);
    let photos = photos(&ground_truth);
    let core = |p: Vec3| p.x < 0.0;
    let setup = Setup { budget: 160, steps: 600, ..Setup::new(perturbed(&ground_truth), &photos) };
    let fitted = setup.try_run(&core, &mut |_| Flow::Continue).unwrap();
    let inside = (0..fitted.len()).filter(|&i| core(fitted.mean(i))).count();
    println!("{inside} inside, {} in all", fitted.len());
    assert!((144..=176).contains(&inside), "{inside} splats instead of 160 (splats move across the border)");
    assert!(fitted.len() > inside + 80, "the halo is there too: {}", fitted.len());
}

#[test]
fn more_splats_fit_better() {
    let ground_truth = cloud(6, 200, 0.8);
    let photos = photos(&ground_truth);
    let initial = perturbed(&ground_truth).filter(|i| i % 4 == 0);
    let run =
        |budget| psnr(&Setup { budget, steps: 400, ..Setup::new(initial.clone(), &photos) }.run(), &photos, |_| true);
    let (few, many) = (run(50), run(200));
    assert!(many > few + 1.0, "{many} dB with four times the splats, {few} dB without");
}

/// The splats on one side of the plane x = 0, with a gap.
fn half(splats: &Splats, sign: f32) -> Splats {
    splats.filter(|i| splats.mean(i).x * sign > 0.15)
}

/// The alpha that `own` contributes to each pixel, over all views, in front of `context`.
fn trainable_alpha(own: &Splats, context: &Splats) -> Vec<f32> {
    let options = Options { sh_degree: 1, extras: true, ..Options::default() };
    let draw = |view: &TrainView| {
        Renderer::default().forward(own, &[Part::beside(context)], &view.camera, &options).trainable_alpha.clone()
    };
    views().iter().flat_map(draw).collect()
}

#[test]
fn invisible_splats_keep_every_bit() {
    let ground_truth = cloud(7, 160, 0.8);
    let photos = photos(&ground_truth);
    // Splats to train; one far above the cameras, never in view; one inside an opaque ball of context, in view but
    // occluded.
    let mut initial = perturbed(&half(&ground_truth, -1.0));
    let trained = initial.len();
    initial.push(&Splat::round(Vec3::new(0.0, 0.0, 40.0), -2.0, Vec3::X, 0.5));
    initial.push(&Splat::round(Vec3::new(0.7, 0.0, 0.0), -5.0, Vec3::Y, 0.9));
    let mut ball = half(&ground_truth, 1.0);
    for _ in 0..4 {
        ball.push(&Splat::round(Vec3::new(0.7, 0.0, 0.0), -1.5, Vec3::splat(0.5), 0.995));
    }
    let shell = ball.clone();
    for (n, direction) in (0..96u64).map(|n| (n, [0, 1, 2].map(|k| random::uniform(31, 3 * n + k) - 0.5))) {
        let direction = Vec3::from_array(direction).normalize();
        let layer = 0.4 + 0.05 * (n % 3) as f32;
        ball.push(&Splat::round(Vec3::new(0.7, 0.0, 0.0) + layer * direction, -1.6, Vec3::splat(0.4), 0.995));
    }
    assert!(shell.len() < ball.len());
    let weight = |i: u32| trainable_alpha(&initial.select(&[i]), &ball).iter().sum::<f32>();
    assert_eq!((weight(trained as u32), weight(trained as u32 + 1)), (0.0, 0.0), "the two splats must be invisible");
    assert!(weight(0) > 1.0);

    let setup = Setup { context: Some(&ball), steps: 120, recipe: no_growth(), ..Setup::new(initial.clone(), &photos) };
    let fitted = setup.run();
    assert_eq!(fitted.len(), initial.len());
    for i in trained..trained + 2 {
        assert_eq!(fitted.get(i), initial.get(i), "splat {i} is invisible and must not change");
    }
    let moved = (0..trained).filter(|&i| fitted.get(i) != initial.get(i)).count();
    assert!(moved * 10 > trained * 9, "only {moved} of {trained} splats were trained");
}

#[test]
fn blocks_do_not_correct_their_neighbours_region() {
    // On the right the photos disagree with the context: an error of the neighbour, not of this block.
    let ground_truth = cloud(8, 300, 0.97);
    let (left, right) = (half(&ground_truth, -1.0), half(&ground_truth, 1.0));
    let mut elsewhere = right.clone();
    for k in 0..3 {
        elsewhere.columns_mut()[column::SH + k].iter_mut().for_each(|v| *v = 1.2 - *v);
    }
    let with = |right: &Splats| {
        let mut both = left.clone();
        both.append(right);
        photos(&both)
    };
    let (agreeing, contradicting) = (with(&right), with(&elsewhere));
    let run = |photos: &Photos, context: Option<&Splats>| {
        let budget = 2 * left.len();
        // Enough steps for a block without context to spread over a third of the neighbour's region.
        Setup { context, budget, steps: 150, ..Setup::new(perturbed(&left), photos) }.run()
    };
    // Pixels of the neighbour: opaque there and free of the block's ground ground_truth.
    let mut theirs = trainable_alpha(&left, &right);
    for (share, other) in theirs.iter_mut().zip(trainable_alpha(&right, &left)) {
        *share = if *share < 0.003 && other > 0.9 { 1.0 } else { 0.0 };
    }
    let count = theirs.iter().sum::<f32>();
    assert!(count > 500.0, "{count}");
    let spill =
        |own: &Splats| trainable_alpha(own, &right).iter().zip(&theirs).map(|(s, t)| s * t).sum::<f32>() / count;

    let agreed = spill(&run(&agreeing, Some(&right)));
    let disagreed = spill(&run(&contradicting, Some(&right)));
    let unguarded = spill(&run(&contradicting, None));
    println!(
        "alpha in the neighbour's pixels: {agreed:.4} if photos agree, {disagreed:.4} if not, {unguarded:.4} without context"
    );
    assert!(unguarded > 0.1, "without a context the block must spread: {unguarded}");
    assert!(disagreed < 0.1 * unguarded, "alpha of {disagreed} in the neighbour's pixels");
}

#[test]
fn reports_can_stop_training_and_errors_name_the_cause() {
    let ground_truth = cloud(9, 60, 0.8);
    let photos = photos(&ground_truth);
    let mut calls = 0;
    let mut report = |p: train::Progress| {
        calls += 1;
        assert_eq!(p.step, calls);
        if p.step == 10 { Flow::Stop } else { Flow::Continue }
    };
    assert!(Setup::new(perturbed(&ground_truth), &photos).try_run(&|_| true, &mut report).is_ok());
    assert_eq!(calls, 10);

    let run =
        |initial: Splats, photos: &Photos| Setup::new(initial, photos).try_run(&|_| true, &mut |_| Flow::Continue);
    let missing = Photos(photos.0[..6].to_vec());
    assert!(
        matches!(run(perturbed(&ground_truth), &missing), Err(TrainError::Source(line)) if line.contains("is missing"))
    );
    assert_eq!(run(Splats::new(1), &photos), Err(TrainError::Empty(0)));
    let mut transparent = perturbed(&ground_truth);
    transparent.columns_mut()[column::OPACITY].fill(-12.0);
    // At the first refinement.
    assert!(matches!(run(transparent, &photos), Err(TrainError::Empty(10..=50))));
    let job = Job {
        initial: perturbed(&ground_truth),
        context: None,
        views: &[],
        counts: &|_| true,
        keeps: &|_| true,
        free_space: None,
        budget: 10,
        steps: 10,
        antialiased: false,
        seed: 0,
        size_bounds_metres: [1e-3, 1.0],
        exposures: None,
        trains_exposures: false,
        trains_poses: false,
        sensors: None,
        path: None,
        recipe: &Recipe::default(),
        source: &photos,
        picture_loss: None,
        backend: &Backend::Cpu,
    };
    assert_eq!(train(job, &mut |_| Flow::Continue), Err(TrainError::NoViews));
}

/// Photos that record which views were announced and which were read.
struct Recorder<'a>(&'a Photos, Mutex<[Vec<u32>; 2]>);

impl WindowSource for Recorder<'_> {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        self.1.lock().unwrap()[1].push(view);
        self.0.window(view, mip, rect)
    }

    fn prefetch(&self, view: u32, _: u8, _: Rect) {
        self.1.lock().unwrap()[0].push(view);
    }
}

/// Few windows are announced that are never read, as each may be a download.
#[test]
fn announced_windows_are_read() {
    let ground_truth = cloud(1, 60, 0.8);
    let (photos, views) = (photos(&ground_truth), views());
    for (views_per_step, worth_db) in [(1, 0.0), (1, 1e6), (5, 0.0), (5, 1e6)] {
        let source = Recorder(&photos, Mutex::default());
        let mut recipe = Recipe { views_per_step, coarse: Vec::new(), ..Recipe::default() };
        recipe.growth.worth_db = worth_db;
        let mut steps = 0;
        let job = Job {
            initial: perturbed(&ground_truth),
            context: None,
            views: &views,
            counts: &|_| true,
            keeps: &|_| true,
            free_space: None,
            budget: 600,
            steps: 600,
            antialiased: false,
            seed: 5,
            size_bounds_metres: [1e-3, 2.0],
            exposures: None,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: None,
            recipe: &recipe,
            source: &source,
            picture_loss: None,
            backend: &Backend::Cpu,
        };
        let trained = train(job, &mut |now| {
            steps += now.views as usize;
            Flow::Continue
        });
        trained.expect("training succeeds");
        let [announced, read] = source.1.into_inner().unwrap();
        println!(
            "{views_per_step} a step, growth worth {worth_db} dB: {} announced, {} read",
            announced.len(),
            read.len()
        );
        assert_eq!(read.len(), steps);
        assert_eq!(steps < 600, worth_db > 0.0, "growth without gain ends early");
        // The first windows are read without announcement. Those announced when growth ends are never read.
        assert!(announced.len().abs_diff(read.len()) <= 16 && announced.len() + 16 > read.len());
    }
}

/// A pixel of weight 0 is left out like a masked one, whatever it shows.
#[test]
fn pixels_of_weight_0_do_not_affect_the_loss() {
    let ground_truth = cloud(13, 120, 0.8);
    let photos = photos(&ground_truth);
    let run = |photos: &Photos| {
        let recipe = Recipe { coarse: Vec::new(), ..no_growth() };
        Setup { steps: 40, recipe, ..Setup::new(perturbed(&ground_truth), photos) }.run()
    };
    let with_weights = |mut photos: Photos| {
        for photo in &mut photos.0 {
            let mask = photo.mask.take().unwrap();
            photo.weights = Some(mask.iter().map(|&mask| if mask == 0 { 0.0 } else { 1.0 }).collect());
        }
        photos
    };
    let masks = masked(&photos, |_| 0);
    let noise = with_weights(masked(&photos, |i| random::bits(8, i as u64) as u8));
    let expected = run(&masks);
    assert!(run(&with_weights(masks)) == expected, "a weight of 0 acts like a mask");
    assert!(run(&noise) == expected, "pixels of weight 0 changed parameters");
}

/// A textureless wall before one camera position: photos cannot tell its distance, target depths can.
#[test]
fn target_depths_pull_splats_to_a_depth_that_photos_leave_ambiguous() {
    let views = &views()[..1];
    let camera = &views[0].camera;
    // A grid of splats of one colour that fills the photo, at a depth in metres along the camera's axis. Sizes grow with
    // the depth, so that every depth gives the same picture.
    let wall = |depth: f64| {
        let mut splats = Splats::new(0);
        for y in 0..7 {
            for x in 0..9 {
                let on_axis =
                    glam::DVec3::new((f64::from(x) * 8.0 - 32.0) / 70.0, (f64::from(y) * 8.0 - 24.0) / 70.0, 1.0);
                let place = camera.camera_from_world.inverse().apply(depth * on_axis).as_vec3();
                splats.push(&Splat::round(place, (depth as f32 * 0.09).ln(), Vec3::splat(0.6), 0.9));
            }
        }
        splats
    };
    const TRUE_DEPTH: f64 = 4.0;
    let sparse = |i: usize| if i.is_multiple_of(5) { TRUE_DEPTH as f32 } else { 0.0 };
    let mut photos = photos(&wall(TRUE_DEPTH));
    photos.0.truncate(1);
    photos.0[0].depth = Some((0..AREA).map(sparse).collect());
    let initial = wall(3.0);
    let mean_depth = |splats: &Splats| {
        let depth = |i: usize| camera.camera_from_world.apply(splats.mean(i).as_dvec3()).z;
        (0..splats.len()).map(depth).sum::<f64>() / splats.len() as f64
    };
    let fit = |depth_weight: f32| {
        let recipe = Recipe { depth_weight, ..no_growth() };
        let job = Job {
            initial: initial.clone(),
            context: None,
            views,
            counts: &|_| true,
            keeps: &|_| true,
            free_space: None,
            budget: initial.len(),
            steps: 1200,
            antialiased: false,
            seed: 5,
            size_bounds_metres: [1e-3, 2.0],
            exposures: None,
            trains_exposures: false,
            trains_poses: false,
            sensors: None,
            path: None,
            recipe: &recipe,
            source: &photos,
            picture_loss: None,
            backend: &Backend::Cpu,
        };
        mean_depth(&train(job, &mut |_| Flow::Continue).unwrap())
    };
    let (without, with) = (fit(0.0), fit(1.0));
    println!("mean depth {without:.2} m without target depths, {with:.2} m with, {TRUE_DEPTH} m is true");
    assert!((without - TRUE_DEPTH).abs() > 0.5, "photos alone must leave the depth open: {without}");
    assert!((with - TRUE_DEPTH).abs() < 0.03, "{with}");
}
