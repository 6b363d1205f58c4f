//! Runs a detector on pictures.

#[cfg(test)]
mod expected;

use rten::{Model, Value};
use scene::BadInput;

use crate::boxes::{Detection, suppressed};
use crate::card::{Card, Head};
use crate::letterbox::letterbox;
use crate::network::{Shapes, load, without_panic};
use crate::{Picture, yolox};

/// The usual least score of a detection.
pub const SCORE: f32 = 0.3;
/// Largest overlap of two boxes of a class.
const OVERLAP: f32 = 0.45;
const ADVICE: &str = "give a YOLOX network exported to ONNX with fixed sizes and undecoded boxes";

/// A network that finds objects in pictures.
pub struct Detector {
    file: String,
    model: Model,
    card: Card,
}

impl Detector {
    /// Loads a detector from the bytes of its ONNX file; `card` is the text of the TOML file beside it, if there is
    /// one.
    ///
    /// # Errors
    /// Bytes that are no ONNX graph, or one that does not fit its card.
    pub fn load(file: &str, bytes: Vec<u8>, card: Option<&str>) -> Result<Self, BadInput> {
        let bad = |problem: String| BadInput::new(file, problem, ADVICE);
        let model = load(bytes).map_err(bad)?;
        let card = Card::of(&Shapes::of(&model), card).map_err(bad)?;
        Ok(Self { file: file.to_owned(), model, card })
    }

    /// How pictures go in and what comes out.
    pub fn card(&self) -> &Card {
        &self.card
    }

    /// The objects in a picture with at least this score, best first. Of boxes of a class that overlap by more than
    /// 0.45 the best stays.
    ///
    /// # Errors
    /// A picture without pixels, or a network that cannot be run.
    pub fn detect(&self, picture: &Picture, score: f32) -> Result<Vec<Detection>, BadInput> {
        let bad = |problem: String| BadInput::new(self.file.clone(), problem, ADVICE);
        let Picture { rgb, width, height } = *picture;
        if rgb.is_empty() || rgb.len() != 3 * width * height {
            return Err(bad(format!("is given a picture of {width}×{height} pixels in {} bytes", rgb.len())));
        }
        let (input, placed) = letterbox(picture, &self.card);
        let output = self.raw(input).map_err(bad)?;
        let found = match self.card.written.head {
            Head::Yolox => yolox::decode(&output, &self.card, &placed, score),
        };
        Ok(suppressed(found, OVERLAP))
    }

    /// The network's output for a picture as it is: anchors × (5 + classes) numbers.
    ///
    /// # Errors
    /// As [`detect`](Self::detect).
    fn raw(&self, input: Vec<f32>) -> Result<Vec<f32>, String> {
        let [width, height] = self.card.input;
        let run = || {
            let input = Value::from_shape(&[1, 3, height, width], input).map_err(|error| error.to_string())?;
            let output = self.model.run_one(input.into(), None).map_err(|error| error.to_string())?;
            Ok(output.into_tensor::<f32>().ok_or("its output is not made of floats")?.into_data())
        };
        without_panic(run).map_err(|error| format!("cannot be run on a picture ({error})"))
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::expected::{Expected, PHOTOS};
    use super::*;

    fn shared(name: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
        let is_there = path.exists();
        if !is_there {
            println!("skipped: ../shared/data not present");
        }
        is_there.then_some(path)
    }

    fn yolox() -> Option<Detector> {
        let bytes = std::fs::read(shared("detectors/yolox_nano_416.onnx")?).unwrap();
        Some(Detector::load("yolox", bytes, None).unwrap())
    }

    #[test]
    fn numbers_and_boxes_are_those_of_onnxruntime() {
        let Some(detector) = yolox() else { return };
        for Expected { photo, columns, sum, raw, boxes } in PHOTOS {
            let Some(path) = shared(&format!("images_street/kitti_object/image_2/{photo}")) else { return };
            let image = image::open(path).unwrap().to_rgb8();
            let of_row = |row: &[u8]| row[3 * columns.start..3 * columns.end].to_vec();
            let rgb: Vec<u8> = image.chunks_exact(3 * image.width() as usize).flat_map(of_row).collect();
            let picture = Picture { rgb: &rgb, width: columns.len(), height: image.height() as usize };
            let output = detector.raw(letterbox(&picture, &detector.card).0).unwrap();
            let mut worst = 0.0f32;
            for (anchor, numbers) in raw {
                let found = &output[85 * anchor..85 * anchor + 8];
                worst = found.iter().zip(numbers).map(|(a, b)| (a - b).abs()).fold(worst, f32::max);
            }
            let total: f64 = output.iter().map(|v| f64::from(v.abs())).sum();
            let found = detector.detect(&picture, 0.12).unwrap();
            println!("{photo}: raw within {worst:.2e}, sum {total:.4} of {sum:.4}, {} boxes", found.len());
            assert!(worst < 1e-3 && (total - sum).abs() < 1e-4 * sum);
            assert_eq!(found.len(), boxes.len(), "{photo}: {found:?}");
            for (found, (class, score, corners)) in found.iter().zip(boxes) {
                assert!(found.class == *class && (found.score - score).abs() < 1e-3, "{photo}: {found:?}");
                let off = found.corners.iter().zip(corners).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off < 0.5, "{photo}: {found:?} is off by {off} pixels");
            }
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
        let Some(other) = shared("detectors/fastestdet_352.onnx") else { return };
        let error = no(std::fs::read(other).unwrap(), None);
        assert!(error.contains("1×3×352×352 in, 1×85×22×22 out"), "{error}");
        let yolox = || std::fs::read(shared("detectors/yolox_nano_416.onnx").unwrap()).unwrap();
        assert!(no(yolox(), Some("classes = ['car']")).contains("YOLOX of 1 classes"));
        no(yolox()[..1_000_000].to_vec(), None);
        let detector = Detector::load("net.onnx", yolox(), None).unwrap();
        for (width, height) in [(0, 0), (2, 1)] {
            assert!(detector.detect(&Picture { rgb: &[0; 3][..3 * width.min(1)], width, height }, SCORE).is_err());
        }
        // The smallest and a thin picture.
        assert!(detector.detect(&Picture { rgb: &[9; 3], width: 1, height: 1 }, SCORE).unwrap().is_empty());
        assert!(detector.detect(&Picture { rgb: &[9; 3000], width: 1000, height: 1 }, SCORE).is_ok());
    }
}
