//! Every analytic gradient of the CPU backend against central differences of the f64 reference.

mod reference;

use glam::{DQuat, DVec2, DVec3};
use reference::{Image, Random, Scene, camera};
use render::cpu::{Isa, Renderer};
use render::{Frame, Gradients, Options, Part, Upstream};
use scene::splats::sh_coefficients;
use scene::{Camera, Splats, column};

/// Half the distance of a central difference; parameters are of order one.
const STEP: f64 = 1e-6;
/// Smallest relative distance to a threshold: a step changes α by about 1e-5, and f32 errors are smaller.
const MIN_MARGIN: f64 = 1e-4;

/// A scene whose loss is smooth within the step of a central difference.
struct Smooth {
    splats: Splats,
    context: Option<Splats>,
    camera: Camera,
    options: Options,
    upstream: Upstream,
    scene: Scene,
}

/// The scene of the first seed without a pixel near a threshold.
fn smooth(fill: impl Fn(&mut Random, &Camera) -> (Splats, Option<Splats>), options: Options) -> Smooth {
    let camera = camera(37, 26, 40.0);
    for seed in 1..1000 {
        let mut random = Random(seed);
        let (splats, context) = fill(&mut random, &camera);
        let scene = Scene::new(&splats, context.as_ref(), &camera, &options);
        if scene.render().nearest() > MIN_MARGIN {
            let area = 37 * 26;
            let upstream = Upstream {
                colour: random.plane(3 * area),
                transmittance: random.plane(area),
                depth: random.plane(area),
                trainable_alpha: random.plane(area),
            };
            return Smooth { splats, context, camera, options, upstream, scene };
        }
    }
    panic!("no seed gives a smooth scene");
}

/// Soft splats of middling size over the image and a little beyond.
fn soft(random: &mut Random, camera: &Camera, count: usize, sh_degree: u8) -> Splats {
    let mut splats = Splats::new(sh_degree);
    for _ in 0..count {
        let pixel = [random.range(-4.0, 41.0), random.range(-4.0, 30.0)];
        let (z, sigma) = (random.range(1.5, 6.0), random.range(0.6, 5.0));
        splats.push(&random.splat(camera, pixel, z, sigma));
    }
    splats
}

fn options(antialiased: bool, sh_degree: u8) -> Options {
    Options { antialiased, sh_degree, background: [0.3, 0.1, 0.6], extras: true, inverse_depth: false }
}

/// The loss of each pixel.
fn losses(image: &Image, upstream: &Upstream) -> Vec<f64> {
    let area = image.transmittance.len();
    let product =
        |gradient: &[f32], values: &[f64], i: usize| gradient.get(i).map_or(0.0, |&g| f64::from(g) * values[i]);
    (0..area)
        .map(|i| {
            (0..3).map(|c| product(&upstream.colour, &image.colour, c * area + i)).sum::<f64>()
                + product(&upstream.transmittance, &image.transmittance, i)
                + product(&upstream.depth, &image.depth, i)
                + product(&upstream.trainable_alpha, &image.trainable_alpha, i)
        })
        .collect()
}

/// dL/dx per pixel, by central differences; `add(scene, x)` adds x to the parameter.
fn slopes(scene: &Scene, upstream: &Upstream, add: &dyn Fn(&mut Scene, f64)) -> Vec<f64> {
    let at = |x: f64| {
        let mut moved = scene.clone();
        add(&mut moved, x);
        losses(&moved.render(), upstream)
    };
    at(STEP).iter().zip(at(-STEP)).map(|(up, down)| (up - down) / (2.0 * STEP)).collect()
}

fn slope(scene: &Scene, upstream: &Upstream, add: &dyn Fn(&mut Scene, f64)) -> f64 {
    slopes(scene, upstream, add).iter().sum()
}

/// Asserts that `ours` equals `expected` up to rounding, in direction, norm and every element.
fn assert_agrees(what: &str, ours: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(ours.len(), expected.len(), "{what}");
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
    let length = norm(&mut expected.iter().copied());
    let error = norm(&mut ours.iter().zip(expected).map(|(&a, b)| f64::from(a) - b));
    let dot: f64 = ours.iter().zip(expected).map(|(&a, b)| f64::from(a) * b).sum();
    let cosine = dot / (length * norm(&mut ours.iter().map(|&a| f64::from(a))));
    println!("{what}: relative error {:.2e}, cosine {cosine:.9}", error / length);
    assert!(length > 0.0, "{what}: nothing to compare");
    assert!(cosine > 0.9999 && error / length < tolerance, "{what}: relative error {}", error / length);
    let largest = expected.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    for (i, (&a, b)) in ours.iter().zip(expected).enumerate() {
        assert!((f64::from(a) - b).abs() < 2.0 * tolerance * largest, "{what}, element {i}: {a} against {b}");
    }
}

/// The classes of parameters: name, first column, one past the last.
fn classes(sh_degree: u8) -> Vec<(&'static str, usize, usize)> {
    let end = column::SH + 3 * sh_coefficients(sh_degree);
    let mut classes = vec![
        ("mean", column::MEAN, column::LOG_SCALE),
        ("log_scale", column::LOG_SCALE, column::QUAT),
        ("quat", column::QUAT, column::OPACITY),
        ("opacity", column::OPACITY, column::SH),
        ("sh_dc", column::SH, column::SH + 3),
    ];
    if sh_degree > 0 {
        classes.push(("sh_rest", column::SH + 3, end));
    }
    classes
}

/// Central differences of every column in use, for the trainable splats.
fn column_slopes(scene: &Scene, upstream: &Upstream) -> Vec<Vec<f64>> {
    let used = column::SH + 3 * sh_coefficients(scene.options.sh_degree);
    (0..used)
        .map(|k| (0..scene.trainable).map(|i| slope(scene, upstream, &|s, x| s.columns[k][i] += x)).collect())
        .collect()
}

/// Central differences of ξ in `camera_from_world ← exp(ξ)·camera_from_world`, one component at a time.
fn pose_slopes(scene: &Scene, upstream: &Upstream) -> Vec<f64> {
    (0..6)
        .map(|k| {
            slope(scene, upstream, &|s, x| {
                let mut axis = DVec3::ZERO;
                axis[k % 3] = x;
                let pose = &mut s.camera.camera_from_world;
                if k < 3 {
                    pose.translation += axis;
                } else {
                    let turn = DQuat::from_scaled_axis(axis);
                    pose.rotation = turn * pose.rotation;
                    pose.translation = turn * pose.translation;
                }
            })
        })
        .collect()
}

/// Central difference of the logarithm of both focal lengths.
fn focal_slope(scene: &Scene, upstream: &Upstream) -> f64 {
    slope(scene, upstream, &|s, x| {
        s.camera.pinhole.fx *= x.exp();
        s.camera.pinhole.fy *= x.exp();
    })
}

fn analytic(isa: Isa, s: &Smooth, upstream: &Upstream) -> (Frame, Gradients) {
    let mut renderer = Renderer::new(isa);
    let part = s.context.as_ref().map(Part::beside);
    let frame = renderer.forward(&s.splats, part.as_slice(), &s.camera, &s.options).clone();
    (frame, renderer.backward(&s.splats, upstream).clone())
}

/// All parameters, the pose and the focal length, on every instruction set.
fn check(name: &str, s: &Smooth, upstream: &Upstream, tolerance: f64) {
    let (columns, pose) = (column_slopes(&s.scene, upstream), pose_slopes(&s.scene, upstream));
    let focal = focal_slope(&s.scene, upstream);
    for isa in Isa::available() {
        let (_, gradients) = analytic(isa, s, upstream);
        for (class, from, to) in classes(s.options.sh_degree) {
            let what = format!("{name} {} {class}", isa.name());
            let expected = columns[from..to].concat();
            // If the loss does not depend on a class at all (colour, for a loss of depth), its gradient must be exactly
            // zero.
            if expected.iter().all(|t| t.abs() < 1e-7) {
                assert!(gradients.columns[from..to].iter().flatten().all(|&g| g == 0.0), "{what} should be zero");
            } else {
                assert_agrees(&what, &gradients.columns[from..to].concat(), &expected, tolerance);
            }
        }
        assert_agrees(&format!("{name} {} pose", isa.name()), &gradients.pose, &pose, tolerance);
        assert_agrees(&format!("{name} {} focal length", isa.name()), &[gradients.focal], &[focal], tolerance);
    }
}

/// Measured errors are 1e-6 to 1e-5.
const TOLERANCE: f64 = 1e-4;

#[test]
fn every_parameter_and_the_pose_in_both_modes_and_all_sh_degrees() {
    for antialiased in [false, true] {
        for degree in 0..=3 {
            let s = smooth(|random, camera| (soft(random, camera, 13, degree), None), options(antialiased, degree));
            check(&format!("antialiased {antialiased} degree {degree}"), &s, &s.upstream, TOLERANCE);
        }
    }
}

#[test]
fn fewer_sh_degrees_in_use_than_stored() {
    let s = smooth(|random, camera| (soft(random, camera, 9, 3), None), options(false, 1));
    check("degree 1 of 3", &s, &s.upstream, TOLERANCE);
}

#[test]
fn every_plane_alone() {
    for antialiased in [false, true] {
        let s = smooth(|random, camera| (soft(random, camera, 11, 1), None), options(antialiased, 1));
        let zeros = |plane: &[f32]| vec![0.0; plane.len()];
        let Upstream { colour, transmittance, depth, trainable_alpha } = s.upstream.clone();
        for (name, upstream) in [
            ("colour", Upstream { colour: colour.clone(), ..Upstream::default() }),
            ("transmittance", Upstream { colour: zeros(&colour), transmittance, ..Upstream::default() }),
            ("depth", Upstream { colour: zeros(&colour), depth, ..Upstream::default() }),
            ("trainable alpha", Upstream { colour: zeros(&colour), trainable_alpha, ..Upstream::default() }),
        ] {
            check(&format!("{name} alone, antialiased {antialiased}"), &s, &upstream, TOLERANCE);
        }
    }
}

#[test]
fn an_empty_plane_of_the_upstream_is_zero() {
    let s = smooth(|random, camera| (soft(random, camera, 11, 1), None), options(false, 1));
    let area = s.upstream.depth.len();
    for isa in Isa::available() {
        let empty = Upstream { colour: Vec::new(), ..s.upstream.clone() };
        let zero = Upstream { colour: vec![0.0; 3 * area], ..s.upstream.clone() };
        assert_eq!(analytic(isa, &s, &empty).1.columns, analytic(isa, &s, &zero).1.columns, "{}", isa.name());
    }
}

#[test]
fn clamped_values() {
    // Opaque stacks (α clamped, early stop), a Jacobian clamped to the cone, colours clamped at zero.
    for antialiased in [false, true] {
        let fill = |random: &mut Random, camera: &Camera| {
            let mut splats = soft(random, camera, 5, 1);
            for n in 0..6 {
                let pixel = [random.range(8.0, 30.0), random.range(6.0, 20.0)];
                let mut opaque = random.splat(camera, pixel, 2.0 + 0.4 * n as f32, 5.0);
                opaque.opacity_logit = random.range(4.0, 9.0);
                splats.push(&opaque);
            }
            for side in [-14.0, 52.0] {
                let mut outside = random.splat(camera, [side, 13.0], 3.0, 9.0);
                outside.opacity_logit = 2.0;
                splats.push(&outside);
            }
            let mut dark = random.splat(camera, [10.0, 10.0], 1.4, 4.0);
            dark.sh[0] = [-3.0, 1.0, -3.0];
            splats.push(&dark);
            (splats, None)
        };
        let s = smooth(fill, options(antialiased, 1));
        let image = s.scene.render();
        let stopped = image.transmittance.iter().filter(|&&t| t < 2e-3).count();
        assert!(stopped > 20, "the scene must be opaque somewhere, {stopped}");
        check(&format!("clamped values, antialiased {antialiased}"), &s, &s.upstream, TOLERANCE);
    }
}

#[test]
fn trainable_splats_among_a_frozen_context() {
    for antialiased in [false, true] {
        let fill = |random: &mut Random, camera: &Camera| {
            let own = soft(random, camera, 7, 1);
            (own, Some(soft(random, camera, 6, 1)))
        };
        let s = smooth(fill, options(antialiased, 1));
        let columns = column_slopes(&s.scene, &s.upstream);
        for isa in Isa::available() {
            let (_, gradients) = analytic(isa, &s, &s.upstream);
            for (class, from, to) in classes(1) {
                let what = format!("with context {} {class}", isa.name());
                assert_agrees(&what, &gradients.columns[from..to].concat(), &columns[from..to].concat(), TOLERANCE);
            }
        }
    }
}

#[test]
fn screen_gradients_and_weights() {
    for antialiased in [false, true] {
        let s = smooth(|random, camera| (soft(random, camera, 13, 0), None), options(antialiased, 0));
        let n = s.splats.len();
        let weight = s.scene.render().weight;
        let (mut screen, mut screen_abs) = (Vec::new(), Vec::new());
        for i in 0..n {
            let [x, y] = [DVec2::X, DVec2::Y].map(|axis| slopes(&s.scene, &s.upstream, &|s, d| s.shift[i] += d * axis));
            let length = |f: fn(f64) -> f64| {
                let sum = |v: &[f64]| v.iter().map(|&v| f(v)).sum::<f64>();
                sum(&x).hypot(sum(&y))
            };
            screen.push(length(|v| v));
            screen_abs.push(length(f64::abs));
        }
        for isa in Isa::available() {
            let (_, gradients) = analytic(isa, &s, &s.upstream);
            assert_agrees(&format!("{} screen", isa.name()), &gradients.screen_gradient, &screen, TOLERANCE);
            assert_agrees(
                &format!("{} screen_abs", isa.name()),
                &gradients.screen_gradient_abs,
                &screen_abs,
                TOLERANCE,
            );
            assert_agrees(&format!("{} weight", isa.name()), &gradients.weight, &weight, TOLERANCE);
        }
    }
}

#[test]
fn the_comparison_detects_a_moved_splat() {
    // Moving a splat by a twentieth of a pixel must exceed the tolerance.
    let s = smooth(|random, camera| (soft(random, camera, 9, 0), None), options(false, 0));
    let columns = column_slopes(&s.scene, &s.upstream);
    let mut moved = Smooth { splats: s.splats.clone(), context: None, upstream: s.upstream.clone(), ..s };
    moved.splats.columns_mut()[column::MEAN][0] += 0.005;
    let (_, gradients) = analytic(Isa::detect(), &moved, &moved.upstream);
    let (ours, expected) = (gradients.columns[..3].concat(), columns[..3].concat());
    let error = |ours: &[f32]| -> f64 {
        let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
        norm(&mut ours.iter().zip(&expected).map(|(&a, b)| f64::from(a) - b)) / norm(&mut expected.iter().copied())
    };
    assert!(error(&ours) > TOLERANCE, "a moved splat is within the tolerance: {}", error(&ours));
}
