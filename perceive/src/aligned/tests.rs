//! The whole chain: detectors in `shared/` on street photos.

use std::time::Instant;

use super::*;
use crate::testing::{self, dot, shared};

const DETECTORS: [&str; 2] = ["yolox_nano_416", "fastestdet_352"];

fn detector(name: &str) -> Option<Aligned> {
    let bytes = std::fs::read(shared(&format!("detectors/{name}.onnx"))?).unwrap();
    // Low enough for several objects.
    Some(Aligned::new(name, &bytes, Some("score = 0.25"), Weights::default()).unwrap())
}

/// Three planes of a photo, its width and its height.
fn photo(name: &str) -> Option<(Vec<f32>, usize, usize)> {
    let image = testing::photo(&format!("{name}.png"))?;
    let plane = |channel: usize| image.pixels().map(move |pixel| f32::from(pixel[channel]) / 255.0);
    Some(((0..3).flat_map(plane).collect(), image.width() as usize, image.height() as usize))
}

/// Numbers between -1 and 1.
fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

fn noisy(photo: &[f32], strength: f32, seed: u64) -> Vec<f32> {
    photo.iter().zip(noise(photo.len(), seed)).map(|(x, n)| x + strength * n).collect()
}

#[test]
fn the_photo_has_no_loss_and_the_gradient_leads_back_to_it() {
    for name in DETECTORS {
        let (Some(aligned), Some((photo, width, height))) = (detector(name), photo("000002")) else { return };
        let mut memory = Activations::default();
        let targets = aligned.targets(&photo, width, height, &mut memory).unwrap();
        assert!(!targets.is_empty());
        let itself = aligned.loss(&photo, width, height, &targets, &mut memory).unwrap();
        assert_eq!((itself.total, itself.boxes, itself.classes), (0.0, 0.0, 0.0));
        // Descent from a noisy picture.
        let mut render = noisy(&photo, 0.1, 1);
        let mut losses = Vec::new();
        for _ in 0..20 {
            let loss = aligned.loss(&render, width, height, &targets, &mut memory).unwrap();
            losses.push(loss.total);
            let step = 0.3 / dot(&loss.gradient, &loss.gradient).sqrt() as f32;
            render.iter_mut().zip(&loss.gradient).for_each(|(pixel, slope)| *pixel -= step * slope);
        }
        println!("{name}: {} objects, loss {:.4} to {:.4} in 20 steps", targets.len(), losses[0], losses[19]);
        assert!(losses[0] > 0.01 && losses[19] < 0.5 * losses[0], "{losses:?}");
    }
}

/// Compares the gradient at a noisy picture with differences along noise, along the gradient and between.
fn check_gradient(name: &str, aligned: &Aligned, photo: &[f32], width: usize, height: usize) {
    let mut memory = Activations::default();
    let targets = aligned.targets(photo, width, height, &mut memory).unwrap();
    let render = noisy(photo, 0.05, 1);
    let loss = aligned.loss(&render, width, height, &targets, &mut memory).unwrap();
    let norm = dot(&loss.gradient, &loss.gradient).sqrt();
    let (boxes, classes) = (loss.boxes, loss.classes);
    println!("{name}: {} objects, boxes {boxes:.4}, classes {classes:.4}, |gradient| {norm:.4}", targets.len());
    assert!(!targets.is_empty() && norm > 0.0);
    let mut slope = |direction: &[f32], h: f64| {
        let mut at = |h: f64| {
            let moved: Vec<f32> = render.iter().zip(direction).map(|(x, d)| x + h as f32 * d).collect();
            aligned.loss(&moved, width, height, &targets, &mut memory).unwrap().total
        };
        (at(h) - at(-h)) / (2.0 * h)
    };
    let unit = |direction: &[f32]| -> Vec<f32> {
        let length = dot(direction, direction).sqrt() as f32;
        direction.iter().map(|d| d / length).collect()
    };
    let along = unit(&loss.gradient);
    // Noise alone is nearly orthogonal to the gradient.
    let random: Vec<Vec<f32>> = (2..5).map(|seed| unit(&noise(render.len(), seed))).collect();
    let half = unit(&along.iter().zip(&random[0]).map(|(a, b)| a + b).collect::<Vec<f32>>());
    for direction in random.iter().chain([&half, &along]) {
        let exact = dot(&loss.gradient, direction);
        let by_steps = [1e-1, 1e-2, 1e-3].map(|h| slope(direction, h));
        println!("  {exact:+.6}, by differences {by_steps:.6?}");
        let off = by_steps.iter().map(|slope| (slope - exact).abs()).fold(f64::INFINITY, f64::min);
        assert!(off < 0.02 * exact.abs() + 1e-4 * norm, "{off} of {exact}");
    }
}

#[test]
fn the_gradient_is_that_of_differences() {
    for name in DETECTORS {
        let (Some(aligned), Some((photo, width, height))) = (detector(name), photo("000002")) else { return };
        check_gradient(name, &aligned, &photo, width, height);
    }
}

#[test]
fn so_is_that_of_small_networks_with_the_other_heads() {
    let networks: [(&str, &[u8]); 2] = [
        ("yolov8_tiny", include_bytes!("../../tests/yolov8_tiny.onnx")),
        ("nanodet_tiny", include_bytes!("../../tests/nanodet_tiny.onnx")),
    ];
    for (name, bytes) in networks {
        let card = Some("classes = ['a', 'b', 'c']\nscore = 0.2");
        let aligned = Aligned::new(name, bytes, card, Weights::default()).unwrap();
        let (width, height) = (90, 70);
        // Waves, so that the cells differ.
        let photo: Vec<f32> = (0..3 * width * height)
            .map(|i| 0.5 + 0.4 * ((i % width) as f32 * 0.11 + (i / width) as f32 * 0.07).sin())
            .collect();
        check_gradient(name, &aligned, &photo, width, height);
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let Some(aligned) = detector(DETECTORS[1]) else { return };
    let mut memory = Activations::default();
    let grey = vec![0.5; 3 * 64 * 48];
    let targets = aligned.targets(&grey, 64, 48, &mut memory).unwrap();
    // Nothing to see: no loss, no pass.
    assert!(targets.is_empty());
    let loss = aligned.loss(&grey, 64, 48, &targets, &mut memory).unwrap();
    assert!(loss.total == 0.0 && loss.gradient == vec![0.0; grey.len()]);
    for (numbers, width, height) in [(0, 0, 0), (3 * 64 * 48, 64, 47), (9, usize::MAX, 3)] {
        assert!(aligned.targets(&grey[..numbers], width, height, &mut memory).is_err());
        assert!(aligned.loss(&grey[..numbers], width, height, &targets, &mut memory).is_err());
    }
    assert!(aligned.loss(&grey, 48, 64, &targets, &mut memory).is_err());
    let no = |bytes: &[u8], card: Option<&str>| {
        let error = Aligned::new("net.onnx", bytes, card, Weights::default()).err().expect("refused").to_string();
        assert!(error.starts_with("net.onnx") && !error.contains('\n'), "{error}");
    };
    no(b"", None);
    no(b"not a network", None);
    let Some(path) = shared("detectors/fastestdet_352.onnx") else { return };
    no(&std::fs::read(path).unwrap(), Some("classes = ['car']"));
}

#[test]
fn numbers_that_are_not_finite_give_no_gradient() {
    let (Some(aligned), Some((mut photo, width, height))) = (detector(DETECTORS[0]), photo("000002")) else { return };
    let mut memory = Activations::default();
    let targets = aligned.targets(&photo, width, height, &mut memory).unwrap();
    photo.fill(f32::NAN);
    let loss = aligned.loss(&photo, width, height, &targets, &mut memory).unwrap();
    assert!(loss.gradient.iter().all(|slope| *slope == 0.0));
}

#[test]
fn cost_of_a_step() {
    for name in DETECTORS {
        let (Some(aligned), Some((photo, width, height))) = (detector(name), photo("000002")) else { return };
        let mut memory = Activations::default();
        let targets = aligned.targets(&photo, width, height, &mut memory).unwrap();
        let render = noisy(&photo, 0.05, 1);
        let mut times = Vec::new();
        for _ in 0..if cfg!(debug_assertions) { 3 } else { 40 } {
            let start = Instant::now();
            aligned.loss(&render, width, height, &targets, &mut memory).unwrap();
            times.push(1e3 * start.elapsed().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        println!(
            "{name}: {width}×{height}, {} objects: {:.1} ms a step (median {:.1})",
            targets.len(),
            times[0],
            times[times.len() / 2]
        );
    }
}
