//! Which objects that a detector finds on photos it still finds on renders: what pruning judges detections by.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use perceive::{Detection, Detector, MAX_MASKED, Picture, kept, masked_share};
use scene::{BadInput, Pixels};
use train::prune::ObjectJudge;

use crate::images::{colour_image, photo_image};

/// Looks at photos and renders with a detector. An object is shown if it would be kept in the figures of
/// [`crate::DetectionReport`]: the same group of classes, and boxes that overlap by half.
pub(crate) struct ShownObjects<'a> {
    detector: &'a Detector,
    /// On the photos of views.
    on_photos: Mutex<BTreeMap<u32, Arc<Vec<Detection>>>>,
}

impl<'a> ShownObjects<'a> {
    pub(crate) fn new(detector: &'a Detector) -> Self {
        Self { detector, on_photos: Mutex::default() }
    }

    /// What the detector finds on a picture of the photo's view, of which most is not masked.
    fn found(&self, rgb: &[u8], photo: &Pixels) -> Result<Vec<Detection>, BadInput> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let mut found = self.detector.detect(&Picture { rgb, width, height }, self.detector.card().score)?;
        found.retain(|of| photo.mask.as_ref().is_none_or(|mask| masked_share(mask, width, of.corners) <= MAX_MASKED));
        Ok(found)
    }

    fn on_photo(&self, view: u32, photo: &Pixels) -> Result<Arc<Vec<Detection>>, BadInput> {
        let mut known = self.on_photos.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = known.get(&view) {
            return Ok(Arc::clone(found));
        }
        let found = Arc::new(self.found(photo_image(photo).as_raw(), photo)?);
        known.insert(view, Arc::clone(&found));
        Ok(found)
    }
}

impl ObjectJudge for ShownObjects<'_> {
    fn shown(&self, view: u32, photo: &Pixels, picture: &[f32]) -> Result<Vec<bool>, String> {
        let shown = || {
            let on_photo = self.on_photo(view, photo)?;
            if on_photo.is_empty() {
                return Ok(Vec::new());
            }
            // Masked pixels are the photo's in both.
            let is_masked = |i: usize| photo.mask.as_ref().is_some_and(|mask| mask[i % mask.len()] < 128);
            let pairs = picture.iter().zip(&photo.rgb).enumerate();
            let filled = pairs.map(|(i, (&of, &byte))| if is_masked(i) { f32::from(byte) / 255.0 } else { of });
            let filled: Vec<f32> = filled.collect();
            let render = colour_image(&filled, photo.width as usize, photo.height as usize);
            Ok(kept(&on_photo, &self.found(render.as_raw(), photo)?, &self.detector.card().classes))
        };
        shown().map_err(|error: BadInput| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::load_detector;

    #[test]
    fn a_photo_shows_its_objects_and_grey_shows_none() {
        const PHOTO: &str = "images_street/kitti_object/image_2/000000.png";
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
        let (detector, photo) = (data.join("detectors/yolox_nano_416.onnx"), data.join(PHOTO));
        if !detector.is_file() || !photo.is_file() {
            println!("skipped: ../shared/data not present");
            return;
        }
        let detector = load_detector(&detector).unwrap();
        let photo = image::open(photo).unwrap().to_rgb8();
        let (width, height) = photo.dimensions();
        let rgb: Vec<u8> = (0..3).flat_map(|channel| photo.pixels().map(move |pixel| pixel.0[channel])).collect();
        let photo = Pixels { width, height, rgb, ..Pixels::default() };
        let judge = ShownObjects::new(&detector);
        let itself: Vec<f32> = photo.rgb.iter().map(|&byte| f32::from(byte) / 255.0).collect();
        let shown = judge.shown(0, &photo, &itself).unwrap();
        assert!(!shown.is_empty() && shown.iter().all(|shown| *shown), "{shown:?}");
        let grey = vec![0.5; itself.len()];
        assert_eq!(judge.shown(0, &photo, &grey).unwrap(), vec![false; shown.len()]);
        // Where all is masked there are no objects.
        let masked = Pixels { mask: Some(vec![0; photo.area()]), ..photo };
        assert!(judge.shown(1, &masked, &grey).unwrap().is_empty());
    }
}
