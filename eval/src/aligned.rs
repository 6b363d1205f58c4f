//! The perception-aligned loss of training and pruning: what a frozen detector sees in renders of windows, against what it sees in the
//! photos.
//!
//! The photo's side is found once for each window, with the network and the size that the render is seen with, and kept. It
//! is not taken from zones: those are boxes of whole photos at mip 0, smoothed over three photos, or from a file,
//! and the loss compares anchor by anchor what the network says of both pictures (equations 4 to 6 of perception-aware 3DGS).
//! Small and masked objects are left out.

use std::sync::{Arc, Mutex, PoisonError};

use dataset::byte_lru::ByteLru;
use perceive::aligned::{Aligned, Targets};
use perceive::gradient::Activations;
use perceive::{MAX_MASKED, masked_share};
use scene::{Pixels, Rect};
use train::PictureLoss;

/// Least side of an object's box, pixels of the window: of smaller ones a detector says little at any mip.
const MIN_SIDE: f32 = 12.0;
/// What is kept of what the detector sees in photos, bytes. An object takes about 7 kB.
const TARGETS_BYTES: usize = 64 << 20;

/// The loss by one detector.
pub struct AlignedLoss {
    network: Aligned,
    state: Mutex<State>,
}

/// What changes from step to step, without an effect on the result.
struct State {
    activations: Activations,
    targets: ByteLru<(u32, u8, Rect), Arc<Targets>>,
}

impl AlignedLoss {
    /// The loss by this detector, which has seen no photo yet.
    pub fn new(network: Aligned) -> Self {
        let targets = ByteLru::new(TARGETS_BYTES);
        Self { network, state: Mutex::new(State { activations: Activations::default(), targets }) }
    }

    /// What the detector sees in the photo of a window.
    fn targets(&self, photo: &Pixels, activations: &mut Activations) -> Result<Targets, String> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let planes: Vec<f32> = photo.rgb.iter().map(|&value| f32::from(value) * (1.0 / 255.0)).collect();
        let targets = self.network.targets(&planes, width, height, activations);
        let mut targets = targets.map_err(|error| error.to_string())?;
        targets.retain(|[left, top, right, bottom]| {
            // The part inside the window.
            let corners = [left.max(0.0), top.max(0.0), right.min(photo.width as f32), bottom.min(photo.height as f32)];
            let side = (corners[2] - corners[0]).min(corners[3] - corners[1]);
            let is_masked = |mask: &Vec<u8>| masked_share(mask, width, corners) > MAX_MASKED;
            side >= MIN_SIDE && !photo.mask.as_ref().is_some_and(is_masked)
        });
        Ok(targets)
    }
}

/// Loss and gradient, if there is anything to compare.
type Compared = Result<Option<(f64, Vec<f32>)>, String>;

impl PictureLoss for AlignedLoss {
    fn evaluate(&self, view: u32, mip: u8, rect: Rect, photo: &Pixels, picture: &[f32]) -> Compared {
        let State { activations, targets: known } = &mut *self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (view, mip, rect);
        let targets = match known.get(&key) {
            Some(targets) => Arc::clone(targets),
            None => {
                let found = Arc::new(self.targets(photo, activations)?);
                known.insert_if_absent(key, Arc::clone(&found), found.bytes());
                found
            }
        };
        if targets.is_empty() {
            return Ok(None);
        }
        let (width, height) = (photo.width as usize, photo.height as usize);
        let loss = self.network.loss(picture, width, height, &targets, activations);
        let loss = loss.map_err(|error| error.to_string())?;
        Ok(loss.total.is_finite().then_some((loss.total, loss.gradient)))
    }
}

#[cfg(test)]
mod tests {
    use perceive::aligned::Weights;

    use super::*;

    const WIDTH: u32 = 90;
    const HEIGHT: u32 = 70;
    const WHOLE: Rect = Rect { x: 0, y: 0, width: WIDTH, height: HEIGHT };

    /// The loss of a small network of random weights.
    fn loss() -> AlignedLoss {
        let onnx = include_bytes!("../../perceive/tests/yolov8_tiny.onnx");
        let card = "classes = ['a', 'b', 'c']\nscore = 0.2";
        AlignedLoss::new(Aligned::new("tiny", onnx, Some(card), Weights::default()).unwrap())
    }

    /// A photo of waves, and planes that differ from it.
    fn photo() -> (Pixels, Vec<f32>) {
        let (width, height) = (WIDTH as usize, HEIGHT as usize);
        let wave = |i: usize| 0.5 + 0.4 * ((i % width) as f32 * 0.11 + (i / width) as f32 * 0.07).sin();
        let rgb: Vec<u8> = (0..3 * width * height).map(|i| (255.0 * wave(i)).round() as u8).collect();
        let planes = (0..).zip(&rgb).map(|(i, &byte)| f32::from(byte) / 255.0 + 0.05 * ((i * 7919 % 97) as f32 / 97.0));
        let planes = planes.collect();
        (Pixels { width: WIDTH, height: HEIGHT, rgb, ..Pixels::default() }, planes)
    }

    #[test]
    fn the_gradient_is_that_of_differences_and_the_photo_has_no_loss() {
        let (loss, (photo, picture)) = (loss(), photo());
        let of = |picture: &[f32]| loss.evaluate(0, 0, WHOLE, &photo, picture).unwrap().expect("objects");
        let itself: Vec<f32> = photo.rgb.iter().map(|&byte| f32::from(byte) * (1.0 / 255.0)).collect();
        assert_eq!(of(&itself).0, 0.0);
        let (value, gradient) = of(&picture);
        assert_eq!(of(&picture), (value, gradient.clone()), "other bits for what is kept");
        let length = gradient.iter().map(|slope| slope * slope).sum::<f32>().sqrt();
        let moved = |by: f32| -> Vec<f32> { picture.iter().zip(&gradient).map(|(x, g)| x + by * g / length).collect() };
        let slope = (of(&moved(1e-2)).0 - of(&moved(-1e-2)).0) / 2e-2;
        println!("loss {value:.4}, slope {slope:.4}, |gradient| {length:.4}");
        assert!(value > 0.0 && (slope - f64::from(length)).abs() < 0.02 * slope.abs(), "{slope} {length}");
    }

    #[test]
    fn masked_and_small_objects_are_left_out() {
        let (loss, (photo, picture)) = (loss(), photo());
        let masked = Pixels { mask: Some(vec![0; photo.area()]), ..photo.clone() };
        assert_eq!(loss.evaluate(0, 0, WHOLE, &masked, &picture), Ok(None));
        // Eight pixels high: no box has twelve inside the window.
        let (width, height) = (WIDTH as usize, 8);
        let strip = |planes: &[f32]| -> Vec<f32> {
            planes.chunks(photo.area()).flat_map(|plane| plane[..width * height].to_vec()).collect()
        };
        let rgb = photo.rgb.chunks(photo.area()).flat_map(|plane| plane[..width * height].to_vec()).collect();
        let low = Pixels { height: 8, rgb, ..photo.clone() };
        let rect = Rect { height: 8, ..WHOLE };
        assert_eq!(loss.evaluate(0, 1, rect, &low, &strip(&picture)), Ok(None));
    }
}
