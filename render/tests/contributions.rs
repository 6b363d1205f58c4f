//! Contributions of splats against renders with and without them.

mod reference;

use reference::{Random, camera};
use render::cpu::Renderer;
use render::{Contributions, Options, Part};
use scene::{Camera, Splats, column};

const AREA: usize = 37 * 26;
const OPTIONS: Options =
    Options { antialiased: false, sh_degree: 3, background: [0.2, 0.4, 0.1], extras: false, inverse_depth: false };

fn splats(seed: u64, count: usize) -> (Splats, Camera) {
    let camera = camera(37, 26, 40.0);
    let mut random = Random(seed);
    let mut splats = Splats::new(1);
    for _ in 0..count {
        let pixel = [random.range(-4.0, 41.0), random.range(-4.0, 30.0)];
        let (z, sigma) = (random.range(1.5, 6.0), random.range(0.6, 5.0));
        splats.push(&random.splat(&camera, pixel, z, sigma));
    }
    (splats, camera)
}

/// Random pixel weights, 0 to 1.
fn weights(seed: u64) -> Vec<f32> {
    Random(seed).plane(AREA).iter().map(|value| value.abs().min(1.0)).collect()
}

fn contributions(splats: &Splats, context: Option<&Splats>, camera: &Camera, weights: &[f32]) -> Contributions {
    let mut renderer = Renderer::default();
    renderer.forward(splats, context.map(Part::beside).as_slice(), camera, &OPTIONS);
    renderer.contributions(weights).clone()
}

#[test]
fn energy_is_the_squared_error_of_the_frame_without_the_splat() {
    for seed in 1..4 {
        let ((splats, camera), (context, _)) = (self::splats(seed, 40), self::splats(seed + 50, 10));
        let weights = weights(seed);
        let mut renderer = Renderer::default();
        let mut draw =
            |splats: &Splats| renderer.forward(splats, &[Part::beside(&context)], &camera, &OPTIONS).colour.clone();
        let all = draw(&splats);
        let computed = contributions(&splats, Some(&context), &camera, &weights).energy;
        assert_eq!(computed.len(), splats.len());
        let mut significant = 0;
        for i in 0..splats.len() {
            let pairs = all.iter().zip(draw(&splats.filter(|k| k != i))).enumerate();
            let energy: f64 = pairs.map(|(k, (a, b))| f64::from(weights[k % AREA]) * f64::from(a - b).powi(2)).sum();
            assert!(
                (energy - f64::from(computed[i])).abs() < 1e-4 + 1e-3 * energy,
                "{seed} {i}: {energy} {}",
                computed[i]
            );
            significant += usize::from(energy > 0.1);
        }
        assert!(significant > 10, "the scene has too few significant splats");
    }
}

#[test]
fn weights_sum_to_the_covered_pixels() {
    let ((splats, camera), weights) = (splats(7, 40), weights(7));
    let computed = contributions(&splats, None, &camera, &weights).weight;
    let mut renderer = Renderer::default();
    let rest = &renderer.forward(&splats, &[], &camera, &OPTIONS).transmittance;
    let covered: f64 = rest.iter().zip(&weights).map(|(rest, weight)| f64::from((1.0 - rest) * weight)).sum();
    let sum: f64 = computed.iter().map(|weight| f64::from(*weight)).sum();
    assert!((sum / covered - 1.0).abs() < 1e-4, "{sum} {covered}");
}

#[test]
fn squared_is_energy_without_the_falloff() {
    let ((splats, camera), weights) = (splats(8, 30), weights(8));
    let mut checked = 0;
    for i in 0..splats.len() {
        let one = splats.filter(|k| k == i);
        let computed = contributions(&one, None, &camera, &weights);
        let mut renderer = Renderer::default();
        let rest = &renderer.forward(&one, &[], &camera, &OPTIONS).transmittance;
        let drawn = || rest.iter().zip(&weights).filter(|(rest, _)| **rest < 1.0);
        let alphas: f64 = drawn().map(|(rest, weight)| f64::from(*weight) * f64::from(1.0 - rest).powi(2)).sum();
        let counted: f64 = drawn().map(|(_, weight)| f64::from(*weight)).sum();
        if counted < 1.0 {
            continue;
        }
        let opacity = 1.0 / (1.0 + (-f64::from(one.col(column::OPACITY)[0])).exp());
        let expected = f64::from(computed.energy[0]) / alphas * opacity * opacity * counted;
        assert!(
            (f64::from(computed.squared[0]) / expected - 1.0).abs() < 1e-3,
            "{i}: {} {expected}",
            computed.squared[0]
        );
        checked += 1;
    }
    assert!(checked > 10);
}

#[test]
fn contributions_do_not_depend_on_threads_or_on_earlier_views() {
    let (splats, camera) = splats(9, 200);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| contributions(&splats, None, &camera, &[]))
    };
    let (one, three) = (run(1), run(3));
    assert_eq!((&one.energy, &one.squared, &one.weight), (&three.energy, &three.squared, &three.weight));
    assert!(one.energy.iter().any(|value| *value > 0.0));
    let mut renderer = Renderer::default();
    renderer.forward(&splats, &[], &camera, &OPTIONS);
    renderer.contributions(&[]);
    let mut away = camera;
    away.camera_from_world.translation.z -= 100.0;
    renderer.forward(&splats, &[], &away, &OPTIONS);
    let nothing = renderer.contributions(&[]);
    assert!(nothing.weight.iter().chain(&nothing.squared).chain(&nothing.energy).all(|value| *value == 0.0));
}
