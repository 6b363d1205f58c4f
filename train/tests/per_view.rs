//! Training of what belongs to one view, its exposure and its pose, on each backend.

mod common;

use common::*;
use glam::{DQuat, DVec3};
use scene::sensors::{Motion, Taken};
use scene::{Camera, Exposure, Exposures, MovingObject, PathPose, Pixels, Rigid, Splats};
use train::{Backend, Flow, ObjectTimes, State, TrainView, Walk, metrics, random};

/// Multiplies each photo by its gain.
fn exposed(photos: &Photos, gains: &[f32]) -> Photos {
    let mut out = photos.clone();
    for (photo, gain) in out.0.iter_mut().zip(gains) {
        photo.rgb.iter_mut().for_each(|byte| *byte = (f32::from(*byte) * gain).round().min(255.0) as u8);
    }
    out
}

/// Gains from 0.6 to 1.
fn gains() -> Vec<f32> {
    (0..12).map(|view| 0.6 + 0.4 * random::uniform(41, view)).collect()
}

#[test]
fn exposures_are_recovered_relative_to_their_mean() {
    let (ground_truth, gains) = (cloud(10, 200, 0.8), gains());
    let mean = gains.iter().sum::<f32>() / gains.len() as f32;
    let given = photos(&ground_truth);
    let shown = exposed(&given, &gains);
    let all_alike = exposed(&given, &[mean; 12]);
    let run = |backend: &Backend, trains_exposures| {
        let setup = Setup { trains_exposures, steps: 600, ..Setup::new(perturbed(&ground_truth), &shown) };
        let setup = Setup { backend: backend.clone(), ..setup };
        setup.try_run_on(None, &|_| true, &mut |_| Flow::Continue).unwrap()
    };
    let without = run(&Backend::Cpu, false);
    assert_eq!(without.exposures, None);
    let without = psnr(&without.splats, &all_alike, |_| true);
    for backend in backends() {
        let with = run(&backend, true);
        let exposures = with.exposures.unwrap();
        let with = psnr(&with.splats, &all_alike, |_| true);
        println!("{}: {without:.2} dB without exposures, {with:.2} dB with", backend.name());
        assert!(with > without + 2.0, "{without} {with}");
        for (view, gain) in gains.iter().enumerate() {
            let found = exposures.of(view as u32).unwrap().gain();
            assert!((found - gain / mean).abs() < 0.1, "view {view}: {found} instead of {}", gain / mean);
        }
    }
}

#[test]
fn fixed_exposures_are_applied() {
    let (ground_truth, gains) = (cloud(11, 150, 0.8), gains());
    let shown = exposed(&photos(&ground_truth), &gains);
    let grey = |gain: f32| Exposure(Exposure::IDENTITY.0.map(|row| row.map(|value| gain * value)));
    // View 11 has no exposure and is rendered as it is.
    let given: Exposures = (0..11).map(|view| (view, grey(gains[view as usize]))).collect();
    let of_most = |photos: &Photos| Photos(photos.0.iter().take(11).cloned().collect());
    let run = |backend: &Backend, exposures| {
        Setup { exposures, backend: backend.clone(), ..Setup::new(ground_truth.clone(), &shown) }.run()
    };
    let fits = |splats: &Splats| {
        let photos = of_most(&photos(&ground_truth));
        let views = views();
        let of = |(view, photo): (&TrainView, &Pixels)| {
            let expected: Vec<f32> = photo.rgb.iter().map(|&b| f32::from(b) / 255.0).collect();
            metrics::psnr(&self::photo(splats, view), &expected, None).unwrap()
        };
        views.iter().zip(&photos.0).map(of).sum::<f64>() / 11.0
    };
    for backend in backends() {
        let [with, without] = [run(&backend, Some(&given)), run(&backend, None)].map(|splats| fits(&splats));
        println!("{}: {with:.2} dB with, {without:.2} without", backend.name());
        assert!(with > without + 4.0, "{with} {without}");
    }
}

#[test]
fn exposures_do_not_depend_on_threads_or_interruptions() {
    let (ground_truth, gains) = (cloud(12, 120, 0.8), gains());
    let shown = exposed(&photos(&ground_truth), &gains);
    let setup = |backend| Setup {
        trains_exposures: true,
        budget: 200,
        steps: 120,
        backend,
        ..Setup::new(perturbed(&ground_truth), &shown)
    };
    let run = |backend: &Backend, threads: usize, from: Option<State>, until: u32| {
        let mut left = None;
        let mut report = |mut now: train::Progress| {
            left = (now.step == until).then(|| now.state().unwrap().to_frame());
            if left.is_some() { Flow::Stop } else { Flow::Continue }
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let done = pool.install(|| setup(backend.clone()).try_run_on(from, &|_| true, &mut report)).unwrap();
        (done, left)
    };
    for backend in backends() {
        let uninterrupted = run(&backend, 1, None, u32::MAX).0;
        assert!(uninterrupted.exposures.as_ref().unwrap().iter().any(|(_, exposure)| *exposure != Exposure::IDENTITY));
        assert!(uninterrupted == run(&backend, 2, None, u32::MAX).0, "two threads give another result");
        // In the middle of an epoch, after some densification.
        let left = run(&backend, 2, None, 67).1.unwrap();
        let resumed = run(&backend, 1, Some(State::from_frame(&left).unwrap()), u32::MAX).0;
        assert!(uninterrupted == resumed, "a resumed run gives another result");
    }
}

/// The views with poses off by up to 1.4° and 0.12 m, of 5 m from the scene, on each axis.
fn disturbed(views: &[TrainView]) -> Vec<TrainView> {
    let noise = |view: u32, k: u64| f64::from(random::uniform(61, 6 * u64::from(view) + k)) - 0.5;
    let disturb = |view: &TrainView| {
        let vector = |first: u64| DVec3::from_array([0, 1, 2].map(|k| noise(view.view, first + k)));
        let error = Rigid { rotation: DQuat::from_scaled_axis(0.05 * vector(0)), translation: 0.25 * vector(3) };
        let camera_from_world = error.after(&view.camera.camera_from_world);
        TrainView { camera: Camera { camera_from_world, ..view.camera }, ..*view }
    };
    views.iter().map(disturb).collect()
}

/// Root mean square distance, in pixels, between the images of a few points of the scene in cameras of these views and in true ones.
fn pixel_error(views: &[TrainView], truth: &[TrainView]) -> f64 {
    let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z];
    let pairs = views.iter().zip(truth).flat_map(|pair| points.map(|point| (pair, point)));
    let squares = pairs.map(|((a, b), point)| (a.camera.project(point).0 - b.camera.project(point).0).length_squared());
    (squares.sum::<f64>() / (points.len() * views.len()) as f64).sqrt()
}

/// PSNR of the photos from the poses that the splats were trained with.
fn fits(splats: &Splats, views: &[TrainView], photos: &Photos) -> f64 {
    let of = |view: &TrainView| {
        let expected: Vec<f32> = photos.0[view.view as usize].rgb.iter().map(|&b| f32::from(b) / 255.0).collect();
        metrics::psnr(&photo(splats, view), &expected, None).unwrap()
    };
    views.iter().map(of).sum::<f64>() / views.len() as f64
}

#[test]
fn disturbed_poses_are_refined_with_the_splats() {
    let ground_truth = cloud(13, 200, 0.8);
    let (photos, truth) = (photos(&ground_truth), views());
    let given = disturbed(&truth);
    let run = |backend: &Backend, trains_poses| {
        let setup =
            Setup { trains_poses, steps: 1200, views: given.clone(), ..Setup::new(perturbed(&ground_truth), &photos) };
        let setup = Setup { backend: backend.clone(), ..setup };
        setup.try_run_on(None, &|_| true, &mut |_| Flow::Continue).unwrap()
    };
    let without = run(&Backend::Cpu, false);
    assert_eq!(without.poses, None);
    for backend in backends() {
        let with = run(&backend, true);
        let poses = with.poses.unwrap();
        assert_eq!(poses.iter().map(|(view, _)| view).collect::<Vec<_>>(), (0..12).collect::<Vec<u32>>());
        let refined: Vec<TrainView> =
            given.iter().map(|view| TrainView { camera: poses.apply(view.view, view.camera), ..*view }).collect();
        let [before, after] = [&given, &refined].map(|views| pixel_error(views, &truth));
        let [without, with] = [fits(&without.splats, &given, &photos), fits(&with.splats, &refined, &photos)];
        println!(
            "{}: {before:.2} pixels off before, {after:.2} after; {without:.2} dB without, {with:.2} dB with",
            backend.name()
        );
        assert!(before > 1.0 && after < 0.5 * before, "{before} {after}");
        assert!(with > without + 2.0, "{without} {with}");
    }
}

/// Two sensors, whose photos are the even and the odd views, and how they move.
fn rig() -> Vec<Taken> {
    let motion = |view: u64| {
        let velocity = DVec3::new(1.0, f64::from(random::uniform(62, view)) - 0.5, 0.2);
        Some(Motion { velocity, spin: DVec3::ZERO })
    };
    (0..12).map(|view| Taken { sensor: view as u32 % 2, motion: motion(view) }).collect()
}

/// The views as a rig with errors has them: the clock of the odd ones is off by 0.15 s, the even ones are turned by 1.1°, and
/// their focal length is 3 % too small.
fn of_wrong_sensors(views: &[TrainView], rig: &[Taken]) -> Vec<TrainView> {
    let wrong = |view: &TrainView| {
        let taken = &rig[view.view as usize];
        let (mut camera, odd) = (view.camera, taken.sensor == 1);
        let error = match taken.motion {
            Some(motion) if odd => Rigid { rotation: DQuat::IDENTITY, translation: -0.15 * motion.velocity },
            _ => Rigid { rotation: DQuat::from_rotation_x(-0.02), translation: DVec3::ZERO },
        };
        camera.camera_from_world = error.inverse().after(&camera.camera_from_world);
        camera.pinhole = camera.pinhole.with_focal_factor(if odd { 1.0 } else { 0.97 });
        TrainView { camera, ..*view }
    };
    views.iter().map(wrong).collect()
}

#[test]
fn errors_of_sensors_are_found_with_the_splats() {
    let ground_truth = cloud(15, 200, 0.8);
    let (photos, truth, rig) = (photos(&ground_truth), views(), rig());
    let given = of_wrong_sensors(&truth, &rig);
    for backend in backends() {
        let setup = Setup {
            sensors: Some(&rig),
            steps: 1200,
            views: given.clone(),
            backend: backend.clone(),
            ..Setup::new(perturbed(&ground_truth), &photos)
        };
        let poses = setup.try_run_on(None, &|_| true, &mut |_| Flow::Continue).unwrap().poses.unwrap();
        let refined: Vec<TrainView> =
            given.iter().map(|view| TrainView { camera: poses.apply(view.view, view.camera), ..*view }).collect();
        let [before, after] = [&given, &refined].map(|views| pixel_error(views, &truth));
        println!("{}: {before:.2} pixels off before, {after:.2} after; {:?}", backend.name(), poses.sensors);
        let [even, odd] = &poses.sensors[..] else { panic!("{:?}", poses.sensors) };
        assert!(before > 0.7 && after < 0.5 * before, "{before} {after}");
        assert!(
            (odd.clock_seconds - 0.15).abs() < 0.06
                && (even.focal_factor / odd.focal_factor - 1.0 / 0.97).abs() < 0.012
        );
    }
}

/// When the views were taken, two at a time.
fn times() -> ObjectTimes {
    ObjectTimes::of((0..12).map(|view| (view, 0.4 * f64::from(view / 2))), 2.0)
}

/// The views as the path of an object with errors gives them: off by up to 0.13 m and 2.3°, alike at neighbouring times.
fn of_wrong_path(views: &[TrainView]) -> Vec<TrainView> {
    let wrong = |view: &TrainView| {
        let (sin, cos) = (1.1 * f64::from(view.view / 2)).sin_cos();
        let translation = DVec3::new(0.13 * sin, 0.1 * cos, 0.0);
        let error = Rigid { rotation: DQuat::from_rotation_z(0.04 * sin), translation };
        let camera_from_world = view.camera.camera_from_world.after(&error);
        TrainView { camera: Camera { camera_from_world, ..view.camera }, ..*view }
    };
    views.iter().map(wrong).collect()
}

#[test]
fn the_path_of_an_object_is_refined_with_its_splats() {
    let ground_truth = cloud(16, 200, 0.8);
    let (photos, truth, times) = (photos(&ground_truth), views(), times());
    let given = of_wrong_path(&truth);
    let setup = |backend: Backend, path| Setup {
        path,
        steps: 1200,
        views: given.clone(),
        backend,
        ..Setup::new(perturbed(&ground_truth), &photos)
    };
    let run = |path| setup(Backend::Cpu, path).try_run_on(None, &|_| true, &mut |_| Flow::Continue).unwrap();
    let (with, without) = (run(Some(&times)), run(None));
    assert_eq!((with.motions.len(), without.motions.len()), (6, 0));
    let moved = |view: &TrainView| {
        let (seconds, motion) = with.motions[view.view as usize / 2];
        assert_eq!(seconds, 0.4 * f64::from(view.view / 2));
        let camera_from_world = view.camera.camera_from_world.after(&motion);
        TrainView { camera: Camera { camera_from_world, ..view.camera }, ..*view }
    };
    let refined: Vec<TrainView> = given.iter().map(moved).collect();
    let [before, after] = [&given, &refined].map(|views| pixel_error(views, &truth));
    let [without, with] = [fits(&without.splats, &given, &photos), fits(&with.splats, &refined, &photos)];
    println!("{before:.2} pixels off before, {after:.2} after; {without:.2} dB without, {with:.2} dB with");
    assert!(before > 0.7 && after < 0.5 * before, "{before} {after}");
    assert!(with > without + 2.0, "{without} {with}");
    // Not on a GPU, and it says so.
    for backend in backends().into_iter().filter(|backend| !matches!(backend, Backend::Cpu)) {
        let refused = setup(backend, Some(&times)).try_run_on(None, &|_| true, &mut |_| Flow::Continue);
        assert!(matches!(refused, Err(train::TrainError::Device(message)) if message.contains("CPU")));
    }
}

#[test]
fn paths_do_not_depend_on_threads_or_interruptions() {
    let ground_truth = cloud(14, 120, 0.8);
    let photos = photos(&ground_truth);
    for walk in [None, Some(walk())] {
        let mut times = times();
        times.walk = walk;
        let run = |threads: usize, from: Option<State>, until: u32| {
            let mut left = None;
            let mut report = |mut now: train::Progress| {
                left = (now.step == until).then(|| now.state().unwrap().to_frame());
                if left.is_some() { Flow::Stop } else { Flow::Continue }
            };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let views = of_wrong_path(&views());
            let setup =
                Setup { path: Some(&times), steps: 120, views, ..Setup::new(perturbed(&ground_truth), &photos) };
            (pool.install(|| setup.try_run_on(from, &|_| true, &mut report)).unwrap(), left)
        };
        let uninterrupted = run(1, None, u32::MAX).0;
        assert!(uninterrupted.motions.iter().all(|(_, motion)| *motion != Rigid::IDENTITY));
        let swings = uninterrupted.swing.iter().flat_map(|swing| &swing.amplitudes).flatten();
        assert_eq!(swings.filter(|value| **value != 0.0).count() > 0, times.walk.is_some());
        assert!(uninterrupted == run(2, None, u32::MAX).0, "two threads give another result");
        // While the stride is listened for, and while splats swing.
        for until in [23, 67] {
            let left = run(2, None, until).1.unwrap();
            let resumed = run(1, Some(State::from_frame(&left).unwrap()), u32::MAX).0;
            assert!(uninterrupted == resumed, "a run resumed from step {until} gives another result");
        }
    }
}

/// Of someone who walks 4 m while the views are taken.
fn walk() -> Walk {
    let pose = |seconds: f64| PathPose {
        seconds,
        world_from_object: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(2.0 * seconds, 0.0, 0.0) },
    };
    let person = MovingObject {
        id: "a".into(),
        class: "person".into(),
        low: DVec3::NEG_ONE,
        high: DVec3::ONE,
        path: (0..5).map(|half| pose(0.5 * f64::from(half))).collect(),
    };
    // Views that are held out are known too.
    Walk::of((0..24).map(|view| (view, 0.4 * f64::from(view % 12 / 2))), |_| true, &person).unwrap()
}

#[test]
fn poses_do_not_depend_on_threads_or_interruptions() {
    let ground_truth = cloud(14, 120, 0.8);
    let (photos, rig) = (photos(&ground_truth), rig());
    let run = |backend: &Backend, threads: usize, from: Option<State>, until: u32| {
        let mut left = None;
        let mut report = |mut now: train::Progress| {
            left = (now.step == until).then(|| now.state().unwrap().to_frame());
            if left.is_some() { Flow::Stop } else { Flow::Continue }
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let setup = Setup {
            trains_poses: true,
            sensors: Some(&rig),
            steps: 120,
            backend: backend.clone(),
            views: disturbed(&views()),
            ..Setup::new(perturbed(&ground_truth), &photos)
        };
        let done = pool.install(|| setup.try_run_on(from, &|_| true, &mut report)).unwrap();
        (done, left)
    };
    for backend in backends() {
        let uninterrupted = run(&backend, 1, None, u32::MAX).0;
        assert!(uninterrupted == run(&backend, 2, None, u32::MAX).0, "two threads give another result");
        let left = run(&backend, 2, None, 67).1.unwrap();
        let resumed = run(&backend, 1, Some(State::from_frame(&left).unwrap()), u32::MAX).0;
        assert!(uninterrupted == resumed, "a resumed run gives another result");
    }
}
