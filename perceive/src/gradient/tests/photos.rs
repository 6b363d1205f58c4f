//! The detectors in `shared/` on a street photo.

use std::time::Instant;

use super::graphs::{noise, rten};
use crate::Picture;
use crate::card::{Card, Head, Written};
use crate::gradient::{Activations, Network};
use crate::placed::place;
use crate::testing::{self, dot, shared};

/// A network's bytes and a photo as its input.
fn detector(name: &str, side: usize, white: f32) -> Option<(Vec<u8>, Vec<f32>)> {
    let bytes = std::fs::read(shared(name)?).unwrap();
    let photo = testing::photo("000001.png")?;
    let picture = Picture { rgb: &photo, width: photo.width() as usize, height: photo.height() as usize };
    let card = Card { input: [side, side], std: [255.0 / white; 3], ..Card::new(Head::Yolox, &Written::default()) };
    Some((bytes, place(&picture, &card).0))
}

const DETECTORS: [(&str, usize, f32); 2] =
    [("detectors/yolox_nano_416.onnx", 416, 255.0), ("detectors/fastestdet_352.onnx", 352, 1.0)];

#[test]
fn detectors_agree_with_rten_and_with_differences() {
    for (name, side, white) in DETECTORS {
        let Some((bytes, input)) = detector(name, side, white) else { return };
        // Equal pixels tie in MaxPool, where there is no derivative.
        let input: Vec<f32> = input.iter().zip(noise(input.len(), 1)).map(|(x, n)| x + 0.02 * white * n).collect();
        let network = Network::load(&bytes).unwrap();
        let mut activations = Activations::default();
        let output = network.forward(&input, &mut activations).to_vec();
        let theirs = rten(&bytes, network.input_shape(), &input);
        let off = output.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        println!("{name}: {:.1} million multiply-adds, off by {off:.1e}", network.work() as f64 / 1e6);
        assert_eq!(output.len(), theirs.len());
        // An evaluation in double precision is off by half of this from ours, by 1e-4 from rten's.
        assert!(off < 1e-4);

        let weights = noise(output.len(), 2);
        let gradient = network.backward(&mut activations, &weights);
        let norm = dot(&gradient, &gradient).sqrt();
        let mut slope = |direction: &[f32], h: f32| {
            let mut at = |h: f32| {
                let moved: Vec<f32> = input.iter().zip(direction).map(|(x, d)| x + h * d).collect();
                dot(network.forward(&moved, &mut activations), &weights)
            };
            (at(h) - at(-h)) / (2.0 * f64::from(h))
        };
        // Along the gradient and along noise of the same length.
        let unit: Vec<f32> = gradient.iter().map(|g| (f64::from(*g) / norm) as f32).collect();
        let random = noise(input.len(), 3);
        let length = dot(&random, &random).sqrt();
        let random: Vec<f32> = random.iter().map(|r| (f64::from(*r) / length) as f32).collect();
        for (kind, direction) in [("its own direction", unit), ("noise", random)] {
            let exact = dot(&gradient, &direction);
            let by_steps = [0.01, 0.001].map(|h| slope(&direction, h * white));
            println!("  along {kind}: {exact:.6}, by differences {by_steps:.6?}");
            let off = by_steps.iter().map(|slope| (slope - exact).abs()).fold(f64::INFINITY, f64::min);
            assert!(off < 0.01 * exact.abs() + 1e-4 * norm, "{off} of {exact}");
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let Some((bytes, input)) = detector(DETECTORS[0].0, DETECTORS[0].1, DETECTORS[0].2) else { return };
    let network = Network::load(&bytes).unwrap();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut activations = Activations::default();
            let output = network.forward(&input, &mut activations).to_vec();
            (network.backward(&mut activations, &output), output)
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn cost_of_a_pass() {
    for (name, side, white) in DETECTORS {
        let Some((bytes, input)) = detector(name, side, white) else { return };
        let network = Network::load(&bytes).unwrap();
        let model = crate::network::load(bytes.clone()).unwrap();
        let mut activations = Activations::default();
        let weights = vec![1.0; network.output_shape().iter().product()];
        let mut least = [f64::INFINITY; 3];
        let mut timed = |which: usize, work: &mut dyn FnMut()| {
            let start = Instant::now();
            work();
            least[which] = least[which].min(1e3 * start.elapsed().as_secs_f64());
        };
        for _ in 0..if cfg!(debug_assertions) { 3 } else { 40 } {
            timed(0, &mut || {
                network.forward(&input, &mut activations);
            });
            timed(1, &mut || drop(network.backward(&mut activations, &weights)));
            timed(2, &mut || {
                let input = rten::Value::from_shape(network.input_shape(), input.clone()).unwrap();
                drop(model.run_one(input.into(), None).unwrap());
            });
        }
        let [forward, backward, theirs] = least;
        println!("{name}: {forward:.1} ms forward, {backward:.1} ms backward; rten {theirs:.1} ms forward");
    }
}
