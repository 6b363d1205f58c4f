//! Runs a detector on pictures.

#[cfg(test)]
mod expected;

use std::sync::Arc;

use rten::{Model, RunOptions, ThreadPool, Value};
use scene::BadInput;

use crate::Picture;
use crate::boxes::{Detection, suppressed};
use crate::card::Card;
use crate::heads::decode;
use crate::network::{Shapes, load, without_panic};
use crate::placed::place;

const ADVICE: &str = "give a detector as an ONNX file of fixed sizes with a model card that fits, see plat eval --help";

/// A network that finds objects in pictures.
pub struct Detector {
    file: String,
    model: Model,
    card: Card,
    /// Bytes of the ONNX file: nearly all are weights.
    bytes: usize,
    /// `None`: those that all networks of the process share.
    threads: Option<Arc<ThreadPool>>,
}

/// What running a detector on one picture takes, estimated from its size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    /// CPU seconds on a core with AVX2; one with AVX-512 takes half.
    pub cpu_seconds: f64,
    /// Memory, bytes, with that of the network.
    pub memory_bytes: u64,
}

/// Pixels of the input that share an evaluation of a weight, on average: a network has most weights where its maps are small.
/// It is 290 to 300 for YOLOX nano and x and for YOLOv8n, by the multiply-adds that their authors state.
const PIXELS_PER_USE: f64 = 300.0;
/// CPU seconds of a multiply-add, and of all else that a picture takes (docs/decisions/0079).
const SECONDS_PER_MULTIPLY: f64 = 0.04e-9;
const SECONDS_PER_PICTURE: f64 = 0.03;
/// Bytes of intermediate maps per pixel of the input.
const BYTES_PER_PIXEL: u64 = 200;

impl Detector {
    /// Loads a detector from the bytes of its ONNX file; `card` is the text of the TOML file beside it, if there is
    /// one.
    ///
    /// # Errors
    /// Bytes that are no ONNX graph, or one that does not fit its card.
    pub fn load(file: &str, bytes: Vec<u8>, card: Option<&str>) -> Result<Self, BadInput> {
        let bad = |problem: String| BadInput::new(file, problem, ADVICE);
        let size = bytes.len();
        let model = load(bytes).map_err(bad)?;
        let card = Card::of(&Shapes::of(&model), card).map_err(bad)?;
        Ok(Self { file: file.to_owned(), model, card, bytes: size, threads: None })
    }

    /// The detector with this many threads of its own. Its results are the same.
    #[must_use]
    pub fn on_threads(self, threads: usize) -> Self {
        Self { threads: Some(Arc::new(ThreadPool::with_num_threads(threads))), ..self }
    }

    /// What a picture takes.
    pub fn cost(&self) -> Cost {
        let [width, height] = self.card.input;
        let (pixels, weights) = ((width * height) as f64, self.bytes as f64 / 4.0);
        Cost {
            cpu_seconds: SECONDS_PER_PICTURE + weights * pixels / PIXELS_PER_USE * SECONDS_PER_MULTIPLY,
            memory_bytes: 3 * self.bytes as u64 + (width * height) as u64 * BYTES_PER_PIXEL,
        }
    }

    /// The file that it was loaded from.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// How pictures go in and what comes out.
    pub fn card(&self) -> &Card {
        &self.card
    }

    /// The objects in a picture with at least this score, best first. Of boxes of a class that overlap by more than
    /// the card says the best stays.
    ///
    /// # Errors
    /// A picture without pixels, or a network that cannot be run.
    pub fn detect(&self, picture: &Picture, score: f32) -> Result<Vec<Detection>, BadInput> {
        let bad = |problem: String| BadInput::new(self.file.clone(), problem, ADVICE);
        let Picture { rgb, width, height } = *picture;
        if rgb.is_empty() || rgb.len() != 3 * width * height {
            return Err(bad(format!("is given a picture of {width}×{height} pixels in {} bytes", rgb.len())));
        }
        let (input, placed) = place(picture, &self.card);
        let output = self.raw(input).map_err(bad)?;
        Ok(suppressed(decode(&output, &self.card, &placed, score), self.card.overlap))
    }

    /// The network's output for an input of three planes, as it is.
    ///
    /// # Errors
    /// As [`detect`](Self::detect).
    fn raw(&self, input: Vec<f32>) -> Result<Vec<f32>, String> {
        let [width, height] = self.card.input;
        let run = || {
            let input = Value::from_shape(&[1, 3, height, width], input).map_err(|error| error.to_string())?;
            let options = RunOptions::default().with_thread_pool(self.threads.clone());
            let output = self.model.run_one(input.into(), Some(options)).map_err(|error| error.to_string())?;
            let output = output.into_tensor::<f32>().ok_or("its output is not made of floats")?.into_data();
            let anchors: usize = self.card.grids().map(|(_, [columns, rows])| columns * rows).sum();
            let count = anchors * self.card.head.numbers(self.card.outputs.len(), self.card.bins);
            // A file can declare another shape than its operators give.
            if output.len() != count {
                return Err(format!("its output has {} numbers, not the {count} that it declares", output.len()));
            }
            Ok(output)
        };
        without_panic(run).map_err(|error| format!("cannot be run on a picture ({error})"))
    }
}

#[cfg(test)]
mod tests {
    use super::expected::EXPECTED;
    use super::*;
    use crate::testing::{self, shared};

    /// What a network gives for a picture.
    pub(super) struct Expected {
        /// A file of the shared data, or beside `tests/expected.py`.
        pub(super) network: &'static str,
        /// A photo of KITTI's object benchmark; else the picture of a formula.
        pub(super) photo: Option<&'static str>,
        /// The part of the picture.
        pub(super) columns: std::ops::Range<usize>,
        /// Sum of the magnitudes of the whole output.
        pub(super) sum: f64,
        /// Least score of the boxes.
        pub(super) least: f32,
        /// Some numbers of the output, by place.
        pub(super) raw: &'static [(usize, f32)],
        /// Class, score and corners of all boxes.
        pub(super) boxes: &'static [(usize, f32, [f32; 4])],
    }

    const YOLOX: &str = "detectors/yolox_nano_416.onnx";
    const TINY: &str = "classes = ['a', 'b', 'c']";

    /// A network with its card.
    fn network(name: &str) -> Option<(Vec<u8>, Option<&'static str>)> {
        let bytes: &[u8] = match name {
            "yolov8_tiny.onnx" => include_bytes!("../tests/yolov8_tiny.onnx"),
            "nanodet_tiny.onnx" => include_bytes!("../tests/nanodet_tiny.onnx"),
            shared_one => return Some((std::fs::read(shared(shared_one)?).unwrap(), None)),
        };
        Some((bytes.to_vec(), Some(TINY)))
    }

    /// Rows of three bytes a pixel of these columns, and the height.
    fn picture(photo: Option<&str>, columns: std::ops::Range<usize>) -> Option<(Vec<u8>, usize)> {
        let Some(photo) = photo else {
            let value = |y: usize, x: usize, c: usize| ((x * x * (c + 1) / 30 + y * (3 * c + 2)) % 256) as u8;
            let of_row = |y: usize| columns.clone().flat_map(move |x| (0..3).map(move |c| value(y, x, c)));
            return Some(((0..70).flat_map(of_row).collect(), 70));
        };
        let image = testing::photo(photo)?;
        let of_row = |row: &[u8]| row[3 * columns.start..3 * columns.end].to_vec();
        Some((image.chunks_exact(3 * image.width() as usize).flat_map(of_row).collect(), image.height() as usize))
    }

    #[test]
    fn numbers_and_boxes_are_those_of_onnxruntime() {
        for Expected { network: name, photo, columns, sum, least, raw, boxes } in EXPECTED {
            let Some((bytes, card)) = network(name) else { continue };
            let Some((rgb, height)) = picture(*photo, columns.clone()) else { continue };
            let detector = Detector::load(name, bytes, card).unwrap();
            let picture = Picture { rgb: &rgb, width: columns.len(), height };
            let output = detector.raw(place(&picture, &detector.card).0).unwrap();
            let worst = raw.iter().map(|&(i, value)| (output[i] - value).abs()).fold(0.0, f32::max);
            let total: f64 = output.iter().map(|v| f64::from(v.abs())).sum();
            let found = detector.detect(&picture, *least).unwrap();
            assert_eq!(found.len(), boxes.len(), "{name}, {photo:?}: {found:?}");
            let (mut score_off, mut off) = (0.0f32, 0.0f32);
            for (found, (class, score, corners)) in found.iter().zip(*boxes) {
                assert_eq!(found.class, *class, "{name}, {photo:?}: {found:?}");
                score_off = score_off.max((found.score - score).abs());
                off = found.corners.iter().zip(corners).map(|(a, b)| (a - b).abs()).fold(off, f32::max);
            }
            println!(
                "{name}, {photo:?}: numbers within {worst:.1e}, their sum within {:.1e} of its size; {} boxes: scores \
                 within {score_off:.1e}, corners within {off:.1e} pixels",
                (total - sum).abs() / sum,
                found.len()
            );
            assert!(worst < 1e-3 && (total - sum).abs() < 1e-4 * sum && score_off < 1e-3 && off < 0.02);
        }
    }

    #[test]
    fn what_is_no_detector_is_refused_in_one_line() {
        let no = |bytes: Vec<u8>, card: Option<&str>| {
            let error = Detector::load("net.onnx", bytes, card).err().expect("refused").to_string();
            assert!(error.starts_with("net.onnx") && !error.contains('\n'), "{error}");
            error
        };
        no(Vec::new(), None);
        no(b"not a network".to_vec(), None);
        let (tiny, _) = network("yolov8_tiny.onnx").unwrap();
        let error = no(tiny.clone(), None);
        assert!(error.contains("1×3×64×96 in, 1×7×126 out") && error.contains("nanodet of 80"), "{error}");
        assert!(no(tiny.clone(), Some("head = 'yolox'\nclasses = ['a']")).contains("anchors×6 (yolox of 1 classes)"));
        no(tiny[..1000].to_vec(), Some(TINY));
        let Some((yolox, _)) = network(YOLOX) else { return };
        no(yolox[..1_000_000].to_vec(), None);
        let detector = Detector::load("net.onnx", yolox, None).unwrap();
        for (width, height) in [(0, 0), (2, 1)] {
            assert!(detector.detect(&Picture { rgb: &[0; 3][..3 * width.min(1)], width, height }, 0.3).is_err());
        }
        // The smallest and a thin picture.
        assert!(detector.detect(&Picture { rgb: &[9; 3], width: 1, height: 1 }, 0.3).unwrap().is_empty());
        assert!(detector.detect(&Picture { rgb: &[9; 3000], width: 1000, height: 1 }, 0.3).is_ok());
    }

    #[test]
    fn an_output_of_another_size_than_declared_is_refused() {
        let (bytes, card) = network("yolov8_tiny.onnx").unwrap();
        let mut detector = Detector::load("net.onnx", bytes, card).unwrap();
        detector.card.strides.pop();
        let error = detector.detect(&Picture { rgb: &[9; 3], width: 1, height: 1 }, 0.3).unwrap_err().to_string();
        assert!(error.starts_with("net.onnx") && error.contains("its output has 882 numbers, not the 840"), "{error}");
    }

    #[test]
    fn threads_change_nothing() {
        let (rgb, height) = picture(None, 0..120).unwrap();
        let picture = Picture { rgb: &rgb, width: 120, height };
        for name in ["yolov8_tiny.onnx", "nanodet_tiny.onnx", YOLOX] {
            let Some((bytes, card)) = network(name) else { continue };
            let load = || Detector::load(name, bytes.clone(), card).unwrap();
            let shared = load().detect(&picture, 0.05).unwrap();
            for threads in [1, 2, 5] {
                assert_eq!(load().on_threads(threads).detect(&picture, 0.05).unwrap(), shared, "{name}, {threads}");
            }
        }
    }

    #[test]
    fn a_larger_network_costs_more() {
        let cost = |name: &str| network(name).map(|(bytes, card)| Detector::load(name, bytes, card).unwrap().cost());
        let tiny = cost("yolov8_tiny.onnx").unwrap();
        assert!((0.03..0.031).contains(&tiny.cpu_seconds) && tiny.memory_bytes < 4 << 20, "{tiny:?}");
        let Some(yolox) = cost(YOLOX) else { return };
        assert!((0.05..0.06).contains(&yolox.cpu_seconds) && (40 << 20..60 << 20).contains(&yolox.memory_bytes));
    }

    #[test]
    fn a_panic_of_the_runtime_is_an_error_on_every_thread() {
        let panics = || crate::network::without_panic(|| -> Result<(), String> { panic!("broken graph") });
        let all: Vec<_> = (0..4).map(|_| std::thread::spawn(panics)).collect();
        assert!(all.into_iter().all(|thread| thread.join().unwrap().unwrap_err().contains("panicked")));
    }

    #[test]
    fn mapped_classes_are_suppressed_as_one() {
        let (bytes, _) = network("nanodet_tiny.onnx").unwrap();
        let card = format!("{TINY}\n[map]\na = 'all'\nb = 'all'\nc = 'all'");
        let (rgb, height) = picture(None, 0..120).unwrap();
        let found = |card: &str| {
            let detector = Detector::load("net.onnx", bytes.clone(), Some(card)).unwrap();
            detector.detect(&Picture { rgb: &rgb, width: 120, height }, 0.5).unwrap()
        };
        let (apart, joined) = (found(TINY), found(&card));
        assert!(
            joined.iter().all(|of| of.class == 0) && joined.len() < apart.len(),
            "{} {}",
            joined.len(),
            apart.len()
        );
    }
}
